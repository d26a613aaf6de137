"""The picture that an event was seen in: which video of the log it is in, and the frame itself.

Contract: reads the log and the video file, changes nothing. A video that is not where it was added from,
or is another file by now, is no error: what is missing is said.
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from events import StreamName, VideoAdded, decode, events_of
from extractors.errors import ExtractorError
from extractors.media import Frame
from extractors.video import digest, frames
from store import Log

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Footage:
    """A frame, or why there is none.

    Attributes:
        video: The video that it is in; None: the log has none of the source.
        frame: Its number in the video.
        picture: The frame, blue-green-red; None: it is not at hand.
        missing: Why not; empty if it is.
    """

    video: VideoAdded | None
    frame: int | None
    picture: Image | None
    missing: str = ""

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height in pixels, where they are known."""
        return None if self.video is None else (self.video.width, self.video.height)


def footage_of(log: Log, station: str, source: str, time: datetime, frame: int | None) -> Footage:
    """The frame of this number in the video that the source had at the time."""
    video = _video_at(log, station, source, time)
    if video is None:
        return Footage(None, frame, None, f"the log has no video of {station}/{source}")
    if frame is None:
        return Footage(video, None, None, "the events say no frame")
    picture, missing = _picture(video, frame)
    return Footage(video, frame, picture, missing)


def _video_at(log: Log, station: str, source: str, time: datetime) -> VideoAdded | None:
    """The last video that began before the time, else the first."""
    videos = [
        event
        for segment in log.read_lives(StreamName.of(station, source, VideoAdded.type_name))
        for event in events_of(decode(segment, log.catalogue))
        if isinstance(event, VideoAdded)
    ]
    before = [video for video in videos if video.started_at <= time]
    return max(before, key=lambda video: video.started_at) if before else next(iter(videos), None)


def _picture(video: VideoAdded, wanted: int) -> tuple[Image | None, str]:
    if "://" in video.path or video.path.startswith("/dev/"):
        return None, f"{video.path} is a live stream: nobody keeps its pictures"
    path = Path(video.path)
    try:
        if digest(path) != video.video:
            return None, f"{path} is another file by now than the video that was added"
        for item in frames(path):
            if isinstance(item, Frame) and item.index == wanted:
                return np.asarray(item.image, np.uint8), ""
    except OSError as error:
        return None, f"the video {path} cannot be read: {error.strerror}"
    except ExtractorError as error:
        return None, str(error)
    return None, f"{path} has no frame {wanted}"
