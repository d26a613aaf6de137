"""Row tables of what stages derive and of what is said of cameras.

Revision: 0011
"""

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = (
    "pair_distance",
    "occupancy",
    "group_seen",
    "tally",
    "stage_deployed",
    "zone_defined",
    "zone_removed",
    "camera_calibrated",
    "scene_changed",
)


def upgrade() -> None:
    _row_table(
        "pair_distance",
        "Two tracked objects of a source were near each other in a frame.",
        sa.Column("stage", sa.Text, nullable=False, comment="name of the stage that derived it"),
        sa.Column("pair", sa.Text, nullable=False, comment="the two tracks' numbers, the lower first: `3+7`"),
        sa.Column("track_a", sa.BigInteger, nullable=False, comment="number of the track with the lower number"),
        sa.Column("track_b", sa.BigInteger, nullable=False, comment="number of the track with the higher number"),
        sa.Column("distance_px", sa.REAL, nullable=False, comment="distance between the two points, px"),
        sa.Column(
            "closing_px_s",
            sa.REAL,
            nullable=False,
            comment="speed at which the distance shrinks, px/s; negative where it grows",
        ),
        sa.Column("speed_a_px_s", sa.REAL, nullable=False, comment="speed of the track with the lower number, px/s"),
        sa.Column("speed_b_px_s", sa.REAL, nullable=False, comment="speed of the track with the higher number, px/s"),
        sa.Column(
            "alignment",
            sa.REAL,
            nullable=True,
            comment="cosine of the angle between the two velocities, -1 to 1; null where one of them stands still",
        ),
        sa.Column("x", sa.REAL, nullable=False, comment="middle between the two points, px"),
        sa.Column("y", sa.REAL, nullable=False, comment="middle between the two points, px"),
    )
    _row_table(
        "occupancy",
        "The number of tracked objects in a zone changed.",
        sa.Column("stage", sa.Text, nullable=False, comment="name of the stage that derived it"),
        sa.Column("zone", sa.Text, nullable=False, comment="name of the zone"),
        sa.Column("tracks", sa.BigInteger, nullable=False, comment="how many tracks are in it from this time on"),
        sa.Column("tracks_before", sa.BigInteger, nullable=False, comment="how many there were until this time"),
    )
    _row_table(
        "group_seen",
        "Tracked objects stood or went together for a while: a group formed, changed, went on or dissolved.",
        sa.Column("stage", sa.Text, nullable=False, comment="name of the stage that derived it"),
        sa.Column(
            "group_id", sa.BigInteger, nullable=False, comment="number of the group, unique within its source and stage"
        ),
        sa.Column(
            "members",
            sa.BigInteger,
            nullable=False,
            comment="how many tracks belong to it from this time on; 0: it has dissolved",
        ),
        sa.Column(
            "tracks",
            sa.Text,
            nullable=False,
            comment="the members' numbers, ascending: `3+7+9`; empty where it has dissolved",
        ),
        sa.Column(
            "began_at", _TIMESTAMP, nullable=False, comment="time from which its members have been together (UTC)"
        ),
        sa.Column(
            "x",
            sa.REAL,
            nullable=False,
            comment="mean of the members' points, px; where it has dissolved, the last one",
        ),
        sa.Column(
            "y",
            sa.REAL,
            nullable=False,
            comment="mean of the members' points, px; where it has dissolved, the last one",
        ),
        sa.Column(
            "radius_px",
            sa.REAL,
            nullable=False,
            comment="distance from the mean to the member furthest from it, px; where it has dissolved, the last one",
        ),
    )
    _row_table(
        "tally",
        "How many events there were in a window of time; its time is the window's end.",
        sa.Column("stage", sa.Text, nullable=False, comment="name of the stage that derived it"),
        sa.Column(
            "key",
            sa.Text,
            nullable=False,
            comment="value of the column by which events are counted apart; empty where they are counted together",
        ),
        sa.Column("began_at", _TIMESTAMP, nullable=False, comment="beginning of the window, inclusive (UTC)"),
        sa.Column("window_s", sa.Double, nullable=False, comment="length of the window, s"),
        sa.Column("events", sa.BigInteger, nullable=False, comment="how many events lie in the window"),
    )
    _row_table(
        "stage_deployed",
        "A version of a stage was put into service.",
        sa.Column("stage", sa.Text, nullable=False, comment="name of the stage"),
        sa.Column("stage_version", sa.BigInteger, nullable=False, comment="version of the stage"),
        sa.Column(
            "stage_hash", sa.Text, nullable=False, comment="SHA-256 of what the stage derives from, in hexadecimal"
        ),
        sa.Column("text", sa.Text, nullable=False, comment="the stage file, whole"),
    )
    _row_table(
        "zone_defined",
        "A zone or line of this source was drawn, or drawn anew; rules share it by its name.",
        sa.Column("zone", sa.Text, nullable=False, comment="name of the zone or line, unique within its source"),
        sa.Column("kind", sa.Text, nullable=False, comment="whether it is a polygon or a line of two points"),
        sa.Column(
            "zone_version",
            sa.BigInteger,
            nullable=False,
            comment="counts this source's definitions of the name, from 1; goes on after a removal",
        ),
        sa.Column(
            "points",
            pg.JSONB,
            nullable=False,
            comment="corners of the polygon, or the two points of the line: [[x, y], ...] in the units named",
        ),
        sa.Column(
            "units",
            sa.Text,
            nullable=False,
            comment="shares of the frame (0 to 1), px of the frame, or "
            "m on the ground of the source's calibration (ENU)",
        ),
        sa.Column("author", sa.Text, nullable=True, comment="who drew it; null where nobody was named"),
        sa.Column(
            "reason", sa.Text, nullable=True, comment="why it was drawn or changed; null where no reason was given"
        ),
    )
    _row_table(
        "zone_removed",
        "A zone or line of this source was taken away; rules that use it no longer hold for this source.",
        sa.Column("zone", sa.Text, nullable=False, comment="name of the zone or line"),
        sa.Column("zone_version", sa.BigInteger, nullable=False, comment="version that stood until now"),
        sa.Column("author", sa.Text, nullable=True, comment="who took it away; null where nobody was named"),
        sa.Column("reason", sa.Text, nullable=True, comment="why it was taken away; null where no reason was given"),
    )
    _row_table(
        "camera_calibrated",
        "Where this source's pixels lie on the ground, for points of the ground plane.",
        sa.Column(
            "homography",
            pg.JSONB,
            nullable=False,
            comment="3 x 3, row by row, as [[a, b, c], ...]: (X, Y, W) = H (x, y, 1) of px; "
            "X/W m east, Y/W m north, where W > 0",
        ),
        sa.Column("width", sa.BigInteger, nullable=False, comment="width of the frame that the pixels are of, px"),
        sa.Column("height", sa.BigInteger, nullable=False, comment="height of the frame that the pixels are of, px"),
        sa.Column(
            "method",
            sa.Text,
            nullable=False,
            comment="how it was found: `points` (pairs of image and ground points), or the extractor's own word",
        ),
        sa.Column(
            "rms_m",
            sa.Double,
            nullable=True,
            comment="root mean square distance between given and mapped ground points, m; "
            "null where it was not measured",
        ),
    )
    _row_table(
        "scene_changed",
        "The picture no longer shows the view that it showed: the camera was turned, covered or lost its focus.",
        sa.Column("cause", sa.Text, nullable=False, comment="what befell the view, as far as it is known"),
        sa.Column(
            "changed_share",
            sa.REAL,
            nullable=False,
            comment="share of the picture that no longer shows what it showed, 0 to 1",
        ),
        sa.Column(
            "dx",
            sa.REAL,
            nullable=True,
            comment="how far the view was shifted to the right, px; null where that is not known",
        ),
        sa.Column(
            "dy", sa.REAL, nullable=True, comment="how far the view was shifted down, px; null where that is not known"
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
