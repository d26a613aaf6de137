-- A base is permanent. What may change: how far the run below it has come, which only grows, and the position of the
-- segment that begins behind it, which the append that makes the base fills in when it knows it.
create function refuse_rebasing() returns trigger language plpgsql as $$
begin
  if (new.stream_id, new.sequence, new.chain_hash) = (old.stream_id, old.sequence, old.chain_hash)
     and (new.position = old.position or old.position = 0)
     and (new.filled_sequence > old.filled_sequence
          or (new.filled_sequence, new.filled_hash) = (old.filled_sequence, old.filled_hash)) then
    return new;
  end if;
  raise exception '% on % refused: the log is append-only', tg_op, tg_table_name using errcode = 'VA004';
end $$;
