from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from events import Segment, StreamName
from store import BadRequest, Log, LogUnavailable, open_log
from store import log as log_module
from store.reading import Filter
from tests.store.samples import GATE, NOON, YARD, append, draft, draft_of, on_both, point, query


@pytest.fixture(autouse=True)
def _small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_module, "READ_SEGMENTS", 2)


def ranges(segments: list[Segment]) -> list[tuple[int, int]]:
    return [(segment.header.first_sequence, segment.header.last_sequence) for segment in segments]


@on_both
def test_a_stream_is_read_in_order_over_many_pages(log: Log) -> None:
    append(log, GATE, 1, 2, 3)
    append(log, YARD, 9)
    append(log, GATE, 1, 1)
    assert ranges(list(log.read(GATE))) == [(1, 1), (2, 3), (4, 6), (7, 7), (8, 8)]


@on_both
def test_a_stream_is_read_from_the_segment_that_holds_the_sequence(log: Log) -> None:
    append(log, GATE, 3, 3)
    both, second = [(1, 3), (4, 6)], [(4, 6)]
    for from_sequence, wanted in ((0, both), (1, both), (3, both), (4, second), (6, second), (7, [])):
        assert ranges(list(log.read(GATE, from_sequence))) == wanted


@on_both
def test_a_page_that_is_just_full_is_followed_by_the_end(log: Log) -> None:
    append(log, GATE, 1, 1)
    assert len(list(log.read(GATE))) == 2
    assert len(list(log.read_all())) == 2


def test_a_stream_that_is_not_there_has_no_segments(log: Log) -> None:
    append(log, YARD, 1)
    assert list(log.read(GATE)) == []
    assert log.stream_head(GATE).sequence == 0


def test_a_streams_newest_life_is_read_unless_another_is_asked_for(log: Log) -> None:
    log.append([draft(GATE, 1, 1)], epochs=[1])
    log.append([draft(GATE, first, first) for first in range(1, 6)], epochs=[2] * 5)
    assert [segment.header.epoch for segment in log.read(GATE)] == [2] * 5
    assert [segment.header.epoch for segment in log.read(GATE, epoch=1)] == [1]


def test_a_new_life_that_begins_during_a_read_does_not_break_into_it(log: Log) -> None:
    log.append([draft(GATE, first, first) for first in range(1, 6)], epochs=[1] * 5)
    reading = log.read(GATE)
    first = next(reading)
    log.append([draft(GATE, first, first) for first in range(1, 9)], epochs=[2] * 8)
    assert [segment.header.epoch for segment in (first, *reading)] == [1] * 5


@pytest.fixture
def mixed(log: Log) -> Log:
    """Positions 1 to 6, over two stations, three sources, two types, an hour each."""
    stations = ("brno", "brno", "plzen", "brno", "plzen", "brno")
    sources = ("gate", "yard", "gate", "roof", "roof", "gate")
    for hour, (station, source) in enumerate(zip(stations, sources, strict=True)):
        log.append([draft_of(point(hour, time=NOON + timedelta(hours=hour)), source, station)])
    return log


CHOICES: list[tuple[dict[str, Any], list[int]]] = [
    ({}, [1, 2, 3, 4, 5, 6]),
    ({"from_position": 3}, [3, 4, 5, 6]),
    ({"from_position": 0, "to_position": 2}, [1, 2]),
    ({"from_position": 7}, []),
    ({"from_position": 4, "to_position": 3}, []),
    ({"to_position": 99}, [1, 2, 3, 4, 5, 6]),
    ({"sources": ["gate"]}, [1, 3, 6]),
    ({"sources": ["gate", "roof"]}, [1, 3, 4, 5, 6]),
    ({"stations": ["plzen"]}, [3, 5]),
    ({"types": ["track_point"]}, [1, 2, 3, 4, 5, 6]),
    ({"types": ["track_ended"]}, []),
    ({"types": []}, []),
    ({"since": NOON + timedelta(hours=2)}, [3, 4, 5, 6]),
    ({"until": NOON + timedelta(hours=2)}, [1, 2]),
    ({"since": NOON + timedelta(hours=1), "until": NOON + timedelta(hours=4)}, [2, 3, 4]),
    ({"stations": ["brno"], "sources": ["gate"], "since": NOON + timedelta(hours=1)}, [6]),
]


@on_both
def test_a_read_lets_through_what_every_filter_lets_through(mixed: Log) -> None:
    for chosen, wanted in CHOICES:
        assert [segment.position for segment in mixed.read_all(**chosen)] == wanted, chosen


def test_a_segment_is_wanted_if_any_of_its_events_is_in_time(log: Log) -> None:
    log.append([draft(GATE, 0, 100)])  # 4 seconds
    assert list(log.read_all(since=NOON + timedelta(seconds=4)))
    assert not list(log.read_all(since=NOON + timedelta(seconds=4, microseconds=1)))
    assert list(log.read_all(until=NOON + timedelta(microseconds=1)))
    assert not list(log.read_all(until=NOON))


