-- The log is append-only, even for its owner's slip: this trigger refuses UPDATE, DELETE and TRUNCATE.
create function refuse_change() returns trigger language plpgsql as $$
begin
  raise exception '% on % refused: the log is append-only', tg_op, tg_table_name using errcode = 'VA004';
end $$;
