"""What the columns are asked is what the models are asked, and what `AtDoor` adds to it."""

import math
from typing import Annotated, Any, Literal

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field, FiniteFloat, ValidationError

from events import (
    SHIPPED,
    AtDoor,
    EventType,
    Finite32,
    InvalidEvent,
    JsonText,
    Share32,
    TrackPoint,
    allowed,
    schema_of,
)
from events.columns import TIMESTAMP
from events.door import TIME_END, TIME_MIN, VALUE_MAX_BYTES, check
from tests.events.examples import NOON

Whole = Annotated[int, Field(ge=-3)]


class Limited(EventType, type="limited", version=1):
    """A type with every kind of limit that a definition can state."""

    ge: Annotated[int, Field(ge=0)]
    gt: Annotated[int, Field(gt=0)]
    le: Annotated[float, Field(le=1)]
    lt: Annotated[float, Field(lt=1)]
    both: Annotated[float, Field(ge=-1, le=1)]
    finite: FiniteFloat
    told: Annotated[float, Field(allow_inf_nan=False, gt=0)]
    maybe: Annotated[int, Field(ge=5, le=7)] | None
    inner: Whole | None
    word: Literal["one", "two"]
    word_or_none: Literal["one", "two"] | None
    text: JsonText
    any_float: float
    any_int: int


LAWFUL: dict[str, Any] = {
    "time": NOON,
    "ge": 0,
    "gt": 1,
    "le": 1.0,
    "lt": 0.5,
    "both": 0.0,
    "finite": 0.0,
    "told": 1.0,
    "maybe": 5,
    "inner": 0,
    "word": "one",
    "word_or_none": None,
    "text": "{}",
    "any_float": 0.0,
    "any_int": 0,
}
numbers = {
    pa.int64(): st.integers(-4, 9) | st.sampled_from([-(2**63), 2**63 - 1]),
    pa.float64(): st.sampled_from(
        [-math.inf, -1.0001, -1.0, -0.0, 0.0, 5e-324, 0.9999, 1.0, 1.0001, math.inf, math.nan]
    ),
    pa.string(): st.sampled_from(["one", "two", "three", "", "{}", "[1]", "NaN", "{", '"one"', "1 2"]),
}


@given(st.data())
@settings(max_examples=300)
def test_the_columns_are_asked_what_the_model_is_asked(data: st.DataObject) -> None:
    field = data.draw(st.sampled_from([field for field in schema_of(Limited) if field.name != "time"]))
    value = data.draw(numbers[field.type] | st.none() if field.nullable else numbers[field.type])
    try:
        Limited.model_validate(LAWFUL | {field.name: value})
        is_lawful = True
    except ValidationError:
        is_lawful = False
    rows = [LAWFUL, LAWFUL | {field.name: value}, LAWFUL]
    columns = pa.RecordBatch.from_pylist(rows, schema=schema_of(Limited)).columns
    if is_lawful:
        check(Limited, columns)
    else:
        with pytest.raises(InvalidEvent, match=rf"limited\.{field.name} must be .* in row 1$"):
            check(Limited, columns)


@pytest.mark.parametrize("event_type", SHIPPED, ids=lambda t: t.type_name)
def test_every_field_of_a_shipped_type_is_asked_for(event_type: type[EventType]) -> None:
    assert {path.split("[]")[0] for path in allowed(event_type)} == set(event_type.model_fields)


def test_every_number_of_a_shipped_type_has_limits() -> None:
    """A field may go without only if it is named here with its reason."""
    free = {
        f"{event_type.type_name}.{field.name}"
        for event_type in SHIPPED
        for field in schema_of(event_type)
        if field.type in (pa.int64(), pa.float64(), pa.float32()) and not allowed(event_type)[field.name].is_limited
    }
    assert free == set()


def test_limits_read_as_people_write_them() -> None:
    asked = allowed(Limited) | allowed(TrackPoint)
    wanted = {"ge": "≥ 0", "gt": "> 0", "le": "≤ 1", "lt": "< 1", "both": "-1 to 1", "finite": "finite"}
    wanted |= {
        "told": "finite, > 0",
        "maybe": "5 to 7",
        "word": "one, two",
        "text": "JSON",
        "any_float": "",
        "x": "finite",
    }
    assert {name: str(asked[name]) for name in wanted} == wanted


