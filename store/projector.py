"""The row projector: segments in, typed rows out, for psql and every SQL tool.

Contract: a subscriber whose rows and checkpoint commit together, so each event has exactly one row
whatever is killed when. Rows appear in order of position. A segment of an unknown version has no rows
until a ViAn that knows it opens the log, nor has one with a value that PostgreSQL cannot hold; it is
counted and named, never a reason to stop the others.

A type may be behind the others: its table is new, has new columns, or is being rebuilt. Then the
checkpoint `projector:<type>` says how far it has come. Each step brings it a little closer, beside the
others' newest events, until it joins them and its checkpoint goes.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

import psycopg

from events import CorruptSegment, EventType, Segment, UnknownType, decode
from store.errors import BadRequest, TableBusy
from store.log import Log, Transaction
from store.reading import Filter
from store.rows import Part, RowFormat, days_of
from store.subscription import DELIVERY_SEGMENTS, Delivery, Subscription

NAME = "projector"
BEHIND = f"{NAME}:"
"""Begins the name of the checkpoint of a type that is behind the others."""
BEHIND_POSITIONS = 20_000
"""Most positions that one step of a type that is behind passes over."""

COPY_EVENTS = 50_000
"""Events at which a transaction takes no further segment, so that a long delivery needs no more memory."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Table:
    """What the database says of one row table."""

    version: int
    retained_from: date | None
    behind: int | None
    """position up to which its rows are there, or None if it moves with the others"""


