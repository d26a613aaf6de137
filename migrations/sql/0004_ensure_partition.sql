-- Makes sure that a row table has a partition for the day. Only row tables have partitions, so the
-- writer, who may not create tables, can call this for any of them and for nothing else.
-- Attached rather than created in place: attaching does not lock out readers.
-- BRIN in short ranges, so that a minute of one day is found in a few pages; attaching takes these indexes over.
create or replace function ensure_partition(p_table text, p_day date) returns void
language plpgsql security definer set search_path from current as $$
declare
  partition constant text := p_table || '_' || to_char(p_day, 'YYYYMMDD');
  column_name text;
begin
  if not exists (select from projections where name = p_table) then
    raise exception 'no row table %', p_table using errcode = 'VA005';
  end if;
  if to_regclass(quote_ident(partition)) is not null then
    return;
  end if;
  perform pg_advisory_xact_lock(hashtext(partition));
  if to_regclass(quote_ident(partition)) is not null then
    return;
  end if;
  execute format('create table %I (like %I including defaults including constraints including comments)',
    partition, p_table);
  execute format('comment on table %I is %L',
    partition, format('Rows of %s of one day, %s (UTC).', p_table, to_char(p_day, 'YYYY-MM-DD')));
  foreach column_name in array array['time', 'position'] loop
    execute format('create index %I on %I using brin (%I) with (pages_per_range = 16)',
      partition || '_' || column_name, partition, column_name);
  end loop;
  execute format('alter table %I attach partition %I for values from (%L) to (%L)',
    p_table, partition, p_day::timestamp at time zone 'UTC', (p_day + 1)::timestamp at time zone 'UTC');
end $$;
