"""What a daemon is told of its pace, and what it says of its steps and its standing.

Contract: frozen data; nothing here acts.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from events import Station, StreamName
from store import LogUnavailable
from sync.errors import SyncError


@dataclass(frozen=True, slots=True)
class Pace:
    """How much at a time, and how long between."""

    request_bytes: int = 256 * 1024
    """Bytes of segments in one request; a single larger segment goes alone."""
    backoff_s: float = 0.5
    """Pause after the first failure; it doubles with each further one."""
    backoff_s_max: float = 60.0
    """Longest pause after a failure."""
    idle_s: float = 60.0
    """Longest sleep when there is nothing to do; a new segment ends it."""


@dataclass(frozen=True, slots=True)
class Step:
    """What one step did."""

    did: Literal["planned", "hello", "sent", "nothing", "doubted", "stopped", "failed"]
    sleep_s: float = 0.0
    """How long nothing needs to be done, unless the log grows."""
    segments: int = 0
    events: int = 0
    bytes: int = 0
    error: SyncError | LogUnavailable | None = None
    """Why it failed, or why a stream was stopped."""


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """Where one planned stream stands."""

    stream: StreamName
    epoch: int
    priority: int
    sequence: int
    """Newest event here."""
    cursor: int | None
    """Newest event at central; None before the first hello."""
    backlog: int | None
    """Events that central lacks."""
    error: str | None
    """Why the stream is stopped."""


@dataclass(frozen=True, slots=True)
class Status:
    """Where the station stands with central."""

    station: Station
    central: str
    streams: tuple[StreamStatus, ...]
    last_contact: datetime | None
    """When central answered last, by this station's clock."""
    clock_offset_s: float | None
    """How far central's clock was ahead of this station's at the last hello, travel time included."""
    failures: int
    """Failed steps since something last went well."""
    last_error: str | None
