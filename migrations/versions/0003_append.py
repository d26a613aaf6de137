"""Append in one round trip of few, large values; `recorded_at` never goes back.

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


def _sql(name: str) -> str:
    return files("migrations").joinpath("sql", name).read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    op.add_column(
        "log_head",
        sa.Column(
            "recorded_at",
            _TIMESTAMP,
            nullable=False,
            server_default=sa.text("'1970-01-01 00:00:00+00'"),
            comment="when the newest segment was taken (UTC); 1970 when there is none",
        ),
    )
    op.execute("update log_head set recorded_at = coalesce((select max(recorded_at) from segments), recorded_at)")
    op.execute("drop function append_segments")
    _create("0003_append_segments.sql")


def downgrade() -> None:
    op.execute("drop function append_segments")
    _create("0001_append_segments.sql")
    op.drop_column("log_head", "recorded_at")


def _create(name: str) -> None:
    # Functions keep this path; temporary tables last, lest a writer's own stand in for the log's.
    op.execute(
        "select set_config('search_path', current_setting('search_path') || ', pg_temp', true) "
        "where current_setting('search_path') not like '%, pg_temp'"
    )
    op.execute(_sql(name))
    op.execute("revoke execute on function append_segments from public")
    op.execute("grant execute on function append_segments to vian_writer")
