-- Takes a table into the set of row tables: the writer may fill it, the reader may read it, it has its views,
-- that of questions from the field too, and events that the log holds already get their rows. Called again,
-- it brings the type's views up to date.
create or replace function adopt_projection(p_table text) returns void
language plpgsql set search_path from current as $$
declare
  is_new boolean;
begin
  insert into projections (name) values (p_table) on conflict do nothing;
  is_new := found;
  execute format('alter table %I add column if not exists epoch integer not null default 1', p_table);
  execute format('comment on column %I.epoch is %L', p_table, 'life of the station''s log, from 1');
  execute format('grant select, insert on %I to vian_writer', p_table);
  execute format('revoke update, delete, truncate on %I from vian_writer', p_table);
  execute format('grant select on %I to vian_reader', p_table);
  perform make_event_view(p_table);
  perform make_field_view(p_table);
  if is_new then
    perform make_events_view();
    insert into checkpoints (name, position, state)
      select 'projector:' || p_table, 0, '' from log_head where position > 0 on conflict do nothing;
  end if;
end $$;
