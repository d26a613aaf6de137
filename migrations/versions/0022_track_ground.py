"""Track points on the ground: a view, so that psql, BI tools and questions to central have metres too.

Revision: 0022
"""

from importlib.resources import files

from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None

_FUNCTIONS = ("camera_ground", "ground_deviation")

_VIEW = """
create view track_ground as
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
  where k.station = p.station and k.source = p.source and k.time <= p.time and not exists (
    select from scene_changed m
    where m.station = p.station and m.source = p.source and m.cause = 'moved' and m.time > k.time and m.time <= p.time
  )
  order by position desc, sequence desc limit 1
) c on true
left join lateral (
  select width, height from video_added f
  where f.station = p.station and f.source = p.source and f.position <= p.position
  order by position desc, sequence desc limit 1
) v on true
cross join lateral (
  select p.x * a.wide as x, p.y * a.high as y, p.vx * a.wide as vx, p.vy * a.high as vy, (p.y2 - p.y1) * a.high as box
  from (select cast(c.width as double precision) / coalesce(v.width, c.width) as wide,
    cast(c.height as double precision) / coalesce(v.height, c.height) as high) a
) s
cross join lateral (
  select
    %(east)s as east, %(north)s as north, nullif(greatest(%(depth)s, 0), 0) as depth,
    %(east_rate)s as east_rate, %(north_rate)s as north_rate, %(depth_rate)s as depth_rate
) g
"""

_COMMENT = (
    "Track points on the ground, each through the calibration that was valid at its time; "
    "null where there was none. Nothing is stored."
)
_COMMENTS = {
    "ground_x": "m east of the calibration's origin",
    "ground_y": "m north of the calibration's origin",
    "ground_speed": "speed on the ground, m/s",
    "ground_x_deviation": "standard deviation of ground_x, m; null where the calibration says none",
    "ground_y_deviation": "standard deviation of ground_y, m; null likewise",
    "ground_speed_deviation": "standard deviation of ground_speed, m/s; null likewise",
    "calibration_position": "position of the camera_calibrated that it was read through",
}


def upgrade() -> None:
    op.execute(  # functions keep this path
        "select set_config('search_path', current_setting('search_path') || ', pg_temp', true) "
        "where current_setting('search_path') not like '%pg_temp'"
    )
    for name in _FUNCTIONS:
        text = files("migrations").joinpath("sql", f"0022_{name}.sql").read_text(encoding="utf-8")
        op.execute(text.replace(":", r"\:"))
    rows = {name: _row(at, "s.x", "s.y", "1") for at, name in enumerate(("east", "north", "depth"))}
    rates = {f"{name}_rate": _row(at, "s.vx", "s.vy", "0") for at, name in enumerate(("east", "north", "depth"))}
    op.execute(_VIEW % (rows | rates))
    op.execute(f"comment on view track_ground is $${_COMMENT}$$")
    for column, comment in _COMMENTS.items():
        op.execute(f"comment on column track_ground.{column} is $${comment}$$")
    op.execute("grant select on track_ground to vian_writer, vian_reader")
    op.execute(
        "create view field_track_ground with (security_barrier) as select * from track_ground "
        "where station = any (cast((select field_stations()) as text[]))"
    )
    op.execute(f"comment on view field_track_ground is $${_COMMENT}$$")
    op.execute("grant select on field_track_ground to vian_field")


def downgrade() -> None:
    op.execute("drop view field_track_ground")
    op.execute("drop view track_ground")
    for name in reversed(_FUNCTIONS):
        op.execute(f"drop function {name}")


def _row(at: int, x: str, y: str, one: str) -> str:
    """One row of the homography times a column."""
    entries = [f"cast(c.h -> {at} ->> {column} as double precision)" for column in range(3)]
    return " + ".join(f"{entry} * {value}" for entry, value in zip(entries, (x, y, one), strict=True))
