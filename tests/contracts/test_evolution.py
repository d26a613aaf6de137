"""Types change, what was stored does not: old versions are read as the newest, newer ones are kept and told."""

import logging
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import psycopg
import pyarrow as pa
import pytest
from alembic import command

from events import (
    SHIPPED,
    Catalogue,
    Draft,
    EventType,
    ProcessFinished,
    StreamName,
    TrackEnded,
    TrackEndedV1,
    TrackEndedV2,
    UnknownType,
    batch_of,
    decode,
    encode,
    events_of,
    schema_of,
)
from patterns.files.loading import parse_rule
from patterns.processor import Processor
from store import Log, Projector, verify
from tests.conftest import Server
from tests.store import test_schema
from tests.store.samples import GATE, NOON, PRODUCER, draft, on_both, query
from tests.vian.conftest import Run, environment, run
from vian.querying import query as answer

__all__ = ["environment", "run"]

ENDS = StreamName.of("brno", "gate", "track_ended")
WEIGHED = StreamName.of("brno", "gate", "weighed")


SHAPE = {"duration_s": 0, "x1_mean": 8, "y1_mean": 12, "x2_mean": 12, "y2_mean": 20}


def ended(track_id: int, x_exit: float, kind: type[EventType] = TrackEndedV1, **more: Any) -> Any:
    frames = {"first_frame": 1, "last_frame": 9, "points": 9}
    places = {"path_px": 20, "x_entry": 10, "y_entry": 20, "x_exit": x_exit, "y_exit": 24}
    return kind(time=NOON, began_at=NOON, track_id=track_id, reason="lost", **frames, **places, **more)


@pytest.fixture
def all_versions(log: Log) -> Log:
    """A stream that two old programs began and this one goes on with: 5, 6 and 7 px."""
    said = [
        ended(1, 13),
        ended(2, 10, TrackEndedV2, displacement_px=6),
        ended(3, 10, TrackEnded, displacement_px=7, **SHAPE),
    ]
    log.append([encode(ENDS, batch_of([event]), PRODUCER) for event in said])
    return log


def test_an_old_version_is_decoded_as_the_newest_and_as_it_was_stored(all_versions: Log) -> None:
    stored = list(all_versions.read(ENDS))
    assert [segment.header.schema_version for segment in stored] == [1, 2, 3]
    old, middle, new = stored
    unknown = dict.fromkeys(SHAPE) | {"duration_s": 0.0}
    assert events_of(decode(old, all_versions.catalogue)) == [ended(1, 13, TrackEnded, displacement_px=5, **unknown)]
    assert events_of(decode(old, all_versions.catalogue, as_stored=True)) == [ended(1, 13)]
    assert events_of(decode(middle, all_versions.catalogue)) == [ended(2, 10, TrackEnded, displacement_px=6, **unknown)]
    assert events_of(decode(new, all_versions.catalogue)) == [ended(3, 10, TrackEnded, displacement_px=7, **SHAPE)]
    assert verify(all_versions).is_sound


def test_rows_and_queries_see_the_newest_version_of_all(all_versions: Log) -> None:
    projector = Projector(all_versions)
    projector.catch_up()
    projector.close()
    sql = "select track_id, displacement_px, x1_mean from track_ended order by track_id"
    rows = [(1, 5.0, None), (2, 6.0, None), (3, 7.0, 8.0)]
    assert query(all_versions, sql) == rows
    assert [tuple(row.values()) for row in answer(all_versions, sql).to_pylist()] == rows


def _far_rule(name: str = "far", type_name: str = "track_ended", condition: str = "far.displacement_px > 4") -> Any:
    return parse_rule(f"""
rule: {name}
version: 1
title: "track {{track_id}} came far"
severity: info
time: {{lateness: 0 s}}
match: |
  SELECT * FROM {type_name} MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES far.time AS at
    ONE ROW PER MATCH AFTER MATCH SKIP PAST LAST ROW
    PATTERN (far)
    DEFINE far AS {condition})
""")


