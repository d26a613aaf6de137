"""The log: append, read, checkpoints, in one handle on an embedded or an external PostgreSQL.

Contract:
- `append` is all or nothing, one round trip, and durable when it returns.
- Positions are gapless and in commit order; sequences are gapless in each stream.
- A re-sent segment is acknowledged and not stored again; other bytes in its place are refused.
- Reads see only what is committed, in order of position or sequence.
- Old segments may lie in sealed files (`store.sealing`); reads give them like the others.
A `Log` may be used by several threads. It runs as the role `vian_writer`, which cannot change or
delete anything in the log.
"""

import select
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Self, TypeVar

import psycopg
from psycopg_pool import ConnectionPool, PoolTimeout

from events import (
    GENESIS,
    Base,
    Catalogue,
    Draft,
    EventType,
    Place,
    Position,
    Run,
    Segment,
    Station,
    StreamName,
    load_catalogue,
)
from store.coldtier import ColdTier
from store.embedded import EmbeddedServer
from store.errors import UNKNOWN, BadRequest, ChainBroken, DatabaseDamaged, DiskNearlyFull, LogUnavailable, StoreError
from store.reading import (
    Filter,
    TimeOrNone,
    check_not_negative,
    head_query,
    place_query,
    read_query,
    segment_of,
    stream_names,
    stream_query,
)
from store.resending import acknowledged
from store.room import Room
from store.schema import migrate, safe_dsn
from store.standing import (
    ALL_RUNS,
    BASES,
    RUNS,
    SOME_RUNS,
    STANDING,
    Standing,
    StreamHead,
    all_runs_of,
    base_of,
    runs_of,
    standing_of,
)
from store.writing import APPEND, Appended, PlaceIsSealed, append_answer, append_error, append_parameters

T = TypeVar("T")

