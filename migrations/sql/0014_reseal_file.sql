-- Enters another file in the place of a sealed one: the same segments, some without payload. The one that goes is
-- noted as pending, so that whoever comes after a kill deletes it.
-- Errors: VA006, nothing is changed.
create function reseal_file(
  p_first_position bigint, p_old_path text, p_path text, p_sha256 bytea, p_bytes bigint
) returns void
language plpgsql security definer set search_path from current as $$
declare
  pending text;
begin
  select pending_path into strict pending from archive_head for update;
  if pending is distinct from p_path then
    raise exception 'no sealing of % is planned', p_path using errcode = 'VA006';
  end if;
  update archive_head set is_rewriting = true;
  update sealed_files set path = p_path, sha256 = p_sha256, bytes = p_bytes
    where first_position = p_first_position and path = p_old_path;
  if not found then
    raise exception 'the sealed file % is another one by now', p_old_path using errcode = 'VA006';
  end if;
  update archive_head set is_rewriting = false, pending_path = p_old_path;
end $$;
