-- The log is append-only, even for its owner's slip: this trigger refuses every DELETE but the one of seal_segments,
-- which says for itself, in its own transaction only, that it is removing.
create function refuse_removal() returns trigger language plpgsql set search_path from current as $$
begin
  if not (select is_removing from archive_head) then
    raise exception '% on % refused: the log is append-only', tg_op, tg_table_name using errcode = 'VA004';
  end if;
  return null;
end $$;
