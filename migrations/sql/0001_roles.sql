-- Roles are shared by a cluster's databases, so they may be there already.
do $$
declare
  wanted text;
begin
  foreach wanted in array array['vian_writer', 'vian_reader'] loop
    begin
      if not exists (select from pg_roles where rolname = wanted) then
        execute format('create role %I nologin', wanted);
      end if;
    exception when duplicate_object or unique_violation then
      null; -- another database of the cluster made it at the same moment
    end;
    -- From PostgreSQL 16 on, who makes a role is its member without the right to act as it.
    if not pg_has_role(current_user, wanted,
        case when current_setting('server_version_num')::integer >= 160000 then 'set' else 'member' end) then
      execute format('grant %I to current_user', wanted);
    end if;
  end loop;
end $$;
