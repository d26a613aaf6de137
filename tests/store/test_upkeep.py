"""Retention, partitions ahead, closed days, and how the row tables stand."""

from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import psycopg
import pytest

from events import ProcessFinished, batch_of, encode
from store import Log, Projector, RowPolicy, RowTable, Upkeep, maintain, row_tables
from tests.store.samples import GATE, NOON, PRODUCER, append, draft_of, on_both, owner, point, query
from tests.store.test_projector import assert_rows_equal_events, project
from tests.store.tiered import seal_all

DAY = timedelta(days=1)
LATER = datetime(2100, 1, 1, tzinfo=UTC)
"""Long after anything that a test's log holds was recorded."""


def points_of_days(log: Log, *days: int) -> None:
    """One track point on each of these days from 2026-01-01 on, in one segment; the day is its frame."""
    log.append([encode(GATE, batch_of([point(day, time=NOON + day * DAY) for day in days]), PRODUCER)])


def partitions(log: Log, table: str = "track_point") -> list[str]:
    found = query(
        log, "select inhrelid::regclass::text from pg_inherits where inhparent = %s::regclass order by 1", table
    )
    return [name.removeprefix(f"{table}_") for (name,) in found]


def frames(log: Log) -> list[int]:
    return [frame for (frame,) in query(log, "select frame from track_point order by frame")]


def closed(log: Log) -> list[str]:
    """The days that have an index for tracks and cameras."""
    found = query(
        log,
        "select tablename from pg_indexes where indexdef like '%%(source, subject, \"time\")' "
        "and schemaname = 'public' order by 1",
    )
    return [name.removeprefix("track_point_") for (name,) in found]


def kept(**by_type: int) -> RowPolicy:
    return RowPolicy(keep_days_by_type=by_type, ahead_days=0, close_after_h=1e6)


@on_both
def test_days_beyond_a_types_retention_are_dropped_and_stay_away(log: Log) -> None:
    points_of_days(log, 0, 1, 2, 3)
    log.append([draft_of(ProcessFinished(time=NOON, process="p", frames=1, events=1, gaps=0))])
    project(log)
    now = NOON + 4 * DAY
    assert list(maintain(log, kept(track_point=2), now)) == [Upkeep("dropped", "track_point", date(2026, 1, 3), 2)]
    assert (frames(log), partitions(log)) == ([2, 3], ["20260103", "20260104"])
    assert partitions(log, "process_finished") == ["20260101"], "another type keeps what it has"
    assert list(maintain(log, kept(track_point=2), now)) == []
    # What is older comes no more: neither late, nor by a projector that begins anew.
    points_of_days(log, 1, 2)
    project(log)
    assert frames(log) == [2, 2, 3]
    with log.connection() as connection:
        connection.execute("update checkpoints set position = 0")
    with owner(log) as connection:
        connection.execute("delete from track_point")
    project(log)
    assert (frames(log), partitions(log)) == ([2, 2, 3], ["20260103", "20260104"])


def test_a_retention_that_is_for_all_types_is_overruled_for_single_ones() -> None:
    policy = RowPolicy(keep_days=10, keep_days_by_type={"track_point": 1, "plate_read": 10_000_000})
    assert policy.retained_from("track_ended", NOON) == date(2025, 12, 22)
    assert policy.retained_from("track_point", NOON) == date(2025, 12, 31)
    assert policy.retained_from("plate_read", NOON) == date.min
    assert RowPolicy().retained_from("track_point", NOON) is None


def test_without_a_retention_nothing_is_dropped(log: Log) -> None:
    points_of_days(log, 0, 400)
    project(log)
    assert [done.action for done in maintain(log, RowPolicy(ahead_days=0), LATER)] == ["closed", "closed"]
    assert frames(log) == [0, 400]


def test_retention_that_queries_are_in_the_way_of_is_postponed(log: Log) -> None:
    points_of_days(log, 0, 1)
    project(log)
    with owner(log) as connection:
        connection.execute("alter function drop_days_before set lock_timeout = '50ms'")
        with connection.transaction():
            connection.execute("select * from track_point")
            done = list(maintain(log, kept(track_point=1), NOON + 2 * DAY))
    assert done == [Upkeep("postponed", "track_point", date(2026, 1, 2))]
    assert frames(log) == [0, 1]
    points_of_days(log, 0)
    project(log)
    assert frames(log) == [0, 0, 1], "what was not dropped is not refused either"
    assert [step.action for step in maintain(log, kept(track_point=1), NOON + 2 * DAY)] == ["dropped"]
    assert frames(log) == [1]


