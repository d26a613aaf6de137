import threading
from collections.abc import Callable

import pytest

from events import Segment
from store import Log, LogUnavailable, Subscription
from store import subscription as subscription_module
from tests.store.samples import GATE, ONE_OF_EACH, YARD, append, draft, draft_of, on_both, query

WAIT_S = 30.0
"""Longest wait for something that a correct log does at once."""


class Watched(Subscription):
    """A subscription that tells when it listens and waits."""

    def __init__(self, log: Log, name: str) -> None:
        super().__init__(log, name)
        self.waiting = threading.Event()

    def _wait(self, seconds: float) -> None:
        if self._listening is not None:
            self.waiting.set()
        super()._wait(seconds)


def drained(subscription: Subscription) -> list[Segment]:
    """All that is there now."""
    segments: list[Segment] = []
    while True:
        delivery = subscription.poll()
        segments += delivery.segments
        assert subscription.position == delivery.position
        if delivery.is_caught_up:
            return segments


@on_both
def test_it_catches_up_in_deliveries_of_limited_size(log: Log) -> None:
    append(log, GATE, *[1] * 7)
    with Subscription(log, "reader", limit=3) as subscription:
        deliveries = [subscription.poll() for _ in range(3)]
        assert [[s.position for s in d.segments] for d in deliveries] == [[1, 2, 3], [4, 5, 6], [7]]
        assert [(d.position, d.is_caught_up) for d in deliveries] == [(3, False), (6, False), (7, True)]
        assert subscription.poll().segments == []


@on_both
def test_no_segment_is_missing_or_double_at_the_seam_from_catching_up_to_live(log: Log) -> None:
    append(log, GATE, *[1] * 5)
    positions: list[int] = []
    with Subscription(log, "reader", limit=2) as subscription:
        for _ in range(8):
            positions += [segment.position for segment in subscription.poll().segments]
            append(log, YARD, 1)
        positions += [segment.position for segment in drained(subscription)]
    assert positions == list(range(1, 14))


