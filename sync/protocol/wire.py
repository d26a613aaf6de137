"""What travels between station and central, to the byte (docs/reference/sync.md).

Contract: `decode_records(encode_records(r))` is the identity but for `position`, which belongs to a
log; a segment's header and payload travel verbatim. Decoding trusts no length, and needs no
knowledge of event types. The JSON messages are frozen; a key that is not known is passed over, so that
the next release may add one, and a key that may be missing has a default.

It does not check hashes: that is the work of whoever stores (`sync.central.apply`) or sends (`sync.station.outbox`).
"""

import hashlib
import json
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from typing import Annotated, Self, TypeVar

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from events import (
    CorruptSegment,
    InvalidName,
    Position,
    Run,
    Segment,
    StreamName,
    header_bytes,
    parse_header,
    station_name,
)
from events.segment import PAYLOAD_MAX_BYTES, microseconds
from sync.errors import ProtocolMismatch, WireError
from sync.runs import StreamKey

PROTOCOL = 2
PROTOCOLS = (PROTOCOL,)
"""Versions that are spoken under this path; release N-1 has a path of its own (`sync.protocol.wire_v1`)."""
PATH = "/sync/v2"
RECORD_TYPE = "application/vnd.vian.segments"
ORDER_HEADER = "vian-order"
"""Number of a request with segments, which the station gives."""
FOLLOWS_HEADER = "vian-follows"
"""Number of the request that must be stored before this one, because it goes on where that ends."""

RECORD_MAGIC = b"VIANREC2"
BEGINS_RUN = 1
NO_PAYLOAD = 2
_PREFIX = struct.Struct(">8sBI")
_MIDDLE = struct.Struct(">32s32s32sqI")

HEADER_BYTES_MAX = 131_332
"""A header with the longest names that its layout allows."""
PAYLOAD_BYTES_MAX = PAYLOAD_MAX_BYTES + PAYLOAD_MAX_BYTES // 256 + 128
"""A payload of the largest size that does not compress at all."""
RECORD_BYTES_MAX = _PREFIX.size + HEADER_BYTES_MAX + _MIDDLE.size + PAYLOAD_BYTES_MAX
BODY_BYTES_MAX = RECORD_BYTES_MAX
"""Most bytes of a body of segments, so that whatever a log can hold can travel."""
SEGMENTS_MAX = 1000
"""Most segments in one body."""
STREAMS_MAX = 10_000
"""Most streams that a plan may send and a hello may name."""
CURSORS_MAX = 50_000
"""Most streams of one station at central, those of earlier epochs included."""
RUNS_MAX = 100
"""Most runs of one stream at central that a station makes."""
HELLO_BYTES_MAX = 4 * 1024 * 1024
HELLO_ANSWER_BYTES_MAX = 32 * 1024 * 1024
ANSWER_BYTES_MAX = 8 * 1024 * 1024
CHALLENGE_BYTES_MAX = 64 * 1024

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TEXT_MAX = 4000

M = TypeVar("M", bound="Message")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Record:
    """A segment on its way, with what it follows."""

    segment: Segment
    previous: bytes
    """chain hash of the segment before it in its stream; zeros for the first"""
    begins_run: bool = False
    """the station knows that central may lack what comes before it, and means it to"""


def record_size(segment: Segment) -> int:
    """Bytes of the segment's record."""
    return _PREFIX.size + len(header_bytes(segment.header)) + _MIDDLE.size + len(segment.payload)


def encode_record(record: Record) -> bytes:
    """The record's bytes."""
    segment = record.segment
    header = header_bytes(segment.header)
    flags = BEGINS_RUN * record.begins_run | NO_PAYLOAD * (not segment.payload)
    return b"".join(
        (
            _PREFIX.pack(RECORD_MAGIC, flags, len(header)),
            header,
            _MIDDLE.pack(
                record.previous,
                segment.payload_hash,
                segment.chain_hash,
                microseconds(segment.recorded_at),
                len(segment.payload),
            ),
            segment.payload,
        )
    )