CONNECTIONS_MAX = 10
_CONNECT_SECONDS = 15.0
_PATIENCE_SECONDS = 1.0
"""How long to wait for the pool before asking the database itself whether it is there."""
_ROOM_BYTES = 32 * 2**20
"""With less room on its disk PostgreSQL may not be able to go on: it takes it in files of 16 MiB."""
_SEQUENCE_MAX = 2**63 - 1
READ_SEGMENTS = 500
"""Segments fetched from the database at a time."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """How far a subscriber has come, and its own state."""

    position: int
    state: bytes


class Transaction:
    """One database transaction over the log: output and checkpoint commit together.

    Append once, and last: from the append to the commit every other writer waits, and two appends in
    one transaction may wait in a circle with another writer (one of the two is then LogUnavailable).
    """

    def __init__(self, connection: psycopg.Connection[Any], epoch: int, archive: ColdTier, room: Room) -> None:
        self.connection = connection
        self._epoch = epoch
        self._archive = archive
        self._room = room

    def append(
        self,
        drafts: Sequence[Draft],
        expected: Sequence[int | None] | None = None,
        *,
        epochs: Sequence[int] | None = None,
        chain_hashes: Sequence[bytes] | None = None,
        bases: Sequence[bytes | None] | None = None,
        from_reserve: bool = False,
    ) -> list[Appended]:
        """Append the drafts, in this order, and say where each came to stand.

        A stream may have gaps where the sender says so: a draft with a base may begin a new run of its stream, beyond
        its head or in a gap. One that is expected at the end of a lower run goes on with it, at most up to the next.

        Args:
            drafts: One or more, of one or many streams.
            expected: For each draft the sequence at which its stream stands before it, or None to
                append wherever it stands. With it, a re-sent draft is recognised.
            epochs: For each draft the epoch of its stream; this log's own by default.
            chain_hashes: For each draft the chain hash that must come out; a replica gives it.
            bases: For each draft the chain hash before it, if it may begin a new run where nothing is yet.
            from_reserve: Append though the disk is nearly full: for the few events that lead to room.

        Raises:
            DiskNearlyFull: The log's disk has less room than must stay free.
            SequenceConflict: A stream stands elsewhere, or holds other bytes there.
            ChainBroken: A chain hash comes out different, or is not the one that the run above was begun behind.
            BadRequest: The lists differ in length, an expected sequence is negative, or a base is none.
        """
        if not from_reserve:
            self._room.require()
        appended = _append(
            self.connection, self._epoch, drafts, expected, epochs, chain_hashes, bases, sealed_is_compared=True
        )
        return [
            each if each.position is not None else self._compared(index, each, drafts, epochs, chain_hashes)
            for index, each in enumerate(appended)
        ]

    def save_checkpoint(self, name: str, position: int, state: bytes = b"") -> None:
        """Set the subscriber's checkpoint."""
        self.connection.execute(
            "insert into checkpoints (name, position, state) values (%s, %s, %s) "
            "on conflict (name) do update set position = excluded.position, state = excluded.state, saved_at = now()",
            (name, position, state),
        )

    def checkpoint(self, name: str) -> Checkpoint:
        """The subscriber's checkpoint, locked until the transaction ends; position 0 where there is none."""
        # A row that is not there cannot be locked, and two first subscribers would both begin at 0.
        self.connection.execute(
            "insert into checkpoints (name, position, state) values (%s, 0, '') on conflict do nothing", (name,)
        )
        row = self.connection.execute(
            "select position, state from checkpoints where name = %s for update", (name,)
        ).fetchone()
        assert row is not None, "the row was inserted above"
        return Checkpoint(*row)

    def checkpoints(self, names: Sequence[str]) -> dict[str, Checkpoint]:
        """The subscribers' checkpoints by name, locked until the transaction ends, in two round trips for all."""
        wanted = sorted(set(names))  # one order for all, so that no two wait for each other in a circle
        self.connection.execute(
            "insert into checkpoints (name, position, state) select unnest(%s::text[]), 0, '' on conflict do nothing",
            (wanted,),
        )
        rows = self.connection.execute(
            "select name, position, state from checkpoints where name = any(%s) order by name for update", (wanted,)
        ).fetchall()
        return {name: Checkpoint(position, state) for name, position, state in rows}

    def save_checkpoints(self, checkpoints: Mapping[str, Checkpoint]) -> None:
        """Set many subscribers' checkpoints in one round trip."""
        names = sorted(checkpoints)
        self.connection.execute(
            "insert into checkpoints (name, position, state) "
            "select * from unnest(%s::text[], %s::bigint[], %b::bytea[]) on conflict (name) do update "
            "set position = excluded.position, state = excluded.state, saved_at = now()",
            (names, [checkpoints[name].position for name in names], [checkpoints[name].state for name in names]),
        )

    def _compared(
        self,
        index: int,
        place: Appended,
        drafts: Sequence[Draft],
        epochs: Sequence[int] | None,
        chain_hashes: Sequence[bytes] | None,
    ) -> Appended:
        """What became of a re-sent draft whose place lies in a sealed file: the file tells whether it is the same."""
        draft, epoch = drafts[index], epochs[index] if epochs else self._epoch
        # Through this very connection: whoever holds one in a transaction must not wait for another.
        archive = self._archive.through(lambda query, values: _fetched(self.connection, query, values))
        try:
            head, stored = archive.holding((draft.stream, epoch), place.first_sequence)
            return acknowledged(
                draft, place.first_sequence, head, stored, chain_hashes[index] if chain_hashes else None
            )
        except StoreError:
            self._fail()
            raise

    def _fail(self) -> None:
        """Fail the transaction in the database too, so that it cannot be committed by mistake."""
        with suppress(psycopg.errors.RaiseException):
            self.connection.execute("do $$ begin raise exception 'refused by its client'; end $$")