def test_rules_see_the_newest_version_of_all(all_versions: Log) -> None:
    finished = ProcessFinished(time=NOON, process="p", frames=1, events=1, gaps=0)
    all_versions.append([encode(StreamName.of("brno", "gate", "process_finished"), batch_of([finished]), PRODUCER)])
    assert Processor(all_versions, "brno", [_far_rule()]).catch_up() == 3
    found = [
        e
        for s in all_versions.read_all(types=["situation_detected"])
        for e in events_of(decode(s, all_versions.catalogue))
    ]
    assert [event.title for event in found] == [f"track {number} came far" for number in (1, 2, 3)]  # type: ignore[attr-defined]


def from_the_future() -> Draft:
    """Two track points in a version that nobody here knows."""
    return replace(draft(GATE, 3, 4), schema_version=99)


@on_both
def test_a_newer_version_is_stored_and_verified_and_told_on_decoding(log: Log) -> None:
    log.append([draft(GATE, 1, 2), from_the_future(), draft(GATE, 5, 6)], [0, 2, 4])
    _, newer, _ = log.read(GATE)
    assert newer.header.schema_version == 99
    assert verify(log).is_sound
    for as_stored in (False, True):
        with pytest.raises(UnknownType, match=r"track_point version 99 is not known here, only 1\. Next: upgrade ViAn"):
            decode(newer, log.catalogue, as_stored=as_stored)


@on_both
def test_a_newer_version_is_left_out_of_rows_queries_and_rules_with_a_count_and_its_name(
    log: Log, caplog: pytest.LogCaptureFixture
) -> None:
    log.append([draft(GATE, 1, 2), from_the_future(), draft(GATE, 5, 6)], [0, 2, 4])
    named = "track_point version 99 is not known here"
    projector = Projector(log)
    with caplog.at_level(logging.WARNING):
        projector.catch_up()
    projector.close()
    assert projector.segments_skipped == 1
    assert f"position 2: {named}" in caplog.text
    assert query(log, "select sequence from track_point order by 1") == [(1,), (2,), (5,), (6,)]
    caplog.clear()

    with caplog.at_level(logging.WARNING):
        assert answer(log, "select count(*) from track_point").column(0).to_pylist() == [4]
        assert answer(log, "select count(*) from events").column(0).to_pylist() == [6]
    assert f"leaves out 2 events: {named}" in caplog.text
    caplog.clear()

    processor = Processor(log, "brno", [_far_rule(type_name="track_point", condition="far.x >= 0")])
    with caplog.at_level(logging.WARNING):
        assert processor.catch_up() > 0
    processor.close()
    assert processor.segments_skipped == 1
    assert f"position 2: {named}" in caplog.text
    assert not processor.failures


def test_tail_tells_a_newer_version_and_what_to_do(log: Log, run: Run) -> None:
    log.append([from_the_future()])
    ran = run("tail", "--dsn", log.dsn)
    assert (ran.code, ran.err) == (0, "")
    assert '"events": 2, "unknown": "track_point version 99 is not known here, only 1. Next: upgrade ViAn' in ran.out


class Weighed(EventType, type="weighed", version=1):
    """A plug-in's type of old."""

    pounds: float
    """mass, lb"""


class WeighedInKilos(EventType, type="weighed", version=2, older=Weighed):
    """Its second version, in another unit."""

    kilos: float
    """mass, kg"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        return pa.RecordBatch.from_arrays(
            [older.column("time"), pa.compute.multiply(older.column("pounds"), 0.5)], schema=schema_of(cls)
        )


class WeighedPrecisely(EventType, type="weighed", version=3, older=WeighedInKilos):
    """Its third, which knows of errors."""

    kilos: float
    """mass, kg"""
    error: float | None
    """half the width of its interval, kg; null where nobody knows"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        return older.append_column(pa.field("error", pa.float64()), pa.nulls(len(older), pa.float64()))


def test_versions_of_a_plug_in_come_step_by_step_to_the_newest(make_log: Callable[..., Log]) -> None:
    log = make_log(Catalogue([*SHIPPED, WeighedPrecisely]))
    said: list[EventType] = [Weighed(time=NOON, pounds=4), WeighedInKilos(time=NOON, kilos=3)]
    said.append(WeighedPrecisely(time=NOON, kilos=5, error=1))
    log.append([encode(WEIGHED, batch_of([event]), PRODUCER) for event in said])
    newest = [WeighedPrecisely(time=NOON, kilos=kilos, error=error) for kilos, error in ((2, None), (3, None), (5, 1))]
    assert [event for segment in log.read(WEIGHED) for event in events_of(decode(segment, log.catalogue))] == newest
    assert answer(log, "select kilos, error from weighed order by kilos").to_pylist() == [
        {"kilos": event.kilos, "error": event.error} for event in newest
    ]


