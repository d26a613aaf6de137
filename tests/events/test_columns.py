import math
from datetime import UTC, datetime

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import (
    SHIPPED,
    EventBatch,
    EventType,
    InvalidEvent,
    StreamName,
    TrackEnded,
    TrackEndedV1,
    TrackPoint,
    batch_of,
    batch_of_type,
    events_of,
    schema_of,
    with_envelope,
)
from events.columns import TIMESTAMP, subject_of
from tests.events.examples import NOON, rule_deployed, situation, sync_planned, track_point
from tests.events.plugged import VehicleWeighed
from tests.events.strategies import INT64_MAX, batches, bits, events

TYPES = (*SHIPPED, TrackEndedV1, VehicleWeighed)
each_type = pytest.mark.parametrize("event_type", TYPES, ids=lambda t: f"{t.type_name}.v{t.version}")


@each_type
@given(data=st.data())
@settings(max_examples=25)
def test_events_of_batch_of_is_the_identity(event_type: type[EventType], data: st.DataObject) -> None:
    said = data.draw(st.lists(events(event_type), max_size=5))
    # repr tells -0.0 from 0.0 and holds NaN equal to itself, which == does not.
    assert repr(events_of(batch_of_type(event_type, said))) == repr(said)


@each_type
def test_the_columns_are_the_fields_in_order_with_time_first(event_type: type[EventType]) -> None:
    schema = schema_of(event_type)
    assert schema.names == list(event_type.model_fields)
    assert schema.field(0).equals(pa.field("time", TIMESTAMP, nullable=False))
    assert [f.metadata[b"description"].decode() for f in schema] == [
        info.description for info in event_type.model_fields.values()
    ]


def test_each_kind_of_field_has_its_column() -> None:
    axle = pa.struct([pa.field("load", pa.float32()), pa.field("label", pa.string(), nullable=False)])
    assert schema_of(VehicleWeighed).equals(
        pa.schema(
            [
                pa.field("time", TIMESTAMP, nullable=False),
                pa.field("plate", pa.string()),
                pa.field("face", pa.binary(), nullable=False),
                pa.field("is_heavy", pa.bool_(), nullable=False),
                pa.field("is_sure", pa.bool_()),
                pa.field("raw", pa.binary()),
                pa.field("mass", pa.float64(), nullable=False),
                pa.field("left_at", TIMESTAMP),
                pa.field("class_of", pa.string()),
                pa.field("notes", pa.string()),
                pa.field("axles", pa.list_(axle), nullable=False),
                pa.field("spares", pa.list_(axle)),
            ]
        )
    )


def test_json_and_personal_fields_are_marked_in_the_schema() -> None:
    schema = schema_of(VehicleWeighed)
    marked = {mark: [f.name for f in schema if mark in f.metadata] for mark in (b"json", b"personal")}
    assert marked == {b"json": ["notes"], b"personal": ["plate", "face"]}


@pytest.mark.parametrize("kind", [dict, list[int], int | str, object, tuple[int, ...], set])
def test_a_field_without_a_column_type_is_refused_by_name(kind: object) -> None:
    odd = type("Odd", (EventType,), {"__annotations__": {"thing": kind}}, type="odd", version=1)
    with pytest.raises(InvalidEvent, match=r"field thing: no column type for .*; wanted bool, int"):
        schema_of(odd)


@pytest.mark.parametrize("event_type", TYPES, ids=lambda t: f"{t.type_name}.v{t.version}")
def test_a_batch_may_be_empty(event_type: type[EventType]) -> None:
    batch = batch_of_type(event_type, [])
    assert len(batch) == 0
    assert batch.data.schema.equals(schema_of(event_type))
    assert events_of(batch) == []


def test_events_without_a_type_make_no_batch() -> None:
    with pytest.raises(InvalidEvent, match="one or more events of one type, got 0 of 0 types"):
        batch_of([])


def test_events_of_two_types_make_no_batch() -> None:
    with pytest.raises(InvalidEvent, match="one type, got 2 of 2 types"):
        batch_of([track_point(), sync_planned()])
    with pytest.raises(InvalidEvent, match="a batch of TrackPoint holds nothing else, got SyncPlanned"):
        batch_of_type(TrackPoint, [track_point(), sync_planned()])  # type: ignore[list-item]


