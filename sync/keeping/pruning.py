"""Pruning: payloads that central holds, as its signature proves, leave the station's disk when they are old.

Contract: only what lies below the newest checkpoint that central countersigned, and only where that says of the
stream the very chain hash that this log has there. What a derived stream still waits for stays. What goes is recorded
as `segments_pruned` in the transaction that takes it off; a sealed file is written anew without it
(`store.resealing`). Streams that prove the log, or that programs read back, stay (`store.payloads.may_leave`). A step
does one bounded thing; killed between any two, nothing is doubled and nothing goes unrecorded.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from hashlib import sha256

from events import (
    CheckpointCountersigned,
    Draft,
    EventType,
    LossRecorded,
    Producer,
    SegmentsPruned,
    Station,
    StreamName,
    batch_of,
    decode,
    encode,
    events_of,
)
from store import Log, StreamHead, Transaction
from store.payloads import Freed, Weight, may_leave, reclaim, take_off, weights
from store.resealing import Resealer, streams_of
from store.room import CREDIT, credit_state
from store.sealed import SealedFile
from sync.keeping.countersigned import Held, held_in
from sync.keeping.countersigning import VOID
from sync.plans.awaiting import Awaited, awaited

SOURCE = "sync"
PRODUCER = Producer("pruner", "1", sha256(b"{}").digest())
ANY_TIME = datetime.max.replace(tzinfo=UTC)
SEGMENTS_MAX = 500
"""Most segments that one step takes off."""
BYTES_MAX = 16 * 1024 * 1024
"""Most bytes of payload that one step takes off, but for a single larger one."""
SHARE_MIN = 0.25
"""A sealed file is written anew when at least this share of its payloads can go."""
RECLAIM_BYTES = 128 * 1024 * 1024
"""Bytes taken off after which the log is let use their room, if there is more to come; it costs a pass over indexes."""

Place = tuple[StreamName, int]
"""A stream and its epoch."""
IsSigned = Callable[[CheckpointCountersigned], bool]
"""Whether central's signature of a countersigned checkpoint holds."""


@dataclass(frozen=True, slots=True)
class Proven:
    """From where to where central holds the station's streams, as it signed."""

    statement_hash: str
    ranges: Mapping[Place, Held]

    def holds(self, weight: Weight) -> bool:
        """Whether central holds the segment."""
        held = self.ranges.get((weight.stream, weight.epoch))
        return held is not None and held.holds(weight.first_sequence, weight.last_sequence)


NOTHING_PROVEN = Proven("", {})


@dataclass(frozen=True, slots=True)
class Span:
    """Segments of one stream, each following the one before."""

    stream: StreamName
    epoch: int
    first_sequence: int
    last_sequence: int
    segments: int
    payload_bytes: int
    time_min: datetime
    time_max: datetime


def spans_of(chosen: Iterable[Weight]) -> list[Span]:
    """The segments, which come in the order of their streams, as ranges; by stream, epoch and sequence."""
    spans: list[Span] = []
    for each in sorted(chosen, key=lambda one: (one.stream, one.epoch, one.first_sequence)):
        one = Span(each.stream, each.epoch, each.first_sequence, each.last_sequence, 1, each.payload_bytes,
                   each.time_min, each.time_max)  # fmt: skip
        if spans and _follows(spans[-1], one):
            one = _joined(spans.pop(), one)
        spans.append(one)
    return spans


def loss_of(span: Span, now: datetime, reason: str, policy: str | None) -> LossRecorded:
    """The event that says that the span's payloads are lost."""
    return LossRecorded(
        time=now,
        stream=str(span.stream),
        what="segments",
        count=span.segments,
        first_sequence=span.first_sequence,
        last_sequence=span.last_sequence,
        lost_from_at=span.time_min,
        lost_until_at=span.time_max,
        reason=reason,
        policy=policy,
    )


def _follows(before: Span, span: Span) -> bool:
    same = (before.stream, before.epoch) == (span.stream, span.epoch)
    return same and before.last_sequence + 1 == span.first_sequence


def _joined(before: Span, span: Span) -> Span:
    return Span(
        before.stream,
        before.epoch,
        before.first_sequence,
        span.last_sequence,
        before.segments + span.segments,
        before.payload_bytes + span.payload_bytes,
        min(before.time_min, span.time_min),
        max(before.time_max, span.time_max),
    )


