import dataclasses
import hashlib
import io
import struct
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from events import (
    GENESIS,
    SHIPPED,
    Catalogue,
    CorruptSegment,
    Draft,
    EventBatch,
    EventType,
    Header,
    InvalidEvent,
    Position,
    Producer,
    RuleDeployed,
    Segment,
    Sequence,
    SituationDetected,
    StreamName,
    TrackEnded,
    TrackEndedV1,
    TrackPoint,
    UnknownType,
    batch_of,
    batch_of_type,
    chain,
    decode,
    encode,
    events_of,
    header_bytes,
    parse_header,
    schema_of,
)
from events.columns import TIMESTAMP
from events.segment import MAGIC, PAYLOAD_MAX_BYTES, decode_payload, encode_payload, microseconds
from tests.events.examples import NOON, PRODUCER, rule_deployed, situation, sync_planned, track_point, unchecked
from tests.events.plugged import VehicleWeighed
from tests.events.strategies import batches, bits, events, headers, lawful_batches

TYPES = (*SHIPPED, TrackEndedV1, VehicleWeighed)
CATALOGUE = Catalogue(TYPES)
TRACKS = StreamName.parse("brno-2/gate/track_point")
each_type = pytest.mark.parametrize("event_type", TYPES, ids=lambda t: f"{t.type_name}.v{t.version}")


def _stored(draft: Draft, **changed: Any) -> Segment:
    """The draft as the first segment of its stream, with fields of header or segment changed by name."""
    parts = {f.name: getattr(draft, f.name) for f in dataclasses.fields(Header) if hasattr(draft, f.name)}
    parts |= {"epoch": 0, "first_sequence": Sequence(1)}
    parts |= {name: changed.pop(name) for name in tuple(changed) if name in parts}
    header = Header(**parts)
    return dataclasses.replace(
        Segment(
            header,
            draft.payload,
            draft.payload_hash,
            chain(GENESIS, header, draft.payload_hash),
            Position(1),
            NOON,
        ),
        **changed,
    )


def _same(got: pa.RecordBatch, wanted: pa.RecordBatch) -> bool:
    return got.schema.equals(wanted.schema) and [*map(bits, got.columns)] == [*map(bits, wanted.columns)]


# What is encoded comes back.


@each_type
@given(data=st.data())
@settings(max_examples=20)
def test_whatever_was_stored_decodes_bit_for_bit(event_type: type[EventType], data: st.DataObject) -> None:
    batch = data.draw(batches(event_type, min_size=1))
    draft = unchecked(StreamName.of("s", "cam", event_type.type_name), batch)
    decoded = decode(_stored(draft), CATALOGUE, as_stored=True)
    assert decoded.type is event_type
    assert _same(decoded.data, batch.data)
    assert draft.payload_hash == hashlib.sha256(draft.payload).digest()
    times = bits(batch.data.column("time"))
    assert (draft.event_count, draft.schema_version) == (len(batch), event_type.version)
    assert (microseconds(draft.time_min), microseconds(draft.time_max)) == (min(times), max(times))


@each_type
@given(data=st.data())
@settings(max_examples=15)
def test_decode_of_encode_is_the_identity(event_type: type[EventType], data: st.DataObject) -> None:
    batch = data.draw(lawful_batches(event_type))
    stream = StreamName.of("s", "cam", event_type.type_name)
    draft = encode(stream, batch, PRODUCER)
    assert draft == unchecked(stream, batch)
    assert _same(decode(_stored(draft), CATALOGUE, as_stored=True).data, batch.data)


@each_type
@given(data=st.data())
@settings(max_examples=10)
def test_encoding_decoded_events_gives_the_same_bytes(event_type: type[EventType], data: st.DataObject) -> None:
    batch = data.draw(batches(event_type))
    payload = encode_payload(batch)
    again = EventBatch(event_type, decode_payload(payload, schema_of(event_type)))
    assert encode_payload(again) == payload


