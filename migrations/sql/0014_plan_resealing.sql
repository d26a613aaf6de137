-- Says which file a sealed one will be written anew in, before it is written: so whoever comes after a kill knows
-- what may lie there half-written.
create function plan_resealing(p_path text) returns void
language plpgsql security definer set search_path from current as $$
declare
  pending text;
begin
  select pending_path into strict pending from archive_head for update;
  if pending is not null then
    raise exception 'the sealing of % has not ended', pending using errcode = 'VA006';
  end if;
  update archive_head set pending_path = p_path;
end $$;
