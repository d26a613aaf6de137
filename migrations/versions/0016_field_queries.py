"""Questions from the field.

Revision: 0016
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

_NEW = ("field_stations", "make_field_view", "plate_key")
_CHANGED = ("adopt_projection", "drop_projection")


def _sql(name: str, number: str = "0016") -> str:
    return files("migrations").joinpath("sql", f"{number}_{name}.sql").read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    # Functions keep this path; temporary tables last, lest a writer's own stand in for the log's.
    op.execute(
        "select set_config('search_path', current_setting('search_path') || ', pg_temp', true) "
        "where current_setting('search_path') not like '%pg_temp'"
    )
    op.execute(_sql("roles"))
    op.create_table(
        "field_callers",
        sa.Column(
            "transaction",
            sa.BigInteger,
            primary_key=True,
            autoincrement=False,
            comment="transaction that answers a question",
        ),
        sa.Column("stations", pg.ARRAY(sa.Text), comment="stations whose events it may read; null for all"),
        comment="Whom a question from the field is answered for: seen by its transaction alone, which never commits.",
        prefixes=["UNLOGGED"],
    )
    op.execute("grant insert on field_callers to vian_writer")
    for name in (*_NEW, *_CHANGED):
        op.execute(_sql(name))
    op.execute("revoke execute on function field_stations, make_field_view, drop_projection from public")
    op.execute("grant execute on function field_stations to vian_field")
    op.execute("""
do $$
begin
  execute format('grant usage on schema %I to vian_field', current_schema());
exception when insufficient_privilege then
  if not has_schema_privilege('vian_field', current_schema(), 'usage') then
    raise;
  end if;
end $$""")
    op.execute("select make_field_view(name) from (select name from projections union all values ('events')) as n")
    op.execute(
        "create view field_streams with (security_barrier) as "
        "select station, epoch, source, type, sequence, encode(chain_hash, 'hex') as chain_hash from streams "
        "where station = any (cast((select field_stations()) as text[]))"
    )
    op.execute("comment on view field_streams is 'Where each stream stands.'")
    op.execute("grant select on field_streams to vian_field")
    op.execute("create index plate_read_key on plate_read (plate_key(plate) text_pattern_ops, time)")


def downgrade() -> None:
    op.execute("drop index plate_read_key")
    op.execute(
        "do $$ declare r record; begin for r in "
        "select name from projections union all values ('events'), ('streams') loop "
        "execute format('drop view %I', 'field_' || r.name); end loop; end $$"
    )
    for name in reversed(_NEW):
        op.execute(f"drop function {name}")
    for name in _CHANGED:
        op.execute(_sql(name, "0004").replace("create function", "create or replace function"))
    op.drop_table("field_callers")
    op.execute("""
do $$
begin
  execute format('revoke usage on schema %I from vian_field', current_schema());
exception when insufficient_privilege then
  null; -- another owner's schema: what was not granted here is not taken here
end $$""")