class Log:
    """A handle on one log."""

    def __init__(
        self, dsn: str, catalogue: Catalogue, server: EmbeddedServer | None = None, role: str = "vian_writer"
    ) -> None:
        self.dsn = dsn
        self.catalogue = catalogue
        self.server = server
        self._role = role
        self._pool: ConnectionPool[psycopg.Connection[Any]] = ConnectionPool(
            dsn,
            min_size=0,
            max_size=CONNECTIONS_MAX,
            timeout=_CONNECT_SECONDS,
            reconnect_timeout=0,  # who needs a connection asks again, and is told why there is none
            configure=self._configure,
            open=False,
        )
        self.archive = ColdTier(self._fetched, server.data_dir if server else None)
        self.room = Room(self._fetched, server.data_dir if server else None)
        self._sealed_position = 0
        """As far as is known; it only grows."""
        self._pool.open()
        try:
            self.epoch: int = self._value("select epoch from log_head")
        except BaseException:
            self._pool.close()
            raise

    def close(self) -> None:
        """Give the connections back, and stop an embedded server that nobody else uses."""
        self._pool.close()
        if self.server is not None:
            self.server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        """A transaction that commits when the block ends, and rolls back when it raises.

        Raises:
            LogUnavailable: The database is away, or went away before the commit was confirmed; the
                transaction may then have been committed or not: append again with `expected`.
        """
        with self.connection() as connection, connection.transaction():
            yield Transaction(connection, self.epoch, self.archive, self.room)

    @contextmanager
    def connection(self) -> Iterator[psycopg.Connection[Any]]:
        """A connection of the pool, in autocommit, as the log's role.

        Raises:
            LogUnavailable: The database is away or went away.
        """
        try:
            connection = self._take()
            try:
                with connection, _left_clean(connection):
                    yield connection
            finally:
                self._pool.putconn(connection)
        except DiskNearlyFull:
            raise
        except LogUnavailable as error:
            raise LogUnavailable(f"{error}{self._room()}") from error
        except PoolTimeout as error:
            raise LogUnavailable(
                f"all {CONNECTIONS_MAX} connections to {safe_dsn(self.dsn)} were busy for {_CONNECT_SECONDS:g} s"
            ) from error
        except psycopg.OperationalError as error:
            raise LogUnavailable(
                f"the database at {safe_dsn(self.dsn)} is away: {error}".strip() + self._room()
            ) from error
        except psycopg.InternalError as error:
            raise _damaged(error) from error

    def _room(self) -> str:
        """A word on the embedded server's disk where it is nearly full: PostgreSQL dies of that without saying why."""
        free = shutil.disk_usage(self.server.data_dir).free if self.server is not None else _ROOM_BYTES
        if free >= _ROOM_BYTES:
            return ""
        return (
            f"; its disk is full ({free // 2**20} MiB free, No space left on device). "
            "Next: make room; what waits goes on by itself"
        )

    def revive(self) -> None:
        """Start an embedded server again that died; do nothing for an external one.

        Raises:
            LogUnavailable: It does not start.
        """
        if self.server is not None:
            self.server.ensure_running()

    def append(
        self,
        drafts: Sequence[Draft],
        expected: Sequence[int | None] | None = None,
        *,
        epochs: Sequence[int] | None = None,
        chain_hashes: Sequence[bytes] | None = None,
        bases: Sequence[bytes | None] | None = None,
        from_reserve: bool = False,
    ) -> list[Appended]:
        """Append the drafts in a transaction of their own and one round trip; see `Transaction.append`."""
        if not from_reserve:
            self.room.require()
        with self.connection() as connection:
            try:
                return _append(connection, self.epoch, drafts, expected, epochs, chain_hashes, bases)
            except PlaceIsSealed:
                # Nothing was stored. The comparison with the file must come before the commit.
                with connection.transaction():
                    transaction = Transaction(connection, self.epoch, self.archive, self.room)
                    return transaction.append(
                        drafts,
                        expected,
                        epochs=epochs,
                        chain_hashes=chain_hashes,
                        bases=bases,
                        from_reserve=from_reserve,
                    )

    def read(
        self, stream: StreamName, from_sequence: int = 1, *, epoch: int | None = None, with_hollow: bool = False
    ) -> Iterator[Segment]:
        """The stream's segments that hold `from_sequence` or a later event, in order; what is in a gap is not here.

        Args:
            stream: The stream; one that does not exist has no segments.
            from_sequence: The first event wanted; the first segment may begin before it.
            epoch: Which life of the stream; its newest by default.
            with_hollow: Give segments without payload too.

        Raises:
            BadRequest: `from_sequence` is negative.
            ChainBroken: A stored segment is one that no log can hold; `vian verify` tells more.
        """
        check_not_negative(f"{stream}: from_sequence", from_sequence)
        return self._read(stream, from_sequence, epoch, Filter(with_hollow=with_hollow))

    def read_lives(self, stream: StreamName) -> Iterator[Segment]:
        """The segments of every life of the stream, the oldest life first, each in order.

        Raises:
            ChainBroken: A stored segment is one that no log can hold; `vian verify` tells more.
        """
        for life in self.lives(stream):
            yield from self.read(stream, epoch=life.epoch)

    def _read(self, stream: StreamName, at: int, epoch: int | None, chosen: Filter) -> Iterator[Segment]:
        at = max(at, 1)
        while True:
            query = stream_query(stream, epoch, at, READ_SEGMENTS, with_hollow=chosen.with_hollow)
            rows = self._fetched(*query)
            for segment in map(segment_of, (row[1:] for row in rows)):
                first, epoch = segment.header.first_sequence, segment.header.epoch
                if first > at:
                    yield from self._read_sealed(stream, epoch, (at, first - 1), chosen)
                yield segment
                at = segment.header.last_sequence + 1
            if len(rows) < READ_SEGMENTS:
                if not rows or at <= rows[-1][0]:
                    yield from self._read_sealed(stream, epoch, (at, _SEQUENCE_MAX), chosen)
                return

    def _read_sealed(
        self, stream: StreamName, epoch: int | None, wanted: tuple[int, int], chosen: Filter
    ) -> Iterator[Segment]:
        """What sealed files hold of a stream between two sequences.

        To be asked after the segments of the database: what is not sealed by now was there to be found.
        """
        for stream_id, life in self._rows(*place_query(stream, epoch)):
            yield from self.archive.of_stream((stream, life), stream_id, *wanted, chosen)

    def read_all(
        self,
        from_position: int = 1,
        *,
        types: Sequence[str] | None = None,
        sources: Sequence[str] | None = None,
        stations: Sequence[str] | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
        to_position: int | None = None,
        with_hollow: bool = False,
    ) -> Iterator[Segment]:
        """The log's segments from a position on, in order of position.

        Args:
            from_position: The first position wanted.
            types: Only these event types.
            sources: Only these sources.
            stations: Only these stations.
            since: Only segments with an event at or after this time.
            until: Only segments with an event before this time.
            to_position: The last position wanted; the log's head at the time of the call by default.
            with_hollow: Give segments without payload too.

        Raises:
            BadRequest: `from_position` is negative, or a time is naive.
            ChainBroken: A stored segment is one that no log can hold; `vian verify` tells more.
        """
        check_not_negative("from_position", from_position)
        return self._read_all(from_position, to_position, Filter(types, sources, stations, since, until, with_hollow))

    def _read_all(self, at: int, to_position: int | None, chosen: Filter) -> Iterator[Segment]:
        end = to_position if to_position is not None else self.head()
        while at <= end:
            segments = self.page(at, end, chosen, READ_SEGMENTS)
            yield from segments
            if len(segments) < READ_SEGMENTS:
                return
            at = segments[-1].position + 1

    def page(self, from_position: int, to_position: int, chosen: Filter, limit: int) -> list[Segment]:
        """At most `limit` segments between two positions, both inclusive, that the filter lets through.

        Raises:
            ChainBroken: A stored segment is one that no log can hold, or PostgreSQL cannot read it.
            ArchiveUnavailable: Sealed files cannot be reached.
        """
        found: list[Segment] = []
        at = from_position
        while at <= to_position and len(found) < limit:
            if at > self._sealed_position:
                sealed, segments = self._hot(at, to_position, chosen, limit - len(found))
                if at > sealed:
                    return found + segments
                # They were sealed since this handle looked last: what is left of them here begins too late.
                self._sealed_position = sealed
            last = min(to_position, self._sealed_position)
            found += self.archive.page(at, last, chosen, limit - len(found))
            at = last + 1
        return found

    def _hot(self, first: int, last: int, chosen: Filter, limit: int) -> tuple[int, list[Segment]]:
        """The segments of a page that PostgreSQL holds, and the position up to which the log is sealed."""
        try:
            rows = self._fetched(*read_query(first, last, chosen, limit))
        except DatabaseDamaged as error:
            raise self._unreadable(first, last, error) from error
        # Asked after the segments where these did not say it: what is not sealed by now was there to be found.
        sealed = rows[0][0] if rows else self.archive.sealed_position()
        return sealed, [segment_of(row[1:]) for row in rows] if sealed < first else []

    def _unreadable(self, first: int, last: int, damage: DatabaseDamaged) -> ChainBroken:
        """The first segment between two positions that PostgreSQL cannot read, by bisection."""
        while first < last:
            middle = (first + last) // 2
            try:
                self._fetched(*read_query(first, middle, Filter(with_hollow=True), middle - first + 1))
            except DatabaseDamaged as error:
                last, damage = middle, error
            else:
                first = middle + 1
        return ChainBroken(UNKNOWN, Position(first), 0, str(damage))

    def head(self) -> int:
        """Position of the newest segment; 0 for an empty log."""
        return int(self._value("select position from log_head"))

    def streams(self) -> list[StreamHead]:
        """The heads of all streams, by name."""
        return self.heads()[1]

    def lives(self, stream: StreamName) -> list[StreamHead]:
        """Where each life of the stream stands that holds events, oldest first: a restored log has several."""
        return [head for head in self.streams() if head.stream == stream and head.sequence]

    def heads(self, station: Station | None = None) -> tuple[int, list[StreamHead]]:
        """The log's head and those of all streams by name, or of a station's, as they stood at one moment."""
        rows = self._rows(
            "select h.position, s.station, s.source, s.type, s.epoch, s.sequence, s.chain_hash "
            "from log_head h left join streams s on %(station)s::text is null or s.station = %(station)s "
            "order by s.station, s.source, s.type, s.epoch",
            {"station": station},
        )
        heads = [StreamHead(StreamName(*row[1:4]), *row[4:]) for row in rows if row[1] is not None]
        return rows[0][0], heads

    def stream_head(
        self, stream: StreamName, *, epoch: int | None = None, at_position: int | None = None
    ) -> StreamHead:
        """Where a stream stands, or stood when the log was at a position; sequence 0 if it is not there."""
        wanted = self.epoch if epoch is None else epoch
        rows = self._rows(*head_query(stream, wanted, at_position))
        sequence, chain_hash = rows[0] if rows else (0, bytes(32))
        # Asked after the segments: what is not sealed by now was there to be found. In a stream with gaps what came
        # later may lie below what is sealed.
        if at_position is not None and (end := self.archive.end_at((stream, wanted), at_position)):
            sequence, chain_hash = max((sequence, chain_hash), (end.sequence, end.chain_hash))
        return StreamHead(stream, wanted, sequence, chain_hash)

    def runs(self, stream: StreamName, epoch: int | None = None) -> list[Run]:
        """What is here of the stream, in this log's own epoch by default: its runs, ascending."""
        wanted = {**stream_names(stream), "epoch": self.epoch if epoch is None else epoch}
        rows = self._rows(RUNS, wanted)
        return runs_of(rows[0][0], rows[0][1], [row[2:] for row in rows]) if rows else []

    def some_runs(self, places: Collection[Place]) -> dict[Place, list[Run]]:
        """What is here of these streams, in one round trip: their runs, ascending; one without events is left out."""
        streams = [stream for stream, _ in places]
        wanted = {
            "stations": [stream.station for stream in streams],
            "sources": [stream.source for stream in streams],
            "types": [stream.type for stream in streams],
            "epochs": [epoch for _, epoch in places],
        }
        return all_runs_of(self._rows(SOME_RUNS, wanted))

    def all_runs(self, *, station: str | None = None) -> dict[Place, list[Run]]:
        """What is here of all streams, or one station's, that hold events: their runs, ascending."""
        return all_runs_of(self._rows(ALL_RUNS, {"station": station}))

    def standing(self) -> Standing:
        """Position, heads, runs and bases, as they stood at one moment."""
        return standing_of(self._rows(STANDING))

    def bases(self, first: int = 1, last: int = _SEQUENCE_MAX) -> list[Base]:
        """Where runs were begun without what comes before them, by the segments between two positions, in order."""
        return [base_of(row) for row in self._rows(BASES, {"first": first, "last": last})]

    def checkpoint(self, name: str) -> Checkpoint:
        """A subscriber's checkpoint; position 0 where there is none."""
        rows = self._rows("select position, state from checkpoints where name = %s", (name,))
        return Checkpoint(*rows[0]) if rows else Checkpoint(0, b"")

    def checkpoints(self) -> dict[str, Checkpoint]:
        """The checkpoints of all subscribers by name."""
        rows = self._rows("select name, position, state from checkpoints order by name")
        return {name: Checkpoint(position, state) for name, position, state in rows}

    def with_retry(self, action: Callable[[], T]) -> T:
        """The action's result; once more after reviving the database if it was away."""
        try:
            return action()
        except LogUnavailable:
            self.revive()
            return action()

    def _take(self) -> psycopg.Connection[Any]:
        """A connection of the pool that answers; those that died with the server are thrown away."""
        while True:
            try:
                connection = self._pool.getconn(timeout=_PATIENCE_SECONDS)
            except PoolTimeout:
                self._knock()
                connection = self._pool.getconn()
            if not _has_been_told(connection):
                return connection
            try:
                ConnectionPool.check_connection(connection)
            except psycopg.OperationalError:
                self._pool.putconn(connection)
                self._knock()
            else:
                return connection

    def _knock(self) -> None:
        """Ask the database itself why there is no connection: return if it is there.

        Raises:
            OperationalError: The database is away; the pool would keep its reason to itself.
            LogUnavailable: The role may not write.
        """
        with psycopg.connect(self.dsn, connect_timeout=int(_CONNECT_SECONDS)) as connection:
            try:
                self._configure(connection)
            except psycopg.errors.InsufficientPrivilege as error:
                raise LogUnavailable(
                    f"{safe_dsn(self.dsn)}: {error}. Next: as the database's owner, grant {self._role} to this role"
                ) from error

    def _fetched(self, query: str, parameters: Mapping[str, Any]) -> list[tuple[Any, ...]]:
        """The rows that a query finds; None for a time that Python does not know."""
        with self.connection() as connection:
            return _fetched(connection, query, parameters)

    def _value(self, query: str) -> Any:
        return self._rows(query)[0][0]

    def _rows(self, query: str, parameters: Sequence[Any] | Mapping[str, Any] | None = None) -> list[tuple[Any, ...]]:
        with self.connection() as connection:
            return connection.execute(query, parameters, binary=True).fetchall()

    def _configure(self, connection: psycopg.Connection[Any]) -> None:
        connection.autocommit = True
        connection.execute("set timezone to 'UTC'")
        connection.execute(psycopg.sql.SQL("set role {}").format(psycopg.sql.Identifier(self._role)))


