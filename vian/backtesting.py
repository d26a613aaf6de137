"""Rules over what the log holds already: which segments a backtest reads, and where it may stop.

Contract: reads both tiers of the log, only the types that the rule wants, and changes nothing.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from events import Segment
from patterns.binding.bound import BoundRule
from patterns.engine.situations import Match
from patterns.processor import ProcessorLimits
from patterns.processor.cameras import known_at
from patterns.processor.deploying import rules_in_service
from patterns.processor.live import Below, live_source, types_below
from patterns.tools.backtest import CONTROL_TYPES, Backtest
from store import Log


@dataclass(frozen=True, slots=True)
class Span:
    """Which part of the past a backtest is about.

    Attributes:
        since: Situations from this time on; None: from the beginning.
        until: Situations before this time; None: to the end.
        after: The position behind which the rule begins, as one that was deployed there.
        sources: Only events of these sources exist; None: of all.
    """

    since: datetime | None = None
    until: datetime | None = None
    after: int = 0
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
        elsewhen: The times of the situations that were found and not asked for.
        position: How far the log was read.
    """

    matches: list[Match] = field(default_factory=list)
    rows: int = 0
    late: int = 0
    waiting: int = 0
    held_back: int = 0
    segments_skipped: int = 0
    elsewhen: list[datetime] = field(default_factory=list)
    position: int = 0

    def add(self, found: Sequence[Match], span: Span) -> None:
        """Take up what was found next; what the span does not show only by its time."""
        for match in found:
            time = decided_at(match)
            if span.shows(time):
                self.matches.append(match)
            else:
                self.elsewhen.append(time)


def backtested(
    log: Log, bound: BoundRule, span: Span, limits: ProcessorLimits, on_position: Callable[[int], None]
) -> Backtested:
    """The situations that the rule would have emitted over the log as it stands.

    Args:
        log: The log.
        bound: The rule.
        span: Which part of the past.
        limits: Those of the processor that would run it.
        on_position: Told how far the log has been read.

    Raises:
        PatternError: The rule cannot go on with these events.
    """
    backtest = backtest_after(log, bound, span.after, limits, span.sources)
    result = Backtested()
    last_wanted: int | None = None
    for segment in segments_of(log, backtest, span):
        result.add(backtest.take(segment).matches, span)
        result.position = segment.position
        on_position(segment.position)
        if _has_come_to(backtest, span.until):
            last_wanted = last_wanted or _last_position(log, backtest, span, segment.position)
            if segment.position >= last_wanted:
                break
    else:
        result.add(backtest.settle().matches, span)
    status = backtest.status
    result.rows, result.late, result.held_back = status.counts.rows, status.counts.late, status.held_back
    result.waiting = status.rows_waiting
    result.segments_skipped = backtest.segments_skipped
    return result


def backtest_after(
    log: Log, bound: BoundRule, after: int, limits: ProcessorLimits, sources: Sequence[str] | None = None
) -> Backtest:
    """A backtest of a rule that begins behind a position, and knows what the log said of the cameras before."""

    def live(position: int) -> str | None:
        below = Below(types_below(bound.rule, rules_in_service(log)), after)
        return live_source(log, below, position, sources)

    return Backtest(bound, log.catalogue, after=after, cameras=known_at(log, after), limits=limits, live=live)


def position_before(log: Log, types: Sequence[str], time: datetime) -> int:
    """The position behind which all events of these types lie that happened at or after the time."""
    first = next(iter(log.read_all(types=types, since=time)), None)
    return log.head() if first is None else first.position - 1


def decided_at(match: Match) -> datetime:
    """The time that the situation bears."""
    return match.decided_at or match.last.time


def segments_of(log: Log, backtest: Backtest, span: Span) -> Iterator[Segment]:
    """What the rule is to see, in order of position."""
    types = [*backtest.row_types, *CONTROL_TYPES]
    return log.read_all(span.after + 1, types=types, sources=span.sources)


def _has_come_to(backtest: Backtest, until: datetime | None) -> bool:
    if until is None:
        return False
    watermark = backtest.status.watermark
    return watermark is not None and watermark >= until


def _last_position(log: Log, backtest: Backtest, span: Span, position: int) -> int:
    """The last position from which a row before the span's end comes; the one at hand if there is none behind it."""
    behind = log.read_all(position + 1, types=backtest.row_types, sources=span.sources, until=span.until)
    return max((segment.position for segment in behind), default=position)
