"""A backtest: the situations that a rule would have emitted over segments of the log, appending nothing.

Contract: a pass of the processor with one rule, given segments in order of position; so the drafts of
its matches are, byte for byte, what the processor would have appended. Who calls it brings the
segments. What depends on the clock on the wall does not happen: no source falls idle.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from events import Catalogue, Segment, SituationDetected
from patterns.binding.bound import BoundRule
from patterns.engine.ruleset import RuleStatus
from patterns.engine.running import Outcome
from patterns.processor.cameras import Known
from patterns.processor.deploying import Service
from patterns.processor.limits import ProcessorLimits
from patterns.processor.members import Finding, Member
from patterns.processor.passes import CONTROL, Pass
from patterns.processor.saving import Mark
from patterns.scene.site import Site

CONTROL_TYPES = tuple(str(each.type_name) for each in CONTROL)
"""What tells a rule of the cameras, and which sources have ended."""
_NEVER = datetime(1970, 1, 1, tzinfo=UTC)


class Backtest:
    """One rule over segments of the log."""

    def __init__(
        self,
        bound: BoundRule,
        catalogue: Catalogue,
        *,
        after: int = 0,
        cameras: Known | None = None,
        limits: ProcessorLimits | None = None,
        live: Callable[[int], str | None] = lambda position: None,
    ) -> None:
        """Begin where nothing has happened.

        Args:
            bound: The rule.
            catalogue: The event types there are.
            after: The position behind which the rule begins.
            cameras: What is known of the cameras there: see `patterns.processor.cameras.known_at`; None: nothing.
            limits: Those of the processor.
            live: A source that may still lead to situations that the rule reads, as the log says it up to a position.
        """
        rule = bound.rule
        service = Service(rule.rule, rule.version, rule.hash, "", _NEVER, after, after)
        self._member = Member(service, bound, Mark(after))
        self._pass = Pass(after, catalogue, limits or ProcessorLimits(), cameras)
        self._pass.add(self._member)
        self._live = live

    @property
    def site(self) -> Site:
        """What is known of the cameras by now."""
        site = self._member.bound.site.copy()
        site.take(self._pass.site)
        return site

    @property
    def row_types(self) -> list[str]:
        """The event types that the rule reads."""
        return sorted(self._member.types)

    @property
    def status(self) -> RuleStatus:
        """How the rule stands."""
        return self._pass.status(self._member)

    @property
    def segments_skipped(self) -> int:
        """Segments of a version unknown here, which took no part."""
        return self._pass.segments_skipped

    def take(self, segment: Segment) -> Outcome:
        """What this segment, the next in order of position, leads to.

        Raises:
            PatternError: The rule cannot go on; online it would be set aside here.
        """
        return self._told(self._pass.take([segment]))

    def settle(self) -> Outcome:
        """What follows from the log's holding no more."""
        return self._told(self._pass.settle(lambda member, position: self._live(position)))

    def _told(self, findings: Iterable[Finding]) -> Outcome:
        outcome = Outcome()
        for finding in findings:
            outcome += finding.outcome
        if self._member.failure is not None:
            raise self._member.failure
        return outcome


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
