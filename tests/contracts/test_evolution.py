"""Types change, what was stored does not: old versions are read as the newest, newer ones are kept and told."""

import logging
from collections.abc import Callable
from dataclasses import replace
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


def ended(track_id: int, x_exit: float, **more: Any) -> Any:
    kind = TrackEnded if more else TrackEndedV1
    frames = {"first_frame": 1, "last_frame": 9, "points": 9}
    places = {"path_px": 20, "x_entry": 10, "y_entry": 20, "x_exit": x_exit, "y_exit": 24}
    return kind(time=NOON, began_at=NOON, track_id=track_id, reason="lost", **frames, **places, **more)


@pytest.fixture
def both_versions(log: Log) -> Log:
    """A stream that an old program began and this one goes on with: 5 and 7 px."""
    said = [ended(1, 13), ended(3, 10, displacement_px=7)]
    log.append([encode(ENDS, batch_of([event]), PRODUCER) for event in said])
    return log


def test_an_old_version_is_decoded_as_the_newest_and_as_it_was_stored(both_versions: Log) -> None:
    old, new = both_versions.read(ENDS)
    assert (old.header.schema_version, new.header.schema_version) == (1, 2)
    assert events_of(decode(old, both_versions.catalogue)) == [ended(1, 13, displacement_px=5)]
    assert events_of(decode(old, both_versions.catalogue, as_stored=True)) == [ended(1, 13)]
    assert events_of(decode(new, both_versions.catalogue)) == [ended(3, 10, displacement_px=7)]
    assert verify(both_versions).is_sound


def test_rows_and_queries_see_the_newest_version_of_all(both_versions: Log) -> None:
    projector = Projector(both_versions)
    projector.catch_up()
    projector.close()
    sql = "select track_id, displacement_px from track_ended order by track_id"
    assert query(both_versions, sql) == [(1, 5.0), (3, 7.0)]
    assert [tuple(row.values()) for row in answer(both_versions, sql).to_pylist()] == [(1, 5.0), (3, 7.0)]


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


def test_rules_see_the_newest_version_of_all(both_versions: Log) -> None:
    finished = ProcessFinished(time=NOON, process="p", frames=1, events=1, gaps=0)
    both_versions.append([encode(StreamName.of("brno", "gate", "process_finished"), batch_of([finished]), PRODUCER)])
    assert Processor(both_versions, "brno", [_far_rule()]).catch_up() == 2
    found = [
        e
        for s in both_versions.read_all(types=["situation_detected"])
        for e in events_of(decode(s, both_versions.catalogue))
    ]
    assert [event.title for event in found] == ["track 1 came far", "track 3 came far"]  # type: ignore[attr-defined]


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
        wanted = TrackEnded.upcast(old.data).column("displacement_px").to_numpy()
        np.testing.assert_array_equal(np.array(got, np.float32).ravel(), wanted)
        test_schema.run(dsn, command.downgrade, "0002")
        with psycopg.connect(dsn) as connection:
            assert connection.execute("select count(*) from track_ended").fetchone() == (len(PLACES),)
    finally:
        server.drop_database(name)
