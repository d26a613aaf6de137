"""TIMER: virtual rows that a match's own rows have set, and the matcher that sees them.

A row that a match maps to `v` sets a virtual row at its time plus the duration of `TIMER(v.time, duration)`.
The definition speaks of rows that are united with the input; a match can only ever see those that are due at the
last row that it has mapped to `v`, so nothing needs to be put among the rows: what a partial match remembers says
when its virtual rows are due. Contract:

- A virtual row comes after the real rows of its time, and there is one in a partition at one time, however many
  timers are due.
- A partial match that has no timer due then does not see it, and goes on unchanged. One that has, takes it by a
  variable whose condition has TIMER and holds, or ends.
- A variable without TIMER never takes a virtual row, one with TIMER takes no other; no match begins with one.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Column, Const, Expr, Kind, Shift, rebuilt
from patterns.binding.guards import Guard, compile_guard
from patterns.binding.registers import UNSET, updated
from patterns.engine.matcher import Attempt, Block, Ending, Event, Found, Machine, Matcher, Partition, Thread, Trace
from patterns.scene.places import Places

Row = tuple[int, Sequence[Any]]
"""(bits of the row-local predicates, slots)."""

TIMER_STREAM = -1
"""The stream number of the event that decides a match where that is a virtual row."""
ROW_TYPE = "timer"
"""What a virtual row says its type is."""
IS_VIRTUAL = 1 << 63
"""The bit that virtual rows alone have: one more than predicates can."""


@dataclass(frozen=True, slots=True)
class Timers:
    """The timers of a machine.

    Attributes:
        registers: Those that hold when a virtual row is due.
        setters: For each of them, the variables whose last row sets it.
        row: The virtual row of a partition's key and a time.
    """

    registers: tuple[int, ...]
    setters: tuple[frozenset[int], ...]
    row: Callable[[Sequence[Any], int], Row]


@dataclass(frozen=True, slots=True)
class _VirtualRow(Block):
    """A block of one virtual row."""


class TimedMatcher(Matcher):
    """Runs a machine that has timers."""

    def __init__(self, machine: Machine, timers: Timers, timed: Sequence[bool]) -> None:
        """Build a matcher; `timed` says of each variable whether its condition has TIMER."""
        self.timers = timers
        self.is_timed = tuple(timed[variable] for variable in machine.tables.variables)
        marks = (IS_VIRTUAL if each else 0 for each in self.is_timed)
        super().__init__(replace(machine, masks=tuple(a | b for a, b in zip(machine.masks, marks, strict=True))))

    def due(self, partition: Partition) -> int | None:
        """When the matcher wants to be told that time has come, to decide what no row need decide."""
        timer_us = self._next(partition)
        deadline = super().due(partition)
        dues = [each for each in (deadline, None if timer_us is None else timer_us + 1) if each is not None]
        return min(dues, default=None)

    def expire(self, partition: Partition, until_us: int) -> list[Found]:
        """The matches made final because time has come to `until_us`: what is due before, happens."""
        found: list[Found] = []
        attempts = partition.attempts
        while attempts:
            deadline, timer_us = self.deadline(attempts[0]), self._next(partition)
            if deadline is not None and deadline <= until_us and (timer_us is None or deadline <= timer_us):
                found += super().expire(partition, deadline)
            elif timer_us is not None and timer_us < until_us:
                found += self._fire(partition, timer_us)
            else:
                break
        return found

    def _is_due(self, partition: Partition, now_us: int) -> bool:
        timer_us = self._next(partition)
        return super()._is_due(partition, now_us) or (timer_us is not None and timer_us < now_us)

    def _next(self, partition: Partition) -> int | None:
        """The time of the next virtual row that a partial match would see."""
        fired_us = -math.inf if partition.fired_us is None else partition.fired_us
        dues = (
            registers[index]
            for attempt in partition.attempts
            for _, registers, _ in attempt.threads
            for index in self.timers.registers
        )
        return min((due for due in dues if due is not None and due is not UNSET and due > fired_us), default=None)

    def _fire(self, partition: Partition, time_us: int) -> list[Found]:
        partition.fired_us = time_us
        bits, values = self.timers.row(partition.key, time_us)
        event: Event = (TIMER_STREAM, 0, time_us)
        row = _VirtualRow([bits | IS_VIRTUAL], [event], [values], [])
        self._step(partition, row, 0, partition.ordinal - 1)
        return self._resolved(partition, time_us, event)

    def _advance(
        self, attempt: Attempt, block: Block, row: int, ordinal: int, seen: dict[Any, float], safe_until: float
    ) -> None:
        if not isinstance(block, _VirtualRow):
            super()._advance(attempt, block, row, ordinal, seen, safe_until)
            return
        threads: list[Thread] = []
        for thread in attempt.threads:
            setter = self._setter(thread, block.events[0][2])
            if setter is None:
                threads.append(thread)
                continue
            ending = self._taken(attempt, thread, block, setter, ordinal, threads, seen, safe_until)
            if ending is not None:
                attempt.ending = ending
                break
        attempt.threads = threads

    def _taken(
        self, attempt: Attempt, thread: Thread, block: Block, setter: tuple[int, int], ordinal: int,
        threads: list[Thread], seen: dict[Any, float], safe_until: float,
    ) -> Ending | None:  # fmt: skip
        """Lets the thread take the virtual row; the match that this completes, if it does."""
        machine, tables = self.machine, self.machine.tables
        bits, values = block.bits[0], block.values[0]
        position, registers, trace = thread
        for target in tables.follow[position]:
            mask = machine.masks[target]
            if not self.is_timed[target] or bits & mask != mask:
                continue
            taken = updated(registers, machine.updates[target], values)
            guard = machine.guards[target]
            if guard is not None and guard(values, taken) is not True:
                continue
            key = (target, *(taken[index] for index in machine.live[target]))
            if seen.get(key, -1) >= attempt.ordinal:
                continue
            seen[key] = safe_until
            stream, sequence = setter
            longer: Trace = (trace, tables.variables[target], stream, sequence, sequence, ordinal, 1)
            if tables.follow[target]:
                threads.append((target, taken, longer))
            if tables.accepts[target]:
                return Ending(taken, longer, (stream, sequence, block.events[0][2]), ordinal)
        return None

    def _setter(self, thread: Thread, time_us: int) -> tuple[int, int] | None:
        """Stream and sequence of the row that set a virtual row of this time, the thread's own; None: it sees none."""
        _, registers, trace = thread
        for index, variables in zip(self.timers.registers, self.timers.setters, strict=True):
            if registers[index] == time_us:
                return _last_row(trace, variables)
        return None

    def _end(self, attempt: Attempt, partition: Partition) -> None:
        attempt.threads = []


