"""The matcher: a priority-ordered automaton over the rows of one partition.

It knows positions, bits and registers, and nothing of what they mean: no
column, no unit, no time zone. All starts advance together, one pass over the
rows. Its contract:

- Matches come from the leftmost start on; of one start, the most preferred.
- A match is found when no thread that is preferred to it, and no earlier start, is alive.
- When the time of an attempt's WITHIN is over, what lives on of it is what `$` may still end: the partition's next
  row, or the end of the input, decides that.
- Threads of one start at one position that remember the same are one thread: the preferred
  one. Where a match skips past its last row and there is no WITHIN, this holds across starts
  too. So the work for a row is bounded by the pattern's size and what its guards remember.
- What a partition holds does not grow with the length of its matches.
"""

import math
import operator
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from patterns.binding.program import Tables
from patterns.binding.registers import Registers, Update, updated
from patterns.errors import LimitError, SkipError
from patterns.language.syntax import SkipMode

Event = tuple[int, int, int]
"""(stream number, sequence, time in microseconds)."""

Trace = tuple[Any, int, int, int, int, int, int]
"""One run of rows and what came before: (earlier trace or None, variable, stream, first sequence,
last sequence, ordinal of the first row, number of rows)."""

Thread = tuple[int, Registers, Trace | None]
"""(position that took the last row, registers, trace)."""


@dataclass(frozen=True, slots=True)
class Machine:
    """All that the matcher knows of a rule; sequences are by position unless they say otherwise.

    Attributes:
        tables: The pattern.
        masks: Bits that a row must all have.
        guards: Conditions on the row's values and the registers, taken after the updates.
        updates: What to remember of the row.
        live: Registers that later guards can still read.
        registers: What they hold before the first row.
        within_us: A match's last row is less than this after its first.
        skip: Where the search goes on after a match.
        skip_variables: Indices of the variables that SKIP TO means.
        threads_most: The limit `threads`, for one partition.
        skip_error: What is raised where a match, from its first to its last row, has no row to skip to; asked with
            whether the variable is there: then it is the match's first row.
        is_strict: Whether that limit is an error; else what is remembered of the partition is given up.
    """

    tables: Tables
    masks: tuple[int, ...]
    guards: tuple[Callable[[Sequence[Any], Sequence[Any]], Any] | None, ...]
    updates: tuple[tuple[Update, ...], ...]
    live: tuple[tuple[int, ...], ...]
    registers: Registers
    within_us: int | None
    skip: SkipMode
    skip_variables: tuple[int, ...]
    threads_most: int
    skip_error: Callable[[Event, Event, bool], SkipError]
    is_strict: bool = True

    @property
    def merges_starts(self) -> bool:
        """Whether a thread of a later start is spare where an earlier one has an equal thread."""
        return self.skip is SkipMode.PAST_LAST_ROW and self.within_us is None


@dataclass(frozen=True, slots=True)
class Block:
    """Rows in order, column by column.

    Attributes:
        bits: Which row-local predicates are true.
        events: Stream number, sequence and time.
        values: The slots that guards and registers read.
        starts: The rows, ascending, that a match could begin at; others cannot.
    """

    bits: Sequence[int]
    events: Sequence[Event]
    values: Sequence[Sequence[Any]]
    starts: Sequence[int]


class Ending(NamedTuple):
    """How far a start has come: a match, unless a more preferred one is still found."""

    registers: Registers
    trace: Trace
    event: Event
    ordinal: int


@dataclass(slots=True)
class Attempt:
    """The matches that begin at one row.

    Attributes:
        event: That row.
        ordinal: Its number in the partition.
        threads: What is alive, preferred first.
        ending: The best match so far; less preferred than every thread.
        is_over: Whether the time of WITHIN is over, so that no thread takes another row.
    """

    event: Event
    ordinal: int
    threads: list[Thread]
    ending: Ending | None = None
    is_over: bool = False


