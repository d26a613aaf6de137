"""Media: which videos a source has."""

from typing import Annotated

from pydantic import Field

from events.model import AtDoor, EventType, UtcTime


class VideoAdded(EventType, type="video_added", version=1, subject="video"):
    """A recorded video became known as footage of a source."""

    video: str
    """name of the video: SHA-256 of its bytes in hexadecimal"""
    path: str
    """where it was when it was added; for people, not a key"""
    width: Annotated[int, Field(gt=0)]
    """width of a frame, px"""
    height: Annotated[int, Field(gt=0)]
    """height of a frame, px"""
    fps: Annotated[float, AtDoor(0)] | None
    """nominal frames per second of the container, 1/s; null where it has none"""
    frames_expected: Annotated[int, AtDoor(0)] | None
    """frames that the container announces; null where it does not say"""
    codec: str
    """codec of the video stream, as the decoder names it"""
    started_at: UtcTime
    """wall-clock time of the first frame (UTC)"""


class StreamInterrupted(EventType, type="stream_interrupted", version=1, subject="video"):
    """A live stream gives no more pictures; its time is that of the last one."""

    video: str
    """name of the footage, as `video_added` names it"""
    why: str
    """what happened, as told to people: it ended, fell silent, or the extractor was killed"""


class StreamResumed(EventType, type="stream_resumed", version=1, subject="video"):
    """A live stream gives pictures again; its time is that of the first one."""

    video: str
    """name of the footage, as `video_added` names it"""
    interrupted_at: UtcTime
    """time of the last picture before (UTC)"""
