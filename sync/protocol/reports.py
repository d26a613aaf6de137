"""What a daemon is told of its pace, and what it says of its steps and its standing.

Contract: frozen data; nothing here acts. `Status.from_json(status.to_json())` is the status: a daemon keeps
it in its log as the state of the checkpoint `sync`, where other processes read it.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Literal, Protocol

from pydantic import BeforeValidator, PlainSerializer, TypeAdapter, ValidationError

from events import Station, StreamName
from store import Log, LogUnavailable
from sync.errors import SyncError, WireError

CHECKPOINT = "sync"
"""Name of the checkpoint in the station's log whose state is the daemon's newest status."""

State = Literal["starting", "sending", "caught_up", "paused", "waiting"]
"""`waiting`: for the pause after a failure to end; `paused`: by the plan."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How much at a time, and how long between."""

    request_bytes: int = 2 * 1024 * 1024
    """Most bytes of segments in one request; a single larger segment goes alone."""
    request_bytes_min: int = 16 * 1024
    """Bytes of segments in the first request, and however slow the link is."""
    latency_s: float = 0.3
    """How long a request should take: what is live waits about so long at most for one that is under way."""
    in_flight: int = 1
    """Requests with segments that are under way at once."""
    backoff_s: float = 0.5
    """Pause after the first failure; it doubles with each further one."""
    backoff_s_max: float = 60.0
    """Longest pause after a failure."""
    idle_s: float = 60.0
    """Longest sleep when there is nothing to do; a new segment ends it."""
    hello_s: float = 900.0
    """Time without an answer of central's after which an idle daemon says hello, to see whether all is well."""


class Chore(Protocol):
    """Further work of a daemon, done between its own steps: deriving streams, pruning."""

    def step(self, now: datetime) -> bool:
        """Do one bounded thing; whether there is more to do.

        It is called when nothing live waits to be sent, in turn with backlog, from the daemon's thread. What it
        appends is seen at the daemon's next step. What was done must be safe to do again.

        Raises:
            LogUnavailable: The database is away; it is called again later.
            SyncError, EventError, StoreError: It cannot be done now; the daemon's status says why, and it is called
                again later.
        """


@dataclass(frozen=True, slots=True)
class Step:
    """What one step did."""

    did: Literal[
        "planned",
        "hello",
        "sending",
        "sent",
        "countersigned",
        "repaired",
        "compared",
        "chore",
        "nothing",
        "doubted",
        "stopped",
        "failed",
    ]
    """`sending`: something is under way; `sent`: it was acknowledged."""
    sleep_s: float = 0.0
    """How long nothing needs to be done, unless the log grows."""
    segments: int = 0
    events: int = 0
    bytes: int = 0
    error: SyncError | LogUnavailable | None = None
    """Why it failed, or why a stream was stopped."""
    gone: tuple[str, ...] = ()
    """Ranges that are sent without payload though they were never given up: central lost what was pruned here."""


_Stream = Annotated[
    StreamName,
    BeforeValidator(lambda given: StreamName.parse(given) if isinstance(given, str) else given),
    PlainSerializer(str, return_type=str),
]


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """Where one planned stream stands."""

    stream: _Stream
    epoch: int
    priority: int
    sequence: int
    """Newest event here."""
    cursor: int | None
    """Newest event at central; None before the first hello, and where central holds another history of the stream."""
    backlog: int | None
    """Events that central lacks and that the plan sends, gaps below its newest included."""
    error: str | None
    """Why the stream is stopped."""
    held_until: datetime | None = None
    """Time of the newest event that central acknowledged; None where this daemon has sent none."""
    bytes_per_event: float | None = None
    """What an event took on the wire, on average; None where this daemon has sent none."""
    is_apart: bool = False
    """It is of an earlier epoch of which central holds another history, and stays here."""


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
    state: State = "starting"
    protocol: int = 2
    rate_bps: float | None = None
    """Bits a second that were sent while sending, measured; None before anything was."""
    saved_at: datetime | None = None
    """When this was saved, by this station's clock; None where it was not."""
    daemon: str = ""
    """Which daemon says so: each has a name of its own."""
    other_daemons: int = 0
    """Others that were seen to run for this station at the same time: one too many, which does no harm."""
    countersigned: int | None = None
    """Sequence of the newest checkpoint that central countersigned."""
    notes: tuple[str, ...] = ()
    """What else the operator should know."""

    def to_json(self) -> bytes:
        """The status as it is kept in the log."""
        return _ADAPTER.dump_json(self)

    @classmethod
    def from_json(cls, data: bytes) -> "Status":
        """The status that was kept.

        Raises:
            WireError: It is none.
        """
        try:
            return _ADAPTER.validate_json(data)
        except ValidationError as error:
            raise WireError(f"the saved status of sync cannot be read: {error.errors()[0]['msg']}") from error


_ADAPTER: TypeAdapter[Status] = TypeAdapter(Status)


def saved_status(log: Log) -> Status | None:
    """What the station's daemon said last; None where none ever ran, or a newer ViAn's did.

    Raises:
        LogUnavailable: The database is away.
    """
    state = log.checkpoint(CHECKPOINT).state
    try:
        return Status.from_json(state) if state else None
    except WireError:
        return None  # The daemon that runs next writes it anew.
