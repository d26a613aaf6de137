"""Work: processes that turn media into events, from start to end."""

from typing import Annotated

from pydantic import Field

from events.model import EventType, JsonText


class ProcessStarted(EventType, type="process_started", version=1, subject="process"):
    """An extractor began to work on a video."""

    process: str
    """name of the process: hash of source, video, extractor, version and configuration"""
    extractor: str
    """name of the extractor"""
    extractor_version: str
    """version of the extractor"""
    configuration: JsonText
    """the extractor's whole configuration"""
    video: str
    """the video it works on: SHA-256 in hexadecimal"""


class ProcessProgressed(EventType, type="process_progressed", version=1, subject="process"):
    """An extractor got so far, or noticed something about its input."""

    process: str
    """name of the process"""
    frames: Annotated[int, Field(ge=0)]
    """frames worked on so far"""
    events: Annotated[int, Field(ge=0)]
    """events emitted so far"""
    note: str | None
    """what was noticed: a gap, a change of the frame's size; null for plain progress"""


class ProcessFinished(EventType, type="process_finished", version=1, subject="process"):
    """An extractor came to the end of its input."""

    process: str
    """name of the process"""
    frames: Annotated[int, Field(ge=0)]
    """frames worked on"""
    events: Annotated[int, Field(ge=0)]
    """events emitted"""
    gaps: Annotated[int, Field(ge=0)]
    """gaps in the input: undecodable frames, changes of size, frames announced and not there"""


class ProcessFailed(EventType, type="process_failed", version=1, subject="process"):
    """An extractor stopped at an error; all that it emitted before stands."""

    process: str
    """name of the process"""
    frames: Annotated[int, Field(ge=0)]
    """frames worked on before the error"""
    events: Annotated[int, Field(ge=0)]
    """events emitted before the error"""
    error: str
    """what went wrong, as told to the user"""
