import struct
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import GENESIS, Header, Position, Producer, Segment, Sequence, StreamName, chain, header_bytes
from sync import ProtocolMismatch, WireError
from sync.protocol.wire import BODY_BYTES_MAX, HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX, parse, program
from sync.protocol.wire_v1 import (
    RECORD_MAGIC,
    Hello,
    Problem,
    SegmentsAnswer,
    StreamState,
    decode_records,
    encode_record,
    encode_records,
    parse_versioned,
    record_size,
)

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
STREAM = StreamName.of("brno-2", "gate", "track_point")
PRODUCER = Producer("motion", "1.2", bytes(range(32)))

times = st.datetimes(timezones=st.just(UTC))
names = st.from_regex(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,62}[A-Za-z0-9])?", fullmatch=True)
types = st.from_regex(r"[a-z][a-z0-9_]{0,47}", fullmatch=True)
hashes = st.binary(min_size=32, max_size=32)
printable = st.text(st.characters(codec="utf-8"), max_size=60).filter(str.isprintable)


@st.composite
def segments(draw: st.DrawFn) -> Segment:
    earlier, later = sorted((draw(times), draw(times)))
    count = draw(st.integers(1, 2**31 - 1))
    header = Header(
        StreamName.of(draw(names), draw(names), draw(types)),
        draw(st.integers(0, 2**31 - 1)),
        Sequence(draw(st.integers(0, 2**63 - count))),
        count,
        draw(st.integers(1, 2**31 - 1)),
        earlier,
        later,
        Producer(draw(printable), draw(printable), draw(hashes)),
    )
    return Segment(header, draw(st.binary(max_size=300)), draw(hashes), draw(hashes), Position(0), draw(times))


def segment(payload: bytes = b"payload") -> Segment:
    header = Header(STREAM, 1, Sequence(5), 3, 1, NOON, NOON + timedelta(seconds=1), PRODUCER)
    return Segment(header, payload, bytes(32), bytes(range(32)), Position(0), NOON)


@settings(max_examples=40)
@given(st.lists(segments(), min_size=1, max_size=5))
def test_decode_of_encode_is_the_identity(sent: list[Segment]) -> None:
    assert decode_records(encode_records(sent)) == sent


@settings(max_examples=40)
@given(segments())
def test_the_size_of_a_record_is_known_before_it_is_encoded(one: Segment) -> None:
    assert record_size(one) == len(encode_record(one))


def test_a_position_does_not_travel() -> None:
    placed = replace(segment(), position=Position(4711))

    assert encode_record(placed) == encode_record(segment())


def test_a_record_is_laid_out_as_documented() -> None:
    one = segment()
    header = header_bytes(one.header)

    assert encode_record(one) == (
        b"VIANREC1"
        + struct.pack(">I", len(header))
        + header
        + one.payload_hash
        + one.chain_hash
        + struct.pack(">q", 1_777_636_800_000_000)
        + struct.pack(">I", 7)
        + b"payload"
    )
    assert header == (
        b"VIANSEG1"
        + struct.pack(">I", 1)
        + b"\0\x06brno-2\0\x04gate\0\x0btrack_point"
        + struct.pack(">QIIqq", 5, 3, 1, 1_777_636_800_000_000, 1_777_636_801_000_000)
        + b"\0\x06motion\0\x031.2"
        + bytes(range(32))
    )


def test_the_longest_header_fits() -> None:
    long = Producer("n" * 65535, "v" * 65535, bytes(32))
    stream = StreamName.of("s" * 64, "o" * 64, "t" * 48)
    header = Header(stream, 1, Sequence(1), 1, 1, NOON, NOON, long)

    assert len(header_bytes(header)) == HEADER_BYTES_MAX
    whole = replace(segment(), header=header)
    assert decode_records(encode_record(whole)) == [whole]


