-- Track points on the ground. Of the calibrations that are valid at a point's time the one that was said last counts;
-- where none is, the first that people gave of the same view, and no move of the camera ever lies between. A point's
-- frame has the size that its source's videos had when it was said; before the first of them that of the first.
create or replace view track_ground as
select p.station, p.source, p.subject, p.time, p.sequence, p.position, p.track_id, p.frame, p.x, p.y,
  g.east / g.depth as ground_x, g.north / g.depth as ground_y,
  sqrt(
    power((g.east_rate - g.east / g.depth * g.depth_rate) / g.depth, 2)
    + power((g.north_rate - g.north / g.depth * g.depth_rate) / g.depth, 2)
  ) as ground_speed,
  ground_deviation('x', c.camera, c.covariance, c.width, c.height, s.x, s.y, s.vx, s.vy, s.box) as ground_x_deviation,
  ground_deviation('y', c.camera, c.covariance, c.width, c.height, s.x, s.y, s.vx, s.vy, s.box) as ground_y_deviation,
  ground_deviation('speed', c.camera, c.covariance, c.width, c.height, s.x, s.y, s.vx, s.vy, s.box)
    as ground_speed_deviation,
  c.position as calibration_position
from track_point p
left join lateral (
  select position, width, height, homography as h, covariance, array[focal_px, pitch_rad, roll_rad, height_m] as camera
  from camera_calibrated k
  where k.station = p.station and k.source = p.source and (k.time <= p.time or k.covariance is null) and not exists (
    select from scene_changed m
    where m.station = p.station and m.source = p.source and m.cause = 'moved'
      and m.time > least(k.time, p.time) and m.time <= greatest(k.time, p.time)
  )
  order by k.time <= p.time desc,
    case when k.time <= p.time then position else -position end desc,
    case when k.time <= p.time then sequence else -sequence end desc
  limit 1
) c on true
left join lateral (
  select width, height from video_added f
  where f.station = p.station and f.source = p.source and f.position <= p.position
  order by position desc, sequence desc limit 1
) v on true
left join lateral (
  select width, height from video_added f
  where v.width is null and f.station = p.station and f.source = p.source
  order by position, sequence limit 1
) later on true
cross join lateral (
  select p.x * a.wide as x, p.y * a.high as y, p.vx * a.wide as vx, p.vy * a.high as vy, (p.y2 - p.y1) * a.high as box
  from (select cast(c.width as double precision) / coalesce(v.width, later.width, c.width) as wide,
    cast(c.height as double precision) / coalesce(v.height, later.height, c.height) as high) a
) s
cross join lateral (
  select
    cast(c.h -> 0 ->> 0 as double precision) * s.x
      + cast(c.h -> 0 ->> 1 as double precision) * s.y
      + cast(c.h -> 0 ->> 2 as double precision) as east,
    cast(c.h -> 1 ->> 0 as double precision) * s.x
      + cast(c.h -> 1 ->> 1 as double precision) * s.y
      + cast(c.h -> 1 ->> 2 as double precision) as north,
    nullif(greatest(
      cast(c.h -> 2 ->> 0 as double precision) * s.x
      + cast(c.h -> 2 ->> 1 as double precision) * s.y
      + cast(c.h -> 2 ->> 2 as double precision)
    , 0), 0) as depth,
    cast(c.h -> 0 ->> 0 as double precision) * s.vx
      + cast(c.h -> 0 ->> 1 as double precision) * s.vy as east_rate,
    cast(c.h -> 1 ->> 0 as double precision) * s.vx
      + cast(c.h -> 1 ->> 1 as double precision) * s.vy as north_rate,
    cast(c.h -> 2 ->> 0 as double precision) * s.vx
      + cast(c.h -> 2 ->> 1 as double precision) * s.vy as depth_rate
) g
