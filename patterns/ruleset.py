"""Many rules over one stream of rows, in one pass.

For each rule a `RuleSetRun` gives what a `RuleRun` of the rule alone gives,
whatever other rules are in the set, come, go or fail. A rule that raises is
set aside and named; the others go on.

Rules are known by their names. Outcomes are given for the rules that have
something to say: a match, a late row, something given up.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from time import perf_counter

from events import EventType
from patterns.bound import BoundRule
from patterns.errors import MatchError, PatternError
from patterns.running import Counts, Outcome, Rows, RuleRun
from patterns.site import Site

Outcomes = dict[str, Outcome]


@dataclass(frozen=True, slots=True)
class RuleStatus:
    """How a rule of the set stands.

    Attributes:
        counts: What it has seen and found.
        watermark: No row before this time is still expected; None: nothing is known yet.
        rows_waiting: Rows that are not final yet.
        partitions_open: Partitions that anything is remembered of.
        held_back: Matches that `once_per` and `cooldown` held back.
        spent_s: Seconds that the rule has taken, by the clock that the set was given.
    """

    counts: Counts
    watermark: datetime | None
    rows_waiting: int
    partitions_open: int
    held_back: int
    spent_s: float


@dataclass(slots=True)
class _Member:
    run: RuleRun
    spent_s: float = 0.0


class RuleSetRun:
    """Rules online, together. Not for several threads at once.

    The methods that feed a set have the meaning of those of `RuleRun`, for all of its rules.
    """

    def __init__(self, bounds: Iterable[BoundRule] = (), clock: Callable[[], float] = perf_counter) -> None:
        self.failures: dict[str, Exception] = {}
        self._clock = clock
        self._members: dict[str, _Member] = {}
        self._site = Site()
        for bound in bounds:
            self.add(bound)

    @property
    def rules(self) -> tuple[str, ...]:
        """The names of the rules, in the order in which they came; those set aside are not among them."""
        return tuple(self._members)

    @property
    def input_types(self) -> frozenset[str]:
        """The event types that the rules are written over."""
        return frozenset().union(*(member.run.input_types for member in self._members.values()))

    # Rules come and go.

    def add(self, bound: BoundRule, state: bytes | None = None, name: str | None = None) -> None:
        """The rule takes part from the next step on.

        Args:
            bound: The rule.
            state: What `state` gave of it, to go on from there; None: it begins anew, and knows of the
                cameras what the set was told.
            name: What the set shall know it by, where that is not the rule's name: two versions of
                a rule may run side by side.

        Raises:
            PatternError: The set has a rule of this name.
            StateError: The state is not one of this rule.
        """
        name = name or bound.rule.rule
        if name in self._members:
            raise PatternError(f"the set has a rule {name} already. Next: remove it, or add this one by another name")
        run = RuleRun(bound)
        if state is not None:
            run.restore(state)
        else:
            run.know(self._site)
        self.failures.pop(name, None)
        self._members[name] = _Member(run)

    def remove(self, name: str) -> None:
        """The rule takes no more part, and what it remembered is forgotten.

        Raises:
            PatternError: The set has no such rule.
        """
        if self.failures.pop(name, None) is None:
            self._member(name)
            del self._members[name]

    def state(self, name: str) -> bytes:
        """All that the rule remembers; `add` goes on from it.

        Raises:
            PatternError: The set has no such rule.
        """
        return self._member(name).run.state()

    def status(self, name: str) -> RuleStatus:
        """How the rule stands.

        Raises:
            PatternError: The set has no such rule.
        """
        member = self._member(name)
        run = member.run
        return RuleStatus(
            run.counts, run.watermark, run.rows_waiting, run.partitions_open, run.held_back, member.spent_s
        )

    # Rows and time.

    def set_frame_size(self, source: str, width: int, height: int) -> None:
        """The source's frames have this size in pixels, from the next step on."""
        self._site.frame_sizes[source] = (width, height)
        for member in self._members.values():
            member.run.set_frame_size(source, width, height)

    def learn(self, event: EventType, stream: str, sequence: int) -> None:
        """Takes in what an event says of a camera: see `RuleRun.learn`. A rule that cannot use it is set aside."""
        with suppress(MatchError):  # The rules that need it say so themselves.
            self._site.learn(event, stream, sequence)
        self._each(partial(_learnt, event=event, stream=stream, sequence=sequence))

    def push(self, rows: Rows) -> Outcomes:
        """Takes rows as they arrive, of any streams and types."""
        return self._each(lambda run: run.push(rows))

    def source_ended(self, source: str) -> Outcomes:
        """The source will send no more."""
        return self._each(lambda run: run.source_ended(source))

    def settle(self) -> Outcomes:
        """All that was said so far has come, what rules found included."""
        return self._each(lambda run: run.settle())

    def advance_idle(self, now: datetime) -> Outcomes:
        """Looks, by the clock on the wall, for sources that have been silent for the idle time."""
        return self._each(lambda run: run.advance_idle(now))

    def finish(self) -> Outcomes:
        """The input has ended: everything is decided. What is pushed after this begins anew."""
        return self._each(lambda run: run.finish())

    # Each rule by itself.

    def _each(self, step: Callable[[RuleRun], Outcome]) -> Outcomes:
        outcomes = {}
        for name, member in list(self._members.items()):
            began = self._clock()
            try:
                outcome = step(member.run)
            except Exception as error:  # Whatever a rule raises, the others go on; the caller reports it.
                self.failures[name] = error
                del self._members[name]
                continue
            finally:
                member.spent_s += self._clock() - began
            if outcome != _NOTHING:
                outcomes[name] = outcome
        return outcomes

    def _member(self, name: str) -> _Member:
        if name not in self._members:
            have = ", ".join(self._members) or "none"
            raise PatternError(f"the set has no rule {name}; there are: {have}")
        return self._members[name]


def merged(parts: Iterable[Mapping[str, Outcome]]) -> Outcomes:
    """Outcomes of several steps, in their order, as those of one."""
    whole: Outcomes = {}
    for part in parts:
        for name, outcome in part.items():
            whole[name] = whole[name] + outcome if name in whole else outcome
    return whole


def _learnt(run: RuleRun, event: EventType, stream: str, sequence: int) -> Outcome:
    run.learn(event, stream, sequence)
    return _NOTHING


_NOTHING = Outcome()
