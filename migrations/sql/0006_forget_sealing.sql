-- Takes back a plan whose file has been deleted.
create function forget_sealing(p_path text) returns void
language sql security definer set search_path from current as $$
  update archive_head set pending_path = null, pending_position = null where pending_path = p_path
$$;
