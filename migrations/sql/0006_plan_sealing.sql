-- Says which file the next range of the log will be sealed in, before the file is written: so whoever comes
-- after a kill knows what may lie there half-written.
create function plan_sealing(p_location text, p_path text, p_last_position bigint) returns void
language plpgsql security definer set search_path from current as $$
declare
  head archive_head;
begin
  select * into strict head from archive_head for update;
  if head.pending_path is not null then
    raise exception 'the sealing of % has not ended', head.pending_path using errcode = 'VA006';
  end if;
  if p_last_position <= head.sealed_position or p_last_position > (select position from log_head) then
    raise exception 'positions % to % cannot be sealed', head.sealed_position + 1, p_last_position
      using errcode = 'VA006';
  end if;
  if head.location <> p_location and head.sealed_position > 0 then
    raise exception 'the archive is at %, not at %', head.location, p_location using errcode = 'VA006';
  end if;
  update archive_head
    set location = p_location, pending_path = p_path, pending_position = p_last_position;
end $$;