def encode_records(records: Iterable[Record]) -> bytes:
    """The records, one behind the other: a body."""
    return b"".join(map(encode_record, records))


def decode_records(body: bytes, *, bytes_max: int = BODY_BYTES_MAX, segments_max: int = SEGMENTS_MAX) -> list[Record]:
    """The records of a body, one or more; their position is 0, for no log has placed them yet.

    Raises:
        WireError: The body is too large, empty, or not a sequence of whole records.
    """
    return each_record(body, _decode_record, bytes_max, segments_max)


def each_record(
    body: bytes, decode: Callable[[bytes, int, str], tuple[R, int]], bytes_max: int, segments_max: int
) -> list[R]:
    """What `decode` makes of each record of a body: given the body, where one begins and that in words, it and its end.

    Raises:
        WireError: The body is too large, empty, holds too many records, or `decode` says so.
    """
    if len(body) > bytes_max:
        raise WireError(f"a body has at most {bytes_max} bytes, got {len(body)}")
    if not body:
        raise WireError("a body holds one record or more, got 0 bytes")
    records: list[R] = []
    at = 0
    while at < len(body):
        if len(records) == segments_max:
            raise WireError(f"a body holds at most {segments_max} records, got more")
        record, at = decode(body, at, f"record {len(records) + 1} at byte {at}")
        records.append(record)
    return records


def _decode_record(body: bytes, at: int, place: str) -> tuple[Record, int]:
    magic, flags, header_length = _PREFIX.unpack(part(body, at, _PREFIX.size, place))
    if magic != RECORD_MAGIC:
        raise WireError(f"{place} must begin with {RECORD_MAGIC!r}, got {magic!r}")
    if flags & ~(BEGINS_RUN | NO_PAYLOAD):
        raise WireError(f"{place}: its flags must be of {BEGINS_RUN | NO_PAYLOAD:#04x}, got {flags:#04x}")
    if header_length > HEADER_BYTES_MAX:
        raise WireError(f"{place}: a header has at most {HEADER_BYTES_MAX} bytes, it declares {header_length}")
    at += _PREFIX.size
    header_data = part(body, at, header_length, place)
    at += header_length
    previous, payload_hash, chain_hash, recorded_us, length = _MIDDLE.unpack(part(body, at, _MIDDLE.size, place))
    at += _MIDDLE.size
    if length > PAYLOAD_BYTES_MAX:
        raise WireError(f"{place}: a payload has at most {PAYLOAD_BYTES_MAX} bytes, it declares {length}")
    if bool(length) == bool(flags & NO_PAYLOAD):
        raise WireError(f"{place}: its flags say {'no ' * bool(flags & NO_PAYLOAD)}payload, it declares {length} bytes")
    payload = part(body, at, length, place)
    segment = segment_of(header_data, payload, payload_hash, chain_hash, recorded_us, place)
    return Record(segment, previous, bool(flags & BEGINS_RUN)), at + length


def segment_of(
    header_data: bytes, payload: bytes, payload_hash: bytes, chain_hash: bytes, recorded_us: int, place: str
) -> Segment:
    """The segment that a record's parts make.

    Raises:
        WireError: They make none.
    """
    try:
        header = parse_header(header_data)
        recorded_at = _EPOCH + timedelta(microseconds=recorded_us)
    except CorruptSegment as error:
        raise WireError(f"{place}: {error}") from error
    except OverflowError as error:
        raise WireError(f"{place}: recorded_at must lie in the years 1 to 9999, got {recorded_us} µs") from error
    return Segment(header, payload, payload_hash, chain_hash, Position(0), recorded_at)


def part(body: bytes, at: int, count: int, place: str) -> bytes:
    """So many bytes of a body.

    Raises:
        WireError: It breaks off before.
    """
    if count > len(body) - at:
        raise WireError(f"{place} breaks off: {count} bytes wanted at byte {at}, {len(body) - at} are left")
    return body[at : at + count]


