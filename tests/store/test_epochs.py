"""A new epoch of a log that was not restored."""

from contextlib import ExitStack
from typing import Any

import psycopg
import pytest

from events import Catalogue
from store import BadRequest, Log, LogUnavailable, epochs, verify
from store.epochs import Life, begin_epoch, life_of, others
from tests.store.samples import GATE, append


def test_a_logs_own_streams_go_on_in_the_new_epoch_and_the_old_one_stays(log: Log) -> None:
    dsn = log.dsn
    assert life_of(dsn) == Life(1, has_events=False)
    append(log, GATE, 3)
    log.close()
    begin_epoch(dsn, 4)
    assert life_of(dsn) == Life(4, has_events=True)
    with Log(dsn, Catalogue.shipped()) as after:
        append(after, GATE, 2)
        assert [(life.epoch, life.sequence) for life in after.lives(GATE)] == [(1, 3), (4, 2)]
        assert verify(after).is_sound


def test_an_epoch_that_is_not_behind_the_logs_own_is_refused(log: Log) -> None:
    log.close()
    begin_epoch(log.dsn, 2)
    with pytest.raises(BadRequest, match="a new epoch lies behind the log's own, which is 2; got 2"):
        begin_epoch(log.dsn, 2)


def test_a_log_in_use_keeps_its_epoch(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(epochs, "_GONE_SECONDS", 0.0)
    log.head()
    with pytest.raises(BadRequest, match=r"the log is in use: .*Next: stop vian serve, vian sync"):
        begin_epoch(log.dsn, 2)
    assert life_of(log.dsn).epoch == 1


def test_who_opened_the_log_before_it_was_locked_keeps_its_epoch(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    log.close()
    with ExitStack() as late:

        def counted(connection: "psycopg.Connection[Any]") -> int:
            count = others(connection)
            late.enter_context(Log(log.dsn, Catalogue.shipped())).head()
            return count

        monkeypatch.setattr(epochs, "others", counted)
        with pytest.raises(BadRequest, match="the log is in use: "):
            begin_epoch(log.dsn, 2)
    assert life_of(log.dsn).epoch == 1


def test_a_database_that_is_away_is_told() -> None:
    for action in (life_of, lambda dsn: begin_epoch(dsn, 2)):
        with pytest.raises(LogUnavailable, match=r"Next: vian doctor"):
            action("postgresql://nobody@127.0.0.1:9/none")
