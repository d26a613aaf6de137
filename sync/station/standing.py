"""How the station's streams stand: here, by the plan, and at central as far as the station knows.

Contract: keeps what the log and central said last, and works out what waits; only streams of which something changed
are looked at again. It sends nothing. What was launched counts as held (`runs`) until it is in doubt; what
central has acknowledged (`acknowledged`) is kept beside it.
"""

from collections.abc import Iterable, Mapping, Sequence

from events import Station, StreamName
from store import Log, StreamHead
from store.reading import DERIVE
from sync.errors import PlanError, SegmentRefused, StreamStopped
from sync.plans.marks import mark_in
from sync.plans.plan import Entry, Plan
from sync.protocol.wire import STREAMS_MAX
from sync.runs import BEGINNING, Point, Runs, StreamKey, end_of, gaps_of, with_range
from sync.station.comparing import is_open
from sync.station.outbox import Filled, check_heads
from sync.station.scheduling import Planned, Work, mark_of, works_of
from sync.station.starting import Starts


class Standing:
    """The streams of one station."""

    def __init__(self, log: Log, station: Station) -> None:
        self._log = log
        self._station = station
        self._starts = Starts(log)
        self._plan: Plan | None = None
        self._entries: dict[StreamKey, Entry | None] = {}
        self._heads: dict[StreamKey, StreamHead] = {}
        self._planned: dict[StreamKey, Planned] = {}
        self._pending: dict[StreamKey, Planned] = {}
        self._marks: dict[StreamKey, Point] = {}
        self._settled: set[StreamKey] = set()
        """Derived streams of which it is known up to where they are backlog."""
        self._told_at = 0
        """Where the log stood when central last said what it holds, or the plan was taken up."""
        self._turns: dict[StreamKey, int] = {}
        self._turn = 0
        self._is_new = True
        self._log_head = 0
        self._unchecked: set[StreamKey] = set()
        self._trouble: StreamStopped | None = None
        self.runs: dict[StreamKey, Runs] | None = None
        """What central holds once all that was launched has landed; None while that is in doubt."""
        self.acknowledged: dict[StreamKey, Runs] | None = None
        """What central said that it holds; None before it said anything."""
        self.stopped: dict[StreamKey, StreamStopped] = {}
        """Streams that are not sent further until somebody does something."""
        self.apart: dict[StreamKey, StreamStopped] = {}
        """Streams of earlier epochs of which central holds another history: they stay here."""
        self.open: set[StreamKey] = set()
        """Streams of earlier epochs of which central holds more, so that only it can say whether of this history."""
        self.agreed: set[StreamKey] = set()
        """Those of them of which it did."""

    @property
    def planned(self) -> Mapping[StreamKey, Planned]:
        """The streams that the plan sends."""
        return self._planned

    def keys(self) -> list[StreamKey]:
        """The streams that the plan sends, by priority."""
        return sorted(self._planned, key=lambda key: (self._planned[key].entry.priority, key))

    def heads(self) -> list[StreamHead]:
        """Where the streams stand here that the plan sends."""
        return [self._heads[key] for key in self._planned]

    def here(self) -> Mapping[StreamKey, StreamHead]:
        """Where all of the station's streams stand here."""
        return self._heads

    def newest(self, stream: StreamName) -> tuple[int, int] | None:
        """Epoch and sequence of the stream's newest event here; None where it has none."""
        return max(
            ((key.epoch, head.sequence) for key, head in self._heads.items() if key.stream == stream), default=None
        )

    def follow(self, plan: Plan) -> None:
        """Work by this plan from now on; what central refused is tried again, for the plan may have made room."""
        self._plan = plan
        self.stopped = {key: error for key, error in self.stopped.items() if not isinstance(error, SegmentRefused)}
        self._entries.clear()
        self._planned.clear()
        self._pending.clear()
        self._unchecked.clear()
        self._forget_marks()
        self._look_at(self._heads.values())

    def look(self, log_head: int, heads: Iterable[StreamHead]) -> None:
        """Take in how the log stands: its head, and those of the station's streams.

        Raises:
            PlanError: The plan sends more streams than can be sent.
            LogUnavailable: The database is away.
        """
        self._log_head = log_head
        changed = []
        for head in heads:
            key = StreamKey(head.stream, head.epoch)
            if head.sequence and self._heads.get(key) != head:
                self._heads[key] = head
                changed.append(head)
        self._look_at(changed)

    def hear(self, held: dict[StreamKey, Runs]) -> None:
        """Take in what central says that it holds, of all streams."""
        self.acknowledged = held
        self.runs = dict(held)
        self._forget_marks()
        self._look_at([self._heads[key] for key in self._planned])

    def launched(self, filled: Sequence[Filled]) -> None:
        """Count what was launched as held."""
        assert self.runs is not None, "nothing is launched while it is in doubt what central holds"
        self._turn += 1
        for each in filled:
            self.runs[each.key] = with_range(self.runs.get(each.key, ()), each.after, each.end)
            self._turns[each.key] = self._turn
            self._wait_or_not(each.key)

    def landed(self, told: Mapping[StreamKey, Runs], under_way: Sequence[Filled]) -> None:
        """Take in what central says that it holds of some streams, while more is under way."""
        assert self.runs is not None, "nothing is in doubt"
        assert self.acknowledged is not None, "central has said what it holds"
        for key, runs in told.items():
            # Of two answers the older may be taken in last: what the newer one said holds on.
            for run in self.acknowledged.get(key, ()):
                runs = with_range(runs, Point(run.after, run.after_hash), Point(run.sequence, run.chain_hash))
            self.acknowledged[key] = runs
            for each in under_way:
                if each.key == key:
                    runs = with_range(runs, each.after, each.end)
            self.runs[key] = runs
            self._wait_or_not(key)

    def doubt(self) -> None:
        """What central holds is not known any more."""
        self.runs = None
        self._pending.clear()
        self._unchecked.clear()

    def works(self, *, may_jump: bool) -> list[Work]:
        """What waits, of streams that are not stopped."""
        assert self.runs is not None, "what waits is known once central has said what it holds"
        return [
            work
            for key, planned in self._pending.items()
            if key not in self.stopped and key not in self.apart
            for work in works_of(planned, self.runs.get(key, ()), self._turns.get(key, 0), may_jump=may_jump)
        ]

    def backlog(self, key: StreamKey) -> int | None:
        """Events of the stream that the plan sends and central lacks; None while that is not known."""
        planned, held = self._planned[key], self.acknowledged
        if held is None:
            return None
        if key in self.apart:
            return 0
        return sum(gap.events for gap in gaps_of(key, held.get(key, ()), planned.start, planned.head))

    def check(self) -> None:
        """Nothing, if what central has newest of each stream can belong to this station's history; looked at once.

        Raises:
            StreamStopped: It cannot, of one of them, or one is damaged; that one is not looked at again.
        """
        if self._trouble is not None:
            trouble, self._trouble = self._trouble, None
            raise trouble
        while self._unchecked:
            key = self._unchecked.pop()
            head, runs = self._heads[key], (self.runs or {}).get(key, ())
            newest = end_of(runs)
            if runs:
                check_heads(head, newest, self._log.epoch)
            if is_open(head, newest, self._log.epoch) and key not in self.agreed and key not in self.apart:
                self.open.add(key)

    def _forget_marks(self) -> None:
        self._marks.clear()
        self._settled.clear()
        self._told_at = self._log_head
        self._is_new = True

    def _look_at(self, heads: Iterable[StreamHead]) -> None:
        """Work out anew what waits of these streams."""
        for head in list(heads):
            key = StreamKey(head.stream, head.epoch)
            entry = self._entry(key)
            if entry is None:
                continue
            here = Point(head.sequence, head.chain_hash)
            try:
                start = self._starts.start_of(head, entry.since, self._log_head)
            except StreamStopped as error:
                self._trouble = error
                start = here
            self._planned[key] = Planned(key, entry, start, here, self._mark(key, entry, start, here))
            self._wait_or_not(key)
        if self.runs is not None:
            self._is_new = False
        if len(self._planned) > STREAMS_MAX:
            raise PlanError(
                f"the plan names {len(self._planned)} streams of this station, at most {STREAMS_MAX} can be sent"
            )

    def _entry(self, key: StreamKey) -> Entry | None:
        if self._plan is None:
            return None
        if key not in self._entries:
            self._entries[key] = self._plan.entry_for(key.stream)
        return self._entries[key]

    def _mark(self, key: StreamKey, entry: Entry, start: Point, here: Point) -> Point:
        """Up to where the stream is backlog: looked at anew after a hello or a new plan, and then kept."""
        if self.runs is None:
            return BEGINNING
        if key not in self._marks:
            runs = self.runs.get(key, ())
            self._marks[key] = mark_of(entry, runs, start, here) if self._is_new else BEGINNING
        is_known = not entry.is_derived or key.epoch != self._log.epoch or key in self._settled
        if not is_known and here.sequence > self._marks[key].sequence:
            self._marks[key] = self._derived_mark(key, here, self._marks[key])
        return self._marks[key]

    def _derived_mark(self, key: StreamKey, here: Point, mark: Point) -> Point:
        """Up to where a derived stream is backlog: all of it, until what was old has been derived."""
        checkpoint = self._log.checkpoint(f"{DERIVE}{key.stream}")
        made = mark_in(checkpoint.state)
        if made is None:
            return here
        if checkpoint.position >= self._told_at:
            self._settled.add(key)
        old = Point(*made)
        return old if mark.sequence < old.sequence <= here.sequence else mark

    def _wait_or_not(self, key: StreamKey) -> None:
        planned = self._planned.get(key)
        if planned is None or self.runs is None:
            return
        self._unchecked.add(key)
        runs = self.runs.get(key, ())
        is_whole = len(runs) == 1 and (runs[0].after, runs[0].sequence) == (0, planned.head.sequence)
        if not is_whole and gaps_of(key, runs, planned.start, planned.head):
            self._pending[key] = planned
        else:
            self._pending.pop(key, None)