class Projector:
    """Keeps the row tables up with the log."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._subscription = Subscription(log, NAME)
        self._formats: dict[type[EventType], RowFormat] = {}
        self._partitions: set[tuple[str, date]] = set()
        """Partitions that were there when this projector last looked; one may have been dropped since."""
        self._behind = self._read_behind()
        self.segments_skipped = 0
        """Segments without rows: of a type or version unknown here, or with what PostgreSQL cannot hold."""

    @property
    def position(self) -> int:
        """Position up to which all row tables are complete."""
        return min([self._subscription.position, *self._behind.values()])

    @property
    def behind(self) -> Mapping[str, int]:
        """The types that are being caught up apart from the others, and the position of each."""
        return dict(self._behind)

    def step(self, timeout_s: float = 0.0) -> Delivery:
        """Project the next segments, waiting up to `timeout_s` seconds for some.

        Raises:
            LogUnavailable: The database is away; nothing is lost, step again later.
            CorruptSegment: A stored segment does not decode; `vian verify` tells more.
        """
        self._log.room.require()
        before = self._subscription.position
        delivery = self._subscription.poll(0.0 if self._behind else timeout_s)
        try:
            delivery = self._store(delivery, before)
        except BaseException:
            self._subscription.position = before
            raise
        self._behind = self._read_behind()
        if self._behind:
            self.step_behind(min(self._behind, key=self._behind.__getitem__))
        return replace(delivery, is_caught_up=delivery.is_caught_up and not self._behind)

    def step_behind(self, type_name: str) -> bool:
        """Bring one type that is behind a little closer to the others; whether it has joined them.

        Raises:
            LogUnavailable: The database is away; nothing is lost, step again later.
            CorruptSegment: A stored segment does not decode; `vian verify` tells more.
        """
        begun = self._log.checkpoint(BEHIND + type_name).position
        others = self._log.checkpoint(NAME).position
        end = min(others, begun + BEHIND_POSITIONS)
        found = self._page(type_name, begun + 1, end)
        whole = Delivery(found, end if len(found) < DELIVERY_SEGMENTS else found[-1].position, is_caught_up=False)
        segments, reached = next(iter(_shares(whole, begun)), ([], begun))
        is_last = reached == others
        by_type, skipped = self._decoded(segments)
        with self._log.transaction() as transaction:
            _commit_lazily(transaction)
            if is_last and transaction.checkpoint(NAME).position != others:
                is_last = False  # more came meanwhile: they are for the next step
            row = transaction.connection.execute(
                "select position from checkpoints where name = %s for update", (BEHIND + type_name,)
            ).fetchone()
            if row is None or row[0] != begun:
                is_last = row is None  # another projector was faster
            else:
                skipped += self._copy_all(transaction, by_type, _tables(transaction.connection), {type_name})
                _move_behind(transaction, type_name, None if is_last else reached)
                self.segments_skipped += skipped
        self._behind = self._read_behind()
        return is_last

    def catch_up(self) -> int:
        """Project all that is there now; the position reached."""
        while not self.step().is_caught_up:
            pass
        return self.position

    def rebuild(self, type_name: str, retained_from: date | None = None) -> None:
        """Empty a type's table, and have the steps that follow fill it from the log.

        Args:
            type_name: The event type.
            retained_from: The first day (UTC) whose rows are wanted; all by default.

        Raises:
            BadRequest: There is no row table of this name.
            TableBusy: Queries that read the table kept it for too long.
        """
        with self._log.connection() as connection:
            try:
                connection.execute("select reset_projection(%s, %s)", (type_name, retained_from))
            except psycopg.errors.LockNotAvailable as error:
                raise TableBusy(
                    f"the row table {type_name} cannot be emptied while queries read it. "
                    "Next: end these queries, then give the command again"
                ) from error
            except psycopg.DatabaseError as error:
                if error.sqlstate != "VA005":
                    raise
                known = ", ".join(sorted(_tables(connection)))
                raise BadRequest(f"no row table {type_name!r}; known: {known}") from error
        self._partitions.clear()
        self._behind = self._read_behind()

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()

    def _read_behind(self) -> dict[str, int]:
        """The types of the catalogue that are behind; those that are not installed wait until they are."""
        with self._log.connection() as connection:
            rows = connection.execute(
                "select substr(name, %s), position from checkpoints where starts_with(name, %s)",
                (len(BEHIND) + 1, BEHIND),
            ).fetchall()
        return {name: position for name, position in rows if name in self._log.catalogue}

    def _page(self, type_name: str, first: int, last: int) -> list[Segment]:
        return self._log.page(first, last, Filter(types=[type_name]), DELIVERY_SEGMENTS) if first <= last else []

    def _store(self, delivery: Delivery, before: int) -> Delivery:
        """What was projected: the delivery, or nothing if another projector was faster."""
        for segments, reached in _shares(delivery, before):
            stored = self._store_share(segments, before, reached)
            if stored != reached:
                self._subscription.position = stored
                return Delivery([], stored, is_caught_up=False)
            before = reached
        return delivery

    def _store_share(self, segments: Sequence[Segment], before: int, reached: int) -> int:
        """Store rows and checkpoint; where the checkpoint stands, not at `reached` if another was faster."""
        by_type, skipped = self._decoded(segments)
        with self._log.transaction() as transaction:
            _commit_lazily(transaction)
            stored = transaction.checkpoint(NAME)
            if stored.position != before:
                return stored.position
            tables = _tables(transaction.connection)
            moving = {name for name, table in tables.items() if table.behind is None}
            skipped += self._copy_all(transaction, by_type, tables, moving)
            self._hold_unknown(transaction, segments, moving)
            transaction.save_checkpoint(NAME, reached)
        self.segments_skipped += skipped
        return reached

    def _hold_unknown(self, transaction: Transaction, segments: Iterable[Segment], moving: set[str]) -> None:
        """Have types with a table, but not installed here, wait at their first segment for who knows them."""
        firsts: dict[str, int] = {}
        for segment in segments:
            firsts.setdefault(segment.stream.type, segment.position)
        for name in firsts.keys() & moving:
            if name not in self._log.catalogue:
                transaction.save_checkpoint(BEHIND + name, firsts[name] - 1)

    def _decoded(self, segments: Iterable[Segment]) -> tuple[dict[type[EventType], list[Part]], int]:
        by_type: dict[type[EventType], list[Part]] = {}
        skipped = 0
        for segment in segments:
            try:
                batch = decode(segment, self._log.catalogue)
            except UnknownType as error:
                skipped += 1
                logger.warning("no rows for the segment at position %d: %s", segment.position, error)
                continue
            except CorruptSegment as error:
                raise CorruptSegment(f"position {segment.position}: {error}. Next: vian verify") from error
            by_type.setdefault(batch.type, []).append(Part(segment, batch))
        return by_type, skipped

    def _copy_all(
        self,
        transaction: Transaction,
        by_type: Mapping[type[EventType], list[Part]],
        tables: Mapping[str, _Table],
        wanted: set[str],
    ) -> int:
        """Copy the wanted types' parts, and say how many of them have no rows."""
        skipped = 0
        for event_type, parts in by_type.items():
            if event_type.type_name not in wanted:
                continue
            table = tables[event_type.type_name]
            if table.version > self._log.catalogue.newest(event_type.type_name).version:
                skipped += len(parts)
                logger.warning(
                    "no rows for the segment at position %d: the table is of version %d, newer than known here. "
                    "Next: upgrade ViAn or the type's plug-in",
                    parts[0].segment.position,
                    table.version,
                )
                continue
            kept = [part for part in parts if _is_retained(part, table.retained_from)]
            if kept:
                skipped += self._copy_what_fits(transaction.connection, kept, table.retained_from)
        return skipped

    def _copy_what_fits(
        self, connection: psycopg.Connection[Any], parts: Sequence[Part], retained_from: date | None
    ) -> int:
        """Copy the parts, and say how many of them PostgreSQL refuses.

        It holds less than a segment does: a number beyond `numeric` in JSON, a nesting too deep.
        """
        try:
            with connection.transaction():
                self._copy(connection, parts, retained_from)
        except psycopg.errors.CheckViolation:
            # A day's partition that was there has been dropped since: make it again.
            self._partitions.clear()
            with connection.transaction():
                self._copy(connection, parts, retained_from)
        except (psycopg.DataError, psycopg.errors.NotNullViolation) as error:
            if len(parts) > 1:
                return sum(self._copy_what_fits(connection, [part], retained_from) for part in parts)
            logger.warning("no rows for the segment at position %d: %s", parts[0].segment.position, error)
            return 1
        return 0

    def _copy(self, connection: psycopg.Connection[Any], parts: Sequence[Part], retained_from: date | None) -> None:
        event_type = parts[0].batch.type
        if event_type not in self._formats:
            self._formats[event_type] = RowFormat(event_type)
        row_format = self._formats[event_type]
        days = {(event_type.type_name, day) for part in parts for day in days_of(part)} - self._partitions
        for type_name, day in sorted(days):
            if retained_from is None or day >= retained_from:
                connection.execute("select ensure_partition(%s, %s)", (type_name, day))
        with connection.cursor().copy(row_format.statement) as copy:
            for data in row_format.copy_data(parts, retained_from):
                copy.write(data)
        self._partitions |= days


