"""How far the attempts of a pattern come over the rows of one partition, and where the best of them stops.

A matcher of its own: slow, with the engine's conditions, registers and tables, that tries every start and
keeps what it saw. It gives no matches to anyone (AFTER MATCH SKIP, preference and `once_per` are not its
business): it says what was nearly a match.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from patterns.binding.bound import BoundRule
from patterns.binding.columns import ColumnEvaluator
from patterns.binding.expressions import Call, Expr, Kind, conjuncts
from patterns.binding.registers import Registers, updated
from patterns.engine.engine import machine_of
from patterns.engine.matcher import Machine
from patterns.engine.timers import timers_of
from patterns.errors import LimitError
from patterns.tools.shortfalls import Judge, Shortfall
from patterns.tools.telling import told, told_duration, told_value


@dataclass(frozen=True, slots=True)
class Taken:
    """One row of an attempt, and what came before it.

    Attributes:
        before: The row before; None for the first.
        row: The row; of a virtual row that which set it.
        variable: What it was taken as.
        due_us: When it was due, for a virtual row; None for a real one.
    """

    before: "Taken | None"
    row: int
    variable: str
    due_us: int | None = None

    def rows(self) -> list["Taken"]:
        """The rows from the first on."""
        found: list[Taken] = []
        at: Taken | None = self
        while at is not None:
            found.append(at)
            at = at.before
        return found[::-1]


@dataclass(frozen=True, slots=True)
class Refused:
    """A row that an attempt could not take as a variable, and why."""

    row: int
    variable: str
    shortfalls: tuple[Shortfall, ...]


@dataclass(frozen=True, slots=True)
class Thread:
    """An attempt that has come to a place of the pattern.

    Attributes:
        start: Its first row.
        place: Where in the pattern it is.
        registers: What it remembers.
        taken: Its rows; None before the first.
    """

    start: int
    place: int
    registers: Registers
    taken: Taken | None


@dataclass(frozen=True, slots=True)
class Best:
    """The attempt that came furthest and nearest.

    Attributes:
        thread: How far it had come.
        missing: How many more rows it needed at least.
        refused: The row that came nearest to taking it further; None: no row came that could have.
        ended: The rows' end, or what the row at which it ended was refused as; empty: it is still open.
        ended_at: That row; None: there was no further row.
    """

    thread: Thread
    missing: int
    refused: Refused | None
    ended: tuple[Refused, ...]
    ended_at: int | None


@dataclass
class Attempts:
    """Tries the rows of one partition.

    Attributes:
        bound: The rule.
        evaluator: The partition's rows in their order; `frame sizes` in it.
        times_us: Their times.
        near_us: The time that attempts should be near to.
        is_whole: Whether the first row is the partition's first.
        has_ended: Whether the last row is the partition's last.
        until_us: How far time has come: virtual rows before it have happened.
        key: The partition columns, for virtual rows.
    """

    bound: BoundRule
    evaluator: ColumnEvaluator
    times_us: Sequence[int]
    near_us: int
    is_whole: bool
    has_ended: bool
    until_us: int = 0
    key: Sequence[Any] = ()
    complete: list[Taken] = field(default_factory=list)

    def __post_init__(self) -> None:
        masks = tuple(sum(1 << at for at in each.predicates) for each in self.bound.conditions)
        self.judge = Judge(self.bound, self.evaluator)
        self.machine: Machine = machine_of(self.bound, self.evaluator.places, masks)
        self.missing = _rows_missing(self.machine)
        self.timers = timers_of(self.bound, self.evaluator.places) if self.bound.timers else None
        self._bits = self._row_bits()
        self._values: dict[int, tuple[Any, ...]] = {}
        self._nearest: tuple[tuple[float, ...], Thread, Refused] | None = None

    def run(self, starts: Sequence[int]) -> Best | None:
        """The best of the attempts that begin at these rows and come to no match; None: there are none.

        The rows of those that come to a match are in `complete`.

        Raises:
            LimitError: More attempts at once than the limit `threads`.
        """
        threads: list[Thread] = []
        wanted = set(starts)
        for row in range(len(self.times_us)):
            threads = self._fired(threads, self.times_us[row], is_noting=True)
            if row in wanted:
                threads.append(self._begun(row))
            if threads:
                threads = self._step(threads, row, is_noting=True)
        threads = self._fired(threads, self.until_us, is_noting=True)
        self.complete += [
            thread.taken for thread in threads
            if self.has_ended and thread.taken is not None and self.machine.tables.accepts_end[thread.place]
        ]  # fmt: skip
        open_ = min(threads, key=lambda thread: self.missing[thread.place], default=None)
        if open_ is not None and (self._nearest is None or self.missing[open_.place] < self._nearest[0][0]):
            return Best(open_, self.missing[open_.place], None, (), None)
        if self._nearest is None:
            return None
        _, thread, refused = self._nearest
        ended_at, ended = self._end_of(thread, refused.row)
        return Best(thread, self.missing[thread.place], refused, ended, ended_at)

    def _begun(self, row: int) -> Thread:
        place = self.machine.tables.starting(is_first=self.is_whole and row == 0)
        return Thread(row, place, self.machine.registers, None)

    def _step(self, threads: list[Thread], row: int, is_noting: bool) -> list[Thread]:
        """The threads that take the row, equal ones once."""
        alive: dict[Any, Thread] = {}
        for thread in threads:
            for target in self.machine.tables.follow[thread.place]:
                taken = self._taken(thread, target, row)
                if taken is None:
                    if is_noting:
                        self._look_at(thread, target, row)
                    continue
                live = tuple(taken.registers[at] for at in self.machine.live[target])
                first = thread.start if self.bound.within_us is not None else 0
                alive.setdefault((target, live, first), taken)
                if is_noting and self.machine.tables.accepts[target] and taken.taken is not None:
                    self.complete.append(taken.taken)
        if len(alive) > self.bound.limits.threads:
            raise LimitError(
                f"{len(alive)} attempts are open at once; the limit `threads` is {self.bound.limits.threads}. "
                "Next: look at a shorter --window"
            )
        return list(alive.values())

    def _taken(self, thread: Thread, target: int, row: int) -> Thread | None:
        """The thread with the row taken at the target; None if it cannot take it."""
        machine = self.machine
        mask = machine.masks[target]
        if self._is_timed(target) or self._bits[row] & mask != mask or self._is_over(thread, row):
            return None
        values = self._values_of(row)
        registers = updated(thread.registers, machine.updates[target], values)
        guard = machine.guards[target]
        if guard is not None and guard(values, registers) is not True:
            return None
        return Thread(thread.start, target, registers, Taken(thread.taken, row, self._variable(target)))

    def _look_at(self, thread: Thread, target: int, row: int) -> None:
        """Notes the row if it came nearer than any before to taking an attempt further."""
        missing = self.missing[thread.place]
        is_further = self.missing[target] < missing
        if not is_further or (self._nearest is not None and missing > self._nearest[0][0]):
            return
        refused = self._refused(thread, target, row)
        size = sum(each.size for each in refused.shortfalls)
        apart = abs(self.times_us[row] - self.near_us)
        rank = (missing, len(refused.shortfalls), size, apart)
        if self._nearest is None or rank < self._nearest[0]:
            self._nearest = (rank, thread, refused)

    def _refused(self, thread: Thread, target: int, row: int) -> Refused:
        variable = self._variable(target)
        if self._is_timed(target):
            return Refused(row, variable, (self._not_due(thread, target, row),))
        values = self._values_of(row)
        registers = updated(thread.registers, self.machine.updates[target], values)
        condition = self.bound.conditions[self.machine.tables.variables[target]]
        shortfalls = self.judge.of_condition(condition, variable, row, registers)
        if self._is_over(thread, row):
            shortfalls.append(self._too_late(thread, row))
        return Refused(row, variable, tuple(shortfalls))

    def _end_of(self, thread: Thread, row: int) -> tuple[int | None, tuple[Refused, ...]]:
        """At which row the attempt ended, and what that row was refused as; None: there was no further row."""
        threads = [thread]
        while row < len(self.times_us):
            threads = self._fired(threads, self.times_us[row], is_noting=False)
            if not threads:
                return None, ()
            refused = [self._refused(each, target, row) for each in threads
                       for target in self.machine.tables.follow[each.place]]  # fmt: skip
            threads = self._step(threads, row, is_noting=False)
            if not threads:
                return row, tuple({each.variable: each for each in refused}.values())
            row += 1
        return None, ()

    # Virtual rows, which come after the real rows of their time: see `patterns.engine.timers`.

    def _fired(self, threads: list[Thread], until_us: int, is_noting: bool) -> list[Thread]:
        """The threads after all virtual rows that are due before this time."""
        if self.timers is None:
            return threads
        waiting, done = list(threads), []
        while waiting:
            thread = waiting.pop()
            due_us = self.due_us(thread)
            if due_us is None or due_us >= until_us:
                done.append(thread)
                continue
            for taken in self._taken_virtually(thread, due_us):
                if self.machine.tables.accepts[taken.place] and is_noting and taken.taken is not None:
                    self.complete.append(taken.taken)
                waiting.append(taken)
        return done[::-1]

    def due_us(self, thread: Thread) -> int | None:
        """When the thread's next virtual row is due; None: it has set none."""
        if self.timers is None:
            return None
        passed_us = self.times_us[thread.taken.row] if thread.taken is not None else 0
        if thread.taken is not None and thread.taken.due_us is not None:
            passed_us = thread.taken.due_us + 1
        dues = [thread.registers[at] for at in self.timers.registers]
        return min((due for due in dues if isinstance(due, int) and due >= passed_us), default=None)

    def _taken_virtually(self, thread: Thread, due_us: int) -> list[Thread]:
        assert self.timers is not None, "the rule has timers"
        assert thread.taken is not None, "a row of the attempt has set it"
        machine = self.machine
        bits, values = self.timers.row(self.key, due_us)
        taken = []
        for target in machine.tables.follow[thread.place]:
            mask = machine.masks[target]
            registers = updated(thread.registers, machine.updates[target], values)
            guard = machine.guards[target]
            is_met = guard is None or guard(values, registers) is True
            if self._is_timed(target) and bits & mask == mask and is_met:
                row = Taken(thread.taken, thread.taken.row, self._variable(target), due_us)
                taken.append(Thread(thread.start, target, registers, row))
        return taken

    def _not_due(self, thread: Thread, target: int, row: int) -> Shortfall:
        """Why a real row is none that TIMER waits for: it came before the virtual row, and so ended the attempt."""
        text = told(self._timer(target), "")
        due_us = self.due_us(thread)
        if due_us is None:
            return Shortfall(text, "nothing that the attempt has taken sets the timer", 2.0)
        early_us = due_us - self.times_us[row]
        reason = f"due at {told_value(due_us, Kind.TIME)}; this row came {told_duration(early_us)} before"
        return Shortfall(text, reason, early_us / (early_us + 60e6))

    def _timer(self, target: int) -> Expr:
        """The TIMER of a variable's condition."""
        guard = self.bound.conditions[self.machine.tables.variables[target]].guard
        assert guard is not None, "TIMER depends on the match"
        return next(part for part in conjuncts(guard) if isinstance(part, Call) and part.op == "timer")

    def _is_timed(self, target: int) -> bool:
        return self.bound.timed[self.machine.tables.variables[target]]

    def _is_over(self, thread: Thread, row: int) -> bool:
        within_us = self.bound.within_us
        return within_us is not None and self.times_us[row] - self.times_us[thread.start] >= within_us

    def _too_late(self, thread: Thread, row: int) -> Shortfall:
        within_us = self.bound.within_us
        assert within_us is not None, "only WITHIN makes a row too late"
        passed = self.times_us[row] - self.times_us[thread.start]
        reason = (
            f"{told_duration(passed)} after the first row, wanted less than {told_duration(within_us)}: "
            f"{told_duration(passed - within_us)} too late"
        )
        return Shortfall(f"WITHIN {told_duration(within_us)}", reason, (passed - within_us) / passed)

    def _variable(self, target: int) -> str:
        return self.bound.variables[self.machine.tables.variables[target]]

    def _values_of(self, row: int) -> tuple[Any, ...]:
        if row not in self._values:
            self._values[row] = self.judge.slot_values(row)
        return self._values[row]

    def _row_bits(self) -> list[int]:
        bits = [0] * len(self.times_us)
        for at, predicate in enumerate(self.bound.predicates):
            for row, is_true in enumerate(self.evaluator.truth(predicate)):
                bits[row] |= int(is_true) << at
        return bits


def _rows_missing(machine: Machine) -> list[int]:
    """For each place of the pattern how many more rows a match needs at least."""
    tables = machine.tables
    never = len(tables.follow) + 1
    missing = [
        0 if accepts or at_end else never for accepts, at_end in zip(tables.accepts, tables.accepts_end, strict=True)
    ]
    is_settled = False
    while not is_settled:
        is_settled = True
        for place, targets in enumerate(tables.follow):
            nearest = 1 + min((missing[target] for target in targets), default=never)
            if nearest < missing[place]:
                missing[place], is_settled = nearest, False
    return missing
