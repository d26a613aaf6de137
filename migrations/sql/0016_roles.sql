-- Who asks from the field, through central: may read what the caller's grant names, and nothing else.
-- Roles are shared by a cluster's databases, so it may be there already.
do $$
begin
  begin
    if not exists (select from pg_roles where rolname = 'vian_field') then
      create role vian_field nologin;
    end if;
  exception when duplicate_object or unique_violation then
    null; -- another database of the cluster made it at the same moment
  end;
  -- From PostgreSQL 16 on, who makes a role is its member without the right to act as it.
  if not pg_has_role(current_user, 'vian_field',
      case when current_setting('server_version_num')::integer >= 160000 then 'set' else 'member' end) then
    grant vian_field to current_user;
  end if;
  -- Only a superuser can let others bound what a query puts on the server's disk for the time being.
  begin
    grant set on parameter temp_file_limit to vian_writer;
  exception when insufficient_privilege then
    null; -- the bound that the server has for everybody holds
  end;
end $$;
