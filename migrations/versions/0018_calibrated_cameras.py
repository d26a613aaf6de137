"""Version 2 of `camera_calibrated`: the camera itself, and how well it is known.

Revision: 0018
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

_COLUMNS = ("focal_px", "pitch_rad", "roll_rad", "height_m", "covariance", "scale")
_RMS = "root mean square distance between given and mapped ground points, m; null where it was not measured"
_METHOD = "how it was found: `points` (pairs of image and ground points), or the extractor's own word"


def upgrade() -> None:
    for column in (
        sa.Column(
            "focal_px",
            sa.Double,
            comment="focal length, px; null where no camera was found beside the homography",
        ),
        sa.Column("pitch_rad", sa.Double, comment="how far the view points below the horizontal, rad; null likewise"),
        sa.Column(
            "roll_rad",
            sa.Double,
            comment="how far the horizon is turned in the picture, clockwise, rad; null likewise",
        ),
        sa.Column("height_m", sa.Double, comment="height of the camera above the ground, m; null likewise"),
        sa.Column(
            "covariance",
            pg.JSONB,
            comment="4 x 4, row by row, of focal_px, pitch_rad, roll_rad and height_m, in their units; "
            "null where it is not known",
        ),
        sa.Column(
            "scale",
            sa.Text,
            comment="where metres come from: `person_height`, `camera_height`, `length`, `points`; "
            "null where that is not known",
        ),
    ):
        op.add_column("camera_calibrated", column)
    op.alter_column(
        "camera_calibrated",
        "method",
        comment="how it was found: `points` (pairs of image and ground points), `tracks` (upright people), "
        "or otherwise",
    )
    op.alter_column(
        "camera_calibrated",
        "rms_m",
        comment="root mean square left over: of ground points, "
        "or people's heights for `tracks`, m; null where not measured",
    )
    op.execute("update projections set version = 2 where name = 'camera_calibrated'")
    op.execute("select adopt_projection('camera_calibrated')")  # its view gets the columns


def downgrade() -> None:
    op.execute("drop view field_camera_calibrated")
    op.execute("drop view camera_calibrated_events")
    for name in _COLUMNS:
        op.drop_column("camera_calibrated", name)
    op.alter_column("camera_calibrated", "method", comment=_METHOD)
    op.alter_column("camera_calibrated", "rms_m", comment=_RMS)
    op.execute("update projections set version = 1 where name = 'camera_calibrated'")
    op.execute("select adopt_projection('camera_calibrated')")
