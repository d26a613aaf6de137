"""Roles: they reach the schema that the log is in, also where it was taken from everybody.

Revision: 0009
"""

from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # Who may make tables in a schema of another owner cannot share it: the roles must have it from there.
    op.execute("""
do $$
begin
  execute format('grant usage on schema %I to vian_writer, vian_reader, vian_archiver', current_schema());
exception when insufficient_privilege then
  if not (has_schema_privilege('vian_writer', current_schema(), 'usage')
      and has_schema_privilege('vian_reader', current_schema(), 'usage')
      and has_schema_privilege('vian_archiver', current_schema(), 'usage')) then
    raise;
  end if;
end $$""")


def downgrade() -> None:
    op.execute("""
do $$
begin
  execute format('revoke usage on schema %I from vian_writer, vian_reader, vian_archiver', current_schema());
exception when insufficient_privilege then
  null; -- another owner's schema: what was not granted here is not taken here
end $$""")
