"""The engine: a bound rule over rows that are final, in the total order.

Between the rows and the matcher: rows are grouped by partition, what they
alone decide is evaluated over columns, rows that no match can begin at and no
partial match waits for are passed over, and the matcher gets the rest as
integers. It knows nothing of watermarks; `patterns.run` releases the rows.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from patterns.binding.bound import BoundRule, Register
from patterns.binding.columns import ColumnEvaluator, Rows, arrow_type
from patterns.binding.expressions import walk
from patterns.binding.guards import compile_guard
from patterns.binding.registers import Update, initial, update_of
from patterns.binding.registers import live_registers as _live
from patterns.binding.rows import SEQUENCE, STREAM, TIME, findable, partition_codes
from patterns.engine.ahead import Ahead, Needs, Release, moved, run
from patterns.engine.matcher import Block, Event, Found, Loss, Machine, Matcher, Partition
from patterns.engine.skipping import rule_skip_error
from patterns.engine.timers import TimedMatcher, timers_of
from patterns.errors import LimitError
from patterns.scene.places import Places
from patterns.scene.site import Site

Key = tuple[Any, ...]


@dataclass(slots=True)
class Open:
    """What is remembered of one partition.

    Attributes:
        partition: Its partial matches.
        tail: Its last rows, as far back as the rule looks.
        due_us: The deadline under which it waits in the queue.
        waiting: The events of the last of these rows, which wait for rows after them.
        released: What released the last row that did not wait any longer.
    """

    partition: Partition = field(default_factory=Partition)
    tail: Sequence[tuple[Any, ...]] = ()
    due_us: int | None = None
    waiting: Sequence[Event] = ()
    released: Release | None = None

    @property
    def last(self) -> Event | None:
        """The event of its last row."""
        return self.waiting[-1] if self.waiting else self.partition.last


@dataclass(frozen=True, slots=True)
class _Grouped:
    """Rows sorted by partition, with the tails of their partitions before them.

    Attributes:
        table: The rows.
        bounds: Where each group begins, and the end.
        fresh: For each group, where its rows begin that are new; before are those of its tail.
        keys: For each group, its partition columns.
    """

    table: pa.Table
    bounds: NDArray[np.int64]
    fresh: NDArray[np.int64]
    keys: list[Key]


class Engine:
    """Runs one rule. Partitions are independent; those with nothing to remember are forgotten."""

    def __init__(self, bound: BoundRule, site: Site, *, is_strict: bool = True) -> None:
        """Build an engine that remembers nothing.

        Args:
            bound: The rule.
            site: What is known of the cameras.
            is_strict: Whether a limit is an error; else what it costs is given up, see `losses`.
        """
        self.bound = bound
        self.is_strict = is_strict
        self.places = Places(bound.rule.zones, bound.rule.lines, site)
        self.masks = tuple(sum(1 << at for at in each.predicates) for each in bound.conditions)
        machine = machine_of(bound, self.places, self.masks, is_strict=is_strict)
        self.matcher = Matcher(machine)
        if bound.timers:
            self.matcher = TimedMatcher(machine, timers_of(bound, self.places), bound.timed)
        self.ahead = Ahead(bound) if any(bound.ahead) else None
        self.open: dict[Key, Open] = {}
        self._due: list[tuple[int, int, Key]] = []
        self._serial = count()

    def take(self, rows: pa.Table) -> list[tuple[Key, Found]]:
        """The matches that these rows, the next in the total order, make final; partition by partition.

        Raises:
            MatchError: The rule cannot go on with these rows.
            LimitError: It remembers more than it may, where that is strict.
        """
        if rows.num_rows == 0:
            return []
        found = self._taken(self._grouped(rows), is_end=False)
        if self.is_strict and len(self.open) > self.bound.limits.partitions:
            raise LimitError(f"rule {self.bound.rule.rule}: {self._too_many}. A WITHIN lets partitions be forgotten")
        return found

    def _taken(self, grouped: _Grouped, *, is_end: bool) -> list[tuple[Key, Found]]:
        evaluator = self._evaluator(grouped)
        truths = [evaluator.truth(predicate) for predicate in self.bound.predicates]
        starts = self._starts(truths, grouped)
        begins = starts if self.ahead is None else starts | self.ahead.may_begin(truths, len(starts))
        active = self._active(grouped, begins)
        kept = self._kept(grouped, active)
        block = self._block(grouped, evaluator, truths, starts, kept)
        needs = None if self.ahead is None else self.ahead.needs(truths, starts, kept)
        return self._run(grouped, block, active, needs, is_end=is_end)

    @property
    def _too_many(self) -> str:
        return f"{len(self.open)} partitions are remembered; the limit `partitions` is {self.bound.limits.partitions}"

    def losses(self) -> list[Loss]:
        """What the limit `threads` cost since this was last asked."""
        losses, self.matcher.losses = self.matcher.losses, []
        return losses

    def limit_partitions(self) -> tuple[str, list[Loss]]:
        """Gives up partitions, those that were silent longest, if there are more than the limit; why, and which."""
        most, why = self.bound.limits.partitions, self._too_many
        if len(self.open) <= most:
            return why, []
        by_age = sorted(self.open, key=lambda key: _touched_us(self.open[key]))
        return why, [self._give_up(key) for key in by_age[: len(by_age) - most // 2]]

    def give_up_silent(self, before_us: int) -> list[Loss]:
        """Gives up the partitions whose last row lies before this time."""
        return [self._give_up(key) for key in [key for key, s in self.open.items() if _touched_us(s) < before_us]]

    def _give_up(self, key: Key) -> Loss:
        state = self.open.pop(key)
        partition = state.partition
        threads = sum(len(attempt.threads) for attempt in partition.attempts)
        first = partition.attempts[0].event if partition.attempts else state.last
        return Loss(key, threads, 0 if first is None else first[2])

    def expire(self, until_us: int) -> list[tuple[Key, Found]]:
        """The matches made final because no row before this time is still to come."""
        found: list[tuple[Key, Found]] = []
        while self._due and self._due[0][0] <= until_us:
            due_us, _, key = heapq.heappop(self._due)
            state = self.open.get(key)
            if state is None or state.due_us != due_us:
                continue
            state.due_us = None
            # No time has come for what a row before it may still decide, which waits.
            until_us_here = min(until_us, state.waiting[0][2]) if state.waiting else until_us
            expired = self.matcher.expire(state.partition, until_us_here)
            found += [(key, each) for each in moved(expired, state.released)]
            self._keep(key, state)
        return found

    def finish(self, newest_us: int) -> list[tuple[Key, Found]]:
        """The matches made final because there are no more rows, and time stands still; everything is forgotten."""
        waiting = [key for key, state in self.open.items() if state.waiting]
        found = self._taken(self._remembered(waiting), is_end=True) if waiting else []
        found += self.expire(newest_us + 1) if self.bound.timers else []
        found += [
            (key, each)
            for key, state in self.open.items()
            for each in moved(self.matcher.finish(state.partition), state.released)
        ]
        self.open.clear()
        self._due.clear()
        return found

    def put(self, key: Key, state: Open) -> None:
        """Remembers a partition that was saved."""
        key = findable(key)
        state.partition.key = key
        self._keep(key, state)

    # From rows to columns.

    def _grouped(self, rows: pa.Table) -> _Grouped:
        codes = partition_codes(rows, self.bound.keys)
        order = np.argsort(codes, kind="stable")
        codes = codes[order]
        table = rows.take(pa.array(order)).combine_chunks() if np.any(np.diff(order) < 0) else rows.combine_chunks()
        bounds = np.concatenate(([0], np.flatnonzero(np.diff(codes)) + 1, [len(codes)]))
        heads = table.select(list(self.bound.keys)).take(pa.array(bounds[:-1]))
        columns = [heads.column(name).to_pylist() for name in self.bound.keys]
        keys: list[Key] = list(map(findable, zip(*columns, strict=True))) if columns else [()]
        return self._with_tails(_Grouped(table, bounds, bounds[:-1], keys))

    @property
    def _has_tails(self) -> bool:
        return self.bound.reach > 0 or self.ahead is not None

    def _remembered(self, keys: list[Key]) -> _Grouped:
        """The rows that these partitions remember, and no others."""
        names = (STREAM, TIME, SEQUENCE, *self.bound.columns)
        types = (*[pa.int64()] * 3, *(arrow_type(kind) for kind in self.bound.columns.values()))
        nothing = pa.schema(list(zip(names, types, strict=True))).empty_table()
        bounds = np.zeros(len(keys) + 1, dtype=np.int64)
        return self._with_tails(_Grouped(nothing, bounds, bounds[:-1], keys))

    def _with_tails(self, grouped: _Grouped) -> _Grouped:
        """The groups, each after the rows that its partition remembers; those that wait are new still."""
        if not self._has_tails or not self.open:
            return grouped
        states = [self.open.get(key) for key in grouped.keys]
        tails = [state.tail if state is not None else () for state in states]
        counts = np.array([len(tail) for tail in tails], dtype=np.int64)
        if not counts.any():
            return grouped
        lengths = np.diff(grouped.bounds)
        groups = np.arange(len(lengths))
        order = np.argsort(np.concatenate((np.repeat(groups, counts), np.repeat(groups, lengths))), kind="stable")
        before = _as_table([row for tail in tails for row in tail], grouped.table.schema)
        table = pa.concat_tables([before, grouped.table]).take(pa.array(order)).combine_chunks()
        bounds = np.concatenate(([0], np.cumsum(counts + lengths)))
        waiting = np.array([len(state.waiting) if state is not None else 0 for state in states], dtype=np.int64)
        return _Grouped(table, bounds, bounds[:-1] + counts - waiting, grouped.keys)

    def _evaluator(self, grouped: _Grouped) -> ColumnEvaluator:
        lengths = np.diff(grouped.bounds)
        ordinals = np.arange(grouped.table.num_rows, dtype=np.int64) - np.repeat(grouped.bounds[:-1], lengths)
        return ColumnEvaluator(Rows(grouped.table, ordinals), self.places)

    # From columns to the rows that matter.

    def _starts(self, truths: list[NDArray[np.bool_]], grouped: _Grouped) -> NDArray[np.bool_]:
        """Which new rows a match could begin at, judged by the row and the one after it, where nothing looks ahead."""
        tables = self.bound.tables
        able = self._able(truths, grouped.table.num_rows)
        is_last = np.zeros(grouped.table.num_rows, dtype=bool)
        is_last[grouped.bounds[1:] - 1] = True
        starts = np.zeros(grouped.table.num_rows, dtype=bool)
        seen: set[tuple[int, frozenset[int] | None]] = set()
        for position in tables.firsts():
            first = tables.variables[position]
            next_ones = frozenset(tables.variables[each] for each in tables.follow[position])
            is_open = tables.accepts[position] or any(self.bound.timed[each] for each in next_ones)
            after = None if is_open or self.ahead is not None else next_ones
            if self.bound.timed[first]:
                continue
            if (first, after) in seen:
                continue
            seen.add((first, after))
            if after is None:
                starts |= able[first]
                continue
            goes_on = np.logical_or.reduce([np.zeros_like(starts), *(able[variable] for variable in after)])
            starts |= able[first] & (is_last | np.append(goes_on[1:], False))
        for begin, fresh in zip(grouped.bounds[:-1], grouped.fresh, strict=True) if self._has_tails else ():
            starts[begin:fresh] = False
        return starts

    def _able(self, truths: list[NDArray[np.bool_]], rows: int) -> list[NDArray[np.bool_]]:
        """For each variable, the rows whose row-local conditions hold."""
        everywhere = np.ones(rows, dtype=bool)
        return [
            np.logical_and.reduce([truths[at] for at in each.predicates]) if each.predicates else everywhere
            for each in self.bound.conditions
        ]

    def _active(self, grouped: _Grouped, starts: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which groups have a start, or partial matches that wait."""
        active = np.logical_or.reduceat(starts, grouped.bounds[:-1])
        if self.open:
            waits = (key in self.open and bool(self.open[key].partition.attempts) for key in grouped.keys)
            active |= np.fromiter(waits, dtype=bool, count=len(grouped.keys))
        return active

    def _kept(self, grouped: _Grouped, active: NDArray[np.bool_]) -> NDArray[np.int64]:
        """The new rows of the active groups, one after the other."""
        lengths = np.diff(grouped.bounds)
        is_fresh = np.arange(grouped.table.num_rows) >= np.repeat(grouped.fresh, lengths)
        return np.flatnonzero(np.repeat(active, lengths) & is_fresh)

    def _block(
        self,
        grouped: _Grouped,
        evaluator: ColumnEvaluator,
        truths: list[NDArray[np.bool_]],
        starts: NDArray[np.bool_],
        kept: NDArray[np.int64],
    ) -> Block:
        """The kept rows as the matcher takes them."""
        bits = np.zeros(len(kept), dtype=np.int64)
        for at, truth in enumerate(truths):
            bits |= truth[kept].astype(np.int64) << at
        events = [grouped.table.column(name).to_numpy()[kept].tolist() for name in (STREAM, SEQUENCE, TIME)]
        slots = [evaluator.column(slot).take(pa.array(kept)).to_pylist() for slot in self.bound.slots]
        values = list(zip(*slots, strict=True)) if slots else [()] * len(kept)
        return Block(bits.tolist(), list(zip(*events, strict=True)), values, np.flatnonzero(starts[kept]).tolist())

    def _run(
        self, grouped: _Grouped, block: Block, active: NDArray[np.bool_], needs: Needs | None, *, is_end: bool
    ) -> list[tuple[Key, Found]]:
        found: list[tuple[Key, Found]] = []
        at = 0
        wanted = self._wanted(grouped, active)
        last = grouped.table.select([STREAM, SEQUENCE, TIME]).take(pa.array(grouped.bounds[1:] - 1))
        events = list(zip(*(column.to_pylist() for column in last.columns), strict=True))
        for group in wanted:
            key = grouped.keys[group]
            state = self.open.get(key) or Open(Partition(key=key))
            length = int(grouped.bounds[group + 1] - grouped.fresh[group])
            if active[group]:
                found += [(key, each) for each in self._run_one(state, block, needs, at, at + length, is_end=is_end)]
                at += length
            else:
                state.partition.ordinal += length
                state.partition.last = events[group]
                state.waiting = ()
            self._keep(key, state)
        if self._has_tails:
            self._keep_tails(grouped, [group for group in wanted if grouped.keys[group] in self.open])
        return found

    def _wanted(self, grouped: _Grouped, active: NDArray[np.bool_]) -> Sequence[int]:
        """The groups whose rows change what is remembered: where rows wait, also those that say they need not."""
        if self.bound.remembers_all:
            return range(len(grouped.keys))
        if self.ahead is not None and self.open:
            active = active | np.fromiter((key in self.open for key in grouped.keys), bool, len(grouped.keys))
        wanted: list[int] = np.flatnonzero(active).tolist()
        return wanted

    def _run_one(
        self, state: Open, block: Block, needs: Needs | None, begin: int, end: int, *, is_end: bool
    ) -> list[Found]:
        if needs is None:
            return self.matcher.run(state.partition, block, begin, end)
        found, at, state.released = run(
            self.matcher, state.partition, block, needs, (begin, end), state.released, is_end=is_end
        )
        state.waiting = block.events[at:end]
        return found

    def _keep_tails(self, grouped: _Grouped, groups: list[int]) -> None:
        """Remembers the last rows of these groups: those that wait, and as many as any expression looks back."""
        ends = [int(grouped.bounds[group + 1]) for group in groups]
        begins = [
            max(int(grouped.bounds[group]), end - len(self.open[grouped.keys[group]].waiting) - self.bound.reach)
            for group, end in zip(groups, ends, strict=True)
        ]
        indices = [at for begin, end in zip(begins, ends, strict=True) for at in range(begin, end)]
        columns = [column.to_pylist() for column in grouped.table.take(pa.array(indices, pa.int64())).columns]
        rows = list(zip(*columns, strict=True))
        at = 0
        for group, begin, end in zip(groups, begins, ends, strict=True):
            self.open[grouped.keys[group]].tail = rows[at : at + end - begin]
            at += end - begin

    def _keep(self, key: Key, state: Open) -> None:
        """Remembers the partition if it has anything to remember, and when it falls due."""
        attempts = state.partition.attempts
        if not attempts and not self.bound.remembers_all and not state.waiting:
            self.open.pop(key, None)
            return
        self.open[key] = state
        due_us = self.matcher.due(state.partition)
        if due_us is not None and state.waiting and state.waiting[0][2] < due_us:
            return
        if due_us is not None and (state.due_us is None or due_us < state.due_us):
            state.due_us = due_us
            heapq.heappush(self._due, (due_us, next(self._serial), key))


