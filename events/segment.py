"""The segment: one append of one stream, encoded once, the truth everywhere.

Contract: `decode(encode(batch))` is the identity, bit for bit, NaN payloads included. The payload
is `zstd(Arrow RecordBatch IPC message, without schema)`; type and version in the header name the
schema. The header's byte layout (`header_bytes`, docs/reference/segment.md) is what the chain
hashes, what travels and what is sealed; every number is big-endian.

`chain_hash = SHA-256(previous chain_hash | header | payload_hash)`; the first segment of a stream
follows 32 zero bytes. `position` and `recorded_at` belong to the log that stores the segment, not
to the segment: they are not hashed, and differ between station and central.
"""

import hashlib
import struct
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NewType

import pyarrow as pa
import pyarrow.compute as pc
import zstandard

from events.catalogue import Catalogue
from events.columns import EventBatch, schema_of
from events.errors import CorruptSegment, InvalidEvent
from events.names import StreamName

Sequence = NewType("Sequence", int)
Position = NewType("Position", int)

MAGIC = b"VIANSEG1"
GENESIS = bytes(32)
PAYLOAD_MAX_BYTES = 64 * 1024 * 1024
"""Most bytes that a payload may decode to; a frame that declares or holds more is refused."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_ZSTD_LEVEL = 3


@dataclass(frozen=True, slots=True)
class Producer:
    """Who said it: an extractor in one version and one configuration."""

    name: str
    version: str
    configuration_hash: bytes
    """SHA-256 of the configuration's canonical form, 32 bytes."""

    def __post_init__(self) -> None:
        if len(self.configuration_hash) != 32:
            raise InvalidEvent(f"configuration_hash must have 32 bytes, got {len(self.configuration_hash)}")


@dataclass(frozen=True, slots=True)
class Draft:
    """A segment before the log has given it a place: encoded, without sequence, hash chain and position."""

    stream: StreamName
    event_count: int
    schema_version: int
    time_min: datetime
    time_max: datetime
    producer: Producer
    payload: bytes
    payload_hash: bytes


@dataclass(frozen=True, slots=True)
class Header:
    """What a segment says of itself; all of it is hashed."""

    stream: StreamName
    epoch: int
    first_sequence: Sequence
    event_count: int
    schema_version: int
    time_min: datetime
    time_max: datetime
    producer: Producer

    @property
    def last_sequence(self) -> Sequence:
        """Sequence of the last event."""
        return Sequence(self.first_sequence + self.event_count - 1)


@dataclass(frozen=True, slots=True)
class Segment:
    """One stored append: header, bytes, proof, and its place in the log that holds it."""

    header: Header
    payload: bytes
    payload_hash: bytes
    chain_hash: bytes
    position: Position
    recorded_at: datetime

    @property
    def stream(self) -> StreamName:
        """The stream it belongs to."""
        return self.header.stream


def encode(stream: StreamName, batch: EventBatch, producer: Producer) -> Draft:
    """The batch as a draft of the stream's next segment.

    Raises:
        InvalidEvent: The batch is not of the stream's type, is empty, or a time lies outside the
            years 1 to 9999.
    """
    if batch.type.type_name != stream.type:
        raise InvalidEvent(f"stream {stream} takes {stream.type}, got a batch of {batch.type.type_name}")
    if not len(batch):
        raise InvalidEvent(f"stream {stream}: a segment holds one event or more, got an empty batch")
    payload = encode_payload(batch)
    times = pc.min_max(batch.data.column("time").cast(pa.int64())).as_py()
    return Draft(
        stream=stream,
        event_count=len(batch),
        schema_version=batch.type.version,
        time_min=_time(stream, times["min"]),
        time_max=_time(stream, times["max"]),
        producer=producer,
        payload=payload,
        payload_hash=hashlib.sha256(payload).digest(),
    )


def encode_payload(batch: EventBatch) -> bytes:
    """The batch's bytes: zstd of its Arrow IPC message without schema."""
    data = batch.data
    if data.get_total_buffer_size() > PAYLOAD_MAX_BYTES:
        raise InvalidEvent(
            f"{batch.type.type_name}: a segment holds at most {PAYLOAD_MAX_BYTES} bytes before compression, "
            f"got {data.get_total_buffer_size()}; append it in smaller batches"
        )
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(data.serialize())


