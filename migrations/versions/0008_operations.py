"""Operations: times of recording that never go back, and a record of backups and restores.

Revision: 0008
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0002"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)


def upgrade() -> None:
    op.add_column(
        "log_head",
        sa.Column(
            "recorded_at",
            _TIMESTAMP,
            nullable=False,
            server_default=sa.text("'epoch'"),
            comment="newest recorded_at; the next is never earlier, though the clock be set back",
        ),
    )
    op.execute("update log_head set recorded_at = coalesce((select max(recorded_at) from segments), recorded_at)")
    op.create_table(
        "maintenance",
        sa.Column("id", sa.BigInteger, sa.Identity(always=True), primary_key=True),
        sa.Column("at", _TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when it was done (UTC)"),
        sa.Column("action", sa.Text, nullable=False, comment="backed_up, restore_began, restored or verified"),
        sa.Column("place", sa.Text, nullable=False, comment="folder of the backup"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position up to which it holds"),
        sa.CheckConstraint(
            "action in ('backed_up', 'restore_began', 'restored', 'verified')", name="maintenance_action"
        ),
        comment="Backups of this log, and the restore that it came from.",
    )
    op.execute("grant select, insert on maintenance to vian_writer")
    # So that a program may run as an account that is no more than a writer: it looks whether the schema is its own.
    op.execute("grant select on alembic_version to vian_writer")
    _replace_append("0008")


def downgrade() -> None:
    _replace_append("0001")
    op.execute("revoke select on alembic_version from vian_writer")
    op.drop_table("maintenance")
    op.drop_column("log_head", "recorded_at")


def _replace_append(revision: str) -> None:
    """The append function as that revision has it."""
    text = files("migrations").joinpath("sql", f"{revision}_append_segments.sql").read_text(encoding="utf-8")
    text = text.replace("create function", "create or replace function", 1).replace(":", r"\:")
    # The path that the function keeps: temporary tables last, and named once though 0001 ran in the same transaction.
    op.execute(
        "select set_config('search_path', "
        "regexp_replace(current_setting('search_path'), '(, pg_temp)?$', ', pg_temp'), true)"
    )
    op.execute(text)
