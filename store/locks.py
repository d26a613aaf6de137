"""Locks in the log's database that only one process holds.

Contract: a lock lives as long as its connection, so a killed holder frees it by itself.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import psycopg

from store.errors import LogUnavailable
from store.log import Log

ARCHIVE = "the archive"
"""What is locked while sealed files are made or made anew."""


def lock_key(what: str) -> int:
    """The lock's number in the database."""
    return int.from_bytes(hashlib.sha256(f"vian {what}".encode()).digest()[:8], "big", signed=True)


@contextmanager
def tried_lock(log: Log, what: str) -> Iterator[bool]:
    """Whether the lock was free; if so, it is held for the length of the block.

    Raises:
        LogUnavailable: The database is away.
    """
    try:
        connection = psycopg.connect(log.dsn, autocommit=True)
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}".strip()) from error
    try:
        yield _is_taken(connection, what)
    finally:
        connection.close()


def _is_taken(connection: psycopg.Connection[Any], what: str) -> bool:
    """Whether the lock was free, and is this connection's now."""
    try:
        row = connection.execute("select pg_try_advisory_lock(%s)", (lock_key(what),)).fetchone()
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}".strip()) from error
    assert row is not None, "a function answers in one row"
    return bool(row[0])
