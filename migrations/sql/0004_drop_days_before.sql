-- Retention: drops a row table's partitions of days before p_day, and remembers the day, so that no
-- projector puts older rows back. The number of partitions dropped. The log itself is untouched.
-- Under the projector's lock, so that none is writing such rows now. It waits a little for readers only.
create function drop_days_before(p_table text, p_day date) returns integer
language plpgsql security definer set search_path from current set lock_timeout = '5s' as $$
declare
  partition regclass;
  dropped integer := 0;
begin
  if not exists (select from projections where name = p_table) then
    raise exception 'no row table %', p_table using errcode = 'VA005';
  end if;
  perform from checkpoints where name in ('projector', 'projector:' || p_table) order by name for update;
  update projections set retained_from = p_day where name = p_table and (retained_from is null or retained_from < p_day);
  for partition in select i.inhrelid::regclass from pg_inherits i join pg_class c on c.oid = i.inhrelid
      where i.inhparent = to_regclass(quote_ident(p_table)) and c.relname ~ ('^' || p_table || '_[0-9]{8}$')
      and right(c.relname, 8) < to_char(p_day, 'YYYYMMDD') loop
    execute format('drop table %s', partition);
    dropped := dropped + 1;
  end loop;
  return dropped;
end $$;