@pytest.mark.parametrize(
    "event, field",
    [
        (track_point(track_id=INT64_MAX + 1), "track_point.track_id"),
        (rule_deployed(text="\ud800"), "rule_deployed.text"),
    ],
)
def test_a_value_that_fits_no_column_is_refused_by_field(event: EventType, field: str) -> None:
    with pytest.raises(InvalidEvent, match=f"{field}: a value does not fit a column of"):
        batch_of([event])


def test_the_largest_integer_and_the_outermost_times_fit() -> None:
    said = [
        track_point(track_id=INT64_MAX, time=datetime(1, 1, 1, 0, 0, 0, 1, tzinfo=UTC)),
        track_point(time=datetime(9999, 12, 31, 23, 59, 59, 999_999, tzinfo=UTC)),
    ]
    assert events_of(batch_of(said)) == said


def _columns(**changed: pa.Array) -> pa.RecordBatch:
    data = batch_of([track_point()]).data
    for name, column in changed.items():
        index = data.schema.get_field_index(name)
        data = data.set_column(index, pa.field(name, column.type, nullable=False), column)
    return data


def test_a_batch_says_which_columns_are_missing_and_which_unknown() -> None:
    data = _columns().rename_columns(["time", "track", *schema_of(TrackPoint).names[2:]])
    with pytest.raises(InvalidEvent, match="track_point: columns missing: track_id; unknown: track"):
        EventBatch(TrackPoint, data)


def test_a_batch_says_which_column_is_there_twice() -> None:
    data = _columns()
    doubled = pa.RecordBatch.from_arrays(
        [*data.columns, data.column("x")], schema=pa.schema([*data.schema, data.schema.field("x")])
    )
    with pytest.raises(InvalidEvent, match=r"each column must be there once, got time, .*, x$"):
        EventBatch(TrackPoint, doubled)


def test_a_batch_in_the_wrong_order_says_the_order_that_is_wanted() -> None:
    names = schema_of(TrackPoint).names
    with pytest.raises(InvalidEvent, match=f"in the order {', '.join(names)}; got confidence, "):
        EventBatch(TrackPoint, _columns().select(names[::-1]))


@pytest.mark.parametrize(
    "name, column, message",
    [
        ("x", pa.array([1.0], pa.float64()), "x is double not null, wanted float not null"),
        ("track_id", pa.array(["1"]), "track_id is string not null, wanted int64 not null"),
        ("time", pa.array([NOON], pa.timestamp("us")), r"time is timestamp\[us\] not null, wanted .*tz=UTC"),
        ("time", pa.array([0], pa.timestamp("ns", "UTC")), r"time is timestamp\[ns, tz=UTC\]"),
    ],
)
def test_a_column_of_the_wrong_type_is_refused(name: str, column: pa.Array, message: str) -> None:
    with pytest.raises(InvalidEvent, match=f"track_point: {message}"):
        EventBatch(TrackPoint, _columns(**{name: column}))


def test_a_schema_that_allows_nulls_where_the_type_does_not_is_refused() -> None:
    data = _columns()
    loose = pa.RecordBatch.from_arrays(data.columns, names=data.schema.names)
    with pytest.raises(InvalidEvent, match="frame is int64, wanted int64 not null"):
        EventBatch(TrackPoint, loose)


def test_nulls_are_refused_with_their_number() -> None:
    with pytest.raises(InvalidEvent, match=r"track_point.x must not be null, got 1 nulls"):
        EventBatch(TrackPoint, _columns(x=pa.array([None], pa.float32())))


def test_nulls_inside_a_part_are_refused_by_path() -> None:
    data = batch_of([situation("a")]).data
    lineage = [[{"variable": None, "stream": "s", "first_sequence": 1, "last_sequence": 2, "events": 2}]]
    column = pa.array(lineage, data.schema.field("lineage").type)
    with pytest.raises(InvalidEvent, match=r"situation_detected.lineage.variable must not be null, got 1"):
        EventBatch(situation().__class__, data.set_column(11, data.schema.field("lineage"), column))


