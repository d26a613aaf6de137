-- Standard deviation of a track point's place on the ground ('x', 'y': m) or of its speed there ('speed': m/s), to
-- first order: from the camera's covariance and from the noise of a foot in the picture, which is a share of its box.
-- Null where the camera or its covariance is not known, and near the horizon.
create function ground_deviation(
  p_what text, p_camera double precision[], p_covariance jsonb, p_width double precision, p_height double precision,
  p_x double precision, p_y double precision, p_vx double precision, p_vy double precision, p_box double precision
) returns double precision
language plpgsql immutable strict set search_path from current as $$
declare
  foot constant double precision := 0.04 * p_box;
  velocity constant double precision := 0.08 * p_box;
  here constant double precision[] := camera_ground(p_camera, p_width, p_height, p_x, p_y, p_vx, p_vy);
  steps constant double precision[] := array[1e-4 * p_camera[1], 1e-4, 1e-4, 1e-4 * p_camera[4]];
  noise constant double precision[] := array[foot, foot, velocity, velocity];
  point constant double precision[] := array[p_x, p_y, p_vx, p_vy];
  directions double precision[];
  by_camera double precision[];
  ahead double precision[];
  behind double precision[];
  along double precision;
  variance double precision := 0;
  speed double precision;
begin
  if here is null or array_position(p_camera, null) is not null then
    return null;
  end if;
  speed := sqrt(here[3] * here[3] + here[4] * here[4]);
  -- Of which of the four numbers the variance is wanted; of a speed of nought, the mean of both directions.
  directions := case
    when p_what = 'x' then array[[1, 0, 0, 0]]
    when p_what = 'y' then array[[0, 1, 0, 0]]
    when speed > 0 then array[[0, 0, here[3] / speed, here[4] / speed]]
    else array[[0, 0, sqrt(0.5), 0], [0, 0, 0, sqrt(0.5)]]
  end;
  for d in 1 .. array_length(directions, 1) loop
    by_camera := '{}';
    for i in 1 .. 4 loop
      ahead := p_camera;
      behind := p_camera;
      ahead[i] := ahead[i] + steps[i];
      behind[i] := behind[i] - steps[i];
      ahead := camera_ground(ahead, p_width, p_height, p_x, p_y, p_vx, p_vy);
      behind := camera_ground(behind, p_width, p_height, p_x, p_y, p_vx, p_vy);
      along := 0;
      for k in 1 .. 4 loop
        along := along + directions[d][k] * (ahead[k] - behind[k]) / (2 * steps[i]);
      end loop;
      by_camera := by_camera || along;
      ahead := point;
      behind := point;
      ahead[i] := ahead[i] + noise[i] / 2;
      behind[i] := behind[i] - noise[i] / 2;
      ahead := camera_ground(p_camera, p_width, p_height, ahead[1], ahead[2], ahead[3], ahead[4]);
      behind := camera_ground(p_camera, p_width, p_height, behind[1], behind[2], behind[3], behind[4]);
      along := 0;
      for k in 1 .. 4 loop
        along := along + directions[d][k] * (ahead[k] - behind[k]);
      end loop;
      variance := variance + along * along;
    end loop;
    for i in 1 .. 4 loop
      for k in 1 .. 4 loop
        variance := variance + by_camera[i] * cast(p_covariance -> (i - 1) ->> (k - 1) as double precision) * by_camera[k];
      end loop;
    end loop;
  end loop;
  return sqrt(variance);
end $$;
