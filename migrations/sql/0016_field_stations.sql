-- The stations whose events the question that this transaction answers may read; none outside of one.
-- What it says was written, before the question, by a role that the question does not have.
create function field_stations() returns text[]
language sql stable security definer parallel restricted set search_path from current as $$
  select coalesce(
    (select coalesce(c.stations, (select array_agg(distinct s.station) from streams s))
       from field_callers c where c.transaction = cast(cast(pg_current_xact_id_if_assigned() as text) as bigint)),
    array[]::text[])
$$;
