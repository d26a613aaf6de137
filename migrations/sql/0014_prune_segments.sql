-- Takes the payloads of segments off the disk; header, hashes, position and time of recording stay. What is gone
-- already, is sealed, or is not there is passed over. Who calls it has recorded it, or records it in the same
-- transaction.
create function prune_segments(p_positions bigint[], out segments bigint, out payload_bytes bigint)
language plpgsql security definer set search_path from current as $$
begin
  update archive_head set is_rewriting = true;
  with going as materialized (
    select g.position, octet_length(g.payload) as size from segments g
      where g.position = any(p_positions) and g.payload is not null order by g.position for update
  ), gone as (
    update segments g set payload = null from going where g.position = going.position returning going.size
  )
  select count(*), coalesce(sum(size), 0) into segments, payload_bytes from gone;
  update archive_head set is_rewriting = false;
end $$;
