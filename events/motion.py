"""Motion: what moved, where and when.

Pixels: origin top-left, x right, y down; boxes are `x1 y1 x2 y2`.
"""

from typing import Annotated, Literal

from pydantic import Field

from events.model import EventType, Float32, UtcTime


class TrackPoint(EventType, type="track_point", version=1, subject="track_id"):
    """Where one tracked object is in one frame."""

    track_id: Annotated[int, Field(ge=1)]
    """number of the track, unique within its source"""
    frame: Annotated[int, Field(ge=0)]
    """number of the frame within the video, from 0"""
    x: Float32
    """filtered ground contact point (middle of the box's lower edge), px"""
    y: Float32
    """filtered ground contact point (middle of the box's lower edge), px"""
    x1: Float32
    """left edge of the box, px"""
    y1: Float32
    """upper edge of the box, px"""
    x2: Float32
    """right edge of the box, px"""
    y2: Float32
    """lower edge of the box, px"""
    vx: Float32
    """filtered velocity of the ground contact point, px/s"""
    vy: Float32
    """filtered velocity of the ground contact point, px/s"""
    confidence: Float32
    """how far the box rests on what was seen in this frame, 0 (predicted) to 1 (seen)"""


class TrackEnded(EventType, type="track_ended", version=1, subject="track_id"):
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
    path_px: Float32
    """length of the path of the ground contact point, px"""
    x_entry: Float32
    """first ground contact point, px"""
    y_entry: Float32
    """first ground contact point, px"""
    x_exit: Float32
    """last ground contact point, px"""
    y_exit: Float32
    """last ground contact point, px"""
    reason: Literal["lost", "left_frame", "input_changed", "end_of_video"]
    """why it ended"""


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
    area_share_max: Float32
    """largest share of the picture in motion, 0 to 1"""
