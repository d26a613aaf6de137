-- Roles are shared by a cluster's databases, so they may be there already.
do $$
declare
  wanted text;
begin
  foreach wanted in array array['vian_writer', 'vian_reader'] loop
    if not exists (select from pg_roles where rolname = wanted) then
      execute format('create role %I nologin', wanted);
    end if;
    if not pg_has_role(current_user, wanted, 'member') then
      execute format('grant %I to current_user', wanted);
    end if;
  end loop;
exception when duplicate_object or unique_violation then
  null; -- another database of the cluster made them at the same moment
end $$;