@dataclass(slots=True)
class Partition:
    """What is remembered of one partition.

    Attributes:
        attempts: By start.
        ordinal: The number of its next row.
        last: The event of its last row, as far as anything was remembered of it then.
        key: Its partition columns, for virtual rows.
        fired_us: The time of the last virtual row; None: there was none.
        number: How many matches were found, the empty ones among them.
        resumed: The number of the row where the search went on after the last match.
    """

    attempts: list[Attempt] = field(default_factory=list)
    ordinal: int = 0
    last: Event | None = None
    key: tuple[Any, ...] = ()
    fired_us: int | None = None
    number: int = 0
    resumed: int = 0


class Found(NamedTuple):
    """A final match.

    Attributes:
        first: The event of its first row.
        ending: Its last row, and what was remembered.
        decided_us: The event time from which it was final; None: only the end of the input decided it.
        decided_by: The event that decided it; None: time, by WITHIN, or the end of the input.
        number: The match's number in its partition, from 1; 0 where nobody counts.
    """

    first: Event
    ending: Ending
    decided_us: int | None
    decided_by: Event | None
    number: int = 0


@dataclass(frozen=True, slots=True)
class Loss:
    """Partial matches that were given up.

    Attributes:
        key: The partition's columns.
        threads: How many there were.
        since_us: The time of the first row of the first.
    """

    key: tuple[Any, ...]
    threads: int
    since_us: int


