-- Makes the view '<type>_events' of a row table: the envelope, then the type's own columns in the order in
-- which the table got them, so that a column added later comes last and none moves. Comments as on the table.
create function make_event_view(p_table text) returns void
language plpgsql set search_path from current as $$
declare
  view_name constant text := p_table || '_events';
  columns text;
  described record;
begin
  select string_agg(quote_ident(attname), ', ' order by attnum) into columns from pg_attribute
    where attrelid = to_regclass(quote_ident(p_table)) and attnum > 0 and not attisdropped
    and attname <> all (array['station', 'source', 'subject', 'time', 'sequence', 'position', 'recorded_at', 'epoch']);
  execute format('create or replace view %I as select event_id(station, epoch, source, %L, sequence) as id, station, '
    'source, cast(%L as text) as type, subject, time, sequence, position, recorded_at, epoch%s from %I',
    view_name, p_table, p_table, ', ' || columns, p_table);
  execute format('comment on view %I is %L',
    view_name, obj_description(to_regclass(quote_ident(p_table)), 'pg_class'));
  for described in
      select attname, col_description(attrelid, attnum) as comment from pg_attribute
      where attrelid = to_regclass(quote_ident(p_table)) and attnum > 0 and not attisdropped
      union all values ('id', 'stream and sequence: the event''s identity'), ('type', 'event type') loop
    execute format('comment on column %I.%I is %L', view_name, described.attname, described.comment);
  end loop;
  execute format('grant select on %I to vian_writer, vian_reader', view_name);
end $$;
