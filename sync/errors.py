"""What can go wrong between a station and central.

SyncError
├── WireError            bytes or JSON that are not this protocol's
├── PlanError            a plan that cannot be used
├── FilterFailed         a plan's condition cannot be worked out for an event
├── GrantError           a token or a table of tokens that cannot be used
├── BadSignature         a request that is not signed as it must be
├── SelectRefused        SQL that a station may not ask
├── Refusal              central: a request that is refused, with the answer to give
├── CentralError         station: central did not do what it was asked
│   ├── CentralUnreachable   no connection, a connection lost, no answer in time
│   ├── CentralFailed        central answered that it is in trouble itself
│   ├── BadAnswer            the answer is not central's: a proxy's page, another server, cut off
│   ├── NotAuthorised        the token is not granted, or not for this station
│   ├── ProtocolMismatch     the two sides share no version of the protocol
│   ├── SessionOver          the session's token is no longer good: say hello again
│   └── Refused              central refused the request and said why
└── StreamStopped        station: a stream that must not be sent further; the others go on
    ├── HeadsDisagree        central holds another history of the stream than this station
    ├── Damaged              the station's own bytes do not carry their hash
    └── SegmentRefused       central will never take one of its segments
"""

from dataclasses import dataclass

from events import Run, StreamName
from sync.runs import StreamKey


class SyncError(Exception):
    """Base of every error that the package `sync` raises."""


class WireError(SyncError):
    """Bytes or JSON that are not this protocol's."""


class PlanError(SyncError):
    """A plan that cannot be used."""


class FilterFailed(SyncError):
    """A plan's condition cannot be worked out for an event: a number that overflows, most often."""


class GrantError(SyncError):
    """A token or a table of tokens that cannot be used."""


class BadSignature(SyncError):
    """A request that is not signed as it must be."""

    def __init__(self, reason: str, *, key_id: str | None = None, is_key_known: bool = False) -> None:
        super().__init__(reason)
        self.key_id = key_id
        self.is_key_known = is_key_known


class SelectRefused(SyncError):
    """SQL that a station may not ask: what, and where."""


@dataclass(eq=False)
class Refusal(SyncError):
    """A request that central refuses: the HTTP status and what the problem body says."""

    status: int
    code: str
    error: str
    got: str
    wanted: str
    next: str
    stream: StreamName | None = None
    epoch: int | None = None
    first_sequence: int | None = None
    held: tuple[tuple[StreamKey, tuple[Run, ...]], ...] = ()
    """what is held of the streams of the request"""

    def __str__(self) -> str:
        return f"{self.error}: got {self.got}, wanted {self.wanted}. Next: {self.next}"


class CentralError(SyncError):
    """Central did not do what it was asked; what it stored is in doubt until the next hello."""


class CentralUnreachable(CentralError):
    """No connection, a connection lost, or no answer in time."""


class CentralFailed(CentralError):
    """Central answered that it is in trouble itself."""


class BadAnswer(CentralError):
    """The answer is not central's: a proxy's page, another server's, or cut off."""


class NotAuthorised(CentralError):
    """The token is not granted at central, or not for this station."""


class ProtocolMismatch(CentralError):
    """The two sides share no version of the protocol."""


class SessionOver(CentralError):
    """The session is over, as sessions are after a while; a new hello begins another."""


class Refused(CentralError):
    """Central refused the request and said why, perhaps because of one segment.

    `got` is what it says that it got, as it came: untrusted text of several lines.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str = "",
        stream: StreamName | None = None,
        epoch: int | None = None,
        first_sequence: int | None = None,
        got: str = "",
    ) -> None:
        super().__init__(message)
        self.code = code
        self.got = got
        self.stream = stream
        self.epoch = epoch
        self.first_sequence = first_sequence


class StreamStopped(SyncError):
    """A stream that must not be sent further; the others go on."""

    stream: StreamName
    epoch: int


@dataclass(eq=False)
class HeadsDisagree(StreamStopped):
    """Central holds another history of the stream than this station."""

    stream: StreamName
    epoch: int
    sequence: int
    here: bytes | None
    """Chain hash here at that sequence; None where no segment here ends at it."""
    at_central: bytes
    is_past: bool = False
    """Whether the epoch is an earlier one of this log's."""

    def __str__(self) -> str:
        here = f"the chain hash here is {self.here.hex()}" if self.here else "no segment ends there on this station"
        differs = f"at sequence {self.sequence} {here}, at central it is {self.at_central.hex()}"
        if self.is_past:
            return (
                f"stream {self.stream} of the earlier epoch {self.epoch} stays here: {differs}. What is newer is sent. "
                f"Next, to hand it on: vian evidence export --stream {self.stream} --epoch {self.epoch}"
            )
        return (
            f"stream {self.stream} (epoch {self.epoch}) is stopped: {differs}; central holds events of this station "
            "that this log never had: the machine took another's place, or its disk was put back to an older state. "
            "Next: stop vian serve and vian sync here, then vian station new-epoch"
        )


@dataclass(eq=False)
class Damaged(StreamStopped):
    """The station's own bytes do not carry their hash, or a part of the stream is missing."""

    stream: StreamName
    epoch: int
    first_sequence: int
    reason: str

    def __str__(self) -> str:
        return (
            f"stream {self.stream} (epoch {self.epoch}) is stopped: this station's own segment from sequence "
            f"{self.first_sequence} is damaged: {self.reason}. Next: vian verify"
        )


@dataclass(eq=False)
class SegmentRefused(StreamStopped):
    """Central will never take one of the stream's segments."""

    stream: StreamName
    epoch: int
    first_sequence: int
    reason: str

    def __str__(self) -> str:
        return (
            f"stream {self.stream} (epoch {self.epoch}) is stopped: its segment from sequence {self.first_sequence} "
            f"is refused: {self.reason}. The other streams go on; restart vian sync to try it again"
        )
