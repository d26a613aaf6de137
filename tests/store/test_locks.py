"""Locks that one process holds."""

import psycopg
import pytest

from store import Log, LogUnavailable
from store.locks import lock_key, tried_lock
from tests.store.samples import owner


def test_one_holds_it_until_its_block_ends(log: Log) -> None:
    with tried_lock(log, "a thing") as is_mine, tried_lock(log, "a thing") as is_anothers:
        assert (is_mine, is_anothers) == (True, False)
    with tried_lock(log, "a thing") as is_mine:
        assert is_mine


def test_a_database_that_goes_away_as_it_is_asked_is_told(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    def cut(what: str) -> int:
        with owner(log) as connection:
            connection.execute(
                "select pg_terminate_backend(pid, 5000) from pg_stat_activity "
                "where datname = current_database() and pid <> pg_backend_pid()"
            )
        return lock_key(what)

    monkeypatch.setattr("store.locks.lock_key", cut)
    with pytest.raises(LogUnavailable, match="the database is away"), tried_lock(log, "a thing"):
        pass


def test_what_fails_in_the_block_is_no_fault_of_the_lock(log: Log) -> None:
    with pytest.raises(psycopg.OperationalError, match="another"), tried_lock(log, "a thing"):
        raise psycopg.OperationalError("another")
