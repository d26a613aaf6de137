"""What goes when the station's disk is nearly full, in the order that the plan's `give_up` says.

Contract: first of all entries what central holds, which is no loss (`sync.keeping.pruning`), then what it lacks, the
first entry's first and the oldest of each first; last of all, in the same order, what a derived stream still waits
for. What is given up is recorded as `loss_recorded`, with exact ranges, in the transaction that takes it off, and
reaches central as any event does. Only as much goes as recording needs: PostgreSQL uses the room again but does not
give it back to the disk, so what went is counted as credit (`store.room`), and more goes when that is used up. Sealed
files on the same disk are written anew, which does give room back. With no policy, or with nothing left that may go,
recording stops: `Room.require` says so. A step does one bounded thing.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import product
from pathlib import Path

from events import EventType, LossRecorded, Station
from store import Log, Transaction
from store.payloads import Freed, Weight, may_leave, reclaim, shrink, weights
from store.resealing import Resealer, streams_of
from store.room import CREDIT
from store.sealed import SealedFile
from sync.keeping.pruning import (
    ANY_TIME,
    SEGMENTS_MAX,
    Proof,
    Span,
    bounded,
    loss_of,
    pruned,
    record_of,
    spans_of,
    take_off_recorded,
)
from sync.plans.awaiting import Awaited, awaited
from sync.plans.plan import GiveUp

_RESERVE_SHARE = 8
"""Credit that is kept ahead of recording: this part of what must stay free."""
_RESERVE_BYTES_MAX = 16 * 1024 * 1024
_LOOK_AGAIN = timedelta(seconds=60)
"""How long after nothing was found that may go it is looked for again: things grow old, and central catches up."""
_LOOK_AGAIN_SEALED = timedelta(hours=1)
"""The same for a sealed file, which must be read for that."""
_MIB = 2**20


@dataclass(frozen=True, slots=True)
class _Kind:
    """Which segments go in one pass over the policy."""

    is_awaited: bool
    """a derived stream waits for them"""
    is_held: bool
    """central holds them"""


_KINDS = [_Kind(*each) for each in product((False, True), (True, False))]


@dataclass(frozen=True, slots=True)
class _Lot:
    """What goes in one step."""

    entry: GiveUp
    kind: _Kind
    weights: Sequence[Weight]
    file: SealedFile | None = None
    """the sealed file that it lies in; None: PostgreSQL"""


class DiskWatch:
    """Makes room on a station's disk when it is nearly full. Not for several threads at once."""

    def __init__(self, log: Log, station: Station, policy: Callable[[], Sequence[GiveUp]], proof: Proof) -> None:
        """Build a watch over the disk of `log.room`.

        Args:
            log: The station's log.
            station: Whose log it is.
            policy: What may go at this moment, the first first.
            proof: What central holds.
        """
        self._log = log
        self._station = station
        self._policy = policy
        self._proof = proof
        self._awaited: Awaited = {}
        self._is_low = False
        self._search: Iterator[_Lot] | None = None
        self._searched_at: datetime | None = None
        """when nothing was left that may go"""
        self._in_vain: dict[tuple[str, GiveUp, _Kind], datetime] = {}
        """when sealed files were read in vain, by path"""

    def step(self, now: datetime) -> bool:
        """Do one bounded thing to make room, if there is less than must stay; whether there is more to do.

        Raises:
            StoreError: A sealed file cannot be read, or written anew; the next search comes by again.
            PlanError: The log's plan does not read here.
            LogUnavailable: The database is away, or the account may not.
        """
        if not self._log.room.is_low():
            if self._is_low:
                self._settle()
            return False
        if not self._is_low:
            self._is_low = True
            shrink(self._log)  # PostgreSQL may keep more of its own log than it needs: that goes first
            return True
        return self._log.room.credit() < self._reserve() and self._give_up(now)

    def _settle(self) -> None:
        """There is room again: what was taken off is no longer counted."""
        position = self._log.head()
        with self._log.transaction() as transaction:
            transaction.save_checkpoint(CREDIT, position)
        self._is_low, self._search, self._searched_at = False, None, None

    def _reserve(self) -> int:
        return min(_RESERVE_BYTES_MAX, self._log.room.bytes_min // _RESERVE_SHARE)

    def _give_up(self, now: datetime) -> bool:
        """Take off the next lot; whether there may be another."""
        policy = self._policy()
        if self._search is None and self._searched_at is not None and now - self._searched_at < _LOOK_AGAIN:
            return False
        if self._proof.look():
            self._search = None  # a search may last for days, and central may have lost meanwhile what it held
        if self._search is None:
            self._awaited = awaited(self._log, self._station)
            self._search = self._lots(policy, now)
        found = next(self._search, None)
        if found is None:
            self._search, self._searched_at = None, now
            return False
        if found.weights and found.entry in policy:  # the plan may have changed since
            self._take(found, now)
            shrink(self._log)  # what took it off stands in PostgreSQL's own log, and that takes room, too
        return True

    def _take(self, lot: _Lot, now: datetime) -> None:
        events = self._events(lot, now)
        if lot.file is None:
            take_off_recorded(self._log, self._station, lot.weights, events, credit=self._log.room.credit())
            reclaim(self._log)
            return

        def record(transaction: Transaction, _: Freed) -> None:
            transaction.append([record_of(self._station, events)], from_reserve=True)

        Resealer(self._log, lot.file).take_off({each.position for each in lot.weights}, record)

    def _events(self, lot: _Lot, now: datetime) -> Sequence[EventType]:
        """What is said of a lot."""
        if lot.kind.is_held:
            return pruned(lot.weights, self._proof.held, now)
        return [self._loss(span, lot, now) for span in spans_of(lot.weights)]

    def _loss(self, span: Span, lot: _Lot, now: datetime) -> LossRecorded:
        free, least = (self._log.room.free() or 0) // _MIB, self._log.room.bytes_min // _MIB
        reason = f"the disk had {free} MiB free, {least} MiB must stay free, and central lacks them"
        if lot.kind.is_awaited:
            reason += f"; {self._awaited[span.stream].stream} had not been derived from them"
        policy = f"give_up: {lot.entry.stream}, older than {lot.entry.older_than.total_seconds():.0f} s"
        return loss_of(span, now, reason, policy)

    def _lots(self, policy: Sequence[GiveUp], now: datetime) -> Iterator[_Lot]:
        """All that may go, in order and in bounded lots; one may be empty, so that no step looks through more."""
        for kind, entry in product(_KINDS, policy):
            yield from self._sealed_lots(entry, kind, now)  # the oldest are there
            at = 0
            while page := weights(self._log, at, ANY_TIME, SEGMENTS_MAX):
                chosen = [each for each in page if self._may_go(each, entry, kind, now)]
                lot = bounded(chosen)
                at = lot[-1].position if len(lot) < len(chosen) else page[-1].position
                yield _Lot(entry, kind, lot)

    def _sealed_lots(self, entry: GiveUp, kind: _Kind, now: datetime) -> Iterator[_Lot]:
        """What may go of each sealed file on the log's disk, the oldest file first."""
        files = self._log.archive.files()
        if not files or not self._gains_by_archive():
            return
        for file in files:
            read_at = self._in_vain.get((file.path, entry, kind))
            if read_at is not None and now - read_at < _LOOK_AGAIN_SEALED:
                continue
            chosen = self._of_file(file, entry, kind, now)
            if not chosen:
                self._in_vain[file.path, entry, kind] = now
            yield _Lot(entry, kind, chosen, file)

    def _gains_by_archive(self) -> bool:
        place = self._log.archive.place()
        return place.is_local and self._log.room.gains_by(Path(place.full("")))

    def _of_file(self, file: SealedFile, entry: GiveUp, kind: _Kind, now: datetime) -> list[Weight]:
        """What may go of a sealed file; nothing where there is no room to write what stays anew."""
        streams = {each.stream for each in streams_of(self._log, file)}
        if not any(entry.fits(stream) and may_leave(stream) for stream in streams):
            return []
        chosen = [each for each in Resealer(self._log, file).weights() if self._may_go(each, entry, kind, now)]
        stays = file.bytes - sum(each.payload_bytes for each in chosen)
        return chosen if stays <= (self._log.room.free() or 0) // 2 else []

    def _may_go(self, each: Weight, entry: GiveUp, kind: _Kind, now: datetime) -> bool:
        # A loss names no epoch, so of an earlier life of the log only what central holds may go.
        is_known = kind.is_held or each.epoch == self._log.epoch
        is_old = each.time_max < now - entry.older_than
        is_meant = entry.fits(each.stream) and may_leave(each.stream)
        return is_known and is_old and is_meant and self._kind_of(each) == kind

    def _kind_of(self, each: Weight) -> _Kind:
        waiting = self._awaited.get(each.stream)
        is_awaited = waiting is not None and waiting.wants(each.position, each.time_max)
        return _Kind(is_awaited, self._proof.held.holds(each))
