-- Says that the sealed files lie elsewhere now; the caller has read all of them there.
create function relocate_archive(p_location text) returns void
language sql security definer set search_path from current as $$
  update archive_head set location = p_location
$$;