class Door(EventType, type="door", version=1):
    """A type whose limits came after its events."""

    x: Finite32
    share: Share32 | None
    count: Annotated[int, AtDoor(1, 5)]
    seen_at: Annotated[int, AtDoor()]


def test_what_the_door_asks_the_model_does_not() -> None:
    event = Door(time=NOON, x=math.nan, share=7, count=0, seen_at=0)
    columns = pa.RecordBatch.from_pylist([event.model_dump()], schema=schema_of(Door)).columns
    with pytest.raises(InvalidEvent, match=r"door\.x must be finite, got 'nan' in row 0"):
        check(Door, columns)


@pytest.mark.parametrize("bad_row", [0, 1, 2])
@pytest.mark.parametrize(
    "name, value", [("x", math.nan), ("x", -math.inf), ("share", 1.5), ("share", -0.1), ("count", 6)]
)
def test_the_first_bad_row_is_named_wherever_it_stands(name: str, value: float, bad_row: int) -> None:
    rows: list[dict[str, Any]] = [{"time": NOON, "x": 0, "share": None, "count": 1, "seen_at": 0} for _ in range(3)]
    rows[bad_row][name] = value
    whole = pa.RecordBatch.from_pylist(rows, schema=schema_of(Door))
    with pytest.raises(InvalidEvent, match=rf"door\.{name} must be .* in row {bad_row}$"):
        check(Door, whole.columns)
    before, behind = whole.slice(0, bad_row), whole.slice(bad_row + 1)
    check(Door, before.columns)
    check(Door, behind.columns)


@pytest.mark.parametrize("microsecond", [TIME_MIN, TIME_END])
def test_the_span_of_times_has_its_first_and_not_its_end(microsecond: Any) -> None:
    edge = round(microsecond.timestamp()) * 1_000_000
    for time, is_lawful in ((edge - 1, microsecond is TIME_END), (edge, microsecond is TIME_MIN)):
        columns = [pa.array([time], pa.int64()).cast(TIMESTAMP), *_track_point(1)[1:]]
        if is_lawful:
            check(TrackPoint, columns)
        else:
            with pytest.raises(
                InvalidEvent, match=r"track_point.time must be in 1970-01-01 to 2200-01-01, got '(1969|22)"
            ):
                check(TrackPoint, columns)


def test_a_value_may_have_the_most_bytes_and_not_one_more() -> None:
    for value, is_lawful in (("x" * VALUE_MAX_BYTES, True), ("é" * (VALUE_MAX_BYTES // 2) + "x", False)):
        text = pa.array(["", '"a"', value.join(['"', '"'])[1:-1]])
        columns = pa.RecordBatch.from_pylist([LAWFUL] * 3, schema=schema_of(Limited)).columns
        columns[schema_of(Limited).get_field_index("word_or_none")] = text
        message = (
            "must be one of" if is_lawful else f"at most {VALUE_MAX_BYTES} bytes, got '{VALUE_MAX_BYTES + 1} bytes'"
        )
        with pytest.raises(InvalidEvent, match=message):
            check(Limited, columns)


def test_many_short_values_are_no_long_one() -> None:
    batch = pa.RecordBatch.from_pylist([LAWFUL | {"text": '"' + "x" * 2**20 + '"'}] * 5, schema=schema_of(Limited))
    check(Limited, batch.columns)
    check(Limited, batch.slice(2, 1).columns)


def test_an_empty_batch_has_nothing_to_refuse() -> None:
    for event_type in (*SHIPPED, Limited):
        check(event_type, pa.RecordBatch.from_pylist([], schema=schema_of(event_type)).columns)


def _track_point(count: int) -> list[pa.Array]:
    row = {"time": NOON, "track_id": 1, "frame": 0, "confidence": 1.0}
    row |= dict.fromkeys(("x", "y", "x1", "y1", "x2", "y2", "vx", "vy"), 0.0)
    return list(pa.RecordBatch.from_pylist([row] * count, schema=schema_of(TrackPoint)).columns)
