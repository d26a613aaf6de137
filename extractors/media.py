"""The words of a decoded video: what it is, its frames, and the gaps between them.

Pure data. `Frame.time_us` counts from the first frame and strictly increases; `Gap` stands in the
stream of frames at the place where something is missing or changed, so no reader can overlook it.
"""

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
"""Pixels `(height, width, 3)`, BGR, 8 bits."""


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """What a video file says of itself, before a frame of it is decoded."""

    width: int
    """width of a frame, px"""
    height: int
    """height of a frame, px"""
    fps: float | None
    """nominal frames per second, 1/s"""
    frames_expected: int | None
    """frames that the container announces"""
    duration_s: float | None
    """length that the container announces, s"""
    codec: str
    """codec of the video stream, as the decoder names it"""
    creation_time: datetime | None
    """when it was recorded, as the container says (UTC); often the time of the export"""
    sha256: str
    """SHA-256 of the file's bytes, hexadecimal"""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One decoded picture."""

    index: int
    """number of the frame in order of presentation, from 0; counts decoded frames only"""
    time_us: int
    """presentation time since the first frame, µs; strictly increasing"""
    image: Image

    @property
    def time_s(self) -> float:
        """Presentation time since the first frame, s."""
        return self.time_us / 1e6


class GapReason(StrEnum):
    """Why a stream of frames has a gap."""

    CORRUPT = "corrupt"
    """packets or frames that do not decode were left out"""
    SIZE_CHANGED = "size_changed"
    """from here on the frames have another size"""
    TIME_JUMPED = "time_jumped"
    """the video's clock stood, went back or leapt; times continue from the last frame"""
    SHORTFALL = "shortfall"
    """the end came a few frames before the container's count"""
    BROKEN_OFF = "broken_off"
    """the file ends in the middle"""


@dataclass(frozen=True, slots=True)
class Gap:
    """A place in the stream of frames where something is missing or changed."""

    before_index: int
    """number of the frame that follows the gap"""
    reason: GapReason
    detail: str
    """what happened, for people"""

    def __str__(self) -> str:
        return f"before frame {self.before_index}: {self.detail}"
