"""What the log holds around a question of why a rule did not fire.

Contract: reads both tiers of the log and changes nothing. The rule is run once more, without `once_per`
and `cooldown`, from a while before the window on, so that late rows are those that were late online.
"""

from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from events import Segment, UnknownType, decode, with_envelope
from patterns.binding.bound import BoundRule
from patterns.binding.strata import rules_read
from patterns.durations import MICROSECOND
from patterns.engine.emitter import Emitter
from patterns.engine.situations import Match, as_microseconds
from patterns.files.rule import EmitSettings
from patterns.processor import ProcessorLimits, schemas
from patterns.tools.telling import told_time
from patterns.tools.whynot import Decided, Past, Question
from store import Log
from vian.backtesting import Span, backtest_after, decided_at, position_before, segments_of


def past_of(log: Log, bound: BoundRule, question: Question, limits: ProcessorLimits) -> Past:
    """What is known of the time around the question.

    Raises:
        PatternError: The rule cannot go on with these events.
    """
    begin, end = _window(question)
    whole = replace(bound, rule=bound.rule.model_copy(update={"emit": EmitSettings()}))
    after = _beginning(log, bound, question, begin)
    backtest = backtest_after(log, whole, after, limits)
    batches: list[pa.Table] = []
    matches: list[Match] = []
    late: set[tuple[str, int]] = set()
    is_cut_after = False
    newest: datetime | None = None
    for segment in segments_of(log, backtest, Span(after=after)):
        outcome = backtest.take(segment)
        matches += outcome.matches
        late |= {(each.stream, each.sequence) for each in outcome.late if begin <= each.time <= end}
        if segment.stream.type in bound.types:
            batches += _rows(log, segment, begin, end)
            is_cut_after |= segment.header.time_max > end
            newest = segment.header.time_max if newest is None else max(newest, segment.header.time_max)
    matches += backtest.settle().matches
    return Past(
        rows=pa.concat_tables(batches, promote_options="default") if batches else _nothing(log, bound),
        late=frozenset(late),
        decided=[each for each in _decided(bound, matches) if _is_near(each.match, begin, end)],
        site=backtest.site,
        watermark=backtest.status.watermark,
        newest=newest,
        is_cut_before=any(True for _ in _earlier_segments(log, bound, begin)),
        is_cut_after=is_cut_after,
    )


def spans_of(log: Log, bound: BoundRule, subject: str) -> list[str]:
    """For each source where the subject has events, from when to when."""
    spans: dict[str, tuple[datetime, datetime]] = {}
    for segment in log.read_all(types=sorted(bound.types)):
        for rows in _rows(
            log, segment, datetime.min.replace(tzinfo=segment.recorded_at.tzinfo), segment.header.time_max
        ):
            own = rows.filter(pc.fill_null(pc.equal(rows.column("subject"), subject), False))
            if own.num_rows:
                first, last = pc.min_max(own.column("time")).as_py().values()
                known = spans.get(segment.stream.source, (first, last))
                spans[segment.stream.source] = (min(first, known[0]), max(last, known[1]))
    return [f"{source} from {told_time(first)} to {told_time(last)}" for source, (first, last) in sorted(spans.items())]


def _beginning(log: Log, bound: BoundRule, question: Question, begin: datetime) -> int:
    """The position behind which the rule is run: early enough that it knows what it would."""
    if rules_read(bound.rule):
        # Situations come behind all that they rest on, the end of their source too.
        return 0
    return position_before(log, sorted(bound.types), _earlier(begin, _lead(bound, question)))


def _lead(bound: BoundRule, question: Question) -> timedelta:
    """How long before the window the rule begins to run: what it may remember there."""
    within = timedelta(0) if bound.within_us is None else bound.within_us * MICROSECOND
    cooldown = bound.rule.emit.cooldown or timedelta(0)
    return max(within, cooldown, question.window) + bound.rule.time.lateness


def _window(question: Question) -> tuple[datetime, datetime]:
    return _earlier(question.at, question.window), _later(question.at, question.window)


def _earlier(time: datetime, by: timedelta) -> datetime:
    try:
        return time - by
    except OverflowError:
        return datetime.min.replace(tzinfo=time.tzinfo)


def _later(time: datetime, by: timedelta) -> datetime:
    try:
        return time + by
    except OverflowError:
        return datetime.max.replace(tzinfo=time.tzinfo)


def _rows(log: Log, segment: Segment, begin: datetime, end: datetime) -> Iterator[pa.Table]:
    """The segment's rows between two times, both inclusive; nothing if there are none."""
    if segment.header.time_max < begin or segment.header.time_min > end:
        return
    try:
        batch = decode(segment, log.catalogue)
    except UnknownType:
        return
    rows = pa.Table.from_batches([with_envelope(segment.stream, segment.header.first_sequence, batch)])
    time = rows.column("time")
    inside = pc.and_(
        pc.greater_equal(time, pa.scalar(begin, time.type)), pc.less_equal(time, pa.scalar(end, time.type))
    )
    rows = rows.filter(inside)
    if rows.num_rows:
        yield rows


def _nothing(log: Log, bound: BoundRule) -> pa.Table:
    """No rows of the rule's types."""
    known = schemas(log.catalogue)
    return pa.unify_schemas([known[each] for each in sorted(bound.types)]).empty_table()


def _earlier_segments(log: Log, bound: BoundRule, begin: datetime) -> Iterator[Segment]:
    return log.read_all(types=sorted(bound.types), until=begin)


def _decided(bound: BoundRule, matches: list[Match]) -> list[Decided]:
    """The matches, each with the situation that held it back."""
    emitter = Emitter(bound.rule.emit)
    emitted: dict[tuple[Any, ...], Match] = {}
    decided = []
    for match in matches:
        key = _emission_key(bound, match)
        now_us = as_microseconds(decided_at(match))
        assert isinstance(now_us, int), "a time"
        if emitter.lets_through(match, now_us):
            emitted[key] = match
            decided.append(Decided(match, None))
        else:
            decided.append(Decided(match, emitted[key]))
    return decided


def _emission_key(bound: BoundRule, match: Match) -> tuple[Any, ...]:
    values = {**match.measures, **match.partition}
    return tuple(values[name] for name in bound.rule.emit.once_per or match.partition)


def _is_near(match: Match, begin: datetime, end: datetime) -> bool:
    return match.first.time <= end and begin <= max(match.last.time, decided_at(match))
