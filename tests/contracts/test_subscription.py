"""Subscriptions: from any position, catching up and then live, without a gap or a double."""

import threading
from collections.abc import Callable

import pytest

from events import Segment
from store import Log, Subscription
from store import subscription as subscription_module
from tests.contracts.followers import WAIT_S, Watched, drained
from tests.store.samples import GATE, ONE_OF_EACH, YARD, append, draft, draft_of


def test_it_catches_up_in_deliveries_of_limited_size(log: Log) -> None:
    append(log, GATE, *[1] * 7)
    with Subscription(log, "reader", limit=3) as subscription:
        deliveries = [subscription.poll() for _ in range(3)]
        assert [[s.position for s in d.segments] for d in deliveries] == [[1, 2, 3], [4, 5, 6], [7]]
        assert [(d.position, d.is_caught_up) for d in deliveries] == [(3, False), (6, False), (7, True)]
        assert subscription.poll().segments == []


def test_it_begins_at_any_position(log: Log) -> None:
    append(log, GATE, *[1] * 5)
    for begin in range(7):
        with Subscription(log, "reader", limit=2) as subscription:
            subscription.position = begin
            assert [segment.position for segment in drained(subscription)] == list(range(begin + 1, 6))


def test_no_segment_is_missing_or_double_at_the_seam_from_catching_up_to_live(log: Log) -> None:
    append(log, GATE, *[1] * 5)
    positions: list[int] = []
    with Subscription(log, "reader", limit=2) as subscription:
        for _ in range(8):
            positions += [segment.position for segment in subscription.poll().segments]
            append(log, YARD, 1)
        positions += [segment.position for segment in drained(subscription)]
    assert positions == list(range(1, 14))


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


def test_what_comes_while_a_page_is_read_waits_for_the_next_one(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    append(log, GATE, 1, 1)
    head, heads = log.head, []

    def head_then_append() -> int:
        heads.append(head())
        append(log, YARD, 1)
        return heads[-1]

    with Subscription(log, "reader") as subscription:
        with monkeypatch.context() as patched:
            patched.setattr(log, "head", head_then_append)
            first = subscription.poll()
        assert ([s.position for s in first.segments], first.position) == ([1, 2], 2)
        assert [segment.position for segment in drained(subscription)] == [3]


def test_nothing_new_in_time_is_an_empty_delivery(log: Log) -> None:
    append(log, GATE, 1)
    with Subscription(log, "reader") as subscription:
        drained(subscription)
        delivery = subscription.poll(0.05)
    assert (delivery.segments, delivery.position, delivery.is_caught_up) == ([], 1, True)


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


def test_a_restarted_subscriber_begins_behind_its_checkpoint(log: Log) -> None:
    append(log, GATE, *[1] * 4)
    with Subscription(log, "reader", limit=2) as subscription, log.transaction() as transaction:
        transaction.save_checkpoint("reader", subscription.poll().position, b"counted 2")
    with Subscription(log, "reader") as again:
        assert (again.position, again.state) == (2, b"counted 2")
        assert [segment.position for segment in drained(again)] == [3, 4]
    with Subscription(log, "another") as another:
        assert len(drained(another)) == 4


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


def test_a_checkpoint_that_another_of_the_name_moved_is_seen_before_output_is_doubled(log: Log) -> None:
    append(log, GATE, 1, 1)
    with Subscription(log, "rules", sources=["gate"]) as first, Subscription(log, "rules", sources=["gate"]) as second:
        for subscription in (first, second):
            begun_at = subscription.position
            delivery = subscription.poll()
            with log.transaction() as transaction:
                if transaction.checkpoint("rules").position == begun_at:
                    transaction.save_checkpoint("rules", delivery.position)
                    transaction.append([draft(YARD, 1, len(delivery.segments))])
    assert log.stream_head(YARD).sequence == 2


def test_several_subscribers_do_not_disturb_each_other(make_log: Callable[[], Log]) -> None:
    log = make_log()
    append(log, GATE, *[1] * 6)
    with Subscription(log, "slow", limit=1) as slow, Subscription(log, "fast") as fast:
        slow.poll()
        assert len(drained(fast)) == 6
        assert [segment.position for segment in drained(slow)] == [2, 3, 4, 5, 6]
