"""Central's registry: which stations may speak, with which key, and what they may do.

Contract: each change is an event in central's own log (`CENTRAL/sync/station_enrolled`, `station_revoked`),
in one transaction with the row that it makes, so the registry can be made again of the log (`recover`)
when that was restored. A station that is revoked is shut out when `revoke` returns: what it had under way
either was durable before, or will never be. Codes are kept as hashes.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import psycopg

from events import (
    EventType,
    Producer,
    Station,
    StationEnrolled,
    StationRevoked,
    StreamName,
    batch_of,
    decode,
    encode,
    events_of,
)
from store import Log, Transaction, key_id
from sync.errors import GrantError, Refusal

SOURCE = "sync"
PRODUCER = Producer("registry", "1", hashlib.sha256(b"{}").digest())

_COLUMNS = "name, key_id, public_key, operations, reads, enrolled_at, revoked_at, challenge_number"


@dataclass(frozen=True, slots=True)
class Registered:
    """A station that central knows."""

    name: Station
    key_id: str
    public_key: bytes
    operations: tuple[str, ...]
    reads: tuple[str, ...]
    enrolled_at: datetime
    revoked_at: datetime | None
    challenge_number: int
    """of the newest challenge that it answered"""


@dataclass(frozen=True, slots=True)
class Invitation:
    """A code that waits to be used."""

    station: Station
    operations: tuple[str, ...]
    reads: tuple[str, ...]
    made_at: datetime
    expires_at: datetime


class Registry:
    """The registry of one central server; may be used by several threads and processes.

    Args:
        log: Central's log.
        central: Central's own name; its streams hold the registry's events.
        now: Central's clock, aware.
    """

    def __init__(self, log: Log, central: Station, now: Callable[[], datetime]) -> None:
        self._log = log
        self.central = central
        self._now = now

    def station(self, name: str) -> Registered | None:
        """The station of that name, revoked or not; None where central does not know it.

        Raises:
            LogUnavailable: The database is away.
        """
        with self._log.connection() as connection:
            row = connection.execute(f"select {_COLUMNS} from stations where name = %s", (name,)).fetchone()
        return None if row is None else _registered(row)

    def stations(self) -> list[Registered]:
        """All stations, revoked ones too, by name."""
        with self._log.connection() as connection:
            return [_registered(row) for row in connection.execute(f"select {_COLUMNS} from stations order by name")]

    def invitations(self) -> list[Invitation]:
        """The codes that can still be used, by station."""
        with self._log.connection() as connection:
            rows = connection.execute(
                "select station, operations, reads, made_at, expires_at from enrolment_codes "
                "where used_at is null and expires_at > %s order by station, made_at",
                (self._now(),),
            ).fetchall()
        return [Invitation(Station(row[0]), tuple(row[1]), tuple(row[2]), *row[3:]) for row in rows]

    def invite(
        self, name: Station, secret: bytes, operations: Sequence[str], reads: Sequence[str], expires_at: datetime
    ) -> None:
        """Let who has the code's secret enrol as that station, once, until it expires.

        Raises:
            GrantError: It is central's own name.
        """
        if name == self.central:
            raise GrantError(
                f"{name} is central's own name, and a station could write central's own streams with it. "
                "Next: give the station another name, or central one with --station"
            )
        with self._log.connection() as connection:
            connection.execute(
                "insert into enrolment_codes (code_hash, station, operations, reads, made_at, expires_at) "
                "values (%s, %s, %s, %s, %s, %s)",
                (_code_hash(secret), name, list(operations), list(reads), self._now(), expires_at),
            )

    def enrol(self, name: str, secret: bytes, public_key: bytes, address: str | None) -> Registered:
        """Take a station in with its key; what it had before, it has no more.

        Args:
            name: The station, as it calls itself.
            secret: The code's.
            public_key: Its raw Ed25519 key; the caller has seen that it has the private one.
            address: Network address that it came from.

        Raises:
            Refusal: There is no such code, it was used or has expired, or is for another station.
        """
        with self._log.transaction() as transaction:
            operations, reads = self._use_code(transaction.connection, name, secret)
            event = StationEnrolled(
                time=self._now(),
                enrolled=name,
                key_id=key_id(public_key),
                public_key=public_key,
                operations=json.dumps(operations),
                reads=json.dumps(reads),
                address=address,
            )
            _take_in(transaction.connection, event)
            self._append(transaction, event)
        found = self.station(name)
        assert found is not None, "it was committed above"
        return found

    def next_epoch(self, name: Station) -> int:
        """The epoch behind all those of which central holds events of the station; 0 where it holds none.

        Ask once the station was enrolled: who had its name before sends no more then.

        Raises:
            LogUnavailable: The database is away.
        """
        with self._log.connection() as connection:
            row = connection.execute(
                "select coalesce(max(epoch) + 1, 0) from streams where station = %s", (name,)
            ).fetchone()
        assert row is not None, "an aggregate has one row"
        return int(row[0])

    def revoke(self, name: str, reason: str | None = None) -> Registered:
        """Shut a station out, from the moment on when this returns; its codes end too.

        Raises:
            GrantError: Central does not know the station, or it is shut out already.
        """
        found = self.station(name)
        if found is None or found.revoked_at is not None:
            known = ", ".join(str(each.name) for each in self.stations() if each.revoked_at is None) or "none"
            state = "is not enrolled" if found is None else "is shut out already"
            raise GrantError(f"station {name} {state}; enrolled: {known}. Next: vian station list")
        event = StationRevoked(time=self._now(), revoked=name, key_id=found.key_id, reason=reason)
        with self._log.transaction() as transaction:
            _shut_out(transaction.connection, event)
            self._append(transaction, event)
        return found

    def withdraw(self, name: str) -> int:
        """How many open codes for the station were ended."""
        with self._log.connection() as connection:
            return _end_codes(connection, name, self._now())

    def recover(self) -> int:
        """Make the registry of the log's events where it is empty, as after a restore; how many stations it holds then.

        Raises:
            LogUnavailable: The database is away.
        """
        if known := len(self.stations()):
            return known
        types = [StationEnrolled.type_name, StationRevoked.type_name]
        with self._log.connection() as connection, connection.transaction():
            # Who makes it too, takes in or shuts out waits until this is done, lest an older event be taken in last.
            connection.execute("lock table stations in share row exclusive mode")
            if connection.execute("select 1 from stations limit 1").fetchone():
                return len(self.stations())
            for event in self._events(types):
                if isinstance(event, StationEnrolled):
                    _take_in(connection, event)
                elif isinstance(event, StationRevoked):
                    _shut_out(connection, event)
        return len(self.stations())

    def _events(self, types: Sequence[str]) -> Iterable[EventType]:
        """Central's own events of the registry in order; a station's streams of such types are its own affair."""
        for segment in self._log.read_all(types=types, stations=[self.central], sources=[SOURCE]):
            yield from events_of(decode(segment, self._log.catalogue))

    def _use_code(self, connection: psycopg.Connection[Any], name: str, secret: bytes) -> tuple[list[str], list[str]]:
        now = self._now()
        row = connection.execute(
            "select station, operations, reads, expires_at, used_at from enrolment_codes where code_hash = %s "
            "for update",
            (_code_hash(secret),),
        ).fetchone()
        if row is None:
            raise _no_code("unknown_code", "central knows no such code", "a code that it did not make")
        station, operations, reads, expires_at, used_at = row
        if used_at is not None:
            raise _no_code("used_code", "the code was used already", f"a code that ended at {used_at:%Y-%m-%d %H:%M}")
        if expires_at <= now:
            raise _no_code("expired_code", "the code has expired", f"a code that ended at {expires_at:%Y-%m-%d %H:%M}")
        if station != name:
            raise Refusal(
                403,
                "foreign_station",
                "the code is for another station",
                f"station {name}",
                f"station {station}",
                f"give --station {station}, or ask central for a code: vian station invite {name}",
            )
        _end_codes(connection, name, now)
        return operations, reads

    def _append(self, transaction: Transaction, event: StationEnrolled | StationRevoked) -> None:
        stream = StreamName.of(self.central, SOURCE, event.type_name)
        transaction.append([encode(stream, batch_of([event]), PRODUCER)])


def check_granted(transaction: Transaction, name: str, key: str) -> None:
    """Nothing, if the station may still speak with that key; it then may until the transaction ends.

    The row stays locked against a revocation, which so waits for what was let in before it.

    Raises:
        Refusal: It was revoked, or enrolled anew with another key.
    """
    row = transaction.connection.execute(
        "select revoked_at from stations where name = %s and key_id = %s for share", (name, key)
    ).fetchone()
    if row is None or row[0] is not None:
        raise revoked(name)


def revoked(name: str) -> Refusal:
    """What a station is told that was shut out."""
    return Refusal(
        401,
        "revoked",
        "central has shut this station out",
        f"station {name}, which was revoked",
        "a station that may speak",
        f"ask central's operator; a way back is vian station invite {name} there, then vian station enrol CODE here",
    )


def _take_in(connection: psycopg.Connection[Any], event: StationEnrolled) -> None:
    connection.execute(
        "insert into stations (name, key_id, public_key, operations, reads, enrolled_at) "
        "values (%s, %s, %s, %s, %s, %s) on conflict (name) do update set key_id = excluded.key_id, "
        "public_key = excluded.public_key, operations = excluded.operations, reads = excluded.reads, "
        "enrolled_at = excluded.enrolled_at, revoked_at = null",
        (
            event.enrolled,
            event.key_id,
            event.public_key,
            json.loads(event.operations),
            json.loads(event.reads),
            event.time,
        ),
    )
    connection.execute("delete from sync_tokens where station = %s", (event.enrolled,))


def _shut_out(connection: psycopg.Connection[Any], event: StationRevoked) -> None:
    connection.execute("update stations set revoked_at = %s where name = %s", (event.time, event.revoked))
    connection.execute("delete from sync_tokens where station = %s", (event.revoked,))
    _end_codes(connection, event.revoked, event.time)


def _end_codes(connection: psycopg.Connection[Any], name: str, now: datetime) -> int:
    ended = connection.execute(
        "update enrolment_codes set used_at = %s where station = %s and used_at is null", (now, name)
    )
    return ended.rowcount


def _code_hash(secret: bytes) -> bytes:
    return hashlib.sha256(secret).digest()


def _registered(row: tuple[Any, ...]) -> Registered:
    name, key, public_key, operations, reads, *rest = row
    return Registered(Station(name), key, public_key, tuple(operations), tuple(reads), *rest)


def _no_code(code: str, error: str, got: str) -> Refusal:
    return Refusal(
        403,
        code,
        error,
        got,
        "an open one-time code",
        "check it for slips, or ask central's operator for another: vian station invite NAME",
    )