@pytest.mark.parametrize("name", ["since", "until"])
def test_a_naive_time_is_refused(log: Log, name: str) -> None:
    append(log, GATE, 1)
    with pytest.raises(BadRequest, match=f"{name} must be aware of its time zone"):
        list(log.read_all(**{name: datetime(2026, 1, 1)}))  # type: ignore[arg-type]  # noqa: DTZ001


def test_a_read_ends_where_the_log_stood_when_it_began(log: Log) -> None:
    append(log, GATE, 1, 1, 1)
    reading = log.read_all()
    first = next(reading)
    append(log, GATE, 1, 1, 1)
    assert [segment.position for segment in (first, *reading)] == [1, 2, 3]


def test_a_pages_limit_counts_only_what_is_wanted(mixed: Log) -> None:
    page = mixed.page(1, 6, Filter(sources=["gate"]), 2)
    assert [segment.position for segment in page] == [1, 3]


def test_the_heads_are_those_of_one_moment(log: Log) -> None:
    assert log.heads() == (0, [])
    append(log, GATE, 2, 2)
    position, heads = log.heads()
    assert (position, heads) == (2, log.streams())


def test_checkpoints_are_kept_by_name(log: Log) -> None:
    assert log.checkpoint("nobody").position == 0
    with log.transaction() as transaction:
        assert transaction.checkpoint("rules").position == 0
        transaction.save_checkpoint("rules", 4, b"\0open state")
        transaction.save_checkpoint("other", 2)
    with log.transaction() as transaction:
        assert transaction.checkpoint("rules").state == b"\0open state"
        transaction.save_checkpoint("rules", 5, b"later")
    assert {name: (c.position, c.state) for name, c in log.checkpoints().items()} == {
        "rules": (5, b"later"),
        "other": (2, b""),
    }
    assert log.checkpoint("rules").position == 5


@on_both
def test_connections_that_died_with_the_server_are_replaced_at_once(log: Log) -> None:
    with ExitStack() as held:
        for _ in range(log_module.CONNECTIONS_MAX):
            held.enter_context(log.connection())
    query(
        log,
        "select pg_terminate_backend(pid, 10000) from pg_stat_activity "
        "where datname = current_database() and pid <> pg_backend_pid()",
    )
    assert log.head() == 0


def test_a_query_whose_connection_dies_under_it_is_an_outage(log: Log) -> None:
    def lose_the_connection() -> None:
        with log.connection() as connection:
            query(log, "select pg_terminate_backend(%s, 10000)", connection.info.backend_pid)
            connection.execute("select 1")

    with pytest.raises(LogUnavailable, match="is away"):
        lose_the_connection()


def test_an_interrupt_in_the_middle_of_a_command_leaves_a_log_that_works(
    log: Log, caplog: pytest.LogCaptureFixture
) -> None:
    def be_interrupted() -> None:
        with log.connection() as connection:
            connection.pgconn.send_query(b"select pg_sleep(60)")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        be_interrupted()
    assert [record for record in caplog.records if record.name == "psycopg"] == []
    assert log.head() == 0


def test_more_users_than_connections_wait_for_their_turn(log: Log) -> None:
    append(log, GATE, 1)
    with ThreadPoolExecutor(3 * log_module.CONNECTIONS_MAX) as pool:
        heads = list(pool.map(lambda _: log.head(), range(200)))
    assert set(heads) == {1}


def test_a_log_whose_connections_are_all_held_says_so(
    make_log: Callable[[], Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_module, "_CONNECT_SECONDS", 2.0)
    monkeypatch.setattr(log_module, "_PATIENCE_SECONDS", 0.1)
    monkeypatch.setattr(log_module, "CONNECTIONS_MAX", 1)
    log = make_log()
    with log.connection(), pytest.raises(LogUnavailable, match=r"all 1 connections to .* were busy for 2 s"):
        log.head()
    assert log.head() == 0


def test_an_action_is_tried_again_once_after_an_outage(log: Log) -> None:
    outcomes = iter([LogUnavailable("away"), None])

    def action() -> str:
        if (outcome := next(outcomes)) is not None:
            raise outcome
        return "done"

    assert log.with_retry(action) == "done"


@pytest.mark.parametrize("given", [{}, {"data_dir": Path("x"), "dsn": "postgresql://h/d"}])
def test_a_log_is_opened_by_folder_or_by_address(given: dict[str, object]) -> None:
    with pytest.raises(BadRequest, match="takes either data_dir or dsn, got " + ("both" if given else "neither")):
        open_log(**given)  # type: ignore[arg-type]


def test_a_log_is_its_own_context(log: Log) -> None:
    with open_log(dsn=log.dsn) as second:
        append(second, StreamName.of("brno", "roof", "track_point"), 1)
    assert log.head() == 1
    with pytest.raises(LogUnavailable, match="closed"):
        second.head()
