"""Room for what partitions remember: the kernel's pools, which grow, shrink, and take in those of others."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from patterns.engine import kernel as k
from patterns.engine.kernel import Integers, Scratch, State, Tables

_POOLS = (
    ("cells", k.C_WIDTH, k.C_NEXT, k.FREE_CELL, k.CELLS, k.NEED_CELLS),
    ("attempts", k.A_WIDTH, k.A_NEXT, k.FREE_ATTEMPT, k.ATTEMPTS, k.NEED_ATTEMPTS),
    ("threads", k.T_WIDTH, k.T_NEXT, k.FREE_THREAD, k.THREADS, k.NEED_THREADS),
    ("traces", k.X_WIDTH, k.X_PARENT, k.FREE_TRACE, k.TRACES, k.NEED_TRACES),
)  # fmt: skip
_SMALLEST = 256


@dataclass(frozen=True, slots=True)
class Shape:
    """How many words of bits, slots, registers at most, and rules there are."""

    words: int
    slots: int
    registers: int
    rules: int

    @property
    def row_width(self) -> int:
        """Columns of a row's record."""
        return k.R_BITS + self.words + self.slots


def new_state(shape: Shape) -> State:
    """Room for little, with nothing remembered."""
    state = State(
        controls=np.zeros(k.CONTROLS, dtype=np.int64),
        cells=np.empty((0, k.C_WIDTH), dtype=np.int64),
        attempts=np.empty((0, k.A_WIDTH), dtype=np.int64),
        threads=np.empty((0, k.T_WIDTH), dtype=np.int64),
        registers=np.empty((0, max(shape.registers, 1)), dtype=np.int64),
        traces=np.empty((0, k.X_WIDTH), dtype=np.int64),
        found=np.empty((_SMALLEST, k.F_WIDTH), dtype=np.int64),
        last_rows=np.empty((0, shape.row_width), dtype=np.int64),
        last_ordinals=np.empty(0, dtype=np.int64),
        first_cells=np.empty(0, dtype=np.int64),
        failures=np.zeros(shape.rules, dtype=np.int64),
    )
    state.controls[[k.FREE_CELL, k.FREE_ATTEMPT, k.FREE_THREAD, k.FREE_TRACE]] = -1
    state.controls[k.DUE] = k.NEVER
    return grown(state)


def grown(state: State) -> State:
    """The same with twice the room, or more, in each pool that has less room than the kernel asked for."""
    changed: dict[str, Any] = {}
    for name, _, link, head, count, needed in _POOLS:
        pool = getattr(state, name)
        missing = int(state.controls[needed]) - int(state.controls[count])
        if missing <= 0 and len(pool):
            continue
        length = max(2 * len(pool), len(pool) + missing, _SMALLEST)
        changed[name] = _longer(pool, length, link, state.controls, head, count)
        if name == "cells":
            changed[name][len(pool) :, k.C_RULE] = -1
        if name == "threads":
            registers = np.empty((length, state.registers.shape[1]), dtype=np.int64)
            registers[: len(pool)] = state.registers
            changed["registers"] = registers
    used = int(state.controls[k.FOUND])
    if used + int(state.controls[k.NEED_FOUND]) > len(state.found):
        found = np.empty((2 * used + int(state.controls[k.NEED_FOUND]), k.F_WIDTH), dtype=np.int64)
        found[:used] = state.found[:used]
        changed["found"] = found
    return state._replace(**changed)


def with_partitions(state: State, count: int) -> State:
    """The same with room for so many partitions, twice as many if it has to grow."""
    have = len(state.first_cells)
    if count <= have:
        return state
    room = max(count, 2 * have, _SMALLEST)
    last_rows = np.empty((room, state.last_rows.shape[1]), dtype=np.int64)
    last_rows[:have] = state.last_rows
    return state._replace(
        last_rows=last_rows,
        last_ordinals=np.concatenate((state.last_ordinals, np.full(room - have, -1, dtype=np.int64))),
        first_cells=np.concatenate((state.first_cells, np.full(room - have, -1, dtype=np.int64))),
    )


def with_partitions_kept(state: State, kept: Integers) -> State:
    """The same with these partitions alone, numbered in this order; nothing may be remembered of the others."""
    numbers = np.full(len(state.first_cells), -1, dtype=np.int64)
    numbers[kept] = np.arange(len(kept))
    is_used = state.cells[:, k.C_RULE] >= 0
    state.cells[is_used, k.C_PARTITION] = numbers[state.cells[is_used, k.C_PARTITION]]
    return state._replace(
        last_rows=state.last_rows[kept],
        last_ordinals=state.last_ordinals[kept],
        first_cells=state.first_cells[kept],
    )


def rules_of_threads(state: State) -> Integers:
    """For each record of a thread the rule that remembers it; -1: the record is free."""
    cells, attempts = state.cells, state.attempts
    used = cells[cells[:, k.C_RULE] >= 0]
    said = reached(len(attempts), (used[:, k.C_FIRST], used[:, k.C_RULE] + 1), attempts[:, k.A_NEXT])
    remembered, rules_of = attempts[said > 0], said[said > 0]
    rules = reached(len(state.threads), (remembered[:, k.A_THREAD], rules_of), state.threads[:, k.T_NEXT])
    has_ending = remembered[:, k.E_THREAD] >= 0
    rules[remembered[has_ending, k.E_THREAD]] = rules_of[has_ending]
    return rules - 1


def reached(count: int, roots: tuple[Integers, Integers], following: Integers) -> Integers:
    """What the roots say, for each record on the way from them; -1 is no record."""
    said = np.zeros(count, dtype=np.int64)
    records, values = roots
    while len(records):
        is_there = records >= 0
        records, values = records[is_there], values[is_there]
        said[records] = values
        records = following[records]
    return said


def new_scratch(tables: Tables, shape: Shape) -> Scratch:
    """Room to work in, for these rules."""
    most = max(tables.rules[:, k.U_THREADS_MOST].max(initial=0), 1)
    entries = 1 << int(4 * (most + 1024)).bit_length()
    positions = len(tables.positions)

    def room(count: int) -> Integers:
        return np.zeros(count, dtype=np.int64)

    scratch = Scratch(
        controls=room(4),
        position_stamps=room(positions),
        position_safe=room(positions),
        hash_stamps=room(entries),
        hash_positions=room(entries),
        hash_threads=room(entries),
        hash_safe=room(entries),
        started=room(shape.rules),
        starts=room(shape.rules),
        other_starts=room(shape.rules),
        memo=room(1 + 2 * shape.words),
        stack=room(k.STACK + 2),
        stack_nulls=room(k.STACK + 2),
        work=room(shape.rules),
    )
    scratch.memo[0] = -1
    return scratch


def _longer(pool: Integers, length: int, link: int, controls: Integers, head: int, count: int) -> Integers:
    """The pool with more records, which are free."""
    have = len(pool)
    longer = np.empty((length, pool.shape[1]), dtype=np.int64)
    longer[:have] = pool
    longer[have:, link] = np.arange(have + 1, length + 1)
    longer[-1, link] = controls[head]
    controls[head] = have
    controls[count] += length - have
    return longer
