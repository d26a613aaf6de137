"""Row tables that look after themselves: versions, retention, rebuilding, closed days, epochs, a view a type.

Revision: 0004
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

_CHANGED = ("ensure_partition", "adopt_projection")
_NEW = (
    "event_id",
    "make_event_view",
    "make_events_view",
    "summarize_days",
    "close_partition",
    "drop_days_before",
    "reset_projection",
    "drop_projection",
)
_OWNERS = ("make_event_view", "make_events_view", "drop_projection")
_WRITERS = ("summarize_days", "close_partition", "drop_days_before", "reset_projection")


def _sql(number: str, name: str) -> str:
    return files("migrations").joinpath("sql", f"{number}_{name}.sql").read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    op.add_column(
        "projections",
        sa.Column(
            "version",
            sa.Integer,
            nullable=False,
            server_default="1",
            comment="version of the event type that the table's columns are of",
        ),
    )
    op.add_column(
        "projections",
        sa.Column("retained_from", sa.Date, comment="first day (UTC) that retention has left; null where it took none"),
    )
    _hold_search_path()
    for name in (*_NEW, *_CHANGED):
        op.execute(_sql("0004", name))
    op.execute(f"revoke execute on function {', '.join((*_OWNERS, *_WRITERS))} from public")
    op.execute(f"grant execute on function {', '.join(_WRITERS)} to vian_writer")
    op.execute("select adopt_projection(name) from projections order by name")
    # Until now two lives of a stream could not be told apart: such tables begin anew.
    op.execute(
        "select reset_projection(name, null) from projections "
        "where name in (select type from streams where epoch <> 1) order by name"
    )
    op.execute(
        "do $$ declare r record; begin for r in "
        "select cast(c.oid as regclass) as partition, p.name, cast(right(c.relname, 8) as date) as day "
        "from projections p join pg_inherits i on i.inhparent = to_regclass(quote_ident(p.name)) "
        "join pg_class c on c.oid = i.inhrelid and c.relname ~ ('^' || p.name || '_[0-9]{8}$') loop "
        "execute format('comment on table %s is %L', r.partition, "
        "format('Rows of %s of one day, %s (UTC).', r.name, to_char(r.day, 'YYYY-MM-DD'))); end loop; end $$"
    )
    op.execute("drop view events")
    op.execute("select make_events_view()")


def downgrade() -> None:
    op.execute("drop view events")
    op.execute(
        "do $$ declare r record; begin for r in select name from projections order by name loop "
        "execute format('drop view %I', r.name || '_events'); "
        "execute format('alter table %I drop column epoch', r.name); "
        "execute format('grant delete on %I to vian_writer', r.name); end loop; end $$"
    )
    for name in (*reversed(_NEW), *_CHANGED):
        op.execute(f"drop function {name}")
    op.drop_column("projections", "retained_from")
    op.drop_column("projections", "version")
    op.execute("delete from checkpoints where name like 'projector\\:%'")
    _hold_search_path()
    for name in _CHANGED:
        op.execute(_sql("0001", name))
    op.execute("revoke execute on function ensure_partition, adopt_projection from public")
    op.execute("grant execute on function ensure_partition to vian_writer")
    names = op.get_bind().scalars(sa.text("select name from projections order by name"))
    op.execute("create view events as " + " union all ".join(map(_select, names)))
    op.execute("grant select on events to vian_writer, vian_reader")


def _select(name: str) -> str:
    return (
        f"select station || '/' || source || '/{name}/' || sequence as id, station, source, "
        f"cast('{name}' as text) as type, subject, time, sequence, position, recorded_at from \"{name}\""
    )


def _hold_search_path() -> None:
    """Functions keep this path; temporary tables last, lest a writer's own stand in for the log's."""
    op.execute(
        "select set_config('search_path', current_setting('search_path') || ', pg_temp', true) "
        "where current_setting('search_path') not like '%pg_temp'"
    )