@each_type
def test_an_empty_batch_has_bytes_and_comes_back_empty(event_type: type[EventType]) -> None:
    batch = batch_of_type(event_type, [])
    assert _same(decode_payload(encode_payload(batch), schema_of(event_type)), batch.data)


# Quiet and signalling, both signs, with a payload; infinities; zeros of both signs; the least of all.
@pytest.mark.parametrize("word", [0x7FC00001, 0xFFC12345, 0x7F800001, 0xFFBFFFFF, 0x7F800000, 0x80000000, 1])
def test_each_bit_of_a_float_is_kept(word: int) -> None:
    data = batch_of([track_point()]).data
    column = pa.array(np.array([word], np.uint32).view(np.float32))
    batch = EventBatch(TrackPoint, data.set_column(3, data.schema.field("x"), column))
    got = decode(_stored(unchecked(TRACKS, batch)), CATALOGUE)
    assert got.data.column("x").to_numpy().view(np.uint32).tolist() == [word]


@pytest.mark.parametrize("text", ["", "\0", "a\0b", "🚗", "\U0010ffff", "\u202e", "e\u0301", "\ufeff", "x" * 100_000])
def test_each_character_of_a_text_is_kept_nul_included(text: str) -> None:
    said = [rule_deployed(text=text, rule=text)]
    draft = encode(StreamName.of("s", "cam", "rule_deployed"), batch_of(said), PRODUCER)
    assert events_of(decode(_stored(draft), CATALOGUE)) == said


def test_the_first_and_the_last_microsecond_are_kept() -> None:
    times = [datetime(9999, 12, 31, 23, 59, 59, 999_999, tzinfo=UTC), datetime(1, 1, 1, tzinfo=UTC), NOON]
    said = [track_point(time=time) for time in times]
    draft = unchecked(TRACKS, batch_of(said))
    assert (draft.time_min, draft.time_max) == (times[1], times[0])
    assert events_of(decode(_stored(draft), CATALOGUE)) == said
    header = _stored(draft).header
    assert parse_header(header_bytes(header)) == header


def test_equal_batches_have_equal_bytes() -> None:
    said = [situation("a", "b"), situation()]
    assert encode_payload(batch_of(said)) == encode_payload(batch_of(said))


# A slice encodes itself and nothing beside it.


@each_type
@given(data=st.data())
@settings(max_examples=15)
def test_a_slice_has_the_bytes_of_a_batch_of_its_own(event_type: type[EventType], data: st.DataObject) -> None:
    said = data.draw(st.lists(events(event_type), max_size=6))
    start, stop = data.draw(st.integers(0, 7)), data.draw(st.integers(0, 7))
    part = batch_of_type(event_type, said).slice(start, stop)
    assert encode_payload(part) == encode_payload(batch_of_type(event_type, said[start:stop]))


@pytest.mark.parametrize(
    "said",
    [
        [rule_deployed(text="secret" * 40), rule_deployed(text="open"), rule_deployed(text="secret" * 40)],
        [situation("secret"), situation("open"), situation("secret")],
    ],
    ids=["text", "parts"],
)
def test_a_slice_does_not_carry_its_neighbours(said: list[EventType]) -> None:
    payload = encode_payload(batch_of(said).slice(1, 2))
    message = zstandard.ZstdDecompressor().decompress(payload)
    assert b"open" in message
    assert b"secret" not in message


def test_a_small_slice_of_a_batch_too_large_for_one_segment_is_encoded() -> None:
    count = PAYLOAD_MAX_BYTES // 8 // 3
    batch = _tracks_ended(count)
    with pytest.raises(InvalidEvent, match=r"track_ended: .* at most 67108864 bytes .*, got \d+; append it in smaller"):
        encode_payload(batch)
    assert len(decode_payload(encode_payload(batch.slice(7, 17)), schema_of(TrackEnded))) == 10


def test_the_largest_batch_that_is_encoded_is_decoded() -> None:
    text = "x" * (PAYLOAD_MAX_BYTES - 1024)
    batch = batch_of([rule_deployed(text=text)])
    assert len(decode_payload(encode_payload(batch), schema_of(RuleDeployed))) == 1
    with pytest.raises(InvalidEvent, match="append it in smaller batches"):
        encode_payload(batch_of([rule_deployed(text=text + "x" * 1024)]))


