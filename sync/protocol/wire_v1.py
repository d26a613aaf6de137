"""Protocol 1, as release N-1 speaks it (docs/reference/sync.md): its records and its messages.

Contract: as that release had it, to the byte; a conversation recorded from it holds this in tests. A message
that holds a key which is not known is refused.
"""

import struct
from collections.abc import Sequence
from typing import Annotated, Self, TypeVar

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from events import Segment, StreamName, header_bytes
from events.segment import microseconds
from store import StreamHead
from sync.errors import ProtocolMismatch, WireError
from sync.protocol.wire import (
    BODY_BYTES_MAX,
    HEADER_BYTES_MAX,
    PAYLOAD_BYTES_MAX,
    SEGMENTS_MAX,
    STREAMS_MAX,
    EpochNumber,
    HashText,
    Message,
    SequenceNumber,
    StationText,
    StreamText,
    Text,
    each_record,
    parse,
    part,
    reason,
    segment_of,
)

PROTOCOL = 1
PATH = "/sync/v1"
ANSWER_BYTES_MAX = 4 * 1024 * 1024

RECORD_MAGIC = b"VIANREC1"
_PREFIX = struct.Struct(">8sI")
_MIDDLE = struct.Struct(">32s32sqI")

M = TypeVar("M", bound="MessageV1")


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
    return each_record(body, _decode_record, bytes_max, segments_max)


def _decode_record(body: bytes, at: int, place: str) -> tuple[Segment, int]:
    magic, header_length = _PREFIX.unpack(part(body, at, _PREFIX.size, place))
    if magic != RECORD_MAGIC:
        raise WireError(f"{place} must begin with {RECORD_MAGIC!r}, got {magic!r}")
    if header_length > HEADER_BYTES_MAX:
        raise WireError(f"{place}: a header has at most {HEADER_BYTES_MAX} bytes, it declares {header_length}")
    at += _PREFIX.size
    header_data = part(body, at, header_length, place)
    at += header_length
    payload_hash, chain_hash, recorded_us, length = _MIDDLE.unpack(part(body, at, _MIDDLE.size, place))
    at += _MIDDLE.size
    if length > PAYLOAD_BYTES_MAX:
        raise WireError(f"{place}: a payload has at most {PAYLOAD_BYTES_MAX} bytes, it declares {length}")
    payload = part(body, at, length, place)
    return segment_of(header_data, payload, payload_hash, chain_hash, recorded_us, place), at + length


class MessageV1(Message):
    """Base of the JSON messages."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class StreamState(MessageV1):
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


class Hello(MessageV1):
    """The station says who it is and where its planned streams stand."""

    protocol: int
    program: Text
    station: StationText
    epoch: EpochNumber
    time: AwareDatetime
    streams: Annotated[tuple[StreamState, ...], Field(max_length=STREAMS_MAX)]


class HelloAnswer(MessageV1):
    """Central's cursor for each stream of the hello, and what it takes at most."""

    protocol: int
    program: Text
    station: StationText
    time: AwareDatetime
    cursors: Annotated[tuple[StreamState, ...], Field(max_length=STREAMS_MAX)]
    body_bytes_max: Annotated[int, Field(ge=1)]
    segments_max: Annotated[int, Field(ge=1)]


class SegmentsAnswer(MessageV1):
    """All segments of the body are durable at central; where each of their streams stands now."""

    cursors: tuple[StreamState, ...]
    stored: Annotated[int, Field(ge=0)]
    duplicates: Annotated[int, Field(ge=0)]


class Problem(MessageV1):
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


def parse_versioned(message_type: type[M], data: bytes) -> M:
    """The message that the JSON holds, if it is of this protocol version.

    Raises:
        ProtocolMismatch: It is of another version, whatever else it says.
        WireError: It is not that message.
    """
    try:
        protocol = _Versioned.model_validate_json(data).protocol
    except ValidationError as error:
        raise WireError(reason(message_type.__name__, error)) from error
    if protocol != PROTOCOL:
        raise ProtocolMismatch(f"sync protocol version {PROTOCOL} is spoken here, got version {protocol}")
    return parse(message_type, data)
