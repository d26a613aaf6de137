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
import threading
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NewType

import numpy as np
import pyarrow as pa
import zstandard

from events.catalogue import Catalogue
from events.columns import EventBatch, numbers, schema_of
from events.door import check
from events.errors import CorruptSegment, InvalidEvent, InvalidName, PayloadGone
from events.model import EventType
from events.names import StreamName

Columns = list[pa.Array]
Sequence = NewType("Sequence", int)
Position = NewType("Position", int)

MAGIC = b"VIANSEG1"
GENESIS = bytes(32)
PAYLOAD_MAX_BYTES = 64 * 1024 * 1024
"""Most bytes that a payload may decode to; a frame that declares or holds more is refused."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_ZSTD_LEVEL = 3
_INT32_MAX, _INT64_MAX = 2**31 - 1, 2**63 - 1


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
        for text in (self.name, self.version):
            if not text.isprintable():
                raise InvalidEvent(f"a producer's name and version must be printable, got {text[:100]!r}")
            if len(text.encode()) > 0xFFFF:
                raise InvalidEvent(f"a producer's name and version have at most 65535 bytes, got {len(text.encode())}")


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
    """What a segment says of itself; all of it is hashed.

    Raises:
        InvalidEvent: A number is one that no log can hold, or the times are naive or in the wrong order.
    """

    stream: StreamName
    epoch: int
    first_sequence: Sequence
    event_count: int
    schema_version: int
    time_min: datetime
    time_max: datetime
    producer: Producer

    def __post_init__(self) -> None:
        self._check("epoch", self.epoch, 0, _INT32_MAX)
        self._check("event_count", self.event_count, 1, _INT32_MAX)
        self._check("schema_version", self.schema_version, 1, _INT32_MAX)
        self._check("first_sequence", self.first_sequence, 0, _INT64_MAX + 1 - self.event_count)
        if self.time_min.tzinfo is None or self.time_max.tzinfo is None:
            raise InvalidEvent(f"{self.stream}: time_min and time_max must be aware, got naive ones")
        if self.time_min > self.time_max:
            raise InvalidEvent(
                f"{self.stream}: time_min must not be after time_max, got {self.time_min} and {self.time_max}"
            )

    def _check(self, name: str, number: int, least: int, most: int) -> None:
        if not least <= number <= most:
            raise InvalidEvent(f"{self.stream}: {name} must be {least} to {most}, got {number}")

    @property
    def last_sequence(self) -> Sequence:
        """Sequence of the last event."""
        return Sequence(self.first_sequence + self.event_count - 1)


@dataclass(frozen=True, slots=True)
class Segment:
    """One stored append: header, bytes, proof, and its place in the log that holds it."""

    header: Header
    payload: bytes
    """empty where it left the disk: the segment is hollow"""
    payload_hash: bytes
    chain_hash: bytes
    position: Position
    recorded_at: datetime

    @property
    def stream(self) -> StreamName:
        """The stream it belongs to."""
        return self.header.stream

    @property
    def has_payload(self) -> bool:
        """Whether its events are here; of a hollow segment only header and hashes are."""
        return bool(self.payload)

    @property
    def is_payload_whole(self) -> bool:
        """Whether the payload is the one that was hashed, or is not here at all."""
        return not self.payload or hashlib.sha256(self.payload).digest() == self.payload_hash

    def draft(self) -> Draft:
        """The segment without the place that a log gave it, to be appended to another."""
        header = self.header
        return Draft(
            stream=header.stream,
            event_count=header.event_count,
            schema_version=header.schema_version,
            time_min=header.time_min,
            time_max=header.time_max,
            producer=header.producer,
            payload=self.payload,
            payload_hash=self.payload_hash,
        )


def encode(stream: StreamName, batch: EventBatch, producer: Producer) -> Draft:
    """The batch as a draft of the stream's next segment.

    Raises:
        InvalidName: The stream's name is outside the grammar.
        InvalidEvent: The batch is not of the stream's type, is empty or too large, holds text that is not
            UTF-8, or a value that the door does not let through (`events.door`).
    """
    StreamName.of(stream.station, stream.source, stream.type)  # the bare constructor takes any text
    if batch.type.type_name != stream.type:
        raise InvalidEvent(f"stream {stream} takes {stream.type}, got a batch of {batch.type.type_name}")
    if not len(batch):
        raise InvalidEvent(f"stream {stream}: a segment holds one event or more, got an empty batch")
    columns = batch.data.columns
    _validate(batch.type, batch.data, columns)
    check(batch.type, columns)
    return draft_of(stream, batch, producer, _packed(batch, columns))


def draft_of(stream: StreamName, batch: EventBatch, producer: Producer, payload: bytes) -> Draft:
    """The draft of a batch whose payload is there already.

    Raises:
        InvalidEvent: A time lies outside the years 1 to 9999.
    """
    time_min, time_max = _span(str(stream), batch.data.column(0))
    return Draft(
        stream=stream,
        event_count=len(batch),
        schema_version=batch.type.version,
        time_min=time_min,
        time_max=time_max,
        producer=producer,
        payload=payload,
        payload_hash=hashlib.sha256(payload).digest(),
    )


def encode_payload(batch: EventBatch) -> bytes:
    """The batch's bytes, whatever its values: zstd of its Arrow IPC message without schema.

    Raises:
        InvalidEvent: The batch is too large, or holds text that is not UTF-8.
    """
    columns = batch.data.columns
    _validate(batch.type, batch.data, columns)
    return _packed(batch, columns)


def _validate(event_type: type[EventType], data: pa.RecordBatch, columns: Columns) -> None:
    try:
        _validate_buffers(data, columns)
    except pa.ArrowInvalid as error:
        raise InvalidEvent(f"{event_type.type_name}: {error}") from error


def _validate_buffers(data: pa.RecordBatch, columns: Columns) -> None:
    """Nothing, if no value of the batch leads outside its buffers and all text is UTF-8.

    Where a column is numbers only and has no nulls, any bytes of the right length will do.
    """
    data.validate()
    for column in columns:
        if column.null_count or not isinstance(column, pa.NumericArray):
            column.validate(full=True)


def _packed(batch: EventBatch, columns: Columns) -> bytes:
    data = _own(batch.data, columns)
    size = pa.ipc.get_record_batch_size(data)
    if size > PAYLOAD_MAX_BYTES:
        raise InvalidEvent(
            f"{batch.type.type_name}: a segment holds at most {PAYLOAD_MAX_BYTES} bytes before compression, "
            f"got {size}; append it in smaller batches"
        )
    return _zstd.compressor.compress(data.serialize())


def decode(segment: Segment, catalogue: Catalogue, *, as_stored: bool = False) -> EventBatch:
    """The segment's events, in the newest version of their type that the catalogue knows.

    Args:
        segment: The segment.
        catalogue: The types that are known.
        as_stored: Leave the events in the version that they were appended in.

    Raises:
        UnknownType: The catalogue does not know the type or the version.
        CorruptSegment: The bytes do not decode to what the header says.
        PayloadGone: The segment is hollow.
    """
    header = segment.header
    event_type = catalogue.find(segment.stream.type, header.schema_version)
    place = f"{segment.stream} from sequence {header.first_sequence}"
    if not segment.has_payload:
        raise PayloadGone(f"{place}: the payload left this log's disk. Next: vian sync repair fetches it from central")
    try:
        batch = EventBatch(event_type, decode_payload(segment.payload, schema_of(event_type)))
        if len(batch) != header.event_count:
            raise CorruptSegment(f"the header says {header.event_count} events, the payload holds {len(batch)}")
        span = _span("time", batch.data.column(0))
    except (CorruptSegment, InvalidEvent) as error:
        raise CorruptSegment(f"{place}: {error}") from error
    if span != (header.time_min, header.time_max):
        raise CorruptSegment(
            f"{place}: the header says times {header.time_min} to {header.time_max}, "
            f"the payload holds {span[0]} to {span[1]}"
        )
    return batch if as_stored else catalogue.upcast(batch)


def decode_payload(payload: bytes, schema: pa.Schema) -> pa.RecordBatch:
    """The record batch that the bytes hold.

    Raises:
        CorruptSegment: They hold none of this schema, or one that is too large.
    """
    try:
        declared = zstandard.get_frame_parameters(payload).content_size
        if declared > PAYLOAD_MAX_BYTES:
            raise CorruptSegment(f"the payload declares {declared} bytes, at most {PAYLOAD_MAX_BYTES} are allowed")
        data = _zstd.decompressor.decompress(payload, max_output_size=PAYLOAD_MAX_BYTES, allow_extra_data=False)
        message = pa.ipc.read_message(pa.py_buffer(data))
        if message.type != "record batch":
            raise CorruptSegment(f"the payload must be a record batch, got a message of type {message.type}")
        if _is_body_compressed(message.metadata.to_pybytes()):
            raise CorruptSegment("the payload's record batch must be compressed by the frame alone, got twice")
        batch = pa.ipc.read_record_batch(message, schema)
        _validate_buffers(batch, batch.columns)
    except (zstandard.ZstdError, pa.ArrowException, OSError, EOFError, IndexError, struct.error) as error:
        raise CorruptSegment(f"the payload of {len(payload)} bytes does not decode: {error}") from error
    return batch


def header_bytes(header: Header) -> bytes:
    """The header in its fixed layout, as the chain hashes it."""
    return b"".join(
        (
            MAGIC,
            struct.pack(">I", header.epoch),
            text_bytes(header.stream.station),
            text_bytes(header.stream.source),
            text_bytes(header.stream.type),
            struct.pack(
                ">QIIqq",
                header.first_sequence,
                header.event_count,
                header.schema_version,
                microseconds(header.time_min),
                microseconds(header.time_max),
            ),
            text_bytes(header.producer.name),
            text_bytes(header.producer.version),
            header.producer.configuration_hash,
        )
    )


def parse_header(data: bytes) -> Header:
    """The header that the bytes hold, the inverse of `header_bytes`.

    Raises:
        CorruptSegment: The bytes are not a header.
    """
    try:
        return _parse_header(data)
    except (InvalidName, InvalidEvent) as error:
        raise CorruptSegment(f"a segment's header does not hold: {error}") from error


def _parse_header(data: bytes) -> Header:
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
        _time(str(stream), time_min),
        _time(str(stream), time_max),
        producer,
    )


def chain(previous: bytes, header: Header, payload_hash: bytes) -> bytes:
    """The chain hash of a segment that follows the one with the hash `previous`, 32 bytes."""
    return hashlib.sha256(previous + header_bytes(header) + payload_hash).digest()


def microseconds(time: datetime) -> int:
    """Microseconds since 1970-01-01 UTC, exact."""
    return (time - _EPOCH) // timedelta(microseconds=1)


def _time(place: str, since_epoch_us: int) -> datetime:
    try:
        return _EPOCH + timedelta(microseconds=since_epoch_us)
    except OverflowError as error:
        raise InvalidEvent(f"{place}: a time must lie in the years 1 to 9999, got {since_epoch_us} µs") from error


def _span(place: str, column: pa.Array) -> tuple[datetime, datetime]:
    """The column's earliest and latest time; the epoch twice where it holds none."""
    times = numbers(column)
    if not len(times):
        return _EPOCH, _EPOCH
    return _time(place, int(np.minimum.reduce(times))), _time(place, int(np.maximum.reduce(times)))


