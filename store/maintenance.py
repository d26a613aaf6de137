"""The log's record of its own care: when it was backed up, restored, verified.

Contract: rows are added, never changed; they are about this database and no part of the log, so a
restored log begins a record of its own.
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import psycopg

from store.log import Log

BACKED_UP = "backed_up"
RESTORE_BEGAN = "restore_began"
RESTORED = "restored"
VERIFIED = "verified"
"""The log was read back and verified as a whole after its restore."""

_INSERT = "insert into maintenance (action, place, position) values (%s, %s, %s)"


@dataclass(frozen=True, slots=True)
class Care:
    """One thing that was done."""

    action: str
    at: datetime
    place: Path
    position: int


def note(log: Log, action: str, place: Path, position: int) -> None:
    """Record that it was done now."""
    with log.connection() as connection:
        note_on(connection, action, place, position)


def note_on(connection: psycopg.Connection[Any], action: str, place: Path, position: int) -> None:
    """Record it over a connection of the caller's, in the caller's transaction."""
    connection.execute(_INSERT, (action, str(place.absolute()), position))


def newest(log: Log) -> dict[str, Care]:
    """The newest of each kind of thing that was done, by kind."""
    with log.connection() as connection:
        rows = connection.execute(
            "select distinct on (action) action, at, place, position from maintenance order by action, id desc"
        ).fetchall()
    return {row[0]: Care(row[0], row[1], Path(row[2]), row[3]) for row in rows}
