"""Epochs: the lives of a log's own streams, and how a log begins a new one without a backup.

Contract: a new epoch lies behind the one before, and nobody else is connected while it begins: a program that goes on
in the old one would write another history of it. What the log holds stays as it is; its own streams begin again at
sequence 1. A restore begins one of its own (`store.restoring`).
"""

import time
from dataclasses import dataclass
from typing import Any

import psycopg

from store.errors import BadRequest, LogUnavailable
from store.schema import safe_dsn

_GONE_SECONDS = 5.0
"""How long sessions that just ended may take to be gone."""


@dataclass(frozen=True, slots=True)
class Life:
    """In which epoch a log is."""

    epoch: int
    has_events: bool


def life_of(dsn: str) -> Life:
    """In which epoch the migrated log is.

    Raises:
        LogUnavailable: The database is away.
    """
    try:
        with psycopg.connect(dsn) as connection:
            return _life(connection)
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database at {safe_dsn(dsn)} does not answer: {error}. Next: vian doctor") from error


def begin_epoch(dsn: str, epoch: int) -> None:
    """Have the log's own streams go on in that epoch.

    Args:
        dsn: Address of the migrated log, as its owner; nobody else may be connected to it.
        epoch: Behind the log's own.

    Raises:
        BadRequest: It is not behind the log's own, or the log is in use.
        LogUnavailable: The database is away, or the role is not the log's owner.
    """
    try:
        with psycopg.connect(dsn, autocommit=True) as connection:
            _check_alone(others(connection))
            with connection.transaction():
                # Who opens the log from here on waits, and then learns the new epoch; who came before knows the old.
                connection.execute("lock table log_head in access exclusive mode")
                _check_alone(_others_now(connection))
                own = _life(connection).epoch
                if epoch <= own:
                    raise BadRequest(f"a new epoch lies behind the log's own, which is {own}; got {epoch}")
                connection.execute("update log_head set epoch = %s", (epoch,))
    except psycopg.errors.InsufficientPrivilege as error:
        raise LogUnavailable(
            f"{safe_dsn(dsn)}: {error}. Next: vian station new-epoch as the role that owns the log's tables"
        ) from error
    except psycopg.OperationalError as error:
        raise LogUnavailable(
            f"the database at {safe_dsn(dsn)} did not begin the epoch: {error}. "
            "Next: vian doctor, then vian station new-epoch"
        ) from error


def others(connection: psycopg.Connection[Any]) -> int:
    """How many other programs are connected, once those that just ended are gone."""
    deadline = time.monotonic() + _GONE_SECONDS
    while (count := _others_now(connection)) and time.monotonic() <= deadline:
        connection.execute("select pg_sleep(0.05)")
    return count


def _others_now(connection: psycopg.Connection[Any]) -> int:
    """How many other programs are connected; in a transaction, as it was when it was first asked there."""
    row = connection.execute(
        "select count(*) from pg_stat_activity where datname = current_database() "
        "and pid <> pg_backend_pid() and usesysid is not null "
        # An owner who is no superuser is not told of what kind another's session is.
        "and coalesce(backend_type, 'client backend') = 'client backend'"
    ).fetchone()
    assert row is not None, "a count has one row"
    return int(row[0])


def _check_alone(count: int) -> None:
    if count:
        raise BadRequest(
            f"the log is in use: {count} other connections. Next: stop vian serve, vian sync and whatever else "
            "uses it, then vian station new-epoch"
        )


def _life(connection: psycopg.Connection[Any]) -> Life:
    row = connection.execute("select epoch, position > 0 from log_head").fetchone()
    assert row is not None, "a log has its one row"
    return Life(*row)
