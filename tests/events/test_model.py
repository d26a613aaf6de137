import json
import math
import struct
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from events import (
    SHIPPED,
    EventType,
    InvalidEvent,
    InvalidName,
    SyncPlanned,
    TrackPoint,
    schema_of,
)
from events.model import ENVELOPE
from tests.events.examples import NOON, sync_planned, track_point


def test_an_event_is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        track_point().track_id = 2


def test_an_unknown_field_is_refused_by_name() -> None:
    with pytest.raises(ValidationError, match="speed"):
        track_point(speed=1.0)


def test_a_missing_field_is_refused_by_name() -> None:
    with pytest.raises(ValidationError, match=r"plan_hash\n.*Field required"):
        SyncPlanned(time=NOON, central="c", plan="{}")


def test_a_naive_time_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"time\n.*should have timezone info"):
        track_point(time=datetime(2026, 1, 1))  # noqa: DTZ001 - what is tried


def test_a_time_of_another_zone_is_kept_in_utc() -> None:
    event = track_point(time=datetime(2026, 1, 1, 14, 0, tzinfo=timezone(timedelta(hours=2))))
    assert event.time == NOON
    assert event.time.tzinfo is UTC


@pytest.mark.parametrize(
    "time",
    [
        datetime(1, 1, 1, tzinfo=timezone(timedelta(hours=1))),
        datetime(9999, 12, 31, 23, 59, tzinfo=timezone(-timedelta(hours=1))),
    ],
)
def test_a_time_beyond_the_years_of_utc_is_refused(time: datetime) -> None:
    with pytest.raises(ValidationError, match=r"must lie in the years 1 to 9999 of UTC, got"):
        track_point(time=time)


@given(st.floats(allow_nan=False))
def test_a_float32_is_the_nearest_of_32_bits_or_refused(number: float) -> None:
    try:
        kept = track_point(x=number).x
    except ValidationError as error:
        assert "must fit a float of 32 bits, got" in str(error)  # noqa: PT017 - either outcome is lawful
        assert abs(number) > 3.4e38
        return
    assert struct.pack("<f", number) == struct.pack("<f", kept)
    assert struct.unpack("<f", struct.pack("<f", kept)) == (kept,)


def test_a_float32_may_be_nan_or_infinite_or_minus_zero() -> None:
    event = track_point(x=math.nan, y=-math.inf, x1=-0.0)
    assert math.isnan(event.x)
    assert event.y == -math.inf
    assert math.copysign(1, event.x1) == -1


@pytest.mark.parametrize("text", ["", "{", "{'a': 1}", "NaN", '{"a": Infinity}', r'"\ud800"', "[" * 10_000])
def test_text_that_is_not_json_is_refused_where_json_is_wanted(text: str) -> None:
    with pytest.raises(ValidationError, match="plan\n"):
        sync_planned(plan=text)


def test_json_text_is_kept_as_it_was_written() -> None:
    text = ' {"b": 1.0, "a": [2, "\\u00e9"], "b": 3} '
    assert sync_planned(plan=text).plan == text


def test_an_event_travels_through_json() -> None:
    event = track_point(x=math.inf, y=-0.0)
    assert TrackPoint.model_validate_json(event.model_dump_json()) == event
    assert json.loads(event.model_dump_json())["time"] == "2026-01-01T12:00:00Z"


@pytest.mark.parametrize("name", [name for name in ENVELOPE if name != "time"])
def test_a_type_that_bears_an_envelope_name_is_refused(name: str) -> None:
    with pytest.raises(InvalidEvent, match=rf"door_opened: the envelope already has {name}; rename"):
        type("DoorOpened", (EventType,), {"__annotations__": {name: str}}, type="door_opened", version=1)


def test_a_type_that_defines_time_anew_is_refused() -> None:
    with pytest.raises(InvalidEvent, match="door_opened: time belongs to the envelope"):

        class DoorOpened(EventType, type="door_opened", version=1):
            time: int  # type: ignore[assignment]


def test_a_type_whose_subject_is_no_field_is_refused() -> None:
    with pytest.raises(InvalidEvent, match="subject must be a field of the type, got 'door'"):

        class DoorOpened(EventType, type="door_opened", version=1, subject="door"):
            pass


@pytest.mark.parametrize("version", [0, -1])
def test_a_version_below_one_is_refused(version: int) -> None:
    with pytest.raises(InvalidEvent, match=rf"a version is 1 or more, got {version}"):

        class DoorOpened(EventType, type="door_opened", version=version):
            pass


def test_a_type_whose_name_is_outside_the_grammar_is_refused() -> None:
    with pytest.raises(InvalidName, match="got 'door/opened'"):

        class DoorOpened(EventType, type="door/opened", version=1):
            pass


@pytest.mark.parametrize("event_type", SHIPPED, ids=lambda t: t.type_name)
def test_every_shipped_type_and_field_says_what_it_is(event_type: type[EventType]) -> None:
    assert event_type.__doc__
    for path, field in _with_parts(schema_of(event_type)):
        assert len(field.metadata[b"description"]) >= 8, f"{event_type.type_name}.{path}"


# What one must know to use a number or a time; a field whose name ends so, or that is a pixel's.
UNITS = {
    "_px": "px",
    "_at": "(UTC",
    "time": "(UTC",
    "width": "px",
    "height": "px",
    "fps": "1/s",
    **dict.fromkeys(["x", "y", "x1", "y1", "x2", "y2", "dx", "dy", "_entry", "_exit"], "px"),
    **dict.fromkeys(["vx", "vy"], "px/s"),
    **dict.fromkeys(["confidence", "_share", "_share_max"], "0 "),
    "_m": ", m;",
    "_rad": ", rad;",
    "_hash": "SHA-256",
    "_px_s": "px/s",
    "_s": "s",
    "alignment": "-1 to 1",
}


@pytest.mark.parametrize("event_type", SHIPPED, ids=lambda t: t.type_name)
def test_every_shipped_measure_names_its_unit_or_range(event_type: type[EventType]) -> None:
    for name, info in event_type.model_fields.items():
        wanted = [unit for end, unit in UNITS.items() if name == end or (end[0] == "_" and name.endswith(end))]
        is_measure = schema_of(event_type).field(name).type in ("float", "double", "timestamp[us, tz=UTC]")
        assert wanted or not is_measure, f"{event_type.type_name}.{name}: add its unit to UNITS"
        for unit in wanted:
            assert unit in (info.description or ""), f"{event_type.type_name}.{name} must name {unit!r}"


def _with_parts(schema, path=""):
    for field in schema:
        yield path + field.name, field
        if hasattr(field.type, "value_type"):
            yield from _with_parts(field.type.value_type, f"{path}{field.name}[].")
