"""Version 3 of `track_ended`, with duration and mean box, and the row table of `appearance`.

Revision: 0019
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_MEANS = {"x1_mean": "left edge", "y1_mean": "upper edge", "x2_mean": "right edge", "y2_mean": "lower edge"}


def upgrade() -> None:
    _add_shape()
    _appearance()


def downgrade() -> None:
    op.execute("drop view field_track_ended")
    op.execute("drop view track_ended_events")
    for name in ("duration_s", *_MEANS):
        op.drop_column("track_ended", name)
    op.execute("update projections set version = 2 where name = 'track_ended'")
    op.execute("select adopt_projection('track_ended')")
    # The events stay in the log: row tables are rebuilt from it.
    op.execute("select drop_projection('appearance')")


def _add_shape() -> None:
    comment = "time from the first point to the last, s"
    op.add_column(
        "track_ended", sa.Column("duration_s", sa.Double, nullable=False, server_default="0", comment=comment)
    )
    # One rewrite of each partition, as the upcaster has it: an event that ends before it begins took no time.
    op.execute(
        "alter table track_ended alter column duration_s drop default, alter column duration_s type double precision "
        "using greatest(extract(epoch from time - began_at), 0)::double precision"
    )
    for name, edge in _MEANS.items():
        since = "null in events of before version 3" if name == "x1_mean" else "null likewise"
        comment = f"{edge} of the box, mean over the points, px; {since}"
        op.add_column("track_ended", sa.Column(name, sa.REAL, nullable=True, comment=comment))
    op.execute("update projections set version = 3 where name = 'track_ended'")
    op.execute("select adopt_projection('track_ended')")  # its view gets the columns


def _appearance() -> None:
    op.create_table(
        "appearance",
        sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
        sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
        sa.Column("subject", sa.Text, comment="what it is about"),
        sa.Column("time", _TIMESTAMP, nullable=False, comment="when it happened (UTC)"),
        sa.Column("sequence", sa.BigInteger, nullable=False, comment="place in its stream"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position of its segment in this log"),
        sa.Column("recorded_at", _TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
        sa.Column("track_id", sa.BigInteger, nullable=False, comment="number of the track, unique within its source"),
        sa.Column(
            "method",
            sa.Text,
            nullable=False,
            comment="how the descriptor was made; only descriptors of one method compare",
        ),
        sa.Column(
            "descriptor",
            pg.BYTEA,
            nullable=False,
            comment="the descriptor: for `tones-2x16`, 32 bytes of 255 times the root of the share of a "
            "histogram's bin",
        ),
        sa.Column("views", sa.BigInteger, nullable=False, comment="number of clear views that it is the mean of"),
        comment="How a tracked object looked, for finding others that look alike; its time is that of the track's "
        "last point.",
        postgresql_partition_by="RANGE (time)",
    )
    op.create_index("appearance_time", "appearance", ["time"], postgresql_using="brin")
    op.create_index("appearance_position", "appearance", ["position"], postgresql_using="brin")
    op.execute("select adopt_projection('appearance')")
