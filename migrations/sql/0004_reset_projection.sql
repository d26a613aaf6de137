-- Empties a row table, and has the projector fill it again from the beginning of the log, beside its
-- other work: the checkpoint 'projector:<type>' says how far it has come, and is there until it is done.
-- p_retained_from: first day whose rows are wanted, or null for all. It waits a little for readers only.
create function reset_projection(p_table text, p_retained_from date) returns void
language plpgsql security definer set search_path from current set lock_timeout = '5s' as $$
declare
  partition regclass;
begin
  if not exists (select from projections where name = p_table) then
    raise exception 'no row table %', p_table using errcode = 'VA005';
  end if;
  perform from checkpoints where name in ('projector', 'projector:' || p_table) order by name for update;
  update projections set retained_from = p_retained_from where name = p_table;
  for partition in select inhrelid::regclass from pg_inherits where inhparent = to_regclass(quote_ident(p_table)) loop
    execute format('drop table %s', partition);
  end loop;
  insert into checkpoints (name, position, state)
    select 'projector:' || p_table, 0, '' from log_head where position > 0
    on conflict (name) do update set position = 0, saved_at = now();
end $$;