# First and last ground contact point: plain, none, not numbers, beyond 32 bits, rounded, the least of all.
PLACES = [
    ("0", "0", "3", "4"),
    ("1", "1", "1", "1"),
    ("NaN", "0", "1", "0"),
    ("Infinity", "0", "1", "0"),
    ("Infinity", "0", "Infinity", "0"),
    ("3e38", "3e38", "-3e38", "-3e38"),
    ("0.1", "0.2", "767.7", "431.3"),
    ("1e-45", "0", "0", "0"),
]


def test_rows_of_before_get_the_new_column_with_what_the_upcaster_says(server: Server) -> None:
    name = server.create_database("template1")
    dsn = server.dsn(name)
    insert = (
        "insert into track_ended (station, source, time, sequence, position, recorded_at, track_id, began_at, "
        "first_frame, last_frame, points, path_px, reason, x_entry, y_entry, x_exit, y_exit) "
        "values ('s', 'c', %s, %s, 1, now(), 1, now(), 0, 0, 1, 0, 'lost', %s, %s, %s, %s)"
    )
    try:
        test_schema.run(dsn, command.upgrade, "0002")
        with psycopg.connect(dsn) as connection:
            connection.execute("select ensure_partition('track_ended', '2026-01-01')")
            for number, place in enumerate(PLACES):
                connection.execute(insert, (NOON, number, *place))
        test_schema.run(dsn, command.upgrade, "0005")
        with psycopg.connect(dsn) as connection:
            got = connection.execute("select displacement_px from track_ended order by sequence").fetchall()
        names = ("x_entry", "y_entry", "x_exit", "y_exit")
        places = [dict(zip(names, map(float, place), strict=True)) for place in PLACES]
        old = batch_of([ended(1, 0).model_copy(update=place) for place in places])
        wanted = TrackEndedV2.upcast(old.data).column("displacement_px").to_numpy()
        np.testing.assert_array_equal(np.array(got, np.float32).ravel(), wanted)
        test_schema.run(dsn, command.downgrade, "0002")
        with psycopg.connect(dsn) as connection:
            assert connection.execute("select count(*) from track_ended").fetchone() == (len(PLACES),)
    finally:
        server.drop_database(name)


# How long a track took, in microseconds: none, a part of a second, a day, and one that ended before it began.
SPANS_US = [0, 1, 333_333, 86_400_000_001, -5]


def test_rows_of_before_get_the_duration_that_the_upcaster_says(server: Server) -> None:
    name = server.create_database("template1")
    dsn = server.dsn(name)
    insert = (
        "insert into track_ended (station, source, time, sequence, position, recorded_at, track_id, began_at, "
        "first_frame, last_frame, points, path_px, reason, x_entry, y_entry, x_exit, y_exit, displacement_px) "
        "values ('s', 'c', %s, %s, 1, now(), 1, %s, 0, 0, 1, 0, 'lost', 0, 0, 3, 4, 5)"
    )
    tracks = [
        ended(1, 3, TrackEndedV2, displacement_px=5).model_copy(
            update={"began_at": NOON - timedelta(microseconds=span)}
        )
        for span in SPANS_US
    ]
    try:
        test_schema.run(dsn, command.upgrade, "0018")
        with psycopg.connect(dsn) as connection:
            connection.execute("select ensure_partition('track_ended', '2026-01-01')")
            for number, track in enumerate(tracks):
                connection.execute(insert, (track.time, number, track.began_at))
        test_schema.run(dsn, command.upgrade, "0019")
        with psycopg.connect(dsn) as connection:
            got = connection.execute("select duration_s, x1_mean from track_ended order by sequence").fetchall()
        wanted = TrackEnded.upcast(batch_of(tracks).data).column("duration_s").to_pylist()
        assert got == [(duration_s, None) for duration_s in wanted]
        test_schema.run(dsn, command.downgrade, "0018")
        with psycopg.connect(dsn) as connection:
            assert connection.execute("select count(*) from track_ended").fetchone() == (len(SPANS_US),)
    finally:
        server.drop_database(name)