class Proof:
    """The newest countersigned checkpoint in the station's log, and what it proves of what central holds.

    A checkpoint whose signature does not hold proves nothing, nor does a head with another chain hash than this
    log has there, nor what central signed before it lost some of it, as its cursors said
    (`sync.keeping.countersigning`).
    """

    def __init__(self, log: Log, station: Station, is_signed: IsSigned) -> None:
        self._log = log
        self._stream = StreamName.of(station, SOURCE, CheckpointCountersigned.type_name)
        self._is_signed = is_signed
        self._seen: tuple[StreamHead, int] | None = None
        self.held = NOTHING_PROVEN

    def look(self) -> bool:
        """Look for a newer checkpoint; whether there is one.

        Raises:
            EventError: It cannot be read.
            LogUnavailable: The database is away.
        """
        newest = next(iter(self._log.lives(self._stream)[-1:]), None)
        if newest is None:
            return False
        seen = newest, self._log.checkpoint(VOID).position
        if seen == self._seen:
            return False
        self.held = NOTHING_PROVEN
        (segment,) = self._log.read(newest.stream, newest.sequence, epoch=newest.epoch)
        event = events_of(decode(segment, self._log.catalogue))[-1]
        is_ours = isinstance(event, CheckpointCountersigned) and event.of_station == self._stream.station
        counts = segment.position > seen[1]  # else central lost, since it signed, what it held then
        if isinstance(event, CheckpointCountersigned) and is_ours and counts and self._is_signed(event):
            self.held = Proven(event.statement_hash, dict(_agreed(self._log, event)))
        self._seen = seen
        return True


def _agreed(log: Log, event: CheckpointCountersigned) -> Iterator[tuple[Place, Held]]:
    """What is signed of streams whose chain hash this log has, too, at the head."""
    for held in held_in(event.held):
        head = held.head
        segment = next(log.read(head.stream, head.sequence, epoch=head.epoch, with_hollow=True), None)
        if segment and (segment.header.last_sequence, segment.chain_hash) == (head.sequence, head.chain_hash):
            yield (head.stream, head.epoch), held


@dataclass(frozen=True, slots=True)
class _Pending:
    """A sealed file that is still to be looked at below the newest checkpoint."""

    file: SealedFile
    may_go: frozenset[tuple[Place, int]]
    """which of its streams could go, and behind which sequence"""


class Pruner:
    """Takes payloads off a station's log that central holds and that are old. Not for several threads at once."""

    def __init__(self, log: Log, station: Station, after: timedelta, is_signed: IsSigned) -> None:
        """Build a pruner.

        Args:
            log: The station's log.
            station: Whose log it is.
            after: How long ago a segment was recorded that may go.
            is_signed: Checks central's signature.
        """
        self._log = log
        self._station = station
        self._after = after
        self._proof = Proof(log, station, is_signed)
        self._awaited: Awaited = {}
        self._position = 0
        self._to_reclaim = 0
        self._files: list[_Pending] = []
        self._files_seen: dict[int, frozenset[tuple[Place, int]]] = {}
        """what could go of each sealed file when it was looked at last, by the file's first position"""

    def step(self, now: datetime) -> bool:
        """Take off a bounded lot of what may go; whether there may be more.

        Raises:
            StoreError: A sealed file cannot be written anew; the others are.
            PlanError: The log's plan does not read here.
            LogUnavailable: The database is away, or the account may not.
        """
        lot = self._next(now)
        if lot is None:
            self._reclaim()
            return self._prune_sealed(now)
        if lot:
            self._to_reclaim += take_off_held(self._log, self._station, lot, self._proof.held, now).payload_bytes
        if self._to_reclaim >= RECLAIM_BYTES:
            self._reclaim()
        return True

    def outlook(self, now: datetime) -> list[Span]:
        """What would go now."""
        position, chosen = self._position, []
        self._position = 0
        while (lot := self._next(now)) is not None:
            chosen += lot
        self._position = position
        for pending in self._files:
            chosen += self._chosen(Resealer(self._log, pending.file).weights())
        return spans_of(chosen)

    def _next(self, now: datetime) -> list[Weight] | None:
        """The next lot, which may be empty; None where nothing is left for now."""
        self._awaited = awaited(self._log, self._station)
        if self._proof.look():
            self._position = 0
            self._files = list(self._old_files(now))
        page = weights(self._log, self._position, now - self._after, SEGMENTS_MAX) if self._proof.held.ranges else []
        if not page:
            return None
        chosen = self._chosen(page)
        lot = bounded(chosen)
        self._position = lot[-1].position if len(lot) < len(chosen) else page[-1].position
        return lot

    def _prune_sealed(self, now: datetime) -> bool:
        """Take off the next sealed file what may go of it; whether there may be another."""
        if not self._files:
            return False
        pending = self._files.pop(0)
        try:
            self._prune_file(pending.file, now)
        except BaseException:
            self._files.append(pending)  # it is tried again, behind the others
            raise
        self._files_seen[pending.file.first_position] = pending.may_go
        return True

    def _prune_file(self, file: SealedFile, now: datetime) -> None:
        resealer = Resealer(self._log, file)
        held_here = resealer.weights()
        chosen = self._chosen(held_here)
        if chosen and _size(chosen) >= _size(held_here) * SHARE_MIN:
            events = pruned(chosen, self._proof.held, now)

            def record(transaction: Transaction, _: Freed) -> None:
                transaction.append([record_of(self._station, events)], from_reserve=True)

            resealer.take_off({each.position for each in chosen}, record)

    def _old_files(self, now: datetime) -> Iterator[_Pending]:
        """The sealed files that are old enough and of which more may go than when they were looked at last."""
        for file in self._log.archive.files() if self._proof.held.ranges else ():
            if file.sealed_at >= now - self._after:
                return
            may_go = frozenset(
                ((each.stream, each.epoch), held.after)
                for each in streams_of(self._log, file)
                if may_leave(each.stream)
                and (held := self._proof.held.ranges.get((each.stream, each.epoch))) is not None
                and held.after < each.last_sequence <= held.head.sequence
                and not self._is_awaited(each.stream, file.last_position)
            )
            if may_go - self._files_seen.get(file.first_position, frozenset()):
                yield _Pending(file, may_go)

    def _chosen(self, given: Iterable[Weight]) -> list[Weight]:
        return [
            each
            for each in given
            if may_leave(each.stream)
            and self._proof.held.holds(each)
            and not self._is_awaited(each.stream, each.position, each.time_max)
        ]

    def _is_awaited(self, stream: StreamName, position: int, time_max: datetime = ANY_TIME) -> bool:
        waiting = self._awaited.get(stream)
        return waiting is not None and waiting.wants(position, time_max)

    def _reclaim(self) -> None:
        if self._to_reclaim:
            reclaim(self._log)
            self._to_reclaim = 0