def _shares(delivery: Delivery, before: int) -> Iterator[tuple[list[Segment], int]]:
    """The delivery in shares for a transaction each, with the position that each reaches."""
    share: list[Segment] = []
    events = 0
    for segment in delivery.segments:
        share.append(segment)
        events += segment.header.event_count
        if events >= COPY_EVENTS:
            yield share, segment.position
            before = segment.position
            share, events = [], 0
    if delivery.position > before:
        yield share, delivery.position


def _commit_lazily(transaction: Transaction) -> None:
    """Do not wait for the disk: rows and checkpoint are lost together in a power cut, and made again."""
    transaction.connection.execute("set local synchronous_commit = off")


def _tables(connection: psycopg.Connection[Any]) -> dict[str, _Table]:
    rows = connection.execute(
        "select p.name, p.version, p.retained_from, c.position from projections p "
        "left join checkpoints c on c.name = %s || p.name",
        (BEHIND,),
    )
    return {name: _Table(*rest) for name, *rest in rows}


def _move_behind(transaction: Transaction, type_name: str, position: int | None) -> None:
    """Set how far a type that is behind has come; None lets it move with the others from now on."""
    if position is None:
        transaction.connection.execute("delete from checkpoints where name = %s", (BEHIND + type_name,))
    else:
        transaction.save_checkpoint(BEHIND + type_name, position)


def _is_retained(part: Part, retained_from: date | None) -> bool:
    return retained_from is None or max(days_of(part)) >= retained_from
