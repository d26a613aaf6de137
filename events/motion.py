"""Motion: what moved, where and when.

Pixels: origin top-left, x right, y down; boxes are `x1 y1 x2 y2`.
"""

from typing import Annotated, Literal

import numpy as np
import pyarrow as pa
from pydantic import Field

from events.columns import schema_of
from events.model import AtDoor, EventType, Finite32, Float32, PersonalBytes, Share32, UtcTime


class TrackPoint(EventType, type="track_point", version=1, subject="track_id"):
    """Where one tracked object is in one frame."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    frame: Annotated[int, Field(ge=0)]
    """number of the frame within the video, from 0"""
    x: Finite32
    """filtered ground contact point (middle of the box's lower edge), px"""
    y: Finite32
    """filtered ground contact point (middle of the box's lower edge), px"""
    x1: Finite32
    """left edge of the box, px"""
    y1: Finite32
    """upper edge of the box, px"""
    x2: Finite32
    """right edge of the box, px"""
    y2: Finite32
    """lower edge of the box, px"""
    vx: Finite32
    """filtered velocity of the ground contact point, px/s"""
    vy: Finite32
    """filtered velocity of the ground contact point, px/s"""
    confidence: Share32
    """how far the box rests on what was seen in this frame, 0 (predicted) to 1 (seen)"""


class TrackEndedV1(EventType, type="track_ended", version=1, subject="track_id"):
    """A track came to its end; its time is that of its last point. Stored before version 2 came, and read as that."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    began_at: UtcTime
    """time of the first point (UTC)"""
    first_frame: Annotated[int, Field(ge=0)]
    """frame of the first point"""
    last_frame: Annotated[int, Field(ge=0)]
    """frame of the last point"""
    points: Annotated[int, Field(ge=1)]
    """number of track points"""
    path_px: Annotated[Float32, AtDoor(0)]
    """length of the path of the ground contact point, px"""
    x_entry: Finite32
    """first ground contact point, px"""
    y_entry: Finite32
    """first ground contact point, px"""
    x_exit: Finite32
    """last ground contact point, px"""
    y_exit: Finite32
    """last ground contact point, px"""
    reason: Literal["lost", "left_frame", "input_changed", "end_of_video"]
    """why it ended"""


class TrackEndedV2(EventType, type="track_ended", version=2, subject="track_id", older=TrackEndedV1):
    """A track came to its end; its time is that of its last point. Stored before version 3 came, and read as that."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    began_at: UtcTime
    """time of the first point (UTC)"""
    first_frame: Annotated[int, Field(ge=0)]
    """frame of the first point"""
    last_frame: Annotated[int, Field(ge=0)]
    """frame of the last point"""
    points: Annotated[int, Field(ge=1)]
    """number of track points"""
    path_px: Annotated[Float32, AtDoor(0)]
    """length of the path of the ground contact point, px"""
    x_entry: Finite32
    """first ground contact point, px"""
    y_entry: Finite32
    """first ground contact point, px"""
    x_exit: Finite32
    """last ground contact point, px"""
    y_exit: Finite32
    """last ground contact point, px"""
    reason: Literal["lost", "left_frame", "input_changed", "end_of_video"]
    """why it ended"""
    displacement_px: Annotated[Float32, AtDoor(0)]
    """straight distance between the first and the last ground contact point, px"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Events of version 1 with the distance between their own entry and exit."""
        x_entry, y_entry, x_exit, y_exit = (
            older.column(name).to_numpy().astype(np.float64) for name in ("x_entry", "y_entry", "x_exit", "y_exit")
        )
        # Version 1 may hold NaN and infinity; so is the distance then, without a warning.
        with np.errstate(invalid="ignore", over="ignore"):
            distance = np.sqrt((x_exit - x_entry) ** 2 + (y_exit - y_entry) ** 2).astype(np.float32)
        return pa.RecordBatch.from_arrays([*older.columns, pa.array(distance)], schema=schema_of(cls))


class TrackEnded(EventType, type="track_ended", version=3, subject="track_id", older=TrackEndedV2):
    """A track came to its end; its time is that of its last point."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    began_at: UtcTime
    """time of the first point (UTC)"""
    first_frame: Annotated[int, Field(ge=0)]
    """frame of the first point"""
    last_frame: Annotated[int, Field(ge=0)]
    """frame of the last point"""
    points: Annotated[int, Field(ge=1)]
    """number of track points"""
    path_px: Annotated[Float32, AtDoor(0)]
    """length of the path of the ground contact point, px"""
    x_entry: Finite32
    """first ground contact point, px"""
    y_entry: Finite32
    """first ground contact point, px"""
    x_exit: Finite32
    """last ground contact point, px"""
    y_exit: Finite32
    """last ground contact point, px"""
    reason: Literal["lost", "left_frame", "input_changed", "end_of_video"]
    """why it ended"""
    displacement_px: Annotated[Float32, AtDoor(0)]
    """straight distance between the first and the last ground contact point, px"""
    duration_s: Annotated[float, AtDoor(0)]
    """time from the first point to the last, s"""
    x1_mean: Finite32 | None
    """left edge of the box, mean over the points, px; null in events of before version 3"""
    y1_mean: Finite32 | None
    """upper edge of the box, mean over the points, px; null likewise"""
    x2_mean: Finite32 | None
    """right edge of the box, mean over the points, px; null likewise"""
    y2_mean: Finite32 | None
    """lower edge of the box, mean over the points, px; null likewise"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Events of version 2 with the time between their own first and last point, and no mean box."""
        began, ended = (older.column(name).cast(pa.int64()).to_numpy() for name in ("began_at", "time"))
        # An event of before may end before it begins: clocks did what they wanted.
        duration_s = np.maximum(ended - began, 0) / 1e6
        nothing = pa.nulls(len(older), pa.float32())
        return pa.RecordBatch.from_arrays(
            [*older.columns, pa.array(duration_s), nothing, nothing, nothing, nothing], schema=schema_of(cls)
        )


class Appearance(EventType, type="appearance", version=1, subject="track_id"):
    """How a tracked object looked, for finding others that look alike; its time is that of the track's last point."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    method: str
    """how the descriptor was made; only descriptors of one method compare"""
    descriptor: PersonalBytes
    """the descriptor: for `tones-2x16`, 32 bytes of 255 times the root of the share of a histogram's bin"""
    views: Annotated[int, AtDoor(1)]
    """number of clear views that it is the mean of"""


class ActivityInterval(EventType, type="activity_interval", version=1):
    """A span of time in which something moved; its time is the span's beginning."""

    ended_at: UtcTime
    """end of the span (UTC)"""
    first_frame: Annotated[int, Field(ge=0)]
    """first frame with motion"""
    last_frame: Annotated[int, Field(ge=0)]
    """last frame with motion"""
    tracks_max: Annotated[int, Field(ge=0)]
    """most tracks seen at once"""
    area_share_max: Share32
    """largest share of the picture in motion, 0 to 1"""