@on_both
def test_an_append_wakes_a_waiting_subscriber(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    # Were the notification lost, the next look would come after the thread was given up.
    monkeypatch.setattr(subscription_module, "POLL_SECONDS", 10 * WAIT_S)
    subscription = Watched(log, "reader")
    got: list[Segment] = []
    reading = threading.Thread(target=lambda: got.extend(subscription.poll(10 * WAIT_S).segments))
    reading.start()
    assert subscription.waiting.wait(WAIT_S)
    append(log, GATE, 1)
    reading.join(WAIT_S)
    try:
        assert [segment.position for segment in got] == [1]
    finally:
        append(log, GATE, 1)
        reading.join(WAIT_S)
        subscription.close()


def test_a_lost_notification_costs_one_poll(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscription_module, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(subscription_module, "CHANNEL", "nobody_speaks_here")
    subscription = Watched(log, "reader")
    got: list[Segment] = []
    reading = threading.Thread(target=lambda: got.extend(subscription.poll(WAIT_S).segments))
    reading.start()
    assert subscription.waiting.wait(WAIT_S)
    append(log, GATE, 1)
    reading.join(2 * WAIT_S)
    subscription.close()
    assert [segment.position for segment in got] == [1]


def test_an_append_between_look_and_listen_is_seen(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subscription_module, "POLL_SECONDS", 10 * WAIT_S)
    subscription = Subscription(log, "reader")
    look, looks = subscription._look, []

    def look_then_append() -> object:
        looks.append(look())
        if len(looks) == 1:
            append(log, GATE, 1)
        return looks[-1]

    monkeypatch.setattr(subscription, "_look", look_then_append)
    assert [segment.position for segment in subscription.poll(WAIT_S).segments] == [1]
    assert len(looks) == 2
    subscription.close()


def test_nothing_new_in_time_is_an_empty_delivery(log: Log) -> None:
    append(log, GATE, 1)
    with Subscription(log, "reader") as subscription:
        drained(subscription)
        delivery = subscription.poll(0.05)
    assert (delivery.segments, delivery.position, delivery.is_caught_up) == ([], 1, True)


@on_both
def test_a_filtered_subscription_moves_on_past_what_it_does_not_want(log: Log) -> None:
    append(log, GATE, *[1] * 5)
    append(log, YARD, 1)
    append(log, GATE, 1)
    with Subscription(log, "reader", sources=["yard"], limit=1) as subscription:
        deliveries = [subscription.poll(), subscription.poll()]
    assert [([s.stream for s in d.segments], d.position) for d in deliveries] == [([YARD], 6), ([], 7)]
    with Subscription(log, "reader", types=["video_added"], stations=["brno"]) as subscription:
        assert (subscription.poll().segments, subscription.position) == ([], 7)


def test_a_subscription_filters_by_type_and_station(log: Log) -> None:
    for station in ("brno", "plzen"):
        log.append([draft_of(event, station=station) for event in ONE_OF_EACH])
    with Subscription(log, "reader", types=["track_ended", "video_added"], stations=["plzen"]) as subscription:
        assert [str(s.stream) for s in drained(subscription)] == ["plzen/gate/video_added", "plzen/gate/track_ended"]


@on_both
def test_a_restarted_subscriber_begins_behind_its_checkpoint(log: Log) -> None:
    append(log, GATE, *[1] * 4)
    with Subscription(log, "reader", limit=2) as subscription, log.transaction() as transaction:
        transaction.save_checkpoint("reader", subscription.poll().position, b"counted 2")
    with Subscription(log, "reader") as again:
        assert (again.position, again.state) == (2, b"counted 2")
        assert [segment.position for segment in drained(again)] == [3, 4]
    with Subscription(log, "another") as another:
        assert len(drained(another)) == 4


@on_both
def test_output_and_checkpoint_commit_together_or_not_at_all(log: Log) -> None:
    append(log, GATE, 1, 1)

    def run(is_killed: bool) -> None:
        with Subscription(log, "rules", sources=["gate"]) as subscription:
            delivery = subscription.poll()
            with log.transaction() as transaction:
                if transaction.checkpoint("rules").position >= delivery.position or not delivery.segments:
                    return
                transaction.save_checkpoint("rules", delivery.position)
                transaction.append([draft(YARD, 1, len(delivery.segments))])
                if is_killed:
                    raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run(is_killed=True)
        assert (log.checkpoint("rules").position, log.stream_head(YARD).sequence) == (0, 0)
    for _ in range(2):
        run(is_killed=False)
        assert (log.checkpoint("rules").position, log.stream_head(YARD).sequence) == (2, 2)


def test_several_subscribers_do_not_disturb_each_other(make_log: Callable[[], Log]) -> None:
    log = make_log()
    append(log, GATE, *[1] * 6)
    with Subscription(log, "slow", limit=1) as slow, Subscription(log, "fast") as fast:
        slow.poll()
        assert len(drained(fast)) == 6
        assert [segment.position for segment in drained(slow)] == [2, 3, 4, 5, 6]


def test_a_listening_connection_that_dies_is_an_outage_and_then_replaced(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subscription_module, "POLL_SECONDS", 10 * WAIT_S)
    subscription = Watched(log, "reader")
    failures: list[BaseException] = []

    def read() -> None:
        try:
            subscription.poll(10 * WAIT_S)
        except LogUnavailable as error:
            failures.append(error)

    reading = threading.Thread(target=read)
    reading.start()
    assert subscription.waiting.wait(WAIT_S)
    query(
        log,
        "select pg_terminate_backend(pid, 10000) from pg_stat_activity "
        "where datname = current_database() and query like 'listen%%'",
    )
    reading.join(WAIT_S)
    assert [type(error) for error in failures] == [LogUnavailable]
    assert "the subscription reader lost the database" in str(failures[0])
    append(log, GATE, 1)
    assert [segment.position for segment in subscription.poll(WAIT_S).segments] == [1]
    subscription.close()
