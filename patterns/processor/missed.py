"""What rules had to go without, summed up, so that a flood of late events does not become a flood of events."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from events import Draft, RuleMissed, StreamName, batch_of, encode
from patterns.engine.running import GivenUp
from patterns.engine.situations import EventRef
from patterns.files.rule import Rule
from patterns.processor.situation_rows import json_of
from patterns.processor.writing import SOURCE, producer_of

What = Literal["late_events", "future_events", "partial_matches"]


@dataclass(slots=True)
class _Sum:
    count: int
    first_sequence: int | None
    last_sequence: int | None
    began_at: datetime
    ended_at: datetime
    partition: str | None
    reason: str

    def add(self, other: "_Sum") -> None:
        self.count += other.count
        if other.first_sequence is not None and other.last_sequence is not None:
            self.first_sequence = min(self.first_sequence or other.first_sequence, other.first_sequence)
            self.last_sequence = max(self.last_sequence or other.last_sequence, other.last_sequence)
        self.began_at = min(self.began_at, other.began_at)
        self.ended_at = max(self.ended_at, other.ended_at)


class Missed:
    """What one rule has missed since it was last recorded."""

    def __init__(self, rule: Rule) -> None:
        self._rule = rule
        self._sums: dict[tuple[What, str], _Sum] = {}

    def __bool__(self) -> bool:
        """Whether there is anything to record."""
        return bool(self._sums)

    def late(self, events: Iterable[EventRef]) -> None:
        """Events that came when the watermark had passed them."""
        lateness = self._rule.time.lateness.total_seconds()
        self._events("late_events", events, f"later than time.lateness of the rule ({lateness:g} s) allows")

    def future(self, events: Iterable[EventRef], ahead_s: float) -> None:
        """Events whose time is too far ahead to be believed."""
        reason = (
            f"more than {ahead_s:g} s ahead of the log's clock and of what its source sent before "
            "(setting rules_ahead_s): look at the source's clock"
        )
        self._events("future_events", events, reason)

    def given_up(self, forgotten: Iterable[GivenUp]) -> None:
        """Partial matches that a limit cost."""
        for each in forgotten:
            partition, count = json_of(each.partition), max(each.partial_matches, each.partitions)
            self._add("partial_matches", "", _Sum(count, None, None, each.since, each.since, partition, each.why))

    def drafts(self, station: str, at: datetime) -> list[Draft]:
        """The sums as events."""
        if not self._sums:
            return []
        events = [
            RuleMissed(
                time=at,
                rule=self._rule.rule,
                rule_version=self._rule.version,
                what=what,
                count=each.count,
                stream=stream or None,
                first_sequence=each.first_sequence,
                last_sequence=each.last_sequence,
                began_at=each.began_at,
                ended_at=each.ended_at,
                partition=each.partition,
                reason=each.reason,
            )
            for (what, stream), each in self._sums.items()
        ]
        return [encode(StreamName.of(station, SOURCE, RuleMissed.type_name), batch_of(events), producer_of(self._rule))]

    def clear(self) -> None:
        """Begins a new sum: this one was recorded."""
        self._sums.clear()

    def _events(self, what: What, events: Iterable[EventRef], reason: str) -> None:
        for each in events:
            self._add(what, each.stream, _Sum(1, each.sequence, each.sequence, each.time, each.time, None, reason))

    def _add(self, what: What, stream: str, more: _Sum) -> None:
        known = self._sums.setdefault((what, stream), more)
        if known is not more:
            known.add(more)
