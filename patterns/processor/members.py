"""One version of a rule in service: what the processor knows of it beside its run."""

from collections.abc import Callable
from dataclasses import dataclass, field

from patterns.binding.bound import BoundRule
from patterns.binding.metres import Metres, metres_of
from patterns.engine.running import Outcome
from patterns.engine.situations import EventRef, Match
from patterns.files.rule import Rule
from patterns.processor.deploying import Service
from patterns.processor.missed import Missed
from patterns.processor.saving import Mark


@dataclass(slots=True)
class Member:
    """One version of a rule in service.

    Attributes:
        service: How the log says it stands.
        bound: The rule.
        mark: How far its situations are in the log.
        known: Identities of situations that are in the log already and that it will find again.
        finish_after_us: When it leaves service, in event time, if it is about to.
        failure: Why it was set aside.
        failed_at: Position at which that was.
        missed: What it had to go without since that was recorded.
        metres: Of which sources it asks for metres.
        uncalibrated: By source that is not calibrated, of how many events it asked for metres.
        pace: How long it takes for an event.
    """

    service: Service
    bound: BoundRule
    mark: Mark
    known: set[str] = field(default_factory=set)
    finish_after_us: int | None = None
    failure: Exception | None = None
    failed_at: int = 0
    missed: Missed = field(init=False)
    metres: Metres = field(init=False)
    uncalibrated: dict[str, int] = field(init=False)
    pace: "Pace" = field(default_factory=lambda: Pace())

    def __post_init__(self) -> None:
        """Begin with nothing missed."""
        self.missed = Missed(self.rule)
        self.metres = metres_of(self.bound)
        self.uncalibrated = dict(self.mark.report.get("uncalibrated", {}))

    @property
    def rule(self) -> Rule:
        """The rule."""
        return self.bound.rule

    @property
    def name(self) -> str:
        """What its set knows it by: two versions of a rule may run side by side."""
        return f"{self.service.rule}/{self.service.version}"

    @property
    def types(self) -> frozenset[str]:
        """The event types that it reads."""
        return self.bound.types

    @property
    def may_fall_idle(self) -> bool:
        """Whether silence means anything to it."""
        return self.rule.time.idle is not None and self.failure is None

    def told(self, finding: "Finding", began_in_time: Callable[[EventRef], bool]) -> list[Match]:
        """The matches of a finding that are the rule's to tell, and not in the log already.

        Args:
            finding: What it found.
            began_in_time: Whether an event lies before the rule's retirement.
        """
        matches = list(finding.outcome.matches)
        if self.known:
            matches = [each for each in matches if each.situation_id not in self.known]
        gone = self.service.retirement
        if gone is None or finding.position <= gone.position:
            return matches
        return [each for each in matches if gone.open_matches == "finished" and began_in_time(each.first)]


@dataclass(frozen=True, slots=True)
class Finding:
    """What a step of the log led to for one rule.

    Attributes:
        member: The rule.
        position: Where in the log.
        outcome: What it led to.
        is_by_silence: Whether not the log but a source's silence led to it.
    """

    member: Member
    position: int
    outcome: Outcome
    is_by_silence: bool = False


@dataclass(slots=True)
class Pace:
    """How long a rule takes for an event, in windows of events.

    Attributes:
        slow_windows: Windows in a row that were over the limit.
        event_us: Microseconds an event took in the last window; in the first one, so far.
    """

    slow_windows: int = 0
    event_us: float = 0.0
    _is_first: bool = True
    _spent_s: float = 0.0
    _events: int = 0

    def note(self, spent_s: float, events: int, event_us_most: float | None, window_events: int) -> None:
        """Takes in what the rule has spent so far, in all, on how many more events."""
        self._events += events
        is_whole = self._events >= window_events
        if (is_whole or self._is_first) and self._events:
            self.event_us = (spent_s - self._spent_s) / self._events * 1e6
        if not is_whole:
            return
        self._is_first = False
        is_slow = event_us_most is not None and self.event_us > event_us_most
        self.slow_windows = self.slow_windows + 1 if is_slow else 0
        self._spent_s, self._events = spent_s, 0