def _size(chosen: Iterable[Weight]) -> int:
    return sum(each.payload_bytes for each in chosen)


def bounded(chosen: Sequence[Weight]) -> list[Weight]:
    """The first of them that together have at most `BYTES_MAX`, one at least."""
    lot: list[Weight] = []
    size = 0
    for each in chosen:
        size += each.payload_bytes
        if lot and size > BYTES_MAX:
            break
        lot.append(each)
    return lot


def take_off_held(log: Log, station: Station, lot: Sequence[Weight], held: Proven, now: datetime) -> Freed:
    """Take off what central holds, and record it; see `take_off_recorded`."""
    return take_off_recorded(log, station, lot, pruned(lot, held, now))


def pruned(lot: Sequence[Weight], held: Proven, now: datetime) -> list[SegmentsPruned]:
    """What is said of a lot that goes because central holds it."""
    return [
        SegmentsPruned(
            time=now,
            stream=str(span.stream),
            stream_epoch=span.epoch,
            first_sequence=span.first_sequence,
            last_sequence=span.last_sequence,
            segments=span.segments,
            payload_bytes=span.payload_bytes,
            statement_hash=held.statement_hash,
        )
        for span in spans_of(lot)
    ]


def take_off_recorded(
    log: Log, station: Station, lot: Sequence[Weight], events: Sequence[EventType], *, credit: int | None = None
) -> Freed:
    """Take the lot off and record the events in one transaction; nothing of both where another was faster.

    Args:
        log: The log.
        station: Whose log it is.
        lot: What is to go.
        events: What is said of it.
        credit: Bytes that were taken off before and not used again, where these are counted (`store.room`).

    Raises:
        LogUnavailable: The database is away, or the account may not.
    """
    at = log.head()
    try:
        with log.transaction() as transaction:
            freed = take_off(transaction, [each.position for each in lot])
            if freed.segments != len(lot):
                raise _Overtaken
            if credit is not None:
                transaction.save_checkpoint(CREDIT, at, credit_state(credit + freed.payload_bytes))
            transaction.append([record_of(station, events)], from_reserve=True)
    except _Overtaken:
        return Freed(0, 0)
    return freed


class _Overtaken(Exception):
    """Another took some of it off meanwhile."""


def record_of(station: Station, events: Sequence[EventType]) -> Draft:
    """The events, all of one type, as a draft for the station's stream of such records."""
    return encode(StreamName.of(station, SOURCE, type(events[0]).type_name), batch_of(list(events)), PRODUCER)
