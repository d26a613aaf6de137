"""Row tables of horizons: what tracks vote, and what the estimate is.

Revision: 0021
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = ("horizon_vote", "horizon_estimate")


def upgrade() -> None:
    _row_table(
        "horizon_vote",
        "A track that is over says where its way meets the horizon; its time is that of the last point before it "
        "spoke.",
        sa.Column("track_id", sa.BigInteger, nullable=False, comment="number of the track, unique within its source"),
        *(
            sa.Column(
                name,
                sa.REAL,
                nullable=False,
                comment="where the track's height would be nought, px; often outside the frame",
            )
            for name in ("x", "y")
        ),
        sa.Column(
            "deviation_px",
            sa.REAL,
            nullable=False,
            comment="standard deviation of that point along the track's way, px",
        ),
        sa.Column(
            "direction_rad",
            sa.REAL,
            nullable=False,
            comment="direction of the track's way in the picture, clockwise from the right, rad; its opposite means "
            "the same",
        ),
        sa.Column("places", sa.BigInteger, nullable=False, comment="places of the track that the vote rests on"),
    )
    _row_table(
        "horizon_estimate",
        "Where this source's horizon is, as far as its tracks show: y = slope x + offset in px of the whole frame.",
        sa.Column(
            "slope",
            sa.Double,
            nullable=False,
            comment="how far the horizon falls for each px to the right, px per px",
        ),
        sa.Column(
            "offset_px",
            sa.Double,
            nullable=False,
            comment="where the horizon meets the frame's left edge, px; negative above the frame",
        ),
        sa.Column("slope_variance", sa.Double, nullable=False, comment="variance of the slope, (px per px)²"),
        sa.Column(
            "slope_offset_covariance",
            sa.Double,
            nullable=False,
            comment="covariance of slope and offset, px² per px",
        ),
        sa.Column("offset_variance", sa.Double, nullable=False, comment="variance of the offset, px²"),
        sa.Column("width", sa.BigInteger, nullable=False, comment="width of the frame that the pixels are of, px"),
        sa.Column("height", sa.BigInteger, nullable=False, comment="height of the frame that the pixels are of, px"),
        sa.Column(
            "votes",
            sa.BigInteger,
            nullable=False,
            comment="tracks with a vote among those that it rests on",
        ),
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