def _tracks_ended(count: int) -> EventBatch:
    schema = schema_of(TrackEnded)
    plain = {
        field.name: pa.array(np.ones(count)).cast(field.type)
        for field in schema
        if field.type not in (TIMESTAMP, pa.string())
    }
    time = pa.array(np.ones(count, np.int64)).cast(TIMESTAMP)
    columns = [plain.get(name, time) for name in schema.names]
    columns[schema.get_field_index("reason")] = pa.repeat("lost", count)
    return EventBatch(TrackEnded, pa.RecordBatch.from_arrays(columns, schema=schema))


# What cannot be a segment is refused when it is encoded.


def test_a_batch_of_another_type_than_the_stream_is_refused() -> None:
    with pytest.raises(InvalidEvent, match="stream brno-2/gate/track_point takes track_point, got a batch of sync_"):
        encode(TRACKS, batch_of([sync_planned()]), PRODUCER)


def test_an_empty_batch_is_no_segment() -> None:
    with pytest.raises(InvalidEvent, match=r"stream brno-2/gate/track_point: .* got an empty batch"):
        encode(TRACKS, batch_of_type(TrackPoint, []), PRODUCER)


def test_text_that_is_not_utf8_is_refused() -> None:
    data = batch_of([rule_deployed()]).data
    raw = pa.array([b"\xff\xfe"], pa.binary())
    column = pa.Array.from_buffers(pa.string(), 1, raw.buffers())
    batch = EventBatch(RuleDeployed, data.set_column(1, data.schema.field("rule"), column))
    with pytest.raises(InvalidEvent, match=r"rule_deployed: .*Invalid UTF8"):
        encode(StreamName.parse("s/c/rule_deployed"), batch, PRODUCER)


@pytest.mark.parametrize("length", [0, 31, 33])
def test_a_configuration_hash_of_another_length_is_refused(length: int) -> None:
    with pytest.raises(InvalidEvent, match=f"configuration_hash must have 32 bytes, got {length}"):
        Producer("motion", "1", bytes(length))


@pytest.mark.parametrize("text", ["a\0", "a\nb", "\x1b[2J", "\ud800"])
def test_a_producer_that_cannot_be_printed_is_refused(text: str) -> None:
    for name, version in ((text, "1"), ("motion", text)):
        with pytest.raises(InvalidEvent, match="name and version must be printable, got"):
            Producer(name, version, bytes(32))


def test_a_producer_of_too_many_bytes_is_refused() -> None:
    assert Producer("é" * 32_767, "x" * 65_535, bytes(32)).version == "x" * 65_535
    with pytest.raises(InvalidEvent, match="at most 65535 bytes, got 65536"):
        Producer("é" * 32_768, "1", bytes(32))


@pytest.fixture
def header() -> Header:
    return _stored(encode(TRACKS, batch_of([track_point(), track_point()]), PRODUCER)).header


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"epoch": -1}, "epoch must be 0 to 2147483647, got -1"),
        ({"epoch": 2**31}, "epoch must be 0 to 2147483647, got 2147483648"),
        ({"event_count": 0}, "event_count must be 1 to 2147483647, got 0"),
        ({"schema_version": 0}, "schema_version must be 1 to 2147483647, got 0"),
        ({"first_sequence": -1}, "first_sequence must be 0 to 9223372036854775806, got -1"),
        ({"first_sequence": 2**63 - 1}, "first_sequence must be 0 to 9223372036854775806, got 9223372036854775807"),
        ({"time_min": datetime(2026, 1, 1)}, "must be aware, got naive ones"),  # noqa: DTZ001 - what is tried
        ({"time_min": NOON + timedelta(1)}, "time_min must not be after time_max, got 2026-01-02"),
    ],
)
def test_a_header_that_no_log_can_hold_is_refused(header: Header, changed: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidEvent, match=f"brno-2/gate/track_point: .*{message}"):
        dataclasses.replace(header, **changed)


