-- Has the BRIN indexes of a row table's open days know the rows that came since the last time; without it,
-- or a vacuum, every query looks at all of those. Nobody waits for it.
create function summarize_days(p_table text) returns void
language plpgsql security definer set search_path from current as $$
begin
  if not exists (select from projections where name = p_table) then
    raise exception 'no row table %', p_table using errcode = 'VA005';
  end if;
  perform brin_summarize_new_values(x.indexrelid) from pg_inherits i
    join pg_class c on c.oid = i.inhrelid
    join pg_index x on x.indrelid = c.oid
    join pg_class b on b.oid = x.indexrelid
    join pg_am a on a.oid = b.relam
    where i.inhparent = to_regclass(quote_ident(p_table)) and a.amname = 'brin'
    and to_regclass(quote_ident(c.relname || '_track')) is null;
end $$;