def _damaged(error: psycopg.InternalError) -> Exception:
    """Our error for what PostgreSQL says of damaged files; any other is a defect and stays what it is."""
    if not (error.sqlstate or "").startswith("XX"):
        return error
    return DatabaseDamaged(
        f"PostgreSQL finds its files damaged: {error}. Next: keep them as they are, and restore a backup elsewhere"
    )


def _append(
    connection: psycopg.Connection[Any],
    epoch: int,
    drafts: Sequence[Draft],
    expected: Sequence[int | None] | None,
    epochs: Sequence[int] | None,
    chain_hashes: Sequence[bytes] | None,
    bases: Sequence[bytes | None] | None,
    *,
    sealed_is_compared: bool = False,
) -> list[Appended]:
    if not drafts:
        return []
    lists = (("expected", expected), ("epochs", epochs), ("chain_hashes", chain_hashes), ("bases", bases))
    for name, given in lists:
        if given is not None and len(given) != len(drafts):
            raise BadRequest(f"{name} must have one entry a draft: got {len(given)} for {len(drafts)} drafts")
    for draft, sequence in zip(drafts, expected or (), strict=False):
        if sequence is not None:
            check_not_negative(f"{draft.stream}: expected", sequence)
    for draft, base in zip(drafts, bases or (), strict=False):
        if base is not None and len(base) != len(GENESIS):
            raise BadRequest(f"{draft.stream}: a base is a chain hash of {len(GENESIS)} bytes, got {len(base)}")
    count = len(drafts)
    parameters = append_parameters(
        drafts, expected or [None] * count, epochs or [epoch] * count, chain_hashes or [None] * count
    )
    begun = list(bases) if bases is not None and any(bases) else None
    try:
        row = connection.execute(APPEND, [*parameters, sealed_is_compared, begun], prepare=True, binary=True).fetchone()
    except psycopg.Error as error:
        raise append_error(error, drafts, expected) from error
    assert row is not None, "the function answers in one row"
    return append_answer(row)