# The header's bytes.


@given(headers())
def test_parsing_a_header_is_the_inverse_of_writing_it(header: Header) -> None:
    assert parse_header(header_bytes(header)) == header


def test_the_last_sequence_is_that_of_the_last_event(header: Header) -> None:
    assert dataclasses.replace(header, first_sequence=Sequence(41)).last_sequence == 42


@given(headers(), st.data())
@settings(max_examples=100)
def test_a_header_with_one_byte_changed_is_refused_or_is_another_header(header: Header, data: st.DataObject) -> None:
    written = bytearray(header_bytes(header))
    written[data.draw(st.integers(0, len(written) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        parsed = parse_header(bytes(written))
    except CorruptSegment:
        return
    assert parsed != header
    assert header_bytes(parsed) == written


@given(st.binary() | st.binary().map(lambda rest: MAGIC + rest))
def test_random_bytes_are_no_header(data: bytes) -> None:
    with pytest.raises(CorruptSegment):
        parse_header(data)


def test_a_header_that_breaks_off_or_goes_on_is_refused(header: Header) -> None:
    written = header_bytes(header)
    for length in range(len(written)):
        with pytest.raises(CorruptSegment, match=f"breaks off after {length} bytes"):
            parse_header(written[:length])
    with pytest.raises(CorruptSegment, match="brno-2/gate/track_point has 3 bytes too many"):
        parse_header(written + b"abc")


@pytest.mark.parametrize(
    "old, new, message",
    [
        (b"VIANSEG1", b"VIANSEG2", "begins with b'VIANSEG1', got b'VIANSEG2'"),
        (b"\0\6brno-2", b"\0\6br\0o-2", "station must be 1 to 64"),
        (b"\0\4gate", b"\0\4ga/e", "source must be 1 to 64"),
        (b"track_point", b"track-point", "type must be 1 to 48"),
        (b"\0\4gate", b"\0\4ga\xff\xfe", "is not UTF-8"),
        (struct.pack(">QI", 1, 2), struct.pack(">QI", 2**64 - 1, 2), "first_sequence must be"),
        (struct.pack(">QI", 1, 2), struct.pack(">QI", 1, 0), "event_count must be"),
        (struct.pack(">q", microseconds(NOON)), struct.pack(">q", 2**63 - 1), "years 1 to 9999"),
        (b"motion", b"mot\0on", "must be printable"),
    ],
)
def test_a_header_with_an_unlawful_part_is_refused_with_its_reason(
    header: Header, old: bytes, new: bytes, message: str
) -> None:
    written = header_bytes(header)
    assert old in written
    with pytest.raises(CorruptSegment, match=message):
        parse_header(written.replace(old, new))


# The chain.

CHANGES: dict[str, Callable[[Header], Any]] = {
    "stream": lambda h: dataclasses.replace(h.stream, source="yard"),
    "epoch": lambda h: h.epoch + 1,
    "first_sequence": lambda h: h.first_sequence + 1,
    "event_count": lambda h: h.event_count + 1,
    "schema_version": lambda h: h.schema_version + 1,
    "time_min": lambda h: h.time_min - timedelta(microseconds=1),
    "time_max": lambda h: h.time_max + timedelta(microseconds=1),
    "producer": lambda h: dataclasses.replace(h.producer, configuration_hash=bytes(32)),
}


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Header)])
def test_the_chain_covers_every_field_of_the_header(header: Header, name: str) -> None:
    other = dataclasses.replace(header, **{name: CHANGES[name](header)})
    assert chain(GENESIS, other, bytes(32)) != chain(GENESIS, header, bytes(32))


