"""What a rule costs and remembers over segments of the log: measured on this machine, now.

Contract: each rule runs alone, twice. In the first run a profiler says in which part of the engine the
time goes; its own cost falls on all parts, so only the shares are taken from it. The second run, warm
and without the profiler, gives CPU time and state. Reading and decoding segments is no rule's cost.
"""

import cProfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow as pa

from events import Catalogue, EventType, Segment, UnknownType, decode, events_of, with_envelope
from patterns.binding.bound import BoundRule
from patterns.engine.ruleset import RuleSetRun
from patterns.processor.passes import CONTROL, ENDS

SAMPLES = 20
"""How often during the run its state is measured."""
PARTS = ("ordering", "predicates", "matcher", "emission")
"""Parts of the engine: rows into columns and their order; row-local conditions; the automaton; what is said."""
_PART_OF = {
    "predicates": ("columns", "conditions", "geometry", "places", "ground", "site", "lists", "raster", "records"),
    "matcher": ("engine", "matcher", "guards", "registers", "kernel", "program", "timers"),
    "emission": ("situations", "titles", "emitter", "writing"),
}
"""For each part its modules; all other modules of this package belong to the ordering."""

_CALLS_KERNEL = {("lane", "_run"), ("lane", "_expire")}
"""Functions whose own time is the compiled matcher's, which the profiler does not see."""

Function = tuple[str, int, str]
"""File, line and name, as the profiler has them."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What one rule cost and remembered.

    Attributes:
        rule: The rule's name.
        version: Its version.
        events: Events of the types that it reads.
        cpu_s: CPU time that they took, in seconds.
        shares: For each part of the engine its share of that, 0 to 1.
        matches: Situations found.
        partitions_most: Most partitions that anything was remembered of.
        partial_matches_most: Most partial matches, of all partitions.
        rows_waiting_most: Most rows that were not final yet.
        state_bytes_most: Most bytes of its saved state.
    """

    rule: str
    version: int
    events: int
    cpu_s: float
    shares: dict[str, float]
    matches: int
    partitions_most: int
    partial_matches_most: int
    rows_waiting_most: int
    state_bytes_most: int

    @property
    def event_us(self) -> float:
        """CPU time for an event, in microseconds; 0 where there was none."""
        return self.cpu_s / self.events * 1e6 if self.events else 0.0


Step: TypeAlias = pa.RecordBatch | list[tuple[EventType, str, int]]
"""Rows to push, or events that say something of a camera or of the end of a source, with their places."""


def steps_of(segments: Iterable[Segment], types: frozenset[str], catalogue: Catalogue) -> Iterator[Step]:
    """What a run is given of these segments, in their order; unknown versions are left out."""
    for segment in segments:
        try:
            batch = decode(segment, catalogue)
        except UnknownType:
            continue
        if segment.stream.type in types:
            yield with_envelope(segment.stream, segment.header.first_sequence, batch)
        if batch.type in CONTROL:
            events = enumerate(events_of(batch), segment.header.first_sequence)
            yield [(event, str(segment.stream), sequence) for sequence, event in events]


def profiled(bound: BoundRule, steps: Iterable[Step]) -> dict[str, float]:
    """For each part of the engine its share of the time that these steps take."""
    run = RuleSetRun([bound])
    profiler = cProfile.Profile()
    for number, step in enumerate(steps):
        if number == 0:
            _take(RuleSetRun([bound]), step)  # what is compiled or loaded once is no cost of an event
        profiler.enable()
        try:
            _take(run, step)
        finally:
            profiler.disable()
    profiler.create_stats()
    return shares_of(profiler.stats)


def measured(bound: BoundRule, steps: Iterable[Step], count: int, shares: dict[str, float]) -> Cost:
    """What the rule costs over these steps, of which there are `count`."""
    name = bound.rule.rule
    run = RuleSetRun([bound])
    cpu_s, events = 0.0, 0
    sampled = _Most()
    every = max(1, count // SAMPLES)
    for number, step in enumerate(steps, start=1):
        began = time.thread_time()
        _take(run, step)
        cpu_s += time.thread_time() - began
        events += step.num_rows if isinstance(step, pa.RecordBatch) else 0
        if run.failures:
            raise run.failures[name]
        sampled.look(run, name, is_deep=number % every == 0)
    return Cost(
        rule=bound.rule.rule,
        version=bound.rule.version,
        events=events,
        cpu_s=cpu_s,
        shares=shares,
        matches=run.status(name).counts.matches,
        partitions_most=sampled.partitions,
        partial_matches_most=sampled.partial_matches,
        rows_waiting_most=sampled.rows_waiting,
        state_bytes_most=sampled.state_bytes,
    )


def shares_of(stats: dict[Function, Any]) -> dict[str, float]:
    """For each part of the engine its share of the profiled time.

    The time of a function outside this package (Arrow, NumPy, Python itself) belongs to those that called it.
    """
    owners = _Owners(stats)
    seconds = dict.fromkeys(PARTS, 0.0)
    for function, (_, _, own_s, _, _) in stats.items():
        for part, share in owners.of(function).items():
            seconds[part] += own_s * share
    whole = sum(seconds.values())
    return {part: value / whole if whole else 0.0 for part, value in seconds.items()}


class _Owners:
    """Which parts of the engine a function works for."""

    def __init__(self, stats: dict[Function, Any]) -> None:
        self._stats = stats
        self._known: dict[Function, dict[str, float]] = {}

    def of(self, function: Function) -> dict[str, float]:
        """Shares of the parts; empty where nobody of this package called it."""
        if function in self._known:
            return self._known[function]
        part = _part_of(function)
        if part is not None:
            self._known[function] = {part: 1.0}
            return self._known[function]
        self._known[function] = {}  # a function that calls itself belongs to its other callers
        weights = dict.fromkeys(PARTS, 0.0)
        for caller, (_, _, _, through_s) in self._stats[function][4].items():
            for each, share in self.of(caller).items() if caller in self._stats else ():
                weights[each] += share * max(through_s, 1e-9)
        whole = sum(weights.values())
        self._known[function] = {each: weight / whole for each, weight in weights.items() if weight} if whole else {}
        return self._known[function]


def _part_of(function: Function) -> str | None:
    """The part of the engine that a function belongs to; None: it is not of this package."""
    path = Path(function[0])
    if not path.is_relative_to(Path(__file__).parent.parent):
        return None
    if (path.stem, function[2]) in _CALLS_KERNEL:
        return "matcher"
    return next((part for part, modules in _PART_OF.items() if path.stem in modules), "ordering")


def _take(run: RuleSetRun, step: Step) -> None:
    if isinstance(step, pa.RecordBatch):
        run.push(step)
        return
    for event, stream, sequence in step:
        if isinstance(event, ENDS):
            run.source_ended(stream.split("/")[1])
        else:
            run.learn(event, stream, sequence)


@dataclass(slots=True)
class _Most:
    """The most that a run remembered."""

    partitions: int = 0
    partial_matches: int = 0
    rows_waiting: int = 0
    state_bytes: int = 0

    def look(self, run: RuleSetRun, name: str, is_deep: bool) -> None:
        status = run.status(name)
        self.rows_waiting = max(self.rows_waiting, status.rows_waiting)
        if is_deep:
            self.partitions = max(self.partitions, status.partitions_open)
            self.partial_matches = max(self.partial_matches, run.partial_matches(name))
            self.state_bytes = max(self.state_bytes, len(run.state(name)))
