"""Many rules over one stream of rows, in one pass.

For each rule a `RuleSetRun` gives what a `RuleRun` of the rule alone gives,
whatever other rules are in the set, come, go or fail. A rule that raises is
set aside and named; the others go on.

Rules that read the same rows by the same clock share a lane, where the compiled kernel runs them
together; a rule that the kernel cannot express has a `RuleRun` of its own.

Rules are known by their names. Outcomes are given for the rules that have
something to say: a match, a late row, something given up.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from time import perf_counter

from patterns.bound import BoundRule
from patterns.errors import PatternError
from patterns.geometry import FrameSize
from patterns.lane import Input, Lane
from patterns.lane_state import restored_lane, saved_lane
from patterns.packed import NotPacked, Packed, pack
from patterns.rows import check_envelope
from patterns.running import Counts, Outcome, Rows, RuleRun, as_table, newest_by_source, wall_us

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


class RuleSetRun:
    """Rules online, together. Not for several threads at once.

    The methods that feed a set have the meaning of those of `RuleRun`, for all of its rules.
    """

    def __init__(
        self,
        bounds: Iterable[BoundRule] = (),
        clock: Callable[[], float] = perf_counter,
        *,
        is_strict: bool = False,
    ) -> None:
        """A set of these rules.

        Args:
            bounds: The rules.
            clock: A clock in seconds, by which the rules' cost is measured.
            is_strict: Whether a limit that is reached ends a rule, as in batch; else what it costs is
                forgotten, and said in the outcome.
        """
        self.failures: dict[str, Exception] = {}
        self._clock = clock
        self._is_strict = is_strict
        self._alone: dict[str, RuleRun] = {}
        self._lanes: list[Lane] = []
        self._lane_of: dict[str, Lane] = {}
        self._names: dict[str, None] = {}
        self._spent_s: dict[str, float] = {}
        self._frame_sizes: dict[str, FrameSize] = {}
        for bound in bounds:
            self.add(bound)

    @property
    def rules(self) -> tuple[str, ...]:
        """The names of the rules, in the order in which they came; those set aside are not among them."""
        return tuple(self._names)

    @property
    def input_types(self) -> frozenset[str]:
        """The event types that the rules are written over."""
        return frozenset(
            (*(run.input_type for run in self._alone.values()), *(lane.input.type for lane in self._lanes))
        )

    # Rules come and go.

    def add(self, bound: BoundRule, state: bytes | None = None, name: str | None = None) -> None:
        """The rule takes part from the next step on.

        Args:
            bound: The rule.
            state: What `state` gave of it, to go on from there; None: it begins anew, and knows the
                frame sizes that the set was told.
            name: What the set shall know it by, where that is not the rule's name: two versions of
                a rule may run side by side.

        Raises:
            PatternError: The set has a rule of this name.
            StateError: The state is not one of this rule.
        """
        name = name or bound.rule.rule
        if name in self._names:
            raise PatternError(f"the set has a rule {name} already. Next: remove it, or add this one by another name")
        try:
            self._add_to_lane(name, pack(bound), state)
        except NotPacked:
            self._add_alone(name, bound, state)
        self.failures.pop(name, None)
        self._names[name] = None
        self._spent_s[name] = 0.0

    def remove(self, name: str) -> None:
        """The rule takes no more part, and what it remembered is forgotten.

        Raises:
            PatternError: The set has no such rule.
        """
        if self.failures.pop(name, None) is None:
            self._check_has(name)
            self._drop(name)

    def state(self, name: str) -> bytes:
        """All that the rule remembers; `add` goes on from it.

        Raises:
            PatternError: The set has no such rule.
        """
        self._check_has(name)
        if name in self._alone:
            return self._alone[name].state()
        return saved_lane(self._lane_of[name], name)

    def status(self, name: str) -> RuleStatus:
        """How the rule stands.

        Raises:
            PatternError: The set has no such rule.
        """
        self._check_has(name)
        spent_s = self._spent_s[name]
        if name in self._alone:
            run = self._alone[name]
            return RuleStatus(run.counts, run.watermark, run.rows_waiting, run.partitions_open, run.held_back, spent_s)
        lane = self._lane_of[name]
        member = lane.members[lane.place_of(name)]
        counts = Counts(lane.counts.rows, lane.counts.late, member.matches)
        return RuleStatus(
            counts, lane.watermark, lane.rows_waiting, lane.partitions_open(name), member.emitter.held_back, spent_s
        )

    # Rows and time.

    def set_frame_size(self, source: str, width: int, height: int) -> None:
        """The source's frames have this size in pixels, from the next step on."""
        self._frame_sizes[source] = (width, height)
        for run in self._alone.values():
            run.set_frame_size(source, width, height)
        for lane in self._lanes:
            lane.set_frame_size(source, width, height)

    def push(self, rows: Rows) -> Outcomes:
        """Takes rows as they arrive, of any streams and types.

        Raises:
            MatchError: The rows do not say when, where and what they are; no rule has seen them.
        """
        table = as_table(rows)
        check_envelope(table)
        if table.num_rows == 0:
            return {}
        newest = newest_by_source(table)
        return self._each(lambda run: run.push(table), lambda lane: lane.push(table, newest))

    def source_ended(self, source: str) -> Outcomes:
        """The source will send no more."""
        return self._each(lambda run: run.source_ended(source), lambda lane: lane.source_ended(source))

    def advance_idle(self, now: datetime) -> Outcomes:
        """Looks, by the clock on the wall, for sources that have been silent for the idle time."""
        now_us = wall_us(now)
        return self._each(lambda run: run.advance_idle(now), lambda lane: lane.advance_idle(now_us))

    def finish(self) -> Outcomes:
        """The input has ended: everything is decided. What is pushed after this begins anew."""
        return self._each(lambda run: run.finish(), lambda lane: lane.finish())

    # Each rule by itself, each lane by itself.

    def _each(self, step: Callable[[RuleRun], Outcome], step_lane: Callable[[Lane], Outcomes]) -> Outcomes:
        outcomes = {}
        for lane in list(self._lanes):
            outcomes.update(self._step_of_lane(lane, step_lane))
        for name, run in list(self._alone.items()):
            began = self._clock()
            try:
                outcome = step(run)
            except Exception as error:  # Whatever a rule raises, the others go on; the caller reports it.
                self._set_aside(name, error)
                continue
            self._spent_s[name] += self._clock() - began
            if outcome != _NOTHING:
                outcomes[name] = outcome
        return outcomes

    def _step_of_lane(self, lane: Lane, step: Callable[[Lane], Outcomes]) -> Outcomes:
        began = self._clock()
        try:
            outcomes = step(lane)
        except Exception as error:  # What no rule of the lane can be blamed for ends them all.
            for member in list(lane.members):
                self._set_aside(member.name, error)
            return {}
        share_s = (self._clock() - began) / max(len(lane.members), 1)
        for member in list(lane.members):
            self._spent_s[member.name] += share_s
            if member.failure is not None:
                self._set_aside(member.name, member.failure)
        return outcomes

    def _set_aside(self, name: str, error: Exception) -> None:
        self.failures[name] = error
        self._drop(name)

    def _drop(self, name: str) -> None:
        del self._names[name], self._spent_s[name]
        if name in self._alone:
            del self._alone[name]
            return
        lane = self._lane_of.pop(name)
        lane.drop(name)
        if not lane.members:
            self._lanes.remove(lane)

    def _add_to_lane(self, name: str, packed: Packed, state: bytes | None) -> None:
        input_ = Input.of(packed)
        if state is not None:
            lane = restored_lane(name, packed, state, is_strict=self._is_strict)
            self._lanes.append(lane)
        else:
            lane = self._fresh_lane(input_, packed)
            lane.join(name, packed)
        self._lane_of[name] = lane

    def _fresh_lane(self, input_: Input, packed: Packed) -> Lane:
        """A lane of this input that has seen nothing yet."""
        sizes = {**packed.bound.frame_sizes, **self._frame_sizes}
        for lane in self._lanes:
            if lane.input == input_ and lane.is_fresh and lane.frame_sizes == sizes and lane.has_room(packed):
                return lane
        lane = Lane(input_, sizes, is_strict=self._is_strict)
        self._lanes.append(lane)
        return lane

    def _add_alone(self, name: str, bound: BoundRule, state: bytes | None) -> None:
        run = RuleRun(bound)
        if state is not None:
            run.restore(state)
        else:
            for source, (width, height) in self._frame_sizes.items():
                run.set_frame_size(source, width, height)
        self._alone[name] = run

    def _check_has(self, name: str) -> None:
        if name not in self._names:
            have = ", ".join(self._names) or "none"
            raise PatternError(f"the set has no rule {name}; there are: {have}")


def merged(parts: Iterable[Mapping[str, Outcome]]) -> Outcomes:
    """Outcomes of several steps, in their order, as those of one."""
    whole: Outcomes = {}
    for part in parts:
        for name, outcome in part.items():
            whole[name] = whole[name] + outcome if name in whole else outcome
    return whole


_NOTHING = Outcome()
