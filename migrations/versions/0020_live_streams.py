"""Row tables of live streams: when they were interrupted, and came back.

Revision: 0020
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = ("stream_interrupted", "stream_resumed")


def upgrade() -> None:
    _row_table(
        "stream_interrupted",
        "A live stream gives no more pictures; its time is that of the last one.",
        sa.Column("video", sa.Text, nullable=False, comment="name of the footage, as `video_added` names it"),
        sa.Column(
            "why",
            sa.Text,
            nullable=False,
            comment="what happened, as told to people: it ended, fell silent, or the extractor was killed",
        ),
    )
    _row_table(
        "stream_resumed",
        "A live stream gives pictures again; its time is that of the first one.",
        sa.Column("video", sa.Text, nullable=False, comment="name of the footage, as `video_added` names it"),
        sa.Column("interrupted_at", _TIMESTAMP, nullable=False, comment="time of the last picture before (UTC)"),
    )


def downgrade() -> None:
    # The events stay in the log: row tables are rebuilt from it.
    for name in _TYPES:
        op.execute(f"select drop_projection('{name}')")


def _row_table(name: str, comment: str, *payload: sa.Column[Any]) -> None:
    op.create_table(
        name,
        sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
        sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
        sa.Column("subject", sa.Text, comment="what it is about"),
        sa.Column("time", _TIMESTAMP, nullable=False, comment="when it happened (UTC)"),
        sa.Column("sequence", sa.BigInteger, nullable=False, comment="place in its stream"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position of its segment in this log"),
        sa.Column("recorded_at", _TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
        *payload,
        comment=comment,
        postgresql_partition_by="RANGE (time)",
    )
    op.create_index(f"{name}_time", name, ["time"], postgresql_using="brin")
    op.create_index(f"{name}_position", name, ["position"], postgresql_using="brin")
    op.execute(f"select adopt_projection('{name}')")
