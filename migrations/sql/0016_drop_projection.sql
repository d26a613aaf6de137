-- Takes a row table out of the set again, with its views and rows; its events stay in the log.
create or replace function drop_projection(p_table text) returns void
language plpgsql set search_path from current as $$
begin
  delete from projections where name = p_table;
  delete from checkpoints where name = 'projector:' || p_table;
  drop view field_events;
  drop view events;
  perform make_events_view();
  perform make_field_view('events');
  execute format('drop view %I', 'field_' || p_table);
  execute format('drop view %I', p_table || '_events');
  execute format('drop table %I', p_table);
end $$;
