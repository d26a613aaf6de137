"""What goes when the station's disk is nearly full, in the order that the plan's `give_up` says.

Contract: first of all entries what central holds, which is no loss (`sync.keeping.pruning`), then what it lacks, the
first entry's first and the oldest of each first. What is given up is recorded as `loss_recorded`, with exact ranges,
in the transaction that takes it off, and reaches central as any event does. Only as much goes as recording needs:
PostgreSQL uses the room again but does not give it back to the disk, so what went is counted as credit
(`store.room`), and more goes when that is used up. With no policy, or with nothing left that may go, recording stops:
`Room.require` says so. A step does one bounded thing.
"""

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta

from events import LossRecorded, Station
from store import Log
from store.payloads import Freed, Weight, may_leave, reclaim, shrink, weights
from store.room import CREDIT
from sync.keeping.pruning import SEGMENTS_MAX, Proof, Span, bounded, spans_of, take_off_held, take_off_recorded
from sync.plans.plan import GiveUp

_ANY_TIME = datetime.max.replace(tzinfo=UTC)
_RESERVE_SHARE = 8
"""Credit that is kept ahead of recording: this part of what must stay free."""
_RESERVE_BYTES_MAX = 16 * 1024 * 1024
_LOOK_AGAIN = timedelta(seconds=60)
"""How long after nothing was found that may go it is looked for again: things grow old, and central catches up."""
_MIB = 2**20


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
        self._is_low = False
        self._search: Iterator[tuple[GiveUp, bool, list[Weight]]] | None = None
        self._searched_at: datetime | None = None
        """when nothing was left that may go"""

    def step(self, now: datetime) -> bool:
        """Do one bounded thing to make room, if there is less than must stay; whether there is more to do.

        Raises:
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
        if self._search is None:
            if self._searched_at is not None and now - self._searched_at < _LOOK_AGAIN:
                return False
            self._proof.look()
            self._search = self._lots(policy, now)
        found = next(self._search, None)
        if found is None:
            self._search, self._searched_at = None, now
            return False
        entry, is_held, lot = found
        if lot and entry in policy:  # the plan may have changed since
            self._take(entry, is_held, lot, now)
            reclaim(self._log)
            shrink(self._log)  # what took it off stands in PostgreSQL's own log, and that takes room, too
        return True

    def _take(self, entry: GiveUp, is_held: bool, lot: list[Weight], now: datetime) -> Freed:
        credit = self._log.room.credit()
        if is_held:
            return take_off_held(self._log, self._station, lot, self._proof.held, now, credit=credit)
        free = self._log.room.free() or 0
        events = [_loss(span, entry, free, self._log.room.bytes_min, now) for span in spans_of(lot)]
        return take_off_recorded(self._log, self._station, lot, events, credit=credit)

    def _lots(self, policy: Sequence[GiveUp], now: datetime) -> Iterator[tuple[GiveUp, bool, list[Weight]]]:
        """All that may go, in order and in bounded lots, with its entry and whether central holds it.

        A lot may be empty, so that no step looks through more than a page.
        """
        for is_held in (True, False):
            for entry in policy:
                at = 0
                while page := weights(self._log, at, _ANY_TIME, SEGMENTS_MAX):
                    chosen = [each for each in page if self._may_go(each, entry, is_held, now)]
                    lot = bounded(chosen)
                    at = lot[-1].position if len(lot) < len(chosen) else page[-1].position
                    yield entry, is_held, lot

    def _may_go(self, each: Weight, entry: GiveUp, is_held: bool, now: datetime) -> bool:
        # A loss names no epoch, so of an earlier life of the log only what central holds may go.
        is_known = is_held or each.epoch == self._log.epoch
        is_old = each.time_max < now - entry.older_than
        is_meant = entry.fits(each.stream) and may_leave(each.stream)
        return is_known and is_old and is_meant and self._proof.held.holds(each) == is_held


def _loss(span: Span, entry: GiveUp, free: int, bytes_min: int, now: datetime) -> LossRecorded:
    return LossRecorded(
        time=now,
        stream=str(span.stream),
        what="segments",
        count=span.segments,
        first_sequence=span.first_sequence,
        last_sequence=span.last_sequence,
        lost_from_at=span.time_min,
        lost_until_at=span.time_max,
        reason=f"the disk had {free // _MIB} MiB free, {bytes_min // _MIB} MiB must stay free, and central lacks them",
        policy=f"give_up: {entry.stream}, older than {entry.older_than.total_seconds():.0f} s",
    )