def _touched_us(state: Open) -> int:
    """The time of the partition's last row."""
    return 0 if state.last is None else state.last[2]


def _as_table(rows: Sequence[tuple[Any, ...]], schema: pa.Schema) -> pa.Table:
    columns = zip(*rows, strict=True)
    return pa.table([pa.array(column, each.type) for column, each in zip(columns, schema, strict=True)], schema=schema)


def machine_of(bound: BoundRule, places: Places, masks: tuple[int, ...], *, is_strict: bool = True) -> Machine:
    """What the matcher needs to know of the rule."""
    tables = bound.tables
    slots = {slot: index for index, slot in enumerate(bound.slots)}
    register_of = dict(bound.register_of)
    guards = [
        None if each.guard is None else compile_guard(each.guard, slots, register_of, places)
        for each in bound.conditions
    ]
    updates = [_updates(bound.registers, variable, bound.limits.listed) for variable in range(len(bound.variables))]
    return Machine(
        tables=tables,
        masks=tuple(masks[variable] for variable in tables.variables),
        guards=tuple(guards[variable] for variable in tables.variables),
        updates=tuple(updates[variable] for variable in tables.variables),
        live=live_registers(bound),
        registers=tuple(initial(register) for register in bound.registers),
        within_us=bound.within_us,
        skip=bound.skip,
        skip_variables=bound.skip_variables,
        threads_most=bound.limits.threads,
        skip_error=partial(rule_skip_error, bound),
        is_strict=is_strict,
    )


def live_registers(bound: BoundRule) -> tuple[tuple[int, ...], ...]:
    """For each position the registers whose value after it can still change which match is found."""
    reads = [_guard_reads(bound, variable) for variable in range(len(bound.variables))]
    live = _live(bound.tables, bound.registers, reads)
    return tuple(tuple(sorted({*each, *bound.timers})) for each in live)


def _guard_reads(bound: BoundRule, variable: int) -> set[int]:
    guard = bound.conditions[variable].guard
    if guard is None:
        return set()
    return {bound.register_of[part] for part in walk(guard) if part in bound.register_of}


def _updates(registers: tuple[Register, ...], variable: int, listed_most: int) -> tuple[Update, ...]:
    return tuple(
        update_of(index, register, variable, listed_most, wraps=True)
        for index, register in enumerate(registers)
        if register.takes(variable)
    )
