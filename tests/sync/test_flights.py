"""Requests under way: slots, the one for what is live, and the distance between two on a slow link."""

import threading
from collections.abc import Iterator
from typing import Any, cast

import pytest

from sync.protocol.wire import SegmentsAnswer
from sync.runs import Point, StreamKey
from sync.station.client import Link
from sync.station.flights import Flights, Landed
from sync.station.outbox import Filled, Parcel
from tests.sync.conftest import NOON, stream_of

NOTHING = Parcel((), ())
ALERTS, POINTS = 0, 30


class Hanging:
    """A central that answers when it is told to."""

    def __init__(self) -> None:
        self.may_answer = threading.Event()
        self.followed: dict[str, str] = {}

    def send(self, _: Any, order: str, follows: str) -> SegmentsAnswer:
        self.followed[order] = follows
        assert self.may_answer.wait(60.0)
        return SegmentsAnswer(cursors=(), stored=0, duplicates=0)


@pytest.fixture
def central() -> Iterator[Hanging]:
    hanging = Hanging()
    yield hanging
    hanging.may_answer.set()


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def flights_to(central: Hanging, slots: int, clock: Clock) -> Flights:
    return Flights(cast(Link, central), slots, "test", clock)


def test_what_is_live_overtakes_a_backlog_that_is_under_way(central: Hanging) -> None:
    flights = flights_to(central, 2, Clock())
    flights.launch(NOTHING)
    flights.launch(NOTHING)
    assert not flights.has_slot
    assert flights.overtakes(POINTS)
    flights.launch(NOTHING, POINTS)
    assert not flights.overtakes(ALERTS), "there is one slot beside the others"


def test_what_is_live_overtakes_lanes_behind_its_own(central: Hanging) -> None:
    flights = flights_to(central, 2, Clock())
    flights.launch(NOTHING, POINTS)
    flights.launch(NOTHING, POINTS)
    assert flights.overtakes(ALERTS)
    assert not flights.overtakes(POINTS)


def test_one_slot_is_one_slot(central: Hanging) -> None:
    central.may_answer.set()
    flights = flights_to(central, 1, Clock())
    flights.launch(NOTHING)
    assert not flights.overtakes(ALERTS)


def test_two_requests_on_a_slow_link_begin_apart(central: Hanging) -> None:
    clock = Clock()
    flights = flights_to(central, 2, clock)
    assert flights.is_apart(took_s=0.6), "nothing is under way"
    flights.launch(NOTHING)
    assert not flights.is_apart(took_s=0.6)
    assert flights.is_apart(took_s=0.01), "a fast link needs no distance"
    clock.now += 0.31
    assert flights.is_apart(took_s=0.6)


def test_a_request_follows_the_one_that_ends_where_it_begins(central: Hanging) -> None:
    flights = flights_to(central, 2, Clock())
    flights.launch(parcel(0, 10))
    flights.launch(parcel(10, 20))
    flights.launch(parcel(30, 40), ALERTS)  # what is live goes on from nothing that is under way
    central.may_answer.set()
    while len(flights):
        flights.wait()
        flights.landed()
    assert central.followed == {"test-1": "", "test-2": "test-1", "test-3": ""}


def parcel(after: int, end: int) -> Parcel:
    """Events of one stream behind a sequence, up to another; the records themselves do not matter here."""
    ends = (Point(sequence, bytes([sequence]) * 32) for sequence in (after, end))
    return Parcel((), (Filled(StreamKey(stream_of(), 1), *ends, 1000, NOON),))


def test_what_central_took_itself_is_not_the_way() -> None:
    answer = SegmentsAnswer(cursors=(), stored=0, duplicates=0, took_s=2.0)
    assert Landed(NOTHING, 2.5, answer).way_s == 0.5
    assert Landed(NOTHING, 1.0, answer).way_s == 0.0, "clocks may differ a little"
    assert Landed(NOTHING, 2.5, TimeoutError()).way_s == 2.5