@settings(max_examples=40)
@given(segments(), st.data())
def test_a_cut_body_is_refused_wherever_it_is_cut(one: Segment, data: st.DataObject) -> None:
    body = encode_records([one, one])
    at = data.draw(st.integers(0, len(body) - 1).filter(lambda n: n != len(body) // 2))

    with pytest.raises(WireError):
        decode_records(body[:at])


@given(st.binary(max_size=2000))
def test_garbage_is_refused_and_nothing_else_happens(garbage: bytes) -> None:
    with pytest.raises(WireError):
        decode_records(garbage)


@settings(max_examples=40)
@given(segments(), st.data())
def test_any_changed_byte_is_refused_or_leaves_the_rest_whole(one: Segment, data: st.DataObject) -> None:
    body = bytearray(encode_record(one))
    body[data.draw(st.integers(0, len(body) - 1))] ^= data.draw(st.integers(1, 255))

    try:
        (got,) = decode_records(bytes(body))
    except WireError:
        return
    assert got != one
    assert encode_record(got) == bytes(body)


def with_length(at: int, length: int) -> bytes:
    body = bytearray(encode_record(segment()))
    struct.pack_into(">I", body, at, length)
    return bytes(body)


HEADER_LENGTH_AT = len(RECORD_MAGIC)
PAYLOAD_LENGTH_AT = len(encode_record(segment())) - len(b"payload") - 4


@pytest.mark.parametrize(
    "body, words",
    [
        (b"", "got 0 bytes"),
        (b"<html>please log in</html>", "record 1 at byte 0 must begin with b'VIANREC1', got b'<html>pl'"),
        (with_length(HEADER_LENGTH_AT, HEADER_BYTES_MAX + 1), f"a header has at most {HEADER_BYTES_MAX} bytes"),
        (with_length(HEADER_LENGTH_AT, 2**32 - 1), "it declares 4294967295"),
        (with_length(PAYLOAD_LENGTH_AT, PAYLOAD_BYTES_MAX + 1), f"a payload has at most {PAYLOAD_BYTES_MAX} bytes"),
        (with_length(PAYLOAD_LENGTH_AT, 8), "breaks off: 8 bytes wanted"),
        (with_length(PAYLOAD_LENGTH_AT, 6), "record 2 at byte"),
        (encode_record(segment()).replace(b"gate", b"g/te"), "record 1 at byte 0: a segment's header does not hold"),
        (encode_record(segment()).replace(b"VIANSEG1", b"VIANSEG2"), "begins with b'VIANSEG1'"),
    ],
)
def test_a_lie_about_a_length_or_a_name_is_named(body: bytes, words: str) -> None:
    with pytest.raises(WireError) as raised:
        decode_records(body)

    assert words in str(raised.value)


def test_a_recording_time_outside_the_calendar_is_refused() -> None:
    body = bytearray(encode_record(segment()))
    struct.pack_into(">q", body, PAYLOAD_LENGTH_AT - 8, 2**62)

    with pytest.raises(WireError, match=r"recorded_at must lie in the years 1 to 9999"):
        decode_records(bytes(body))


def test_a_body_has_a_largest_size_and_number() -> None:
    body = encode_records([segment()] * 3)

    assert len(decode_records(body, bytes_max=len(body), segments_max=3)) == 3
    with pytest.raises(WireError, match=rf"at most {len(body) - 1} bytes, got {len(body)}"):
        decode_records(body, bytes_max=len(body) - 1)
    with pytest.raises(WireError, match=r"at most 2 records"):
        decode_records(body, segments_max=2)


def test_the_largest_segment_that_a_log_holds_fits_a_body() -> None:
    largest = replace(segment(), payload=bytes(PAYLOAD_BYTES_MAX))

    assert record_size(largest) <= BODY_BYTES_MAX


def hello(**changed: object) -> bytes:
    state = StreamState(stream=str(STREAM), epoch=1, sequence=9, chain_hash="0" * 64)
    one = Hello(protocol=1, program="vian/0", station="brno-2", epoch=1, time=NOON, streams=(state,))
    return one.model_copy(update=changed).encoded()


def test_a_hello_travels_unchanged() -> None:
    assert parse_versioned(Hello, hello()).encoded() == hello()


def test_another_protocol_version_is_named_whatever_else_is_said() -> None:
    with pytest.raises(ProtocolMismatch, match=r"version 1 is spoken here, got version 2"):
        parse_versioned(Hello, b'{"protocol": 2, "something": ["new"]}')


@pytest.mark.parametrize(
    "data, words",
    [
        (b"\xff\xfe", "not a Hello"),
        (b"[]", "not a Hello"),
        (b'{"program": "x"}', "protocol: Field required"),
        (b'{"protocol": "1"}', "protocol"),
        (hello(station="../etc"), "station: Value error, station must be 1 to 64"),
        (hello()[:-1] + b', "more": 1}', "more: Extra inputs are not permitted"),
        (hello().replace(b"brno-2/gate/track_point", b"gate/track_point"), "streams.0.stream"),
        (hello().replace(b'"sequence":9', b'"sequence":-1'), "streams.0.sequence"),
        (hello().replace(b'"sequence":9', b'"sequence":"9"'), "streams.0.sequence"),
        (hello().replace(b"0" * 64, b"x" * 64), "streams.0.chain_hash"),
        (hello().replace(b"12:00:00Z", b"12:00:00"), "time"),
    ],
)
def test_what_is_no_hello_is_refused_with_the_place(data: bytes, words: str) -> None:
    with pytest.raises(WireError) as raised:
        parse_versioned(Hello, data)

    assert words in str(raised.value)
    assert len(str(raised.value)) < 400


@given(st.binary(max_size=200))
def test_garbage_is_no_message(garbage: bytes) -> None:
    for message in (SegmentsAnswer, Problem):
        with pytest.raises(WireError):
            parse(message, garbage)


def test_the_state_of_a_stream_is_that_of_its_head() -> None:
    state = StreamState(
        stream=str(STREAM), epoch=2, sequence=2**63 - 1, chain_hash=chain(GENESIS, segment().header, bytes(32)).hex()
    )

    assert StreamState.of(state.head()) == state


def test_the_program_names_its_version() -> None:
    assert program().startswith("vian/")
