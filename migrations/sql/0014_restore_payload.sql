-- Puts a segment's payload back, where it is gone or damaged: only the bytes that the segment's hash names.
-- Errors: VA008 it is none of these bytes, or there is no such segment outside of sealed files.
create function restore_payload(p_position bigint, p_payload bytea) returns void
language plpgsql security definer set search_path from current as $$
begin
  update archive_head set is_rewriting = true;
  update segments set payload = p_payload where position = p_position and payload_hash = sha256(p_payload);
  if not found then
    raise exception 'position % does not take a payload with the hash %', p_position, encode(sha256(p_payload), 'hex')
      using errcode = 'VA008';
  end if;
  update archive_head set is_rewriting = false;
end $$;
