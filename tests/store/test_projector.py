import json
import logging
import math
import struct
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pyarrow as pa
import pytest

from events import (
    SHIPPED,
    Catalogue,
    CorruptSegment,
    EventBatch,
    EventType,
    Float32,
    JsonText,
    Part,
    PersonalBytes,
    ProcessFailed,
    ProcessStarted,
    StreamName,
    SyncPlanned,
    TrackPoint,
    UtcTime,
    batch_of,
    decode,
    encode,
    schema_of,
)
from store import Log, LogUnavailable, Projector, Transaction
from tests.events.examples import unchecked
from tests.store.samples import GATE, NOON, ONE_OF_EACH, PRODUCER, append, draft, draft_of, on_both, owner, point, query


def project(log: Log) -> Projector:
    """A projector that has caught up."""
    made = Projector(log)
    made.catch_up()
    made.close()
    return made


def assert_rows_equal_events(log: Log) -> None:
    """Each event has exactly one row, in the table of its type and in the view `events`."""
    events: dict[str, list[tuple[str, int, int]]] = {}
    for segment in log.read_all():
        count = len(decode(segment, log.catalogue))
        first = segment.header.first_sequence
        events.setdefault(segment.stream.type, []).extend(
            (str(segment.stream), sequence, segment.position) for sequence in range(first, first + count)
        )
    rows: dict[str, list[tuple[str, int, int]]] = {}
    for type_name, stream, sequence, position, id_ in query(
        log, "select type, station || '/' || source || '/' || type, sequence, position, id from events"
    ):
        assert id_ == f"{stream}/{sequence}"
        rows.setdefault(type_name, []).append((stream, sequence, position))
    assert {name: sorted(found) for name, found in rows.items()} == {
        name: sorted(sent) for name, sent in events.items()
    }


@on_both
def test_every_type_has_rows_with_the_values_that_were_sent(log: Log) -> None:
    assert {type(event) for event in ONE_OF_EACH} == set(SHIPPED)
    log.append([draft_of(event) for event in ONE_OF_EACH])
    assert project(log).segments_skipped == 0
    assert_rows_equal_events(log)
    for event in ONE_OF_EACH:
        names = list(type(event).model_fields)
        columns = ", ".join(f'"{name}"' for name in names)
        ((station, source, subject, *values),) = query(
            log, f"select station, source, subject, {columns} from {event.type_name}"
        )
        assert (station, source) == ("brno", "gate")
        wanted = event.model_dump(mode="python")
        for name, value in zip(names, values, strict=True):
            is_json = type(value) in (dict, list)
            assert value == (as_json(wanted[name]) if is_json else wanted[name]), name
        field = type(event).subject_field
        assert subject == (None if field is None else str(wanted[field]))


def as_json(value: Any) -> Any:
    return json.loads(value) if isinstance(value, str) else json.loads(json.dumps(value))


@on_both
def test_the_numbers_that_are_none_and_the_smallest_and_largest_come_through(log: Log) -> None:
    specials = [math.nan, math.inf, -math.inf, -0.0, 2.0**-149, 3.4028234663852886e38]
    log.append([unchecked(GATE, batch_of([point(frame, x=x) for frame, x in enumerate(specials)]))])
    project(log)
    stored = [x for (x,) in query(log, "select x from track_point order by sequence")]
    assert [struct.pack("<f", x) for x in stored] == [struct.pack("<f", x) for x in specials]


@on_both
def test_events_fall_into_the_partition_of_their_day_in_utc(log: Log) -> None:
    midnight = datetime(2026, 3, 29, tzinfo=UTC)
    times = [
        midnight - timedelta(microseconds=1),
        midnight,
        midnight + timedelta(days=1) - timedelta(microseconds=1),
        datetime(1, 1, 1, tzinfo=UTC),
        datetime(9999, 12, 31, 23, 59, 59, 999_999, tzinfo=UTC),
    ]
    log.append([unchecked(GATE, batch_of([point(frame, time=time) for frame, time in enumerate(times)]))])
    project(log)
    found = dict(query(log, "select frame, tableoid::regclass::text from track_point"))
    assert found == {
        0: "track_point_20260328",
        1: "track_point_20260329",
        2: "track_point_20260329",
        3: "track_point_00010101",
        4: "track_point_99991231",
    }
    assert {time for (time,) in query(log, "select time from track_point where frame < 3")} == set(times[:3])


