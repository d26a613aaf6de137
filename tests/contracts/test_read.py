"""Reads: in order, filtered, limited, and taken up again at any place."""

from datetime import datetime, timedelta
from typing import Any

import pytest

from events import Segment
from store import BadRequest, Log
from store import log as log_module
from store.reading import Filter
from tests.store.samples import GATE, NOON, ONE_OF_EACH, YARD, append, draft, draft_of, point


@pytest.fixture(autouse=True)
def _small_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_module, "READ_SEGMENTS", 2)


def ranges(segments: list[Segment]) -> list[tuple[int, int]]:
    return [(segment.header.first_sequence, segment.header.last_sequence) for segment in segments]


def test_a_stream_is_read_in_order_over_many_pages(log: Log) -> None:
    append(log, GATE, 1, 2, 3)
    append(log, YARD, 9)
    append(log, GATE, 1, 1)
    assert ranges(list(log.read(GATE))) == [(1, 1), (2, 3), (4, 6), (7, 7), (8, 8)]


def test_a_stream_is_read_from_the_segment_that_holds_the_sequence(log: Log) -> None:
    append(log, GATE, 3, 3)
    both, second = [(1, 3), (4, 6)], [(4, 6)]
    for from_sequence, wanted in ((0, both), (1, both), (3, both), (4, second), (6, second), (7, [])):
        assert ranges(list(log.read(GATE, from_sequence))) == wanted


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


def test_every_life_of_a_stream_is_read_oldest_first(log: Log) -> None:
    log.append([draft(GATE, first, first) for first in range(1, 6)], epochs=[2] * 5)
    log.append([draft(GATE, 1, 1), draft(YARD, 1, 1)], epochs=[1, 3])
    assert [segment.header.epoch for segment in log.read_lives(GATE)] == [1, 2, 2, 2, 2, 2]
    assert [(life.epoch, life.sequence) for life in log.lives(GATE)] == [(1, 1), (2, 5)]


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
    ({"stations": ["brno", "plzen"], "sources": ["roof"], "from_position": 5}, [5]),
    ({"sources": ["nowhere"]}, []),
]


def test_a_read_lets_through_what_every_filter_lets_through(mixed: Log) -> None:
    for chosen, wanted in CHOICES:
        assert [segment.position for segment in mixed.read_all(**chosen)] == wanted, chosen


def test_a_read_that_is_taken_up_again_at_any_position_misses_and_doubles_nothing(mixed: Log) -> None:
    for chosen, wanted in CHOICES:
        if "to_position" in chosen:
            continue
        for stop in range(chosen.get("from_position", 1), 7):
            begun = [segment.position for segment in mixed.read_all(**chosen, to_position=stop)]
            resumed = [segment.position for segment in mixed.read_all(**{**chosen, "from_position": stop + 1})]
            assert begun + resumed == wanted, (chosen, stop)


def test_a_read_by_type_finds_each_type_alone_and_several_together(log: Log) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    names = [type(event).type_name for event in ONE_OF_EACH]
    for position, name in enumerate(names, 1):
        (segment,) = log.read_all(types=[name])
        assert (segment.position, segment.stream.type) == (position, name)
    assert [s.stream.type for s in log.read_all(types=[names[3], names[0]])] == [names[0], names[3]]


def test_a_page_of_any_limit_is_followed_by_the_rest(mixed: Log) -> None:
    chosen = Filter(stations=["brno"])
    for limit in range(1, 6):
        positions: list[int] = []
        while page := mixed.page(positions[-1] + 1 if positions else 1, 6, chosen, limit):
            assert len(page) <= limit
            positions += [segment.position for segment in page]
        assert positions == [1, 2, 4, 6]


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
