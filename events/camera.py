"""Cameras: zones and lines drawn in their pictures, where their pixels lie on the ground, what befell their view.

Pixels: origin top-left, x right, y down. Ground: metres, east and north (ENU).
"""

from typing import Annotated, Literal

import pyarrow as pa
from pydantic import Field

from events.columns import schema_of
from events.model import AtDoor, EventType, Finite32, Float32, JsonText, Share32


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


class HorizonVote(EventType, type="horizon_vote", version=1, subject="track_id"):
    """A track that is over says where its way meets the horizon; its time is that of the last point before it spoke."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    x: Finite32
    """where the track's height would be nought, px; often outside the frame"""
    y: Finite32
    """where the track's height would be nought, px; often outside the frame"""
    deviation_px: Annotated[Float32, AtDoor(0)]
    """standard deviation of that point along the track's way, px"""
    direction_rad: Finite32
    """direction of the track's way in the picture, clockwise from the right, rad; its opposite means the same"""
    places: Annotated[int, AtDoor(1)]
    """places of the track that the vote rests on"""


class HorizonEstimate(EventType, type="horizon_estimate", version=1):
    """Where this source's horizon is, as far as its tracks show: y = slope x + offset in px of the whole frame."""

    slope: Annotated[float, AtDoor()]
    """how far the horizon falls for each px to the right, px per px"""
    offset_px: Annotated[float, AtDoor()]
    """where the horizon meets the frame's left edge, px; negative above the frame"""
    slope_variance: Annotated[float, AtDoor(0)]
    """variance of the slope, (px per px)²"""
    slope_offset_covariance: Annotated[float, AtDoor()]
    """covariance of slope and offset, px² per px"""
    offset_variance: Annotated[float, AtDoor(0)]
    """variance of the offset, px²"""
    width: Annotated[int, AtDoor(1)]
    """width of the frame that the pixels are of, px"""
    height: Annotated[int, AtDoor(1)]
    """height of the frame that the pixels are of, px"""
    votes: Annotated[int, AtDoor(0)]
    """tracks with a vote among those that it rests on"""
