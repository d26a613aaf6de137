"""Subscriptions on PostgreSQL: notifications that are lost, connections that die."""

import threading

import pytest

from events import Segment
from store import Log, LogUnavailable
from store import subscription as subscription_module
from tests.contracts.followers import WAIT_S, Watched
from tests.store.samples import GATE, append, query


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