@on_both
def test_rows_come_in_the_order_of_positions_over_many_deliveries(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    append(log, GATE, 2, 1, 4, 1, 1)
    made = Projector(log)
    monkeypatch.setattr(made._subscription, "_limit", 2)
    assert [made.step().position for _ in range(3)] == [2, 4, 5]
    assert made.step().is_caught_up
    assert made.position == 5
    made.close()
    assert_rows_equal_events(log)


@on_both
@pytest.mark.parametrize("step", ["_decoded", "_copy", "_copy_what_fits", "save_checkpoint", "commit"])
@pytest.mark.parametrize("is_restarted", [True, False])
def test_each_event_has_one_row_whatever_step_is_cut_short(
    log: Log, monkeypatch: pytest.MonkeyPatch, step: str, is_restarted: bool
) -> None:
    append(log, GATE, 2, 3)
    made = Projector(log)
    cut = {"save_checkpoint": Transaction}

    def stop_after(self: Any, *arguments: Any) -> Any:
        original(self, *arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        name = "_store" if step == "commit" else step
        original = getattr(cut.get(step, Projector), name)
        patch.setattr(cut.get(step, Projector), name, stop_after)
        with pytest.raises(KeyboardInterrupt):
            made.step()
    rows = 5 if step == "commit" else 0
    assert query(log, "select count(*) from track_point") == [(rows,)]
    append(log, GATE, 1)
    if is_restarted:
        made = Projector(log)
    made.catch_up()
    made.close()
    assert_rows_equal_events(log)


@on_both
def test_two_projectors_at_once_store_each_event_once(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    append(log, GATE, 3, 2)
    both_have_it = threading.Barrier(2, timeout=60)
    decoded = Projector._decoded
    met: set[Projector] = set()

    def wait_for_the_other(self: Projector, segments: Any) -> Any:
        if self not in met:
            met.add(self)
            both_have_it.wait()
        return decoded(self, segments)

    monkeypatch.setattr(Projector, "_decoded", wait_for_the_other)
    made = [Projector(log), Projector(log)]
    threads = [threading.Thread(target=one.catch_up) for one in made]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(met) == 2
    assert [one.position for one in made] == [2, 2]
    assert_rows_equal_events(log)
    append(log, GATE, 1)
    for one in made:
        one.catch_up()
        one.close()
    assert_rows_equal_events(log)


class Beep(EventType, type="beep", version=1, subject="tone"):
    """Something beeped."""

    tone: str
    """what it sounded like"""


class LouderBeep(EventType, type="beep", version=2, subject="tone", older=Beep):
    """Something beeped, and how loud."""

    tone: str
    """what it sounded like"""
    loudness_db: float | None
    """how loud, dB"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Nobody knows how loud they were."""
        return pa.RecordBatch.from_arrays([*older.columns, pa.nulls(len(older), pa.float64())], schema=schema_of(cls))


class Echo(Part):
    """One echo."""

    heard_at: UtcTime
    """when"""
    strength: Float32
    """how strong, may be no number"""
    sound: PersonalBytes
    """what"""


class Order(EventType, type="order", version=1):
    """A type whose names are words of SQL, with a list of structures of all kinds."""

    select: str
    """a text"""
    table: JsonText | None
    """a structure"""
    user: tuple[Echo, ...]
    """a list"""


@on_both
def test_segments_of_an_unknown_type_or_version_are_counted_and_keep_nobody_waiting(
    make_log: Callable[..., Log], caplog: pytest.LogCaptureFixture
) -> None:
    log = make_log(Catalogue([*SHIPPED, Beep]))
    streams = [StreamName.of("brno", "gate", "beep"), GATE]
    log.append([encode(streams[0], batch_of([LouderBeep(time=NOON, tone="a", loudness_db=3)]), PRODUCER)])
    log.append([draft(GATE, 1, 2)])
    log.append([encode(streams[0], batch_of([Beep(time=NOON, tone="b")]), PRODUCER)])
    with caplog.at_level(logging.WARNING, "store.projector"):
        assert project(log).segments_skipped == 1
    assert "no rows for the segment at position 1: beep version 2 is not known here, only 1" in caplog.text
    assert query(log, "select tone from beep") == [("b",)]
    assert query(log, "select type, count(*) from events group by 1 order by 1") == [("beep", 1), ("track_point", 2)]


def test_skipped_segments_are_counted_once_however_often_a_step_is_tried(
    make_log: Callable[..., Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = make_log(Catalogue([*SHIPPED, Beep]))
    log.append([draft_of(LouderBeep(time=NOON, tone="a", loudness_db=3))])
    made = Projector(log)
    with monkeypatch.context() as patch:
        patch.setattr(Transaction, "save_checkpoint", lambda *_: (_ for _ in ()).throw(LogUnavailable("away")))
        for _ in range(3):
            with pytest.raises(LogUnavailable):
                made.step()
    made.catch_up()
    made.close()
    assert made.segments_skipped == 1


@on_both
def test_two_versions_of_a_type_in_one_delivery_have_their_rows(make_log: Callable[..., Log]) -> None:
    log = make_log(Catalogue([*SHIPPED, Beep, LouderBeep]))
    stream = StreamName.of("brno", "gate", "beep")
    log.append([encode(stream, batch_of([Beep(time=NOON, tone="a")]), PRODUCER)])
    log.append([encode(stream, batch_of([LouderBeep(time=NOON, tone="b", loudness_db=3)]), PRODUCER)])
    log.append([encode(stream, batch_of([Beep(time=NOON, tone="c")]), PRODUCER)])
    project(log)
    assert sorted(query(log, "select tone, loudness_db from beep")) == [("a", None), ("b", 3), ("c", None)]


@on_both
def test_names_that_are_words_of_sql_and_lists_of_structures_have_rows(make_log: Callable[..., Log]) -> None:
    log = make_log(Catalogue([*SHIPPED, Order]))
    echoes = (
        Echo(heard_at=NOON, strength=math.nan, sound=b"\xff\0"),
        Echo(heard_at=NOON, strength=1.5, sound=b""),
    )
    log.append([draft_of(Order(time=NOON, select="x", table=None, user=echoes))])
    log.append([draft_of(Order(time=NOON, select="y", table='{"a": [1, null]}', user=()))])
    assert project(log).segments_skipped == 0
    (first, second) = query(log, 'select "select", "table", "user" from "order" order by position')
    assert second == ("y", {"a": [1, None]}, [])
    assert first[:2] == ("x", None)
    assert [echo["strength"] for echo in first[2]] == ["NaN", 1.5]
    assert [datetime.fromisoformat(echo["heard_at"]) for echo in first[2]] == [NOON, NOON]
    assert query(log, "select id, subject from events order by position")[0] == ("brno/gate/order/1", None)


@on_both
def test_text_with_a_nul_has_rows_with_the_replacement_character(log: Log) -> None:
    log.append([draft_of(ProcessFailed(time=NOON, process="p\0", frames=1, events=1, error="a\0b"))])
    configuration = r'{"nul": "\u0000", "backslash": "\\u0000", "both": "\\\u0000"}'
    started = ProcessStarted(
        time=NOON, process="p", extractor="e", extractor_version="1", configuration=configuration, video="v"
    )
    log.append([draft_of(started)])
    assert project(log).segments_skipped == 0
    assert query(log, "select subject, process, error from process_failed") == [("p�", "p�", "a�b")]
    assert query(log, "select configuration from process_started") == [
        ({"nul": "�", "backslash": r"\u0000", "both": "\\�"},)
    ]


@on_both
def test_a_value_beyond_what_postgresql_holds_costs_only_its_own_segment_its_rows(
    log: Log, caplog: pytest.LogCaptureFixture
) -> None:
    plans = ["[1]", "[1e1000000]", "[2]"]
    for plan in plans:
        log.append([draft_of(SyncPlanned(time=NOON, central="c", plan=plan, plan_hash="h"))])
    append(log, GATE, 2)
    with caplog.at_level(logging.WARNING, "store.projector"):
        assert project(log).segments_skipped == 1
    assert "no rows for the segment at position 2" in caplog.text
    assert query(log, "select plan from sync_planned order by position") == [([1],), ([2],)]
    assert query(log, "select count(*) from track_point") == [(2,)]


def test_a_segment_that_does_not_decode_stops_the_projector_and_is_named(log: Log) -> None:
    append(log, GATE, 1, 1)
    with owner(log) as connection:
        connection.execute("alter table segments disable trigger user")
        connection.execute("update segments set payload = 'x' where position = 2")
    made = Projector(log)
    with pytest.raises(CorruptSegment, match=r"position 2: .* Next: vian verify"):
        made.catch_up()
    assert made.position == 0
    made.close()


def test_a_projector_waits_for_segments(log: Log) -> None:
    made = Projector(log)
    appending = threading.Thread(target=append, args=(log, GATE, 3))
    appending.start()
    delivery = made.step(30.0)
    appending.join()
    made.close()
    assert [segment.position for segment in delivery.segments] == [1]
    assert_rows_equal_events(log)


@on_both
def test_only_row_tables_get_partitions(log: Log) -> None:
    import psycopg

    for table in ("segments", "nowhere", "track_point; drop table streams"):
        with pytest.raises(psycopg.Error, match="no row table"), log.connection() as connection:
            connection.execute("select ensure_partition(%s, '2026-01-01')", (table,))


@on_both
def test_partitions_carry_the_indexes_and_comments_of_their_table(log: Log) -> None:
    append(log, GATE, 1)
    project(log)
    indexes = query(log, "select indexdef from pg_indexes where tablename = 'track_point_20260101' order by 1")
    assert [definition.split(" USING ")[1] for (definition,) in indexes] == [
        "brin (\"position\") WITH (pages_per_range='16')",
        "brin (\"time\") WITH (pages_per_range='16')",
    ]
    assert query(
        log,
        "select col_description('track_point_20260101'::regclass, attnum) from pg_attribute "
        "where attrelid = 'track_point_20260101'::regclass and attname = 'vx'",
    ) == [("filtered velocity of the ground contact point, px/s",)]


def test_a_batch_from_columns_needs_no_event_objects(log: Log) -> None:
    schema = schema_of(TrackPoint)
    columns = {field.name: pa.array([1] * 3).cast(field.type, safe=False) for field in schema if field.name != "time"}
    times = pa.array([NOON] * 3, schema.field("time").type)
    data = pa.RecordBatch.from_arrays([times, *columns.values()], schema=schema)
    log.append([encode(GATE, EventBatch(TrackPoint, data), PRODUCER)])
    project(log)
    assert query(log, "select count(*), min(x), max(frame) from track_point") == [(3, 1.0, 1)]
