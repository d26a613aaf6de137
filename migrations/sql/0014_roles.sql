-- The pruner may take payloads off the log's disk and put them back, and nobody else may.
-- Roles are shared by a cluster's databases, so it may be there already.
do $$
begin
  begin
    if not exists (select from pg_roles where rolname = 'vian_pruner') then
      create role vian_pruner nologin;
    end if;
  exception when duplicate_object or unique_violation then
    null; -- another database of the cluster made it at the same moment
  end;
  -- From PostgreSQL 16 on, who makes a role is its member without the right to act as it.
  if not pg_has_role(current_user, 'vian_pruner',
      case when current_setting('server_version_num')::integer >= 160000 then 'set' else 'member' end) then
    grant vian_pruner to current_user;
  end if;
end $$;
