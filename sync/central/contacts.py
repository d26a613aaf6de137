"""What central heard last of each station: for people to look at, nothing is decided by it.

Contract: a hello is kept as it came, of segments the time alone, and that at most every `HEARD_EVERY_S`. What a
station says of itself is no more than that. May be used by several threads.
"""

import json
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

from events import Station, StreamName
from store import Log, LogUnavailable
from sync.runs import StreamKey

HEARD_EVERY_S = 5.0


class _StreamSaid(Protocol):
    @property
    def stream(self) -> str: ...
    @property
    def epoch(self) -> int: ...
    @property
    def sequence(self) -> int: ...


class Greeted(Protocol):
    """A hello, in any version of the protocol."""

    @property
    def station(self) -> str:
        """Who says it."""

    @property
    def program(self) -> str:
        """Its program."""

    @property
    def epoch(self) -> int:
        """Life of its log."""

    @property
    def time(self) -> datetime:
        """Its clock."""

    @property
    def streams(self) -> Sequence[_StreamSaid]:
        """Where the streams stand there that it sends."""


@dataclass(frozen=True, slots=True)
class StationContact:
    """What central heard last of one station."""

    station: Station
    last_contact_at: datetime
    hello_at: datetime
    program: str
    protocol: int
    epoch: int
    clock_offset_s: float
    """how far central's clock was ahead of the station's at its newest hello, travel time included"""
    heads: dict[StreamKey, int]
    """newest event of each stream that the station sends, by its newest hello"""


class Contacts:
    """Keeps in central's log what is heard of stations.

    Args:
        log: Central's log.
        monotonic: Seconds that never go back.
    """

    def __init__(self, log: Log, monotonic: Callable[[], float]) -> None:
        self._log = log
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._kept: dict[str, float] = {}

    def greeted(self, hello: Greeted, protocol: int, now: datetime) -> None:
        """A station that may speak has said hello.

        One that names no streams, as before a question or by `vian sync doctor`, leaves those that were named.

        Raises:
            LogUnavailable: The database is away.
        """
        heads = [[each.stream, each.epoch, each.sequence] for each in hello.streams]
        offset = (now - hello.time).total_seconds()
        with self._log.connection() as connection:
            connection.execute(
                "insert into station_contacts (station, last_contact_at, hello_at, program, protocol, epoch, "
                "clock_offset_s, heads) values (%s, %s, %s, %s, %s, %s, %s, %s::jsonb) on conflict (station) do update "
                "set (last_contact_at, hello_at, program, protocol, epoch, clock_offset_s, heads) = "
                "(excluded.last_contact_at, excluded.hello_at, excluded.program, excluded.protocol, excluded.epoch, "
                "excluded.clock_offset_s, "
                "case when excluded.heads = '[]' then station_contacts.heads else excluded.heads end)",
                (hello.station, now, now, _text(hello.program), protocol, hello.epoch, offset, json.dumps(heads)),
            )
        with self._lock:
            self._kept[hello.station] = self._monotonic()

    def heard(self, station: Station, now: datetime) -> None:
        """Something else of the station has been answered; a database that is away is no error here."""
        if self._is_due(station):
            with suppress(LogUnavailable), self._log.connection() as connection:
                connection.execute(
                    "update station_contacts set last_contact_at = %s where station = %s", (now, station)
                )

    def _is_due(self, station: str) -> bool:
        at = self._monotonic()
        with self._lock:
            is_due = at - self._kept.get(station, -HEARD_EVERY_S) >= HEARD_EVERY_S
            if is_due:
                self._kept[station] = at
        return is_due


def contacts_of(log: Log) -> dict[Station, StationContact]:
    """What was heard last of each station, by name.

    Raises:
        LogUnavailable: The database is away.
    """
    with log.connection() as connection:
        rows = connection.execute(
            "select station, last_contact_at, hello_at, program, protocol, epoch, clock_offset_s, heads "
            "from station_contacts order by station"
        ).fetchall()
    return {row[0]: _contact(*row) for row in rows}


def _contact(
    station: Station,
    last: datetime,
    hello: datetime,
    program: str,
    protocol: int,
    epoch: int,
    offset: float,
    heads: list[tuple[str, int, int]],
) -> StationContact:
    said = {StreamKey(StreamName.parse(name), epoch): sequence for name, epoch, sequence in heads}
    return StationContact(station, last, hello, program, protocol, epoch, offset, said)


def _text(text: str) -> str:
    """The text as PostgreSQL takes it, in one line: a station wrote it."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)[:200]