def test_a_value_outside_the_definition_is_refused_when_events_are_made() -> None:
    batch = EventBatch(TrackPoint, _columns(track_id=pa.array([0], pa.int64())))
    with pytest.raises(
        InvalidEvent, match=r"track_point: 1 validation error .*\ntrack_id\n.*greater than or equal to 1"
    ):
        events_of(batch)


def test_a_time_beyond_year_9999_is_refused_when_events_are_made() -> None:
    late = pa.array([2**62], pa.int64()).cast(TIMESTAMP)
    with pytest.raises(InvalidEvent, match="track_point: "):
        events_of(EventBatch(TrackPoint, _columns(time=late)))


@given(st.data())
@settings(max_examples=60)
def test_a_slice_is_what_a_list_would_give(data: st.DataObject) -> None:
    said = [track_point(track_id=i) for i in range(1, 6)]
    bound = st.integers(-7, 7)
    start, stop = data.draw(bound), data.draw(st.none() | bound)
    assert events_of(batch_of(said).slice(start, stop)) == said[start:stop]


def test_the_envelope_stands_in_front_of_the_columns() -> None:
    batch = batch_of([track_point(track_id=7), track_point(track_id=8)])
    table = with_envelope(StreamName.parse("brno-2/gate/track_point"), 41, batch)
    assert table.schema.names[:7] == ["station", "source", "type", "subject", "sequence", "time", "track_id"]
    assert table.select(table.schema.names[:5]).to_pylist() == [
        {"station": "brno-2", "source": "gate", "type": "track_point", "subject": "7", "sequence": 41},
        {"station": "brno-2", "source": "gate", "type": "track_point", "subject": "8", "sequence": 42},
    ]


@each_type
@given(data=st.data())
@settings(max_examples=10)
def test_the_subject_is_the_subject_field_as_text(event_type: type[EventType], data: st.DataObject) -> None:
    batch = data.draw(batches(event_type))
    subjects = subject_of(batch)
    assert subjects.type == pa.string()
    if event_type.subject_field is None:
        assert subjects.null_count == len(batch)
    else:
        values = batch.data.column(event_type.subject_field).to_pylist()
        assert subjects.to_pylist() == [None if value is None else str(value) for value in values]


def test_enveloped_columns_keep_their_bits() -> None:
    batch = batch_of([track_point(x=math.nan, y=-0.0)])
    table = with_envelope(StreamName.parse("s/c/track_point"), 1, batch)
    for name in schema_of(TrackPoint).names:
        assert bits(table.column(name)) == bits(batch.data.column(name))


def test_an_optional_field_of_a_shipped_type_is_a_column_that_may_be_null() -> None:
    optional = {f"{t.type_name}.{f.name}" for t in SHIPPED for f in schema_of(t) if f.nullable}
    lost = ("count", "first_sequence", "last_sequence", "lost_from_at", "lost_until_at", "policy")
    assert optional == {
        "video_added.fps",
        "video_added.frames_expected",
        "process_progressed.note",
        *(f"loss_recorded.{name}" for name in lost),
        *(f"plate_read.{name}" for name in ("country", "region", "candidates")),
        "pair_distance.alignment",
        *(f"{name}.{why}" for name in ("zone_defined", "zone_removed") for why in ("author", "reason")),
        "camera_calibrated.rms_m",
        *(f"track_ended.{name}" for name in ("x1_mean", "y1_mean", "x2_mean", "y2_mean")),
        *(f"camera_calibrated.{name}" for name in ("focal_px", "pitch_rad", "roll_rad", "height_m")),
        *(f"camera_calibrated.{name}" for name in ("covariance", "scale")),
        *(f"scene_changed.{name}" for name in ("dx", "dy")),
        "rule_deployed.after_position",
        "station_enrolled.address",
        *(f"station_revoked.{name}" for name in ("key_id", "reason")),
        *(f"request_refused.{name}" for name in ("claimed", "address")),
        *(f"query_answered.{name}" for name in ("person", "reason")),
        *(f"rule_missed.{name}" for name in ("stream", "first_sequence", "last_sequence", "partition")),
    }
    assert TrackEnded.subject_field == "track_id"