def test_partitions_are_made_ahead_for_types_in_use(log: Log) -> None:
    points_of_days(log, 0)
    log.append([draft_of(ProcessFinished(time=NOON - 5 * DAY, process="p", frames=1, events=1, gaps=0))])
    project(log)
    policy = RowPolicy(ahead_days=2)
    made = [Upkeep("made", "track_point", date(2026, 1, day)) for day in (2, 3)]
    assert list(maintain(log, policy, NOON)) == made
    assert list(maintain(log, policy, NOON)) == []
    assert partitions(log) == ["20260101", "20260102", "20260103"]
    assert partitions(log, "process_finished") == ["20251227"]
    assert list(maintain(log, policy, NOON + DAY)) == [Upkeep("made", "track_point", date(2026, 1, 4))]
    # A day that no event came to for a while is not in use.
    assert list(maintain(log, policy, NOON + 30 * DAY)) == []


@on_both
def test_a_day_is_closed_some_time_after_its_end_and_its_newest_row(log: Log) -> None:
    points_of_days(log, 0)
    project(log)
    ((recorded_at,),) = query(log, "select recorded_at from track_point")
    policy = RowPolicy(ahead_days=0, close_after_h=2)
    hours = timedelta(hours=2)
    assert list(maintain(log, policy, recorded_at + hours - timedelta(microseconds=1))) == []
    assert closed(log) == []
    assert list(maintain(log, policy, recorded_at + hours)) == [Upkeep("closed", "track_point", date(2026, 1, 1))]
    assert closed(log) == ["20260101"]
    assert list(maintain(log, policy, recorded_at + hours)) == []
    # The day itself has to be over too, however long ago its rows came.
    future = recorded_at.replace(hour=12, minute=0) + 3 * DAY
    log.append([encode(GATE, batch_of([point(9, time=future)]), PRODUCER)])
    project(log)
    end = future.replace(hour=0, minute=0, second=0, microsecond=0) + DAY
    assert list(maintain(log, policy, end + hours - timedelta(microseconds=1))) == []
    assert [done.action for done in maintain(log, policy, end + hours)] == ["closed"]


@on_both
def test_an_event_that_comes_late_to_a_closed_day_is_found_there(log: Log) -> None:
    points_of_days(log, 0)
    project(log)
    assert [done.action for done in maintain(log, RowPolicy(ahead_days=0), LATER)] == ["closed"]
    points_of_days(log, 0)
    project(log)
    with owner(log) as connection:
        connection.execute("set enable_seqscan = off")
        connection.execute("set enable_bitmapscan = off")
        statement = (
            "select frame from track_point where source = 'gate' and subject = '1' and time = '2026-01-01 12:00Z'"
        )
        plan = str(connection.execute(f"explain {statement}").fetchall())
        assert "track_point_20260101_track" in plan
        assert connection.execute(statement).fetchall() == [(0,), (0,)]
    assert_rows_equal_events(log)


def test_days_made_ahead_are_not_closed_while_nothing_came_to_them(log: Log) -> None:
    points_of_days(log, 0)
    project(log)
    assert [done.action for done in maintain(log, RowPolicy(ahead_days=1), NOON)] == ["made"]
    assert [done.day for done in maintain(log, RowPolicy(ahead_days=0), LATER)] == [date(2026, 1, 1)]
    points_of_days(log, 1)
    project(log)
    assert [done.day for done in maintain(log, RowPolicy(ahead_days=0), LATER)] == [date(2026, 1, 2)]


@pytest.mark.parametrize("empty_pages", [0, 300])
def test_the_newest_row_is_found_before_pages_that_hold_none(
    log: Log, monkeypatch: pytest.MonkeyPatch, empty_pages: int
) -> None:
    monkeypatch.setattr("store.upkeep._TAIL_PAGES", 1 if empty_pages else 256)
    points_of_days(log, *[0] * 500)
    project(log)
    if empty_pages:
        with owner(log) as connection:  # a copy that was cut short leaves its pages behind
            connection.execute("insert into track_point select t.* from track_point t, generate_series(1, 9)")
            connection.execute("delete from track_point where ctid >= '(10,0)'")
    assert list(maintain(log, RowPolicy(ahead_days=0, close_after_h=1), datetime.now(UTC))) == []


def test_upkeep_that_is_cut_short_is_finished_by_the_next(log: Log) -> None:
    points_of_days(log, 0, 1, 2)
    project(log)
    policy = RowPolicy(keep_days=2, ahead_days=1)
    now = LATER.replace(year=2026, month=1, day=4, hour=1)
    started = maintain(log, policy, now)
    assert next(started) == Upkeep("dropped", "track_point", date(2026, 1, 2))
    del started
    assert [done.action for done in maintain(log, policy, now)] == ["made"]
    assert (frames(log), partitions(log)) == ([1, 2], ["20260102", "20260103", "20260105"])


def test_rows_that_came_are_known_to_the_index_on_time_after_upkeep(log: Log) -> None:
    points_of_days(log, *[0] * 2000)
    project(log)

    def ranges() -> int:
        ((count,),) = query(log, "select brin_summarize_new_values('track_point_20260101_time')")
        return int(count)

    list(maintain(log, RowPolicy(ahead_days=0), NOON))
    assert ranges() == 0
    points_of_days(log, *[0] * 2000)
    project(log)
    assert ranges() > 0