@given(headers(), st.binary(min_size=32, max_size=32), st.binary(min_size=32, max_size=32), st.integers(0, 511))
def test_the_chain_covers_each_bit_of_what_went_before_and_of_the_payload(
    header: Header, previous: bytes, payload_hash: bytes, bit: int
) -> None:
    flipped = (int.from_bytes(previous + payload_hash) ^ 1 << bit).to_bytes(64)
    assert chain(flipped[:32], header, flipped[32:]) != chain(previous, header, payload_hash)
    assert chain(previous, header, payload_hash) == chain(previous, header, payload_hash)


def test_no_text_can_move_over_the_border_between_two_names(header: Header) -> None:
    pairs = [("ab", "c"), ("a", "bc")]
    written = {header_bytes(dataclasses.replace(header, producer=Producer(*pair, bytes(32)))) for pair in pairs}
    assert len(written) == 2


# What is not a payload is refused when it is decoded.

SITUATIONS = batch_of([situation("a", "b"), situation(), situation("c")])
SCHEMA = schema_of(SituationDetected)
MESSAGE = SITUATIONS.data.serialize().to_pybytes()


def _is_sound_or_corrupt(payload: bytes) -> bool:
    try:
        batch = decode_payload(payload, SCHEMA)
    except CorruptSegment:
        return True
    batch.validate(full=True)  # raises where a value lies outside of its buffer
    return bool(batch.schema.equals(SCHEMA))


@given(st.binary(max_size=2000))
def test_random_bytes_are_no_payload(data: bytes) -> None:
    with pytest.raises(CorruptSegment, match=f"payload of {len(data)} bytes does not decode|declares"):
        decode_payload(data, SCHEMA)


@given(st.binary(max_size=2000))
def test_random_bytes_in_a_frame_are_no_payload(data: bytes) -> None:
    with pytest.raises(CorruptSegment):
        decode_payload(zstandard.compress(data), SCHEMA)


@given(st.integers(0, 10**6), st.integers(1, 255))
@settings(max_examples=300)
def test_a_payload_with_one_byte_changed_decodes_or_is_corrupt(at: int, flip: int) -> None:
    payload = bytearray(encode_payload(SITUATIONS))
    payload[at % len(payload)] ^= flip
    assert _is_sound_or_corrupt(bytes(payload))


@given(st.lists(st.tuples(st.integers(0, len(MESSAGE) - 1), st.integers(1, 255)), min_size=1, max_size=4))
@settings(max_examples=400)
def test_a_message_with_bytes_changed_decodes_or_is_corrupt(flips: list[tuple[int, int]]) -> None:
    message = bytearray(MESSAGE)
    for at, flip in flips:
        message[at] ^= flip
    assert _is_sound_or_corrupt(zstandard.compress(bytes(message)))


def test_a_payload_that_breaks_off_or_goes_on_is_corrupt() -> None:
    payload = encode_payload(SITUATIONS)
    for part in (*(payload[:length] for length in range(len(payload))), payload + b"\0", payload * 2):
        with pytest.raises(CorruptSegment, match=f"payload of {len(part)} bytes does not decode"):
            decode_payload(part, SCHEMA)


def test_a_message_that_breaks_off_is_corrupt() -> None:
    for length in range(0, len(MESSAGE), 8):
        with pytest.raises(CorruptSegment, match="does not decode"):
            decode_payload(zstandard.compress(MESSAGE[:length]), SCHEMA)


def test_a_payload_of_another_type_is_corrupt() -> None:
    with pytest.raises(CorruptSegment, match="does not decode"):
        decode_payload(encode_payload(batch_of([track_point()])), SCHEMA)


def test_a_frame_that_declares_too_much_is_refused_before_it_is_unpacked() -> None:
    bomb = zstandard.compress(bytes(PAYLOAD_MAX_BYTES + 1))
    assert len(bomb) < 10_000
    with pytest.raises(CorruptSegment, match="declares 67108865 bytes, at most 67108864 are allowed"):
        decode_payload(bomb, SCHEMA)


def test_a_frame_that_holds_more_than_it_declares_is_corrupt() -> None:
    bomb = bytearray(zstandard.compress(bytes(1_000_000)))
    at = bomb.index(struct.pack("<I", 1_000_000))
    bomb[at : at + 4] = struct.pack("<I", 1000)
    assert zstandard.get_frame_parameters(bytes(bomb)).content_size == 1000
    with pytest.raises(CorruptSegment, match="does not decode"):
        decode_payload(bytes(bomb), SCHEMA)


