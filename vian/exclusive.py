"""One at a time: a lock in the log's database that only one process holds.

Contract: the lock lives as long as its connection, so a killed holder frees it by itself. It spares
people the harder errors behind it; what the log holds is safe without it, because every append names
the sequence that it expects.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import psycopg

from store import Log, LogUnavailable
from store.locks import lock_key
from vian.errors import WorldFailed

_PATIENCE_SECONDS = 3.0
"""How long a lock is waited for: the server may notice a moment later that its holder was killed."""


@contextmanager
def exclusively(log: Log, what: str, *, patience_s: float = _PATIENCE_SECONDS) -> Iterator[None]:
    """Holds the lock on `what` for the length of the block.

    Args:
        log: The log.
        what: What is locked, as people would say it.
        patience_s: How long to wait for it, in seconds.

    Raises:
        WorldFailed: Somebody else holds it.
        LogUnavailable: The database is away.
    """
    connection = _connected(log)
    try:
        try:
            connection.execute("select set_config('lock_timeout', %s, false)", (f"{patience_s * 1000:.0f}ms",))
            connection.execute("select pg_advisory_lock(%s)", (lock_key(what),))
        except psycopg.errors.LockNotAvailable as error:
            raise WorldFailed(
                f"another command is at work on {what}. Next: wait until it has ended, then run this again"
            ) from error
        yield
    finally:
        connection.close()


def _connected(log: Log) -> psycopg.Connection[tuple[object, ...]]:
    log.with_retry(log.head)
    try:
        return psycopg.connect(log.dsn, autocommit=True)
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}") from error