def _checked_stream(text: str) -> str:
    try:
        return str(StreamName.parse(text))
    except InvalidName as error:
        raise ValueError(str(error)) from error


def _checked_station(text: str) -> str:
    try:
        return station_name(text)
    except InvalidName as error:
        raise ValueError(str(error)) from error


StreamText = Annotated[str, AfterValidator(_checked_stream)]
StationText = Annotated[str, AfterValidator(_checked_station)]
HashText = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
EpochNumber = Annotated[int, Field(ge=0, le=2**31 - 1)]
SequenceNumber = Annotated[int, Field(ge=0, le=2**63 - 1)]
Text = Annotated[str, Field(max_length=_TEXT_MAX)]


class Message(BaseModel):
    """Base of the JSON messages."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    def encoded(self) -> bytes:
        """The message as JSON."""
        return self.model_dump_json().encode()


class StreamState(Message):
    """Where a stream stands at the station."""

    stream: StreamText
    epoch: EpochNumber
    sequence: SequenceNumber
    chain_hash: HashText


class RunState(Message):
    """A range of a stream's events that central holds: those behind `after`, up to `sequence`."""

    after: SequenceNumber
    after_hash: HashText
    """chain hash at `after`; zeros where that is 0"""
    sequence: SequenceNumber
    chain_hash: HashText

    @classmethod
    def of(cls, run: Run) -> Self:
        """The message that says the run."""
        return cls(
            after=run.after, after_hash=run.after_hash.hex(), sequence=run.sequence, chain_hash=run.chain_hash.hex()
        )

    def run(self) -> Run:
        """The run that the message says."""
        return Run(self.after, bytes.fromhex(self.after_hash), self.sequence, bytes.fromhex(self.chain_hash))


class Cursor(Message):
    """What central holds of one stream: runs, ascending; none where it holds nothing."""

    stream: StreamText
    epoch: EpochNumber
    runs: tuple[RunState, ...] = ()

    @classmethod
    def of(cls, key: StreamKey, runs: Iterable[Run]) -> Self:
        """The message that says what central holds of the stream."""
        return cls(stream=str(key.stream), epoch=key.epoch, runs=tuple(map(RunState.of, runs)))

    @property
    def key(self) -> StreamKey:
        """Which stream in which epoch."""
        return StreamKey(StreamName.parse(self.stream), self.epoch)


def cursors_hash(held: Iterable[tuple[StreamKey, Sequence[Run]]]) -> str:
    """SHA-256 of what central holds of a station, in hexadecimal: two that agree in it agree in every cursor."""
    rows = [
        [str(key.stream), key.epoch, [[r.after, r.after_hash.hex(), r.sequence, r.chain_hash.hex()] for r in runs]]
        for key, runs in held
        if runs
    ]
    return hashlib.sha256(json.dumps(sorted(rows), separators=(",", ":")).encode()).hexdigest()


class ChallengeRequest(Message):
    """A station wants to say hello."""

    station: StationText


class Challenge(Message):
    """What the station's hello must be signed over; good once."""

    challenge: Text
    central: Text
    """id of central's key"""
    expires_s: Annotated[float, Field(gt=0)]


class Hello(Message):
    """The station says who it is and where the streams stand of which central may lack something."""

    protocols: Annotated[tuple[int, ...], Field(max_length=100)]
    """versions that it speaks"""
    program: Text
    station: StationText
    epoch: EpochNumber
    time: AwareDatetime
    challenge: Text = ""
    streams: Annotated[tuple[StreamState, ...], Field(max_length=STREAMS_MAX)] = ()
    cursors_hash: HashText | None = None
    """hash of what it believes that central holds; null where it does not know"""
    checkpoint: SequenceNumber | None = None
    """sequence of its newest checkpoint that central countersigned"""
    wants_cursors: bool = True
    """false: the session is for questions, and needs no word of what central holds"""


