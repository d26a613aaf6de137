"""Many rules over one stream of rows, in one pass.

For each rule a `RuleSetRun` gives what a `RuleRun` of the rule alone gives,
whatever other rules are in the set, come, go or fail. A rule that raises is
set aside and named; the others go on.

Rules that read the same rows by the same clock share a lane, where the compiled kernel runs them
together; a rule that the kernel cannot express has a `RuleRun` of its own.

Rules are known by their names. Outcomes are given for the rules that have
something to say: a match, a late row, something given up.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from time import thread_time
from typing import TYPE_CHECKING, TypeVar

from events import EventType
from patterns.binding.bound import BoundRule
from patterns.binding.rows import Units, check_envelope, newest_of_units, with_envelope_encoded
from patterns.engine.running import Counts, Outcome, Rows, RuleRun, as_table, wall_us
from patterns.errors import MatchError, PatternError, StateError
from patterns.scene.site import Site

if TYPE_CHECKING:
    # Numba takes a third of a second to import: only who runs rules pays that.
    from patterns.engine.lane import Lane
    from patterns.engine.packed import Packed

logger = logging.getLogger(__name__)

T = TypeVar("T")

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
        spent_s: Seconds that the rule has taken, by the clock that the set was given. Of what rules do
            together, the kernel's time is shared out by the work that it had with each, a condition's
            among those that ask it, the rest evenly.
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
        clock: Callable[[], float] = thread_time,
        *,
        is_strict: bool = False,
        uses_kernel: bool | None = None,
    ) -> None:
        """A set of these rules.

        Args:
            bounds: The rules.
            clock: A clock in seconds, by which the rules' cost is measured: by default the processor time of this
                thread, so that a busy machine makes no rule slow.
            is_strict: Whether a limit that is reached ends a rule, as in batch; else what it costs is
                forgotten, and said in the outcome.
            uses_kernel: Whether the rules run on the compiled kernel, where it can express them; None:
                if it is compiled on this machine when they come, see `patterns.engine.compiling`.
        """
        self._uses_kernel = uses_kernel
        self.failures: dict[str, Exception] = {}
        self._clock = clock
        self._is_strict = is_strict
        self._alone: dict[str, RuleRun] = {}
        self._stays_alone: set[str] = set()
        self._lanes: list[Lane] = []
        self._lane_of: dict[str, Lane] = {}
        self._names: dict[str, None] = {}
        self._spent_s: dict[str, float] = {}
        self._site = Site()
        for bound in bounds:
            self.add(bound)

    @property
    def rules(self) -> tuple[str, ...]:
        """The names of the rules, in the order in which they came; those set aside are not among them."""
        return tuple(self._names)

    @property
    def input_types(self) -> frozenset[str]:
        """The event types that the rules are written over."""
        alone = (run.input_types for run in self._alone.values())
        return frozenset().union(*alone, *(lane.types for lane in self._lanes))

    # Rules come and go.

    def add(self, bound: BoundRule, state: bytes | None = None, name: str | None = None, spent_s: float = 0.0) -> None:
        """The rule takes part from the next step on.

        Args:
            bound: The rule.
            state: What `state` gave of it, to go on from there; None: it begins anew, and knows of the
                cameras what the set was told.
            name: What the set shall know it by, where that is not the rule's name: two versions of
                a rule may run side by side.
            spent_s: Seconds that it has taken elsewhere, from which its own go on.

        Raises:
            PatternError: The set has a rule of this name.
            StateError: The state is not one of this rule.
        """
        name = name or bound.rule.rule
        if name in self._names:
            raise PatternError(f"the set has a rule {name} already. Next: remove it, or add this one by another name")
        packed = self._packed(bound)
        if packed is None:
            self._add_alone(name, bound, state)
        else:
            self._add_to_lane(name, packed, None if state is None else _for_kernel(packed, state))
        self.failures.pop(name, None)
        self._names[name] = None
        self._spent_s[name] = spent_s

    def remove(self, name: str) -> None:
        """The rule takes no more part, and what it remembered is forgotten.

        Raises:
            PatternError: The set has no such rule.
        """
        if self.failures.pop(name, None) is None:
            self._check_has(name)
            self._drop(name)

    def use_kernel(self) -> None:
        """Rules that came before the kernel was compiled go on on it, if it is by now and can express them.

        A rule that cannot be moved, for whatever reason, goes on where it is, and is not asked again.
        """
        waiting = [name for name in self._alone if name not in self._stays_alone]
        if self._uses_kernel is not None or not waiting or not self._may_use_kernel:
            return
        for name in waiting:
            try:
                is_moved = self._is_moved(name)
            except Exception as error:  # Whatever keeps it from moving, it runs where it is, and the others move.
                logger.warning("rule %s goes on without the kernel: %s", name, error, exc_info=error)
                is_moved = False
            if is_moved:
                del self._alone[name]
            else:
                self._stays_alone.add(name)

    def _is_moved(self, name: str) -> bool:
        """Whether a rule that runs alone is in a lane now, with all that it remembers."""
        packed = self._packed(self._alone[name].bound)
        if packed is None:
            return False
        self._add_to_lane(name, packed, _for_kernel(packed, self._alone[name].state()))
        return True

    def state(self, name: str) -> bytes:
        """All that the rule remembers; `add` goes on from it.

        Raises:
            PatternError: The set has no such rule.
        """
        self._check_has(name)
        if name in self._alone:
            return self._alone[name].state()
        from patterns.engine.lane_state import saved_lane

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

    def watermark(self, name: str) -> datetime | None:
        """How far the rule's time has come, as in its status, but without looking at its partitions.

        Raises:
            PatternError: The set has no such rule.
        """
        self._check_has(name)
        return self._alone[name].watermark if name in self._alone else self._lane_of[name].watermark

    def spent_s(self, name: str) -> float:
        """Seconds that the rule has taken, by the clock that the set was given.

        Raises:
            PatternError: The set has no such rule.
        """
        self._check_has(name)
        return self._spent_s[name]

    def partial_matches(self, name: str) -> int:
        """How many partial matches of the rule are open, of all partitions; looks at each of them.

        Raises:
            PatternError: The set has no such rule.
        """
        self._check_has(name)
        return self._alone[name].partial_matches if name in self._alone else self._lane_of[name].partial_matches(name)

    # Rows and time.

    def set_frame_size(self, source: str, width: int, height: int) -> None:
        """The source's frames have this size in pixels, from the next step on."""
        self._site.frame_sizes[source] = (width, height)
        for run in self._alone.values():
            run.set_frame_size(source, width, height)
        for lane in self._lanes:
            lane.set_frame_size(source, width, height)

    def learn(self, event: EventType, stream: str, sequence: int, *, epoch: int = 1) -> None:
        """Takes in what an event says of a camera: see `RuleRun.learn`. A rule that cannot use it is set aside."""
        with suppress(MatchError):  # The rules that need it say so themselves.
            self._site.learn(event, stream, sequence, epoch=epoch)
        self._each(
            partial(_learnt, event=event, stream=stream, sequence=sequence, epoch=epoch),
            lambda lane: lane.learn(event, stream, sequence, epoch=epoch),
        )

    def push(self, rows: Rows) -> Outcomes:
        """Takes rows as they arrive, of any streams and types.

        Raises:
            MatchError: The rows do not say when, where and what they are; no rule has seen them.
        """
        return self.push_units([Units.one(as_table(rows))])[0]

    def push_units(self, arrived: Sequence[Units]) -> list[Outcomes]:
        """Takes units of arrival one after the other: for each of them what `push` of it alone would give.

        It is the same, only faster, but for two things. What a limit costs is said with the last unit. And of a rule
        that fails nothing is given, though it may have found something in units before; who wants that
        pushes the units one by one.

        Args:
            arrived: The units; those of one table are of one event type, or they are one.

        Raises:
            MatchError: The rows do not say when, where and what they are; no rule has seen them.
        """
        for units in arrived:
            check_envelope(units.table)
        outcomes: list[Outcomes] = [{} for _ in range(sum(len(units) for units in arrived))]
        if any(units.table.num_rows for units in arrived):
            self._push_to_lanes(arrived, outcomes)
            self._push_to_others(arrived, outcomes)
        return outcomes

    def _push_to_lanes(self, arrived: Sequence[Units], outcomes: list[Outcomes]) -> None:
        if not self._lanes:
            return
        arrived = [Units(with_envelope_encoded(units.table), units.bounds) for units in arrived]
        newest = [each for units in arrived for each in newest_of_units(units)]
        nothing: list[Outcomes] = [{} for _ in outcomes]
        for lane in list(self._lanes):
            found = self._step_of_lane(lane, lambda lane: lane.push_units(arrived, newest), nothing)
            for outcome, more in zip(outcomes, found, strict=True):
                outcome.update(more)

    def _push_to_others(self, arrived: Sequence[Units], outcomes: list[Outcomes]) -> None:
        parts = [table for units in arrived for table in units.of(units.table)] if self._alone else []
        for name, run in list(self._alone.items()):
            for outcome, part in zip(outcomes, parts, strict=False):
                outcome.update(self._step_alone(name, run, partial(_pushed, rows=part)))
                if name in self.failures:
                    break

    def source_ended(self, source: str) -> Outcomes:
        """The source will send no more."""
        return self._each(lambda run: run.source_ended(source), lambda lane: lane.source_ended(source))

    def may_settle(self, name: str) -> bool:
        """Whether `settle` would finish the rule."""
        return name in self._alone and self._alone[name].may_settle

    def settle(self, name: str | None = None) -> Outcomes:
        """All that was said so far has come to the rule, what others found included; None: to all rules."""
        chosen = [each for each in self._alone if name in (None, each)]
        return merged(self._step_alone(each, self._alone[each], lambda run: run.settle()) for each in chosen)

    def advance_idle(self, now: datetime) -> Outcomes:
        """Looks, by the clock on the wall, for sources that have been silent for the idle time."""
        now_us = wall_us(now)
        return self._each(lambda run: run.advance_idle(now), lambda lane: lane.advance_idle(now_us))

    def finish(self) -> Outcomes:
        """The input has ended: everything is decided. What is pushed after this begins anew."""
        return self._each(lambda run: run.finish(), lambda lane: lane.finish())

    def compile_rest(self, name: str) -> None:
        """Runs what the kernel seldom runs, so that it is compiled: see `patterns.engine.compiling`."""
        self._lane_of[name].compile_rest()

    # Each rule by itself, each lane by itself.

    def _each(self, step: Callable[[RuleRun], Outcome], step_lane: Callable[["Lane"], Outcomes]) -> Outcomes:
        outcomes: Outcomes = {}
        nothing: Outcomes = {}
        for lane in list(self._lanes):
            outcomes.update(self._step_of_lane(lane, step_lane, nothing))
        for name, run in list(self._alone.items()):
            outcomes |= self._step_alone(name, run, step)
        return outcomes

    def _step_alone(self, name: str, run: RuleRun, step: Callable[[RuleRun], Outcome]) -> Outcomes:
        began = self._clock()
        try:
            outcome = step(run)
        except Exception as error:  # Whatever a rule raises, the others go on; the caller reports it.
            self._set_aside(name, error)
            return {}
        self._spent_s[name] += self._clock() - began
        return {} if outcome == _NOTHING else {name: outcome}

    def _step_of_lane(self, lane: "Lane", step: Callable[["Lane"], T], nothing: T) -> T:
        began = self._clock()
        try:
            outcomes = step(lane)
        except Exception as error:  # What no rule of the lane can be blamed for ends them all.
            for member in list(lane.members):
                self._set_aside(member.name, error)
            return nothing
        spent_s = self._clock() - began
        shared_s = max(spent_s - sum(member.spent_s for member in lane.members), 0.0) / max(len(lane.members), 1)
        for member in list(lane.members):
            self._spent_s[member.name] += member.spent_s + shared_s
            member.spent_s = 0.0
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
            self._stays_alone.discard(name)
            return
        lane = self._lane_of.pop(name)
        lane.drop(name)
        if not lane.members:
            self._lanes.remove(lane)

    @property
    def _may_use_kernel(self) -> bool:
        if self._uses_kernel is None:
            from patterns.engine.compiling import is_compiled

            return is_compiled()
        return self._uses_kernel

    def _packed(self, bound: BoundRule) -> "Packed | None":
        """The rule for the kernel; None: it runs alone."""
        if not self._may_use_kernel:
            return None
        from patterns.engine.packed import NotPacked, pack

        try:
            packed = pack(bound)
            _check_tables(packed)
        except NotPacked:
            return None
        except Exception as error:  # Found out before it is among others, whom it would keep from their tables.
            logger.warning("rule %s runs without the kernel: %s", bound.rule.rule, error, exc_info=error)
            return None
        return packed

    def _add_to_lane(self, name: str, packed: "Packed", state: bytes | None) -> None:
        from patterns.engine.lane_state import restored

        if state is not None:
            lane = restored(name, packed, state, self._lanes, self._clock, is_strict=self._is_strict)
            if lane not in self._lanes:
                self._lanes.append(lane)
        else:
            lane = self._fresh_lane(packed)
            lane.join(name, packed)
        self._lane_of[name] = lane

    def _fresh_lane(self, packed: "Packed") -> "Lane":
        """A lane of the rule's input that has seen nothing yet."""
        from patterns.engine.lane import Lane, LaneInput

        input_, site = LaneInput.of(packed), packed.bound.site.copy()
        site.take(self._site)
        for lane in self._lanes:
            if lane.input == input_ and lane.is_fresh and lane.site == site and lane.has_room(packed):
                return lane
        lane = Lane(input_, site, self._clock, is_strict=self._is_strict)
        self._lanes.append(lane)
        return lane

    def _add_alone(self, name: str, bound: BoundRule, state: bytes | None) -> None:
        run = RuleRun(bound, is_strict=self._is_strict)
        if state is not None:
            run.restore(_for_general(bound, state))
        else:
            run.know(self._site)
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