@on_both
def test_the_status_says_how_each_table_stands(log: Log) -> None:
    points_of_days(log, 0, 1, 2)
    log.append([draft_of(ProcessFinished(time=NOON, process="p", frames=1, events=1, gaps=0))])
    project(log)
    list(maintain(log, kept(track_point=3), NOON + 4 * DAY))
    list(maintain(log, RowPolicy(ahead_days=0), LATER))
    points_of_days(log, 2)
    points_of_days(log, 2, 3)
    tables = {table.type: table for table in row_tables(log)}
    size = tables["track_point"].bytes
    lag = tables["track_point"].lag_s
    assert tables["track_point"] == RowTable(
        "track_point", 1, 2, False, 2, 2, date(2026, 1, 2), date(2026, 1, 3), date(2026, 1, 2), size, 2, lag, 2
    )
    assert size > 8192
    assert 0 < lag < 600
    assert (tables["process_finished"].lag_segments, tables["process_finished"].lag_s) == (0, 0.0)
    assert (tables["rule_deployed"].partitions, tables["rule_deployed"].bytes) == (0, 0)
    made = Projector(log)
    made.rebuild("track_point")
    (table,) = [each for each in row_tables(log) if each.type == "track_point"]
    assert (table.is_behind, table.position, table.lag_segments, table.rows_estimate) == (True, 0, 3, 0)
    made.catch_up()
    (table,) = [each for each in row_tables(log) if each.type == "track_point"]
    assert (table.is_behind, table.position, table.lag_segments, table.rows_estimate) == (False, 4, 0, 6)


@on_both
def test_the_status_counts_what_is_sealed_too(log: Log, tmp_path: Path) -> None:
    points_of_days(log, 0, 1)
    points_of_days(log, 2)
    log.append([draft_of(ProcessFinished(time=NOON, process="p", frames=1, events=1, gaps=0))])
    project(log)
    seal_all(log, tmp_path, file_bytes=1)
    tables = {table.type: table for table in row_tables(log)}
    assert {table.lag_segments for table in tables.values()} == {0}
    Projector(log).rebuild("track_point")
    points_of_days(log, 3)
    tables = {table.type: table for table in row_tables(log)}
    assert (tables["track_point"].is_behind, tables["track_point"].lag_segments) == (True, 3)
    assert tables["track_point"].lag_s > 0
    project(log)
    seal_all(log, tmp_path)
    assert {table.lag_segments for table in row_tables(log)} == {0}
    # A projector that begins anew has all before it, and nothing of it is in PostgreSQL.
    with log.connection() as connection:
        connection.execute("update checkpoints set position = 0")
    tables = {table.type: table for table in row_tables(log)}
    assert [tables[name].lag_segments for name in ("track_point", "process_finished", "rule_deployed")] == [3, 1, 0]
    assert tables["process_finished"].lag_s > 0


def test_rows_of_a_large_table_are_estimated(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    points_of_days(log, *[0] * 3000)
    project(log)
    list(maintain(log, RowPolicy(ahead_days=0), LATER))
    monkeypatch.setattr("store.upkeep._COUNTED_BYTES", 0)
    (table,) = [each for each in row_tables(log) if each.type == "track_point"]
    assert table.rows_estimate == 3000


@on_both
def test_the_writer_sees_to_row_tables_and_to_nothing_else(log: Log) -> None:
    append(log, GATE, 1)
    day = "'2026-01-01'"
    for function, rest in (
        ("close_partition", f", {day}"),
        ("drop_days_before", f", {day}"),
        ("reset_projection", ", null"),
        ("summarize_days", ""),
    ):
        with pytest.raises(psycopg.Error, match="no row table segments"), log.connection() as connection:
            connection.execute(f"select {function}('segments'{rest})")
        with owner(log) as connection:
            connection.execute("set role vian_reader")
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                connection.execute(f"select {function}('track_point'{rest})")


def test_upkeep_of_a_type_that_is_not_installed_goes_on(log: Log) -> None:
    with owner(log) as connection:
        connection.execute("create table beep (like track_point including all) partition by range (time)")
        connection.execute("select adopt_projection('beep')")
        connection.execute("select ensure_partition('beep', '2026-01-01')")
    assert list(maintain(log, RowPolicy(keep_days=1), LATER)) == [Upkeep("dropped", "beep", date(2099, 12, 31))]


def test_a_name_like_a_partitions_is_left_alone(log: Log) -> None:
    """Only partitions that upkeep made have a day for a name; one attached by hand is its owner's."""
    with owner(log) as connection:
        connection.execute(
            "create table track_point_lastyear partition of track_point "
            "for values from ('2020-01-01') to ('2020-01-02')"
        )
    points_of_days(log, 0)
    project(log)
    assert [done.partitions for done in maintain(log, kept(track_point=1), LATER)] == [1]
    assert partitions(log) == ["lastyear"]