def test_a_frame_that_declares_no_size_is_refused() -> None:
    frame = zstandard.ZstdCompressor(write_content_size=False).compress(MESSAGE)
    with pytest.raises(CorruptSegment, match=r"declares .* at most 67108864 are allowed"):
        decode_payload(frame, SCHEMA)


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_a_message_compressed_once_more_inside_is_refused_before_it_is_unpacked(codec: str) -> None:
    batch = batch_of([rule_deployed(text="x" * 100_000)]).data
    _, message = _messages(batch, pa.ipc.IpcWriteOptions(compression=codec))
    assert len(message) < 10_000
    assert pa.ipc.read_record_batch(pa.py_buffer(message), batch.schema).equals(batch)
    with pytest.raises(CorruptSegment, match="compressed by the frame alone, got twice"):
        decode_payload(zstandard.compress(message), batch.schema)


def test_a_message_that_is_no_batch_is_refused() -> None:
    schema_message, _ = _messages(SITUATIONS.data, pa.ipc.IpcWriteOptions())
    with pytest.raises(CorruptSegment, match="must be a record batch, got a message of type schema"):
        decode_payload(zstandard.compress(schema_message), SCHEMA)


def _messages(batch: pa.RecordBatch, options: pa.ipc.IpcWriteOptions) -> list[bytes]:
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, batch.schema, options=options) as writer:
        writer.write_batch(batch)
    return [message.serialize().to_pybytes() for message in pa.ipc.MessageReader.open_stream(sink.getvalue())]


# A whole segment whose parts contradict each other.


@pytest.fixture
def draft() -> Draft:
    return encode(TRACKS, batch_of([track_point(), track_point(time=NOON + timedelta(1))]), PRODUCER)


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"event_count": 3}, "the header says 3 events, the payload holds 2"),
        ({"time_min": NOON - timedelta(1)}, "the header says times 2025-12-31 .* the payload holds 2026-01-01"),
        ({"time_max": NOON + timedelta(2)}, "the header says times .* to 2026-01-03"),
        ({"payload": b"?"}, "payload of 1 bytes does not decode"),
    ],
)
def test_a_segment_that_contradicts_itself_is_corrupt_with_its_place(
    draft: Draft, changed: dict[str, Any], message: str
) -> None:
    with pytest.raises(CorruptSegment, match=f"brno-2/gate/track_point from sequence 1: .*{message}"):
        decode(_stored(draft, **changed), CATALOGUE)


def test_a_payload_with_nulls_that_the_type_forbids_is_corrupt(draft: Draft) -> None:
    data = batch_of([track_point(), track_point()]).data
    holed = data.set_column(3, pa.field("x", pa.float32()), pa.array([None, 1.0], pa.float32()))
    payload = zstandard.compress(holed.serialize())
    with pytest.raises(CorruptSegment, match=r"track_point.x must not be null, got 1"):
        decode(_stored(draft, payload=payload), CATALOGUE)


def test_a_payload_with_a_time_outside_the_years_is_corrupt(draft: Draft) -> None:
    data = batch_of([track_point(), track_point()]).data
    late = data.set_column(0, data.schema.field(0), pa.array([0, 2**62], pa.int64()).cast(TIMESTAMP))
    with pytest.raises(CorruptSegment, match="years 1 to 9999"):
        decode(_stored(draft, payload=zstandard.compress(late.serialize())), CATALOGUE)


@pytest.mark.parametrize("changed", [{"schema_version": 2}, {"stream": StreamName.parse("brno-2/gate/door_opened")}])
def test_an_unknown_type_or_version_is_told_apart_from_corruption(draft: Draft, changed: dict[str, Any]) -> None:
    with pytest.raises(UnknownType, match="track_point"):
        decode(_stored(draft, **changed), CATALOGUE)
