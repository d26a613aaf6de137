-- Makes the view 'field_<name>' of a row table, or of all events: those rows of the stations that the question may read.
-- A security barrier: nothing that a question says is evaluated on a row before the row is known to be one of them.
create function make_field_view(p_name text) returns void
language plpgsql set search_path from current as $$
declare
  view_name constant text := 'field_' || p_name;
  source constant text := case p_name when 'events' then p_name else p_name || '_events' end;
begin
  execute format('create or replace view %I with (security_barrier) as select * from %I '
    'where station = any (cast((select field_stations()) as text[]))', view_name, source);
  execute format('comment on view %I is %L',
    view_name, obj_description(to_regclass(quote_ident(source)), 'pg_class'));
  execute format('grant select on %I to vian_field', view_name);
end $$;
