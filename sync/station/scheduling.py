"""What is sent next: live work before backlog, lanes in order, and the backlog's least share.

Contract: pure, and knows no network: it decides over `Work`, ranges of streams that wait. Live work of a lane goes
before any work of a lane behind it, and before all backlog; backlog goes by lane too. While both wait, backlog gets
its share of the bytes. In one lane streams take turns.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sync.plans.plan import Entry
from sync.protocol.wire import RUNS_MAX
from sync.runs import Gap, Point, Runs, StreamKey, end_of, gaps_of, split

LIVE_EVENTS_MAX = 100
"""With at most so many events missing a stream that is sent `live` is simply gone on with."""
CAUGHT_UP_EVENTS_MAX = 10_000
"""With at most so many events missing a stream that is sent in order counts as live."""


@dataclass(frozen=True, slots=True)
class Work:
    """A range of a stream that waits to be sent."""

    gap: Gap
    entry: Entry
    is_live: bool
    turn: int
    """when its stream was served last"""

    @property
    def place(self) -> tuple[int, int, StreamKey, int]:
        """Where it stands among its like."""
        return self.entry.priority, self.turn, self.gap.key, self.gap.after.sequence


@dataclass(frozen=True, slots=True)
class Planned:
    """A stream that the plan sends, and where it stands here."""

    key: StreamKey
    entry: Entry
    start: Point
    """Behind which the plan wants it."""
    head: Point
    mark: Point
    """What lies below it is backlog."""


def mark_of(entry: Entry, runs: Runs, start: Point, head: Point) -> Point:
    """Up to where a stream that is looked at anew counts as backlog: its head, if central lacks much."""
    at = max(end_of(runs), start, key=lambda point: point.sequence)
    most = LIVE_EVENTS_MAX if entry.order == "live" else CAUGHT_UP_EVENTS_MAX
    return head if head.sequence - at.sequence > most else at


def works_of(planned: Planned, runs: Runs, turn: int, *, may_jump: bool) -> list[Work]:
    """What of the stream waits, ascending; where it may jump, what is new does not wait for what is old."""
    gaps = gaps_of(planned.key, runs, planned.start, planned.head)
    if not gaps or gaps[-1].until != planned.head:
        return [Work(gap, planned.entry, False, turn) for gap in gaps]
    *lower, newest = gaps
    mark = planned.mark
    is_inside = newest.after.sequence < mark.sequence < newest.until.sequence
    if planned.entry.order == "live" and may_jump and is_inside and len(runs) < RUNS_MAX:
        below, above = split(newest, mark)
        return [Work(gap, planned.entry, False, turn) for gap in (*lower, below)] + [
            Work(above, planned.entry, True, turn)
        ]
    is_live = newest.after.sequence >= mark.sequence and (not lower or planned.entry.order == "live")
    return [
        *(Work(gap, planned.entry, False, turn) for gap in lower),
        Work(newest, planned.entry, is_live, turn),
    ]


class Share:
    """Which of live traffic and backlog is next, so that backlog gets its least share while both wait.

    What backlog is owed is paid a whole request at a time, so that a small alert seldom waits for it.
    """

    def __init__(self) -> None:
        self._live = 0
        self._backlog = 0

    def is_backlogs_turn(self, share: float, size: int) -> bool:
        """Whether backlog is owed a request of that size since both began to wait."""
        owed = share * (self._live + self._backlog) - self._backlog
        return owed > 0 and owed >= share * size

    def sent(self, size: int, *, was_live: bool) -> None:
        """Count what was sent while both waited."""
        if was_live:
            self._live += size
        else:
            self._backlog += size

    def begin(self) -> None:
        """Only one of the two waits now: what follows is counted anew."""
        self._live = self._backlog = 0


def in_order(works: Iterable[Work]) -> list[Work]:
    """The works as they are served; of each stream only the first, for what follows goes on from it."""
    first: dict[StreamKey, Work] = {}
    for work in sorted(works, key=lambda each: each.place):
        first.setdefault(work.gap.key, work)
    return list(first.values())


def chosen(works: Sequence[Work], share: Share, least_share: float, size: int) -> list[Work]:
    """The works for the next request, in the order in which they fill it: all live or all backlog.

    They never share a request: one that carries an alert is no larger than what is live.

    Args:
        works: All that waits.
        share: What each had.
        least_share: Of the bytes, backlog's.
        size: Bytes of a full request.
    """
    live = in_order(work for work in works if work.is_live)
    backlog = in_order(work for work in works if not work.is_live)
    if not live or not backlog:
        share.begin()
        return live or backlog
    return backlog if share.is_backlogs_turn(least_share, size) else live
