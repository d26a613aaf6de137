-- The log is append-only, even for its owner's slip: this trigger refuses every UPDATE but those of prune_segments,
-- restore_payload, repair_segments and reseal_file, which say for themselves, in their own transaction only, that
-- they are rewriting.
create function refuse_rewriting() returns trigger language plpgsql set search_path from current as $$
begin
  if not (select is_rewriting from archive_head) then
    raise exception '% on % refused: the log is append-only', tg_op, tg_table_name using errcode = 'VA004';
  end if;
  return null;
end $$;
