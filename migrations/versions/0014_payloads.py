"""Payloads that leave a station's disk, and come back.

Revision: 0014
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

_FUNCTIONS = ("prune_segments", "restore_payload", "repair_segments", "plan_resealing", "reseal_file")


def _sql(name: str) -> str:
    return files("migrations").joinpath("sql", f"0014_{name}.sql").read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    op.execute(_sql("roles"))
    op.alter_column(
        "segments", "payload", nullable=True, comment="zstd of an Arrow record batch; null: it left the disk"
    )
    op.add_column(
        "archive_head",
        sa.Column(
            "is_rewriting",
            sa.Boolean,
            nullable=False,
            server_default=sa.text("false"),
            comment="true only inside the functions that take payloads off the disk and put them back",
        ),
    )
    _set_path()
    for name in ("refuse_rewriting", *_FUNCTIONS):
        op.execute(_sql(name))
    op.execute("drop trigger segments_no_update on segments")
    _refuse("segments", "update", "refuse_rewriting")
    op.execute("drop trigger sealed_files_no_update on sealed_files")
    _refuse("sealed_files", "update", "refuse_rewriting")
    _refuse("sealed_files", "delete", "refuse_change")
    op.execute(f"revoke execute on function {', '.join(_FUNCTIONS)} from public")
    op.execute(f"grant execute on function {', '.join(_FUNCTIONS)}, forget_sealing to vian_pruner")
    op.execute(_schema("grant usage on schema %I to vian_pruner"))


def downgrade() -> None:
    op.execute(
        "do $$ begin if exists (select from segments where payload is null) then "
        "raise exception 'segments have no payload any more, which the schema before does not know'; end if; end $$"
    )
    op.execute("drop trigger sealed_files_no_delete on sealed_files")
    op.execute("drop trigger sealed_files_no_update on sealed_files")
    _refuse("sealed_files", "update or delete", "refuse_change")
    op.execute("drop trigger segments_no_update on segments")
    _refuse("segments", "update", "refuse_change")
    op.execute("revoke execute on function forget_sealing from vian_pruner")
    for name in (*_FUNCTIONS, "refuse_rewriting"):
        op.execute(f"drop function {name}")
    op.drop_column("archive_head", "is_rewriting")
    op.alter_column("segments", "payload", nullable=False, comment="zstd of an Arrow record batch")
    op.execute(_schema("revoke usage on schema %I from vian_pruner"))


def _schema(statement: str) -> str:
    """A statement on the schema that the log is in; of another owner's, the roles must have it from there."""
    return (
        f"do $$ begin execute format('{statement}', current_schema()); "
        "exception when insufficient_privilege then null; end $$"
    )


def _set_path() -> None:
    """Functions keep this path; temporary tables last, lest a caller's own stand in for the log's."""
    op.execute(
        "select set_config('search_path', "
        "replace(current_setting('search_path'), ', pg_temp', '') || ', pg_temp', true)"
    )


def _refuse(table: str, change: str, function: str) -> None:
    op.execute(
        f"create trigger {table}_no_{change.split()[0]} before {change} on {table} "
        f"for each statement execute function {function}()"
    )
