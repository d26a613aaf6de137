"""A backtest: the situations that a rule would have emitted over segments of the log, appending nothing.

Contract: the segments come in order of position, each as one whole, as the processor gives them to a
rule; so the drafts of its matches are, byte for byte, what the processor would have appended. A row before
`since` does not exist for the rule: it is as if it had been deployed there. Knows no log: who calls
it brings the segments.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from events import (
    Catalogue,
    EventType,
    ProcessFailed,
    ProcessFinished,
    Segment,
    SituationDetected,
    UnknownType,
    decode,
    events_of,
    with_envelope,
)
from patterns.bound import BoundRule
from patterns.errors import MatchError
from patterns.running import Outcome, RuleRun
from patterns.site import SITE_TYPES
from patterns.situations import Match

_CONTROL: tuple[type[EventType], ...] = (*SITE_TYPES, ProcessFinished, ProcessFailed)
CONTROL_TYPES = tuple(str(each.type_name) for each in _CONTROL)
"""What tells a rule of the cameras, and which sources have ended."""


class Backtest:
    """One rule over segments of the log."""

    def __init__(self, bound: BoundRule, catalogue: Catalogue, since: datetime | None = None) -> None:
        """Begin where nothing has happened.

        Args:
            bound: The rule.
            catalogue: The event types there are.
            since: Rows before this time take no part.
        """
        self.run = RuleRun(bound)
        self.segments_skipped = 0
        """Segments of a version unknown here, which took no part."""
        self.site = bound.site.copy()
        """All that the log has said of the cameras so far."""
        self._catalogue = catalogue
        self._since = since

    @property
    def types(self) -> tuple[str, ...]:
        """The event types whose segments it wants."""
        return (*sorted(self.run.input_types), *CONTROL_TYPES)

    def take(self, segment: Segment) -> Outcome:
        """What this segment, the next in order of position, leads to.

        Raises:
            PatternError: The rule cannot go on; online it would be set aside here.
        """
        try:
            batch = decode(segment, self._catalogue)
        except UnknownType:
            self.segments_skipped += 1
            return Outcome()
        source = segment.stream.source
        if segment.stream.type in self.run.input_types:
            return self.run.push(self._rows(with_envelope(segment.stream, segment.header.first_sequence, batch)))
        matches: list[Match] = []
        for sequence, event in enumerate(events_of(batch), segment.header.first_sequence):
            if isinstance(event, SITE_TYPES):
                self.run.learn(event, str(segment.stream), sequence)
                self._learn(event, str(segment.stream), sequence)
            elif isinstance(event, ProcessFinished | ProcessFailed):
                matches += self.run.source_ended(source).matches
        return Outcome(tuple(matches))

    def settle(self) -> Outcome:
        """What follows from the log's holding no more."""
        return self.run.settle()

    def _learn(self, event: EventType, stream: str, sequence: int) -> None:
        with suppress(MatchError):  # a rule that needs it has raised
            self.site.learn(event, stream, sequence)

    def _rows(self, rows: pa.RecordBatch) -> pa.RecordBatch:
        if self._since is None:
            return rows
        return rows.filter(pc.greater_equal(rows.column("time"), pa.scalar(self._since, rows.column("time").type)))


@dataclass(frozen=True, slots=True)
class Pair:
    """One happening, as two versions of a rule saw it; None: the version did not."""

    first: SituationDetected | None
    second: SituationDetected | None

    @property
    def sides(self) -> str:
        """Which versions saw it: `both`, `only A` or `only B`."""
        if self.first is None:
            return "only B"
        return "only A" if self.second is None else "both"

    @property
    def one(self) -> SituationDetected:
        """The situation, of the first version where both saw it."""
        found = self.first or self.second
        assert found is not None, "a pair has one side at least"
        return found

    @property
    def differences(self) -> list[str]:
        """What the versions say differently of it: names of fields and measures."""
        if self.first is None or self.second is None:
            return []
        one, other = (_said(each) for each in (self.first, self.second))
        return [name for name in dict.fromkeys([*one, *other]) if one.get(name) != other.get(name)]


def paired(first: Sequence[SituationDetected], second: Sequence[SituationDetected]) -> list[Pair]:
    """The situations of two versions side by side, in order of time.

    Two are one happening if they agree in the partition columns that both have and their spans from first to last
    event share a moment; each is paired once, the earliest first, and those of one and the same span before others.
    """
    shared = sorted(_partition_names(first) & _partition_names(second))
    waiting: dict[tuple[str, ...], list[SituationDetected]] = {}
    for each in second:
        waiting.setdefault(_key(each, shared), []).append(each)
    pairs = []
    for meets in (_is_same_span, _is_overlapping):
        alone = []
        for one in first:
            others = waiting.get(_key(one, shared), [])
            other = next((each for each in others if meets(one, each)), None)
            if other is None:
                alone.append(one)
                continue
            others.remove(other)
            pairs.append(Pair(one, other))
        first = alone
    pairs += [Pair(each, None) for each in first]
    pairs += [Pair(None, each) for others in waiting.values() for each in others]
    return sorted(pairs, key=lambda pair: (pair.one.began_at, pair.one.ended_at, pair.one.partition, pair.sides))


def _partition_names(events: Sequence[SituationDetected]) -> set[str]:
    return set(json.loads(events[0].partition)) if events else set()


def _key(event: SituationDetected, names: Sequence[str]) -> tuple[str, ...]:
    partition = json.loads(event.partition)
    return tuple(json.dumps(partition[name]) for name in names)


def _is_same_span(one: SituationDetected, other: SituationDetected) -> bool:
    return (one.began_at, one.ended_at) == (other.began_at, other.ended_at)


def _is_overlapping(one: SituationDetected, other: SituationDetected) -> bool:
    return one.began_at <= other.ended_at and other.began_at <= one.ended_at


def _said(event: SituationDetected) -> dict[str, Any]:
    fields = {"began_at": event.began_at, "ended_at": event.ended_at, "severity": event.severity, "title": event.title}
    return {**fields, "time": event.time, **json.loads(event.measures)}
