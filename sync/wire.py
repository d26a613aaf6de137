"""What travels between station and central, to the byte (docs/reference/sync.md).

Contract: `decode_records(encode_record(s))` is the identity but for `position`, which belongs to a
log; a segment's header and payload travel verbatim. Decoding trusts no length, and needs no
knowledge of event types. The JSON messages are frozen and refuse what they do not know; a change of
any of them is another protocol version.

It does not check hashes: that is the work of whoever stores (`sync.apply`) or sends (`sync.outbox`).
"""

import struct
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from typing import Annotated, Self, TypeVar

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from events import (
    CorruptSegment,
    InvalidName,
    Position,
    Segment,
    StreamName,
    header_bytes,
    parse_header,
    station_name,
)
from events.segment import PAYLOAD_MAX_BYTES, microseconds
from store import StreamHead
from sync.errors import ProtocolMismatch, WireError

PROTOCOL = 1
PATH = "/sync/v1"
RECORD_TYPE = "application/vnd.vian.segments"

RECORD_MAGIC = b"VIANREC1"
_PREFIX = struct.Struct(">8sI")
_MIDDLE = struct.Struct(">32s32sqI")

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
"""Most streams in one hello."""
HELLO_BYTES_MAX = 4 * 1024 * 1024
ANSWER_BYTES_MAX = 4 * 1024 * 1024

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TEXT_MAX = 4000

M = TypeVar("M", bound="Message")


def record_size(segment: Segment) -> int:
    """Bytes of the segment's record."""
    return _PREFIX.size + len(header_bytes(segment.header)) + _MIDDLE.size + len(segment.payload)


def encode_record(segment: Segment) -> bytes:
    """The segment's record."""
    header = header_bytes(segment.header)
    return b"".join(
        (
            _PREFIX.pack(RECORD_MAGIC, len(header)),
            header,
            _MIDDLE.pack(
                segment.payload_hash, segment.chain_hash, microseconds(segment.recorded_at), len(segment.payload)
            ),
            segment.payload,
        )
    )


def encode_records(segments: Sequence[Segment]) -> bytes:
    """The segments' records, one behind the other: a body."""
    return b"".join(encode_record(segment) for segment in segments)


def decode_records(body: bytes, *, bytes_max: int = BODY_BYTES_MAX, segments_max: int = SEGMENTS_MAX) -> list[Segment]:
    """The segments of a body, one or more; their position is 0, for no log has placed them yet.

    Raises:
        WireError: The body is too large, empty, or not a sequence of whole records.
    """
    if len(body) > bytes_max:
        raise WireError(f"a body has at most {bytes_max} bytes, got {len(body)}")
    if not body:
        raise WireError("a body holds one record or more, got 0 bytes")
    segments: list[Segment] = []
    at = 0
    while at < len(body):
        if len(segments) == segments_max:
            raise WireError(f"a body holds at most {segments_max} records, got more")
        place = f"record {len(segments) + 1} at byte {at}"
        segment, at = _decode_record(body, at, place)
        segments.append(segment)
    return segments


def _decode_record(body: bytes, at: int, place: str) -> tuple[Segment, int]:
    magic, header_length = _PREFIX.unpack(_part(body, at, _PREFIX.size, place))
    if magic != RECORD_MAGIC:
        raise WireError(f"{place} must begin with {RECORD_MAGIC!r}, got {magic!r}")
    if header_length > HEADER_BYTES_MAX:
        raise WireError(f"{place}: a header has at most {HEADER_BYTES_MAX} bytes, it declares {header_length}")
    at += _PREFIX.size
    header_data = _part(body, at, header_length, place)
    at += header_length
    payload_hash, chain_hash, recorded_us, length = _MIDDLE.unpack(_part(body, at, _MIDDLE.size, place))
    at += _MIDDLE.size
    if length > PAYLOAD_BYTES_MAX:
        raise WireError(f"{place}: a payload has at most {PAYLOAD_BYTES_MAX} bytes, it declares {length}")
    payload = _part(body, at, length, place)
    try:
        header = parse_header(header_data)
        recorded_at = _EPOCH + timedelta(microseconds=recorded_us)
    except CorruptSegment as error:
        raise WireError(f"{place}: {error}") from error
    except OverflowError as error:
        raise WireError(f"{place}: recorded_at must lie in the years 1 to 9999, got {recorded_us} µs") from error
    return Segment(header, payload, payload_hash, chain_hash, Position(0), recorded_at), at + length


def _part(body: bytes, at: int, count: int, place: str) -> bytes:
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

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def encoded(self) -> bytes:
        """The message as JSON."""
        return self.model_dump_json().encode()


class StreamState(Message):
    """Where one stream stands: a head at the station, a cursor at central."""

    stream: StreamText
    epoch: EpochNumber
    sequence: SequenceNumber
    chain_hash: HashText

    @classmethod
    def of(cls, head: StreamHead) -> Self:
        """The state that a log's head of the stream gives."""
        return cls(stream=str(head.stream), epoch=head.epoch, sequence=head.sequence, chain_hash=head.chain_hash.hex())

    def head(self) -> StreamHead:
        """The state as a head."""
        return StreamHead(StreamName.parse(self.stream), self.epoch, self.sequence, bytes.fromhex(self.chain_hash))


class Hello(Message):
    """The station says who it is and where its planned streams stand."""

    protocol: int
    program: Text
    station: StationText
    epoch: EpochNumber
    time: AwareDatetime
    streams: Annotated[tuple[StreamState, ...], Field(max_length=STREAMS_MAX)]


class HelloAnswer(Message):
    """Central's cursor for each stream of the hello, and what it takes at most."""

    protocol: int
    program: Text
    station: StationText
    time: AwareDatetime
    cursors: Annotated[tuple[StreamState, ...], Field(max_length=STREAMS_MAX)]
    body_bytes_max: Annotated[int, Field(ge=1)]
    segments_max: Annotated[int, Field(ge=1)]


class SegmentsAnswer(Message):
    """All segments of the body are durable at central; where each of their streams stands now."""

    cursors: tuple[StreamState, ...]
    stored: Annotated[int, Field(ge=0)]
    duplicates: Annotated[int, Field(ge=0)]


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
    cursors: tuple[StreamState, ...] = ()


class _Versioned(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    protocol: int


def parse(message_type: type[M], data: bytes) -> M:
    """The message that the JSON holds.

    Raises:
        WireError: It is not that message.
    """
    try:
        return message_type.model_validate_json(data)
    except ValidationError as error:
        raise WireError(_reason(message_type.__name__, error)) from error


def parse_versioned(message_type: type[M], data: bytes) -> M:
    """The message that the JSON holds, if it is of this protocol version.

    Raises:
        ProtocolMismatch: It is of another version, whatever else it says.
        WireError: It is not that message.
    """
    try:
        protocol = _Versioned.model_validate_json(data).protocol
    except ValidationError as error:
        raise WireError(_reason(message_type.__name__, error)) from error
    if protocol != PROTOCOL:
        raise ProtocolMismatch(f"sync protocol version {PROTOCOL} is spoken here, got version {protocol}")
    return parse(message_type, data)


def program() -> str:
    """Name and version of this program, as it introduces itself."""
    return f"vian/{version('vian')}"


def _reason(name: str, error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(str(part) for part in first["loc"])
    return f"not a {name}: {f'{place}: ' if place else ''}{first['msg']}"
