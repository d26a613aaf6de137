-- Closes a day of a row table: builds the index for tracks and cameras that is too dear to keep up row
-- by row, and brings the others and the statistics up to date. True if it was open until now. Rows that
-- come later still find their place: they keep the index up themselves.
create function close_partition(p_table text, p_day date) returns boolean
language plpgsql security definer set search_path from current as $$
declare
  partition constant text := p_table || '_' || to_char(p_day, 'YYYYMMDD');
  index_name text;
begin
  if not exists (select from projections where name = p_table) then
    raise exception 'no row table %', p_table using errcode = 'VA005';
  end if;
  perform pg_advisory_xact_lock(hashtext(partition));
  if to_regclass(quote_ident(partition)) is null or to_regclass(quote_ident(partition || '_track')) is not null then
    return false;
  end if;
  execute format('create index %I on %I (source, subject, time)', partition || '_track', partition);
  for index_name in select x.indexrelid::regclass from pg_index x join pg_class c on c.oid = x.indexrelid
      join pg_am a on a.oid = c.relam
      where x.indrelid = to_regclass(quote_ident(partition)) and a.amname = 'brin' loop
    perform brin_summarize_new_values(index_name::regclass);
  end loop;
  execute format('analyze %I', partition);
  return true;
end $$;
