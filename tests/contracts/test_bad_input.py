"""What no log takes: each is refused by name before anything is written, and with it all of its call."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pydantic import ValidationError

from events import (
    CheckpointSigned,
    EventBatch,
    EventType,
    Float32,
    InvalidEvent,
    InvalidName,
    PlateRead,
    RuleDeployed,
    SituationDetected,
    StreamName,
    TrackEnded,
    TrackPoint,
    UnknownType,
    batch_of,
    batch_of_type,
    encode,
    schema_of,
)
from events.columns import TIMESTAMP
from events.segment import PAYLOAD_MAX_BYTES
from store import Appender, BadRequest, Log
from tests.store.samples import GATE, NOON, ONE_OF_EACH, PRODUCER, YARD, append, draft, on_both, points, query

EXAMPLES: dict[type[EventType], EventType] = {type(event): event for event in ONE_OF_EACH}
YEAR_1, YEAR_9999 = datetime(1, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, tzinfo=UTC)


class Unregistered(EventType, type="unregistered", version=1):
    """A type that no catalogue knows."""

    value: Float32
    """a value"""


@contextmanager
def nothing_stored(log: Log) -> Iterator[None]:
    """Holds that the block leaves the log as it was."""
    tables = ("log_head", "streams", "segments", "checkpoints")
    before = [query(log, f"select * from {table} order by 1") for table in tables]
    yield
    assert [query(log, f"select * from {table} order by 1") for table in tables] == before


def stream_of(event_type: type[EventType]) -> StreamName:
    return StreamName.of("brno", "gate", event_type.type_name)


def columns(event_type: type[EventType], **changed: Any) -> EventBatch:
    """Three lawful events in columns, the middle one with these values."""
    data = batch_of_type(event_type, [EXAMPLES[event_type]] * 3).data
    for name, value in changed.items():
        index = data.schema.get_field_index(name)
        field, values = data.schema.field(index), data.column(index).to_pylist()
        values[1] = value
        number = isinstance(value, int) and field.type == TIMESTAMP
        column = pa.array([0, value, 0], pa.int64()).cast(TIMESTAMP) if number else pa.array(values, field.type)
        data = data.set_column(index, field, column)
    return EventBatch(event_type, data)


LONG = "x" * 10_000_000
PART = {"variable": "a", "stream": "s", "first_sequence": 1, "last_sequence": 2, "events": 2}

VALUES: list[tuple[type[EventType], dict[str, Any], str]] = [
    # NaN and infinity.
    *(
        (TrackPoint, {name: number}, f"track_point.{name} must be finite, got '{number}' in row 1")
        for name in ("x", "y", "x1", "y1", "x2", "y2", "vx", "vy")
        for number in (math.nan, math.inf, -math.inf)
    ),
    (TrackPoint, {"confidence": math.nan}, r"track_point.confidence must be 0 to 1, got 'nan' in row 1"),
    (TrackEnded, {"displacement_px": math.inf}, r"track_ended.displacement_px must be finite, ≥ 0, got 'inf'"),
    # Outside the field's range.
    (TrackPoint, {"confidence": 1.5}, r"track_point.confidence must be 0 to 1, got '1.5' in row 1"),
    (PlateRead, {"confidence": -0.25}, r"plate_read.confidence must be 0 to 1, got '-0.25' in row 1"),
    (TrackPoint, {"frame": -1}, r"track_point.frame must be ≥ 0, got '-1' in row 1"),
    (TrackPoint, {"track_id": 0}, r"track_point.track_id must be ≥ 1, got '0' in row 1"),
    (TrackEnded, {"path_px": -1.0}, r"track_ended.path_px must be finite, ≥ 0, got '-1.0' in row 1"),
    (TrackEnded, {"reason": "bored"}, r"track_ended.reason must be one of lost, left_frame, .*, got 'bored' in row 1"),
    (CheckpointSigned, {"log_position": -1}, r"checkpoint_signed.log_position must be ≥ 0, got '-1' in row 1"),
    (CheckpointSigned, {"heads": "{"}, r"checkpoint_signed.heads must be JSON .*, got '{' in row 1"),
    (CheckpointSigned, {"heads": "[NaN]"}, r"checkpoint_signed.heads must be JSON .*, got '\[NaN\]' in row 1"),
    (SituationDetected, {"lineage": [PART | {"events": 0}]}, r"lineage\[\].events must be ≥ 1, got '0' in part 2"),
    # Times that only a clock out of order says.
    *(
        (TrackEnded, {name: time}, rf"track_ended.{name} must be in 1970-01-01 to 2200-01-01, got '{time.year:04d}-")
        for name in ("time", "began_at")
        for time in (YEAR_1, datetime(1969, 12, 31, 23, 59, tzinfo=UTC), datetime(2200, 1, 1, tzinfo=UTC), YEAR_9999)
    ),
    (TrackPoint, {"time": 2**63 - 1}, rf"track_point.time must be in .*, got '{2**63 - 1} µs' in row 1"),
    (TrackPoint, {"time": -(2**62)}, rf"track_point.time must be in .*, got '-{2**62} µs' in row 1"),
    # Too long.
    (RuleDeployed, {"text": LONG}, r"rule_deployed.text must be at most 4194304 bytes, got '10000000 bytes' in row 1"),
    (CheckpointSigned, {"signature": LONG.encode()}, r"checkpoint_signed.signature must be at most 4194304 bytes"),
    (SituationDetected, {"lineage": [PART | {"stream": LONG}]}, r"lineage\[\].stream must be at most 4194304 bytes"),
]


@pytest.mark.parametrize(
    "event_type, changed, message",
    VALUES,
    ids=[f"{t.type_name}-{next(iter(c))}-{n}" for n, (t, c, _) in enumerate(VALUES)],
)
def test_a_value_that_may_not_be_is_refused_by_field_with_all_of_its_call(
    log: Log, event_type: type[EventType], changed: dict[str, Any], message: str
) -> None:
    append(log, GATE, 2)
    batch = columns(event_type, **changed)
    with nothing_stored(log):
        with pytest.raises(InvalidEvent, match=message) as caught:
            Appender(log, PRODUCER).append([(YARD, points(1, 3)), (stream_of(event_type), batch), (YARD, points(4, 5))])
        assert len(str(caught.value)) < 300
        with pytest.raises(InvalidEvent, match=message):
            encode(stream_of(event_type), batch, PRODUCER)


def _replaced(name: str, column: pa.Array, *, nullable: bool = False) -> Callable[[], EventBatch]:
    def make() -> EventBatch:
        data = columns(TrackPoint).data
        index = data.schema.get_field_index(name)
        return EventBatch(TrackPoint, data.set_column(index, pa.field(name, column.type, nullable), column))

    return make


ROWS = columns(TrackPoint).data
NAIVE = pa.array([datetime(2026, 1, 1)] * 3, pa.timestamp("us"))  # noqa: DTZ001 - what is tried
SHAPES: list[tuple[str, Callable[[], EventBatch], str]] = [
    ("a column missing", lambda: EventBatch(TrackPoint, ROWS.drop_columns(["x"])), "track_point: columns missing: x"),
    ("a column too many", lambda: EventBatch(TrackPoint, ROWS.append_column("z", ROWS["x"])), "unknown: z"),
    (
        "another order",
        lambda: EventBatch(TrackPoint, ROWS.select(ROWS.schema.names[::-1])),
        "columns must be in the order",
    ),
    ("another type's", lambda: EventBatch(TrackEnded, ROWS), "track_ended: columns missing: began_at"),
    (
        "a table",
        lambda: EventBatch(TrackPoint, pa.Table.from_batches([ROWS])),
        "must be a pyarrow.RecordBatch, got Table",
    ),
    ("a dict", lambda: EventBatch(TrackPoint, {"x": 1}), r"must be a pyarrow\.RecordBatch, got dict"),  # type: ignore[arg-type]
    ("wider floats", _replaced("x", pa.array([1.0] * 3, pa.float64())), "x is double not null, wanted float not null"),
    ("text for a number", _replaced("track_id", pa.array(["1"] * 3)), "track_id is string not null, wanted int64"),
    ("a naive time", _replaced("time", NAIVE), r"time is timestamp\[us\] not null, wanted timestamp\[us, tz=UTC\]"),
    ("a null", _replaced("x", pa.array([1, None, 1], pa.float32())), "track_point.x must not be null, got 1 nulls"),
    ("nothing", lambda: batch_of([]), "one or more events of one type, got 0"),
    ("text that is not UTF-8", lambda: _not_utf8(), "rule_deployed: .*Invalid UTF8"),
    ("a batch too large", lambda: _too_large(), f"track_point: .* at most {PAYLOAD_MAX_BYTES} bytes"),
    ("an empty batch", lambda: batch_of_type(TrackPoint, []), f"{GATE}: .* got an empty batch"),
]


def _not_utf8() -> EventBatch:
    data = columns(RuleDeployed).data
    raw = pa.array([b"\xff"] * 3, pa.binary())
    text = pa.Array.from_buffers(pa.string(), 3, raw.buffers())
    return EventBatch(RuleDeployed, data.set_column(1, data.schema.field(1), text))


def _too_large() -> EventBatch:
    count = PAYLOAD_MAX_BYTES // 56
    ones = pa.array(np.ones(count, np.int64))
    return EventBatch(
        TrackPoint, pa.RecordBatch.from_arrays([ones.cast(f.type) for f in ROWS.schema], schema=ROWS.schema)
    )


@pytest.mark.parametrize("make, message", [case[1:] for case in SHAPES], ids=[case[0] for case in SHAPES])
def test_a_batch_of_another_shape_is_refused_with_all_of_its_call(
    log: Log, make: Callable[[], EventBatch], message: str
) -> None:
    def made_and_appended() -> None:
        batch = make()
        Appender(log, PRODUCER).append([(YARD, points(1, 3)), (stream_of(batch.type), batch)])

    append(log, GATE, 2)
    with nothing_stored(log), pytest.raises(InvalidEvent, match=message):
        made_and_appended()


SINGLE: list[tuple[type[EventType], dict[str, Any], str]] = [
    (TrackPoint, {"time": datetime(2026, 1, 1)}, "time\n.*timezone"),  # noqa: DTZ001 - what is tried
    (TrackPoint, {"x": None}, "x\n"),
    (TrackPoint, {"x": "far"}, "x\n"),
    (TrackPoint, {"speed": 1.0}, "speed\n"),
    (TrackPoint, {"frame": -1}, "frame\n"),
    (CheckpointSigned, {"heads": "{"}, "heads\n"),
    (TrackEnded, {"reason": "bored"}, "reason\n"),
]


@pytest.mark.parametrize("event_type, changed, message", SINGLE)
def test_an_event_of_wrong_values_does_not_even_come_to_be(
    event_type: type[EventType], changed: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        event_type(**(EXAMPLES[event_type].model_dump() | changed))


NAMES = ["", "a/b", "a'b", 'a"b', "a\nb", "a\0b", "a b", "-a", "x" * 10_000, "../etc", "é", "a;drop table streams"]


@pytest.mark.parametrize("name", NAMES, ids=[ascii(name[:12]) for name in NAMES])
@pytest.mark.parametrize("part", ["station", "source", "type"])
def test_a_stream_name_outside_the_grammar_is_refused_by_part(log: Log, part: str, name: str) -> None:
    parts = {"station": "brno", "source": "gate", "type": "track_point"} | {part: name}
    with pytest.raises(InvalidName, match=f"{part} must be ") as caught:
        StreamName.of(**parts)
    assert len(str(caught.value)) < 400
    unchecked = StreamName(**parts)  # type: ignore[arg-type]
    with (
        nothing_stored(log),
        pytest.raises((InvalidName, InvalidEvent), match=part if part != "type" else "takes|type"),
    ):
        log.append([draft(YARD, 1, 2), encode(unchecked, points(1, 2), PRODUCER)])


def test_an_event_of_a_type_that_is_not_registered_is_refused_by_its_name(log: Log) -> None:
    batch = batch_of([Unregistered(time=NOON, value=1)])
    with nothing_stored(log), pytest.raises(UnknownType, match="'unregistered'"):
        Appender(log, PRODUCER).append([(YARD, points(1, 2)), (stream_of(Unregistered), batch)])


@on_both
@pytest.mark.parametrize("number", [-1, -(2**63)])
def test_a_negative_sequence_or_position_is_refused_by_name(log: Log, number: int) -> None:
    append(log, GATE, 2)
    with nothing_stored(log):
        with pytest.raises(BadRequest, match=f"brno/yard/track_point: expected must be 0 or more, got {number}"):
            log.append([draft(GATE, 3, 4), draft(YARD, 1, 2)], [2, number])
        with pytest.raises(BadRequest, match=f"brno/gate/track_point: from_sequence must be 0 or more, got {number}"):
            log.read(GATE, number)
        with pytest.raises(BadRequest, match=f"from_position must be 0 or more, got {number}"):
            log.read_all(number)


def test_every_limit_of_the_catalogue_is_lawful_itself(log: Log) -> None:
    log.append([encode(stream_of(event_type), columns(event_type), PRODUCER) for event_type in EXAMPLES])
    assert log.head() == len(EXAMPLES)
    assert {name for event_type in EXAMPLES for name in schema_of(event_type).names} >= {"confidence", "heads"}