class Range(Message):
    """A range of events of one stream, both ends inclusive."""

    stream: StreamText
    epoch: EpochNumber
    first_sequence: SequenceNumber
    last_sequence: SequenceNumber


class HelloAnswer(Message):
    """What central holds of the station, and what it takes at most."""

    protocol: int
    program: Text
    station: StationText
    time: AwareDatetime
    token: Text = ""
    token_expires_s: Annotated[float, Field(ge=0)] = 0.0
    """how long the token is good; 0: no end"""
    cursors: Annotated[tuple[Cursor, ...], Field(max_length=CURSORS_MAX)] = ()
    """all streams of the station; none where they are as the station believes"""
    are_cursors_known: bool = False
    """central holds what the hello's hash says"""
    body_bytes_max: Annotated[int, Field(ge=1)]
    segments_max: Annotated[int, Field(ge=1)]
    bits_per_s_max: Annotated[int, Field(ge=1)] | None = None
    """most that the station may send"""
    countersigned: HashText | None = None
    """hash of the station's newest statement that central countersigned"""
    wanted: Annotated[tuple[Range, ...], Field(max_length=1000)] = ()
    """ranges that are damaged at central, which it asks the station for"""


class SegmentsAnswer(Message):
    """All segments of the body are durable at central; what it holds of each of their streams now."""

    cursors: Annotated[tuple[Cursor, ...], Field(max_length=CURSORS_MAX)]
    stored: Annotated[int, Field(ge=0)]
    duplicates: Annotated[int, Field(ge=0)]
    took_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    """seconds that central itself took, by its steady clock: all but the body's way"""


class CountersignRequest(Message):
    """The station asks central to countersign one of its checkpoints."""

    epoch: EpochNumber
    """of the stream of checkpoints"""
    checkpoint_sequence: Annotated[int, Field(ge=1, le=2**63 - 1)]
    """of the event checkpoint_signed"""


class Countersigned(Message):
    """Central's signature that it holds what a checkpoint says: the fields of checkpoint_countersigned."""

    of_station: StationText
    checkpoint_sequence: Annotated[int, Field(ge=1, le=2**63 - 1)]
    statement_hash: HashText
    held: str
    key_id: Text
    algorithm: Text
    signature: Annotated[str, Field(pattern=r"^[0-9a-f]{128}$")]
    time: AwareDatetime


class RepairAnswer(Message):
    """What central put back of the segments that it wanted and a station sent again."""

    repaired: Annotated[int, Field(ge=0)]


class Problem(Message):
    """Why a request was refused, and what to do next."""

    code: Text
    error: Text
    got: Text
    wanted: Text
    next: Text
    stream: StreamText | None = None
    epoch: EpochNumber | None = None
    first_sequence: SequenceNumber | None = None
    cursors: tuple[Cursor, ...] = ()


def parse(message_type: type[M], data: bytes) -> M:
    """The message that the JSON holds.

    Raises:
        WireError: It is not that message.
    """
    try:
        return message_type.model_validate_json(data)
    except ValidationError as error:
        raise WireError(reason(message_type.__name__, error)) from error


def common_protocol(hello: Hello) -> int:
    """The newest version that both sides speak.

    Raises:
        ProtocolMismatch: There is none.
    """
    common = set(PROTOCOLS) & set(hello.protocols)
    if not common:
        spoken, got = (", ".join(map(str, sorted(each))) or "none" for each in (PROTOCOLS, hello.protocols))
        raise ProtocolMismatch(f"sync protocol version {spoken} is spoken here, got version {got}")
    return max(common)


def program() -> str:
    """Name and version of this program, as it introduces itself."""
    return f"vian/{version('vian')}"


def reason(name: str, error: ValidationError) -> str:
    """What is wrong with a message, in a line."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(str(each) for each in first["loc"])
    return f"not a {name}: {f'{place}: ' if place else ''}{first['msg']}"
