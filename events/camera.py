"""Cameras: zones and lines drawn in their pictures, where their pixels lie on the ground, what befell their view.

Pixels: origin top-left, x right, y down. Ground: metres, east and north (ENU).
"""

from typing import Annotated, Literal

import pyarrow as pa

from events.columns import schema_of
from events.model import AtDoor, EventType, Finite32, JsonText, Share32


class ZoneDefined(EventType, type="zone_defined", version=1, subject="zone"):
    """A zone or line of this source was drawn, or drawn anew; rules share it by its name."""

    zone: str
    """name of the zone or line, unique within its source"""
    kind: Literal["zone", "line"]
    """whether it is a polygon or a line of two points"""
    zone_version: Annotated[int, AtDoor(1)]
    """counts this source's definitions of the name, from 1; goes on after a removal"""
    points: JsonText
    """corners of the polygon, or the two points of the line: [[x, y], ...] in the units named"""
    units: Literal["normalised", "pixels", "metres"]
    """shares of the frame (0 to 1), px of the frame, or m on the ground of the source's calibration (ENU)"""
    author: str | None
    """who drew it; null where nobody was named"""
    reason: str | None
    """why it was drawn or changed; null where no reason was given"""


class ZoneRemoved(EventType, type="zone_removed", version=1, subject="zone"):
    """A zone or line of this source was taken away; rules that use it no longer hold for this source."""

    zone: str
    """name of the zone or line"""
    zone_version: Annotated[int, AtDoor(1)]
    """version that stood until now"""
    author: str | None
    """who took it away; null where nobody was named"""
    reason: str | None
    """why it was taken away; null where no reason was given"""


class CameraCalibratedV1(EventType, type="camera_calibrated", version=1):
    """Where this source's pixels lie on the ground. Stored before version 2 came, and read as that."""

    homography: JsonText
    """3 x 3, row by row, as [[a, b, c], ...]: (X, Y, W) = H (x, y, 1) of px; X/W m east, Y/W m north, where W > 0"""
    width: Annotated[int, AtDoor(1)]
    """width of the frame that the pixels are of, px"""
    height: Annotated[int, AtDoor(1)]
    """height of the frame that the pixels are of, px"""
    method: str
    """how it was found: `points` (pairs of image and ground points), or the extractor's own word"""
    rms_m: Annotated[float, AtDoor(0)] | None
    """root mean square distance between given and mapped ground points, m; null where it was not measured"""


class CameraCalibrated(EventType, type="camera_calibrated", version=2, older=CameraCalibratedV1):
    """Where this source's pixels lie on the ground, for points of the ground plane."""

    homography: JsonText
    """3 x 3, row by row, as [[a, b, c], ...]: (X, Y, W) = H (x, y, 1) of px; X/W m east, Y/W m north, where W > 0"""
    width: Annotated[int, AtDoor(1)]
    """width of the frame that the pixels are of, px"""
    height: Annotated[int, AtDoor(1)]
    """height of the frame that the pixels are of, px"""
    method: str
    """how it was found: `points` (pairs of image and ground points), `tracks` (upright people), or otherwise"""
    rms_m: Annotated[float, AtDoor(0)] | None
    """root mean square left over: of ground points, or people's heights for `tracks`, m; null where not measured"""
    focal_px: Annotated[float, AtDoor(0)] | None
    """focal length, px; null where no camera was found beside the homography"""
    pitch_rad: Annotated[float, AtDoor()] | None
    """how far the view points below the horizontal, rad; null likewise"""
    roll_rad: Annotated[float, AtDoor()] | None
    """how far the horizon is turned in the picture, clockwise, rad; null likewise"""
    height_m: Annotated[float, AtDoor(0)] | None
    """height of the camera above the ground, m; null likewise"""
    covariance: JsonText | None
    """4 x 4, row by row, of focal_px, pitch_rad, roll_rad and height_m, in their units; null where it is not known"""
    scale: str | None
    """where metres come from: `person_height`, `camera_height`, `length`, `points`; null where that is not known"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Events of version 1, which say nothing of the camera itself."""
        schema = schema_of(cls)
        new = [pa.nulls(len(older), field.type) for field in list(schema)[older.num_columns :]]
        return pa.RecordBatch.from_arrays([*older.columns, *new], schema=schema)


class SceneChanged(EventType, type="scene_changed", version=1):
    """The picture no longer shows the view that it showed: the camera was turned, covered or lost its focus."""

    cause: Literal["moved", "covered", "blurred", "unknown"]
    """what befell the view, as far as it is known"""
    changed_share: Share32
    """share of the picture that no longer shows what it showed, 0 to 1"""
    dx: Finite32 | None
    """how far the view was shifted to the right, px; null where that is not known"""
    dy: Finite32 | None
    """how far the view was shifted down, px; null where that is not known"""