class Matcher:
    """Runs one machine over rows of any partition. Who drives it takes the `losses`."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.merges_starts = machine.merges_starts
        tables = machine.tables
        self.ends_late = tuple(map(operator.ne, tables.accepts_end, tables.accepts))
        """For each position whether only `$` makes the rows so far a match."""
        self.losses: list[Loss] = []

    def run(self, partition: Partition, block: Block, begin: int, end: int) -> list[Found]:
        """The matches that the rows `begin` to `end` of the block, the partition's next, make final.

        Raises:
            SkipError: AFTER MATCH SKIP has no row to go to.
            LimitError: More threads than the limit, where that is strict.
        """
        found: list[Found] = []
        attempts = partition.attempts
        base = partition.ordinal - begin
        next_start = bisect_left(block.starts, begin)
        row = begin
        while True:
            if not attempts:
                next_start = bisect_left(block.starts, row, next_start)
                row = block.starts[next_start] if next_start < len(block.starts) else end
            if row >= end:
                break
            event = block.events[row]
            if attempts and self._is_due(partition, event[2]):
                partition.ordinal = base + row
                found += self.expire(partition, event[2])
                found += self._not_last(partition, event)
            while next_start < len(block.starts) and block.starts[next_start] < row:
                next_start += 1
            if next_start < len(block.starts) and block.starts[next_start] == row:
                self._begin(attempts, event, base + row)
            if attempts:
                self._step(partition, block, row, base + row)
                found += self._resolved(partition, event[2], event)
            row += 1
        partition.ordinal = base + end
        partition.last = block.events[end - 1]
        return found

    def expire(self, partition: Partition, until_us: int) -> list[Found]:
        """The matches made final because time has come to `until_us`: no row before it is still to come."""
        return self._lapsed(partition, until_us)

    def finish(self, partition: Partition) -> list[Found]:
        """The matches made final because there are no more rows."""
        found = self._lapsed(partition, None)
        while partition.attempts:
            self._end(partition.attempts[0], partition)
            found += self._resolved(partition, None, None)
        return found

    def _lapsed(self, partition: Partition, until_us: int | None) -> list[Found]:
        """The matches made final because the time of their WITHIN is over; None: it is for all, and no row came.

        One by one, so that each is decided by its own deadline however far time went at once.
        """
        found: list[Found] = []
        while (attempt := self._waiting(partition)) and (until_us is None or self._is_over(attempt, until_us)):
            deadline = self.deadline(attempt)
            if deadline is None:
                break
            attempt.is_over = True
            attempt.threads = [each for each in attempt.threads if self.ends_late[each[0]]]
            found += self._resolved(partition, deadline, None)
        return found

    def _not_last(self, partition: Partition, event: Event) -> list[Found]:
        """The matches made final because a row came, so that the one before it was not the partition's last."""
        over = [attempt for attempt in partition.attempts if attempt.is_over]
        for attempt in over:
            attempt.threads = []
        return self._resolved(partition, event[2], event) if over else []

    def _waiting(self, partition: Partition) -> Attempt | None:
        """The first attempt that the time of WITHIN can still end."""
        return next((attempt for attempt in partition.attempts if not attempt.is_over), None)

    def _end(self, attempt: Attempt, partition: Partition) -> None:
        """No more rows: the preferred of the threads that may end here is the attempt's match, if there is one."""
        accepts_end = self.machine.tables.accepts_end
        for position, registers, trace in attempt.threads:
            if accepts_end[position]:
                assert trace is not None, "a thread has taken a row"
                assert partition.last is not None, "there are threads"
                attempt.ending = Ending(registers, trace, partition.last, partition.ordinal - 1)
                break
        attempt.threads = []

    def deadline(self, attempt: Attempt) -> int | None:
        """The time from which on no row can belong to the attempt."""
        within = self.machine.within_us
        return None if within is None else attempt.event[2] + within

    def due(self, partition: Partition) -> int | None:
        """When the matcher wants to be told that time has come, to decide what no row need decide."""
        attempt = self._waiting(partition)
        return None if attempt is None else self.deadline(attempt)

    def _is_due(self, partition: Partition, now_us: int) -> bool:
        return self._is_over(partition.attempts[0], now_us)

    def _is_over(self, attempt: Attempt, now_us: int) -> bool:
        within = self.machine.within_us
        return within is not None and attempt.event[2] + within <= now_us

    def _begin(self, attempts: list[Attempt], event: Event, ordinal: int) -> None:
        machine = self.machine
        place = machine.tables.starting(is_first=ordinal == 0)
        attempts.append(Attempt(event, ordinal, [(place, machine.registers, None)]))

    def _step(self, partition: Partition, block: Block, row: int, ordinal: int) -> None:
        """Every thread of every attempt takes the row, or dies.

        A thread may stand for an equal one of a later start unless an earlier start may yet settle
        for a match that covers the former's start and not the latter's; `safe_until` is the first
        such end. Ends that are found from now on cover every start there is.
        """
        shares = self.merges_starts
        seen: dict[Any, float] = {}
        ends: list[int] = []
        threads = 0
        for attempt in partition.attempts:
            safe_until = math.inf
            if not shares:
                seen = {}
            elif ends:
                safe_until = min((end for end in ends if end >= attempt.ordinal), default=math.inf)
            if attempt.ending is not None:
                ends.append(attempt.ending.ordinal)
            if attempt.threads:
                self._advance(attempt, block, row, ordinal, seen, safe_until)
                threads += len(attempt.threads)
        if threads > self.machine.threads_most:
            if self.machine.is_strict:
                raise LimitError(
                    f"a partition has {threads} partial matches; the limit `threads` is {self.machine.threads_most}. "
                    "Begin the pattern with a rarer row, or shorten WITHIN"
                )
            self.losses.append(Loss(partition.key, threads, partition.attempts[0].event[2]))
            partition.attempts.clear()

    def _advance(
        self, attempt: Attempt, block: Block, row: int, ordinal: int, seen: dict[Any, float], safe_until: float
    ) -> None:
        machine = self.machine
        start = attempt.ordinal
        masks, guards, updates, live = machine.masks, machine.guards, machine.updates, machine.live
        tables = machine.tables
        follow, accepts, accepts_end, variables = tables.follow, tables.accepts, tables.accepts_end, tables.variables
        bits, event, values = block.bits[row], block.events[row], block.values[row]
        threads: list[Thread] = []
        for position, registers, trace in attempt.threads:
            for target in follow[position]:
                mask = masks[target]
                if bits & mask != mask:
                    continue
                taken = updated(registers, updates[target], values) if updates[target] else registers
                guard = guards[target]
                if guard is not None and guard(values, taken) is not True:
                    continue
                key = (target, *[taken[index] for index in live[target]]) if live[target] else target
                if seen.get(key, -1) >= start:
                    continue
                seen[key] = safe_until
                longer = _extended(trace, variables[target], event, ordinal)
                if follow[target] or accepts_end[target] != accepts[target]:
                    threads.append((target, taken, longer))
                if accepts[target]:
                    attempt.threads = threads
                    attempt.ending = Ending(taken, longer, event, ordinal)
                    return
        attempt.threads = threads

    def _resolved(self, partition: Partition, decided_us: int | None, decided_by: Event | None) -> list[Found]:
        """The matches that nothing earlier or more preferred can still replace; attempts that failed are removed."""
        found: list[Found] = []
        attempts = partition.attempts
        if not attempts:
            return found
        first = attempts[0]
        if self.machine.skip is SkipMode.PAST_LAST_ROW and decided_by and first.ending and len(attempts) > 1:
            # The first start's match can only grow: what begins inside it is spare.
            attempts[1:] = [later for later in attempts[1:] if later.ordinal > first.ending.ordinal]
        if any(not attempt.threads and attempt.ending is None for attempt in attempts):
            attempts[:] = [attempt for attempt in attempts if attempt.threads or attempt.ending is not None]
        while attempts and not attempts[0].threads:
            attempt = attempts.pop(0)
            if attempt.ending is not None:
                resume = self.resume(attempt.event, attempt.ordinal, attempt.ending)
                number = self._count(partition, attempt.ordinal, resume)
                found.append(Found(attempt.event, attempt.ending, decided_us, decided_by, number))
                attempts[:] = [later for later in attempts if later.ordinal >= resume]
        return found

    def _count(self, partition: Partition, start: int, resume: int) -> int:
        """The number of the match that begins there; every row before it where the search stood is an empty match."""
        tables = self.machine.tables
        if tables.accepts[tables.start]:
            partition.number += start - partition.resumed
        if partition.resumed == 0 < start:
            partition.number += tables.accepts[tables.first_start] - tables.accepts[tables.start]
        partition.number += 1
        partition.resumed = resume
        return partition.number

    def resume(self, first: Event, start: int, ending: Ending) -> int:
        """The number of the row where the search goes on after the match that begins at row `start`, which is `first`.

        Raises:
            SkipError: There is none.
        """
        skip = self.machine.skip
        if skip is SkipMode.PAST_LAST_ROW:
            return ending.ordinal + 1
        if skip is SkipMode.TO_NEXT_ROW:
            return start + 1
        target = _skip_target(ending.trace, self.machine.skip_variables, is_first=skip is SkipMode.TO_FIRST)
        if target is None or target == start:
            raise self.machine.skip_error(first, ending.event, target is not None)
        return target


def _extended(trace: Trace | None, variable: int, event: Event, ordinal: int) -> Trace:
    stream, sequence, _ = event
    if trace is not None and trace[1] == variable and trace[2] == stream and trace[4] < sequence:
        return (trace[0], variable, stream, trace[3], sequence, trace[5], trace[6] + 1)
    return (trace, variable, stream, sequence, sequence, ordinal, 1)


def runs(trace: Trace | None) -> list[Trace]:
    """The runs of a trace, from the match's first row to its last."""
    found = []
    while trace is not None:
        found.append(trace)
        trace = trace[0]
    return found[::-1]


def _skip_target(trace: Trace, variables: tuple[int, ...], is_first: bool) -> int | None:
    of_variable = [run for run in runs(trace) if run[1] in variables]
    if not of_variable:
        return None
    return of_variable[0][5] if is_first else of_variable[-1][5] + of_variable[-1][6] - 1