def _own(data: pa.RecordBatch, columns: Columns) -> pa.RecordBatch:
    """The batch without what lies beside it in memory.

    Arrow writes some of a slice's neighbours along with it: up to 64 bytes of each buffer, the rest of a
    byte of bits, the values of nested rows. A copy has none, and equal rows then have equal bytes.
    """
    alone = [_is_alone(column) for column in columns]
    if all(alone):
        return data
    rows = pa.array(np.arange(data.num_rows, dtype=np.int64))
    copies = [column if kept else column.take(rows) for column, kept in zip(columns, alone, strict=True)]
    return pa.RecordBatch.from_arrays(copies, schema=data.schema)


def _is_alone(column: pa.Array) -> bool:
    if isinstance(column, pa.NumericArray) and column.get_total_buffer_size() == len(column) * column.type.byte_width:
        return True  # as the answer below, for the most frequent columns; that one takes ten times as long
    is_plain = not (pa.types.is_nested(column.type) or pa.types.is_boolean(column.type))
    return is_plain and column.offset == 0 and column.get_total_buffer_size() == column.nbytes


def _is_body_compressed(metadata: bytes) -> bool:
    """Whether the message asks Arrow to decompress its body, which would know no limit.

    Source: Arrow's format/Message.fbs: `Message.header` is field 2, `RecordBatch.compression` field 3.
    Arrow has verified the FlatBuffer before.
    """
    (message,) = struct.unpack_from("<I", metadata, 0)
    header = message + _field_offset(metadata, message, 2)
    record_batch = header + struct.unpack_from("<I", metadata, header)[0]
    return _field_offset(metadata, record_batch, 3) != 0


def _field_offset(metadata: bytes, table: int, index: int) -> int:
    """Where in a FlatBuffer's table a field lies, from the table's start; 0 where it is absent."""
    vtable = table - struct.unpack_from("<i", metadata, table)[0]
    (size,) = struct.unpack_from("<H", metadata, vtable)
    slot = 4 + 2 * index
    return int(struct.unpack_from("<H", metadata, vtable + slot)[0]) if slot < size else 0


def text_bytes(text: str) -> bytes:
    """A text in a hashed layout: two bytes of length, then UTF-8."""
    data = text.encode()
    return struct.pack(">H", len(data)) + data


class _Zstd(threading.local):
    """Each thread's own compressor and decompressor: making them anew costs more than a small segment."""

    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL)
        self.decompressor = zstandard.ZstdDecompressor()


_zstd = _Zstd()


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