def decode(segment: Segment, catalogue: Catalogue) -> EventBatch:
    """The segment's events.

    Raises:
        UnknownType: The catalogue does not know the type or the version.
        CorruptSegment: The bytes do not decode to what the header says.
    """
    event_type = catalogue.find(segment.stream.type, segment.header.schema_version)
    batch = EventBatch(event_type, decode_payload(segment.payload, schema_of(event_type)))
    if len(batch) != segment.header.event_count:
        raise CorruptSegment(
            f"{segment.stream} from sequence {segment.header.first_sequence}: the header says "
            f"{segment.header.event_count} events, the payload holds {len(batch)}"
        )
    return batch


def decode_payload(payload: bytes, schema: pa.Schema) -> pa.RecordBatch:
    """The record batch that the bytes hold.

    Raises:
        CorruptSegment: They hold none of this schema, or one that is too large.
    """
    try:
        declared = zstandard.get_frame_parameters(payload).content_size
        if declared > PAYLOAD_MAX_BYTES:
            raise CorruptSegment(
                f"the payload declares {declared} bytes, at most {PAYLOAD_MAX_BYTES} are allowed"
            )
        message = zstandard.ZstdDecompressor().decompress(payload, max_output_size=PAYLOAD_MAX_BYTES)
        batch = pa.ipc.read_record_batch(pa.py_buffer(message), schema)
        batch.validate(full=True)
    except (zstandard.ZstdError, pa.ArrowInvalid, OSError) as error:
        raise CorruptSegment(f"the payload of {len(payload)} bytes does not decode: {error}") from error
    return batch


def header_bytes(header: Header) -> bytes:
    """The header in its fixed layout, as the chain hashes it."""
    return b"".join(
        (
            MAGIC,
            struct.pack(">I", header.epoch),
            _text(header.stream.station),
            _text(header.stream.source),
            _text(header.stream.type),
            struct.pack(
                ">QIIqq",
                header.first_sequence,
                header.event_count,
                header.schema_version,
                microseconds(header.time_min),
                microseconds(header.time_max),
            ),
            _text(header.producer.name),
            _text(header.producer.version),
            header.producer.configuration_hash,
        )
    )


def parse_header(data: bytes) -> Header:
    """The header that the bytes hold, the inverse of `header_bytes`.

    Raises:
        CorruptSegment: The bytes are not a header.
    """
    reader = _Reader(data)
    if reader.take(len(MAGIC)) != MAGIC:
        raise CorruptSegment(f"a segment's header begins with {MAGIC!r}, got {data[:8]!r}")
    (epoch,) = struct.unpack(">I", reader.take(4))
    stream = StreamName.of(reader.text(), reader.text(), reader.text())
    first, count, version, time_min, time_max = struct.unpack(">QIIqq", reader.take(32))
    producer = Producer(reader.text(), reader.text(), reader.take(32))
    if reader.rest:
        raise CorruptSegment(f"a segment's header of {stream} has {reader.rest} bytes too many")
    return Header(
        stream,
        epoch,
        Sequence(first),
        count,
        version,
        _time(stream, time_min),
        _time(stream, time_max),
        producer,
    )


def chain(previous: bytes, header: Header, payload_hash: bytes) -> bytes:
    """The chain hash of a segment that follows the one with the hash `previous`, 32 bytes."""
    return hashlib.sha256(previous + header_bytes(header) + payload_hash).digest()


def microseconds(time: datetime) -> int:
    """Microseconds since 1970-01-01 UTC, exact."""
    return (time - _EPOCH) // timedelta(microseconds=1)


def _time(stream: StreamName, since_epoch_us: int) -> datetime:
    try:
        return _EPOCH + timedelta(microseconds=since_epoch_us)
    except OverflowError as error:
        raise InvalidEvent(
            f"{stream}: time must lie in the years 1 to 9999, got {since_epoch_us} µs"
        ) from error


def _text(text: str) -> bytes:
    data = text.encode()
    if len(data) > 0xFFFF:
        raise InvalidEvent(f"a name in a header has at most 65535 bytes, got {len(data)}")
    return struct.pack(">H", len(data)) + data


class _Reader:
    """Reads a header's parts in order, and refuses to read past its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def rest(self) -> int:
        return len(self._data) - self._at

    def take(self, count: int) -> bytes:
        if count > self.rest:
            raise CorruptSegment(f"a segment's header breaks off after {len(self._data)} bytes")
        part = self._data[self._at : self._at + count]
        self._at += count
        return part

    def text(self) -> str:
        (length,) = struct.unpack(">H", self.take(2))
        try:
            return self.take(length).decode()
        except UnicodeDecodeError as error:
            raise CorruptSegment(f"a name in a segment's header is not UTF-8: {error}") from error
