"""Rules over what the log holds already: which segments a backtest reads, and where it may stop.

Contract: reads both tiers of the log, only the types that the rule wants, and changes nothing.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from heapq import merge

from events import Segment
from patterns.backtest import CONTROL_TYPES, Backtest
from patterns.bound import BoundRule
from patterns.situations import Match
from store import Log


@dataclass(frozen=True, slots=True)
class Span:
    """Which part of the past a backtest is about.

    Attributes:
        since: Situations from this time on; None: from the beginning.
        until: Situations before this time; None: to the end.
        begin: Rows before this time do not exist, as for a rule that was deployed there; None: all exist.
        sources: Only events of these sources exist; None: of all.
    """

    since: datetime | None = None
    until: datetime | None = None
    begin: datetime | None = None
    sources: Sequence[str] | None = None

    def shows(self, time: datetime) -> bool:
        """Whether a situation of this time is asked for."""
        return (self.since is None or time >= self.since) and (self.until is None or time < self.until)


@dataclass(slots=True)
class Backtested:
    """What a backtest came to.

    Attributes:
        matches: What would have become situations, in the order in which it would have been appended.
        rows: Rows that took part.
        late: Rows that came too late to take part.
        waiting: Rows that are not final yet, for the watermark has not passed them.
        held_back: Matches that `once_per` and `cooldown` held back.
        segments_skipped: Segments of versions unknown here, which took no part.
        position: How far the log was read.
    """

    matches: list[Match] = field(default_factory=list)
    rows: int = 0
    late: int = 0
    waiting: int = 0
    held_back: int = 0
    segments_skipped: int = 0
    position: int = 0


def backtested(log: Log, bound: BoundRule, span: Span, on_position: Callable[[int], None]) -> Backtested:
    """The situations that the rule would have emitted over the log as it stands.

    Args:
        log: The log.
        bound: The rule.
        span: Which part of the past.
        on_position: Told how far the log has been read.

    Raises:
        PatternError: The rule cannot go on with these events.
    """
    backtest = Backtest(bound, log.catalogue, span.begin)
    result = Backtested()
    last_wanted: int | None = None
    for segment in segments_of(log, bound, span):
        found = backtest.take(segment).matches
        result.matches += [each for each in found if span.shows(decided_at(each))]
        result.position = segment.position
        on_position(segment.position)
        if _has_come_to(backtest, span.until):
            last_wanted = last_wanted or _last_position(log, bound, span, segment.position)
            if segment.position >= last_wanted:
                break
    else:
        result.matches += [each for each in backtest.settle().matches if span.shows(decided_at(each))]
    counts = backtest.run.counts
    result.rows, result.late, result.held_back = counts.rows, counts.late, backtest.run.held_back
    result.waiting = backtest.run.rows_waiting
    result.segments_skipped = backtest.segments_skipped
    return result


def decided_at(match: Match) -> datetime:
    """The time that the situation bears."""
    return match.decided_at or match.last.time


def segments_of(log: Log, bound: BoundRule, span: Span) -> Iterator[Segment]:
    """What the rule is to see, in order of position; frame sizes and ends of sources from the log's beginning on."""
    rows = log.read_all(types=sorted(bound.types), sources=span.sources, since=span.begin)
    control = log.read_all(types=CONTROL_TYPES, sources=span.sources)
    return merge(rows, control, key=lambda segment: segment.position)


def _has_come_to(backtest: Backtest, until: datetime | None) -> bool:
    watermark = backtest.run.watermark
    return until is not None and watermark is not None and watermark >= until


def _last_position(log: Log, bound: BoundRule, span: Span, position: int) -> int:
    """The last position from which a row before the span's end comes; the one at hand if there is none behind it."""
    behind = log.read_all(position + 1, types=sorted(bound.types), sources=span.sources, until=span.until)
    return max((segment.position for segment in behind), default=position)