def timers_of(bound: BoundRule, places: Places) -> Timers:
    """The timers of a rule that has some."""
    rows = _virtual_rows(bound, places)
    setters = []
    for index in bound.timers:
        variables = bound.registers[index].variables
        assert variables is not None, "a timer counts from a variable's row"
        setters.append(frozenset(variables))
    return Timers(bound.timers, tuple(setters), rows)


def _virtual_rows(bound: BoundRule, places: Places) -> Callable[[Sequence[Any], int], Row]:
    known: dict[Expr, int] = {Column("time", Kind.TIME): 0, Column("type", Kind.STRING): 1}
    for at, name in enumerate(bound.keys):
        known[Column(name, bound.columns[name])] = 2 + at

    def compiled(expr: Expr) -> Guard:
        return compile_guard(_of_virtual_row(expr, known), known, {}, places)

    predicates = [compiled(each) for each in bound.predicates]
    slots = [compiled(each) for each in bound.slots]

    def row(key: Sequence[Any], time_us: int) -> Row:
        columns = (time_us, ROW_TYPE, *key)
        bits = sum(1 << at for at, predicate in enumerate(predicates) if predicate(columns, ()) is True)
        return bits, [slot(columns, ()) for slot in slots]

    return row


def _of_virtual_row(expr: Expr, known: dict[Expr, int]) -> Expr:
    """The expression with NULL for what a virtual row does not have: other columns, rows before and after it."""
    if expr in known:
        return expr
    if isinstance(expr, Column | Shift):
        return Const(None, expr.kind)
    return rebuilt(expr, lambda part: _of_virtual_row(part, known))


def _last_row(trace: Trace | None, variables: frozenset[int]) -> tuple[int, int]:
    while trace is not None:
        if trace[1] in variables:
            return trace[2], trace[4]
        trace = trace[0]
    raise AssertionError("a timer was set by a row of the match")
