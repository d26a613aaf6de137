-- Takes a table into the set of row tables: the writer may fill it, the reader may read it.
create function adopt_projection(p_table text) returns void
language plpgsql set search_path from current as $$
begin
  insert into projections (name) values (p_table) on conflict do nothing;
  execute format('grant select, insert, delete on %I to vian_writer', p_table);
  execute format('grant select on %I to vian_reader', p_table);
end $$;
