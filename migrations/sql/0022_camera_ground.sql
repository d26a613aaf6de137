-- Where a camera sees a pixel on the ground, m east and north, and how fast what moves there moves, m/s: 4 numbers.
-- Null above the horizon. The camera is focal length px, pitch rad, roll rad, height m; as extractors.calibration has it.
create function camera_ground(
  p_camera double precision[], p_width double precision, p_height double precision,
  p_x double precision, p_y double precision, p_vx double precision, p_vy double precision
) returns double precision[]
language plpgsql immutable strict set search_path from current as $$
declare
  f constant double precision := p_camera[1];
  sin_t constant double precision := sin(p_camera[2]);
  cos_t constant double precision := cos(p_camera[2]);
  sin_r constant double precision := sin(p_camera[3]);
  cos_r constant double precision := cos(p_camera[3]);
  h constant double precision := p_camera[4];
  u constant double precision := cos_r * (p_x - p_width / 2) + sin_r * (p_y - p_height / 2);
  v constant double precision := cos_r * (p_y - p_height / 2) - sin_r * (p_x - p_width / 2);
  u_rate constant double precision := cos_r * p_vx + sin_r * p_vy;
  v_rate constant double precision := cos_r * p_vy - sin_r * p_vx;
  depth constant double precision := cos_t * v + f * sin_t;
  east double precision;
  north double precision;
begin
  if depth <= 0 then
    return null;
  end if;
  east := h * u / depth;
  north := h * (f * cos_t - sin_t * v) / depth;
  return array[
    east, north,
    (h * u_rate - east * cos_t * v_rate) / depth, (-h * sin_t * v_rate - north * cos_t * v_rate) / depth
  ];
end $$;
