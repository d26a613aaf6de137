-- Makes the view 'events': the envelope of every row table's events.
create function make_events_view() returns void
language plpgsql set search_path from current as $$
declare
  selects text;
  described record;
begin
  select string_agg(format('select event_id(station, epoch, source, %L, sequence) as id, station, source, '
    'cast(%L as text) as type, subject, time, sequence, position, recorded_at, epoch from %I', name, name, name),
    ' union all ' order by name) into selects from projections;
  execute 'create or replace view events as ' || selects;
  comment on view events is 'Every event that has a row, of all types: the envelope. The types'' own columns: <type>_events.';
  for described in select * from (values
      ('id', 'stream and sequence: the event''s identity'),
      ('station', 'station that recorded it'),
      ('source', 'camera or sensor'),
      ('type', 'event type'),
      ('subject', 'what it is about'),
      ('time', 'when it happened (UTC)'),
      ('sequence', 'place in its stream'),
      ('position', 'position of its segment in this log'),
      ('recorded_at', 'when this log took it (UTC)'),
      ('epoch', 'life of the station''s log, from 1')) as c (name, comment) loop
    execute format('comment on column events.%I is %L', described.name, described.comment);
  end loop;
  grant select on events to vian_writer, vian_reader;
end $$;
