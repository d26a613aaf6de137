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
class Shape:
    """Which of a video's pictures are wanted, and how large at most."""

    width_max: int | None = None
    """wider pictures are made smaller, px; the ratio of the sides stays"""
    height_max: int | None = None
    """higher ones likewise, px"""
    fps: float | None = None
    """most pictures per second of media time, 1/s; of a folder of pictures: the rate at which they were taken"""


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """What a video says of itself, and its first frame shows."""

    width: int
    """width of a frame as it is shown (turned upright), before it is made smaller, px"""
    height: int
    """height of it, px"""
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
    """SHA-256 of the file's bytes, hexadecimal; of names and bytes where it is a folder; empty where it is live"""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One decoded picture."""

    index: int
    """number of the frame in order of presentation, from 0; counts decoded frames only"""
    time_us: int
    """presentation time since the first frame, µs; strictly increasing"""
    image: Image
    scale: float = 1.0
    """pixels of the video for one of the image: more than 1 where it was made smaller"""

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
    CONVERTED = "converted"
    """nothing is missing: from here on pictures are converted in a way that people should know of"""
    DROPPED = "dropped"
    """pictures of a live stream were left out, because they came faster than they were worked on"""
    INTERRUPTED = "interrupted"
    """a live stream gives no more pictures; it is tried again"""
    RESUMED = "resumed"
    """a live stream gives pictures again"""
    CAMERA_MOVED = "camera_moved"
    """the picture shows another view; nothing is said of it until the camera rests"""
    CAMERA_RESTS = "camera_rests"
    """the camera rests again; the view is learnt anew"""


@dataclass(frozen=True, slots=True)
class Gap:
    """A place in the stream of frames where something is missing or changed."""

    before_index: int
    """number of the frame that follows the gap"""
    reason: GapReason
    detail: str
    """what happened, for people"""
    time_us: int | None = None
    """when it happened, on the clock of the frames, µs; where frames do not tell it (live streams)"""
    size: tuple[int, int] | None = None
    """width and height that the video's frames have from here on, before they are made smaller, px; where it changed"""

    def __str__(self) -> str:
        return f"before frame {self.before_index}: {self.detail}"