def _check_tables(packed: "Packed") -> None:
    """Makes the kernel's tables of the rule alone, as a lane makes them of many; raises whatever that raises."""
    from patterns.engine.packed import Assembly
    from patterns.engine.records import Layout

    layout = Layout()
    layout.add(packed.predicates, packed.slots, packed.zones)
    Assembly(layout.bits, layout.slots, layout.words).tables([packed], is_strict=False)


def _for_kernel(packed: "Packed", state: bytes) -> bytes:
    """The state as one of a rule on the kernel."""
    from patterns.engine.moving import moved_to_kernel

    return state if state.startswith(KERNEL_STATE) else moved_to_kernel(packed, state)


def _for_general(bound: BoundRule, state: bytes) -> bytes:
    """The state as one of a rule on the general matcher."""
    if not state.startswith(KERNEL_STATE):
        return state
    from patterns.engine.moving_back import moved_from_kernel
    from patterns.engine.packed import NotPacked, pack

    try:
        return moved_from_kernel(pack(bound), state)
    except NotPacked as error:
        raise StateError(f"the saved state is of the kernel, which does not run the rule any more: {error}") from error


def _pushed(run: RuleRun, rows: Rows) -> Outcome:
    return run.push(rows)


def _learnt(run: RuleRun, event: EventType, stream: str, sequence: int, epoch: int) -> Outcome:
    run.learn(event, stream, sequence, epoch=epoch)
    return _NOTHING


_NOTHING = Outcome()
KERNEL_STATE = b"VRS2"
"""What the state of a rule begins with that ran on the kernel."""
