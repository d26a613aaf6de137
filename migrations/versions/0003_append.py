"""Append: `recorded_at` never goes back.

Revision: 0003
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op

revision = "0003"
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
            server_default=sa.text("'-infinity'"),
            comment="when the newest segment was taken (UTC); -infinity when there is none",
        ),
    )
    op.execute("update log_head set recorded_at = coalesce((select max(recorded_at) from segments), '-infinity')")
    _replace("0003_append_segments.sql")


def downgrade() -> None:
    _replace("0001_append_segments.sql")
    op.drop_column("log_head", "recorded_at")


def _replace(name: str) -> None:
    # The path that the function keeps: temporary tables last.
    op.execute(
        "select set_config('search_path', current_setting('search_path') || ', pg_temp', true) "
        "where current_setting('search_path') not like '%, pg_temp'"
    )
    text = files("migrations").joinpath("sql", name).read_text(encoding="utf-8").replace(":", r"\:")
    op.execute(text.replace("create function", "create or replace function", 1))