def _fetched(connection: psycopg.Connection[Any], query: str, parameters: Mapping[str, Any]) -> list[tuple[Any, ...]]:
    try:
        return connection.execute(query, parameters, binary=True).fetchall()
    except psycopg.DataError:
        cursor = connection.cursor(binary=True)
        cursor.adapters.register_loader("timestamptz", TimeOrNone)
        return cursor.execute(query, parameters).fetchall()


@contextmanager
def _left_clean(connection: psycopg.Connection[Any]) -> Iterator[None]:
    """Close the connection if an interrupt leaves a command running on it: it cannot be rolled back."""
    try:
        yield
    except BaseException:
        if connection.info.transaction_status == psycopg.pq.TransactionStatus.ACTIVE:
            connection.close()
        raise


def _has_been_told(connection: psycopg.Connection[Any]) -> bool:
    """Whether the server has said something unasked: that it ends, most often. No round trip."""
    listening = select.poll()
    listening.register(connection.fileno(), select.POLLIN)
    return bool(listening.poll(0))


def open_log(*, data_dir: Path | None = None, dsn: str | None = None, catalogue: Catalogue | None = None) -> Log:
    """A handle on the log in `data_dir` (embedded PostgreSQL) or at `dsn` (external), migrated if need be.

    Raises:
        BadRequest: Not exactly one of the two was given.
        LogUnavailable: The database cannot be started or reached.
        SchemaMismatch: The database was migrated by a newer ViAn.
    """
    if (data_dir is None) == (dsn is None):
        raise BadRequest("open_log takes either data_dir or dsn, got " + ("both" if data_dir else "neither"))
    known = catalogue or load_catalogue()
    if dsn is not None:
        return _opened(dsn, known, None)
    assert data_dir is not None
    server = EmbeddedServer(data_dir.expanduser().resolve())
    try:
        return _opened(server.dsn, known, server)
    except BaseException:
        server.close()
        raise


def _opened(dsn: str, catalogue: Catalogue, server: EmbeddedServer | None) -> Log:
    types: Iterable[type[EventType]] = catalogue
    migrate(dsn, types)
    return Log(dsn, catalogue, server)
