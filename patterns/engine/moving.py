"""What the general matcher remembered of a rule, as the kernel remembers it.

A rule that came before the kernel was compiled on this machine goes on with it afterwards. Contract: what the state
of a `RuleRun` says, the state that comes of it says too; a row that a match may only begin at is a partial match in it,
as it was.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from patterns.binding.bound import BoundRule
from patterns.binding.columns import arrow_type
from patterns.binding.expressions import Kind
from patterns.binding.registers import UNSET, Registers
from patterns.binding.rows import SEQUENCE, STREAM, TIME, StreamNumbers, in_total_order
from patterns.engine import kernel as k
from patterns.engine.engine import Open
from patterns.engine.interning import Keys, Texts
from patterns.engine.kernel import Integers
from patterns.engine.lane_state import Saved, encoded, own_layout, table_of
from patterns.engine.matcher import Attempt, Trace, runs
from patterns.engine.packed import Packed
from patterns.engine.saved import decode, partitions_from_json
from patterns.errors import StateError


def moved_to_kernel(packed: Packed, state: bytes) -> bytes:
    """The state of a rule that ran on the general matcher, for a lane.

    Raises:
        StateError: Not such a state.
    """
    saved = decode(state)
    bound, header = packed.bound, saved.header
    try:
        partitions = list(partitions_from_json(header.pop("partitions")))
    except (KeyError, TypeError, ValueError) as error:
        raise StateError(f"the saved state is damaged: {error}") from error
    kinds = [bound.columns[name] for name in bound.keys]
    keys = Keys(kinds)
    keys.numbers([_column([key[at] for key, _ in partitions], kind) for at, kind in enumerate(kinds)], len(partitions))
    pools = _Pools(bound)
    for number, (_, remembered) in enumerate(partitions):
        pools.add(number, remembered)
    states = [remembered for _, remembered in partitions]
    header |= {
        "texts": pools.texts.known, "key_texts": keys.texts.known, "due_us": pools.due_us,
        "begins_us": header["clock"]["watermark_us"],
    }  # fmt: skip
    tables = {name: table_of(integers) for name, integers in pools.tables().items()} | {
        "keys": table_of(keys.table[: keys.count]),
        "last_rows": table_of(_last_rows(packed, states)),
        "last_ordinals": table_of(_integers([[each.partition.ordinal - 1] for each in states], 1)),
        "tails": _tails(bound, states),
    }
    waiting = saved.waiting
    if waiting is not None:
        waiting = in_total_order(waiting, StreamNumbers.of(header["streams"]))
    return encoded(Saved(header, tables), waiting)


@dataclass(slots=True)
class _Pools:
    """The kernel's records of what partitions remember."""

    bound: BoundRule
    texts: Texts = field(default_factory=Texts)
    due_us: int = int(k.NEVER)
    cells: list[list[int]] = field(default_factory=list)
    attempts: list[list[int]] = field(default_factory=list)
    threads: list[list[int]] = field(default_factory=list)
    registers: list[list[int]] = field(default_factory=list)
    traces: list[list[int]] = field(default_factory=list)

    def tables(self) -> dict[str, Integers]:
        """The records, pool by pool."""
        return {
            "cells": _integers(self.cells, k.C_WIDTH),
            "attempts": _integers(self.attempts, k.A_WIDTH),
            "threads": _integers(self.threads, k.T_WIDTH),
            "registers": _integers(self.registers, max(len(self.bound.registers), 1)),
            "traces": _integers(self.traces, k.X_WIDTH),
        }

    def add(self, number: int, remembered: Open) -> None:
        """One partition."""
        partition = remembered.partition
        cell = _record(k.C_WIDTH, {k.C_PARTITION: number, k.C_NEXT: -1, k.C_FIRST: -1, k.C_LAST: -1})
        # At a row that was seen no match begins any more: where one could, it has.
        cell[k.C_RESUME] = partition.ordinal
        for attempt in partition.attempts:
            at = self._attempt(attempt)
            if cell[k.C_FIRST] < 0:
                cell[k.C_FIRST] = at
            else:
                self.attempts[cell[k.C_LAST]][k.A_NEXT] = at
            cell[k.C_LAST] = at
            cell[k.C_ATTEMPTS] += 1
            cell[k.C_THREADS] += len(attempt.threads)
        self.cells.append(cell)

    def _attempt(self, attempt: Attempt) -> int:
        stream, sequence, time_us = attempt.event
        record = _record(k.A_WIDTH, {
            k.A_NEXT: -1, k.A_ORDINAL: attempt.ordinal, k.A_STREAM: stream, k.A_SEQUENCE: sequence, k.A_TIME: time_us,
            k.A_THREAD: -1, k.E_THREAD: -1, k.A_END: -1,
        })  # fmt: skip
        before = -1
        for position, registers, trace in attempt.threads:
            thread = self._thread(position, registers, trace)
            if before < 0:
                record[k.A_THREAD] = thread
            else:
                self.threads[before][k.T_NEXT] = thread
            before = thread
        ending = attempt.ending
        if ending is not None:
            record[k.E_THREAD] = self._thread(0, ending.registers, ending.trace)
            record[k.E_STREAM], record[k.E_SEQUENCE], record[k.E_TIME] = ending.event
            record[k.E_ORDINAL] = ending.ordinal
        if self.bound.within_us is not None:
            self.due_us = min(self.due_us, time_us + self.bound.within_us)
        self.attempts.append(record)
        return len(self.attempts) - 1

    def _thread(self, position: int, registers: Registers, trace: Trace | None) -> int:
        record = _record(k.T_WIDTH, {k.T_NEXT: -1, k.T_POSITION: position, k.T_TRACE: self._trace(trace)})
        words = []
        for at, value in enumerate(registers):
            record[k.T_UNSET] |= (value is UNSET) << at
            record[k.T_NULLS] |= (value is UNSET or value is None) << at
            words.append(0 if value is UNSET or value is None else self._word(at, value))
        self.threads.append(record)
        self.registers.append(words or [0])
        return len(self.threads) - 1

    def _trace(self, trace: Trace | None) -> int:
        last = -1
        for _, variable, stream, first, end, ordinal, rows in runs(trace):
            self.traces.append(_record(k.X_WIDTH, {
                k.X_PARENT: last, k.X_VARIABLE: variable, k.X_STREAM: stream, k.X_FIRST: first, k.X_LAST: end,
                k.X_ORDINAL: ordinal, k.X_ROWS: rows, k.X_REFERENCES: 1,
            }))  # fmt: skip
            last = len(self.traces) - 1
        return last

    def _word(self, register: int, value: Any) -> int:
        """A value as 64 bits: a number, the bits of a float, the number of a text."""
        slot = self.bound.registers[register].slot
        is_count = self.bound.registers[register].how in ("rows", "values")
        kind = Kind.INT if is_count or slot is None else self.bound.slots[slot].kind
        if kind is Kind.STRING:
            return self.texts.number(value)
        if kind is Kind.FLOAT:
            word: int = struct.unpack("<q", struct.pack("<d", value))[0]
            return word
        return (int(value) + 2**63) % 2**64 - 2**63


def _last_rows(packed: Packed, states: Sequence[Open]) -> Integers:
    """For each partition when and where its last row was; nothing else of it is known."""
    layout = own_layout(packed)
    rows = np.zeros((len(states), k.R_BITS + layout.words + len(layout.slots)), dtype=np.int64)
    for record, remembered in zip(rows, states, strict=True):
        last = remembered.partition.last
        assert last is not None, "what is remembered of a partition comes from its rows"
        record[k.R_STREAM], record[k.R_SEQUENCE], record[k.R_TIME] = last
        record[k.R_NULLS] = (1 << len(layout.slots)) - 1
    return rows


def _tails(bound: BoundRule, states: Sequence[Open]) -> pa.Table:
    """The last rows of each partition, newest first, in the form of `patterns.engine.tails`."""
    if bound.reach == 0:
        return pa.table({})
    kinds = {STREAM: Kind.INT, TIME: Kind.INT, SEQUENCE: Kind.INT, **bound.columns}
    tails = [list(each.tail)[::-1] for each in states]
    said = {"@count": pa.array([len(tail) for tail in tails], pa.int64())}
    for at, (name, kind) in enumerate(kinds.items()):
        for age in range(bound.reach):
            said[f"{age}/{name}"] = _column([tail[age][at] if age < len(tail) else None for tail in tails], kind)
    return pa.table(said)


def _column(values: list[Any], kind: Kind) -> pa.Array:
    return pa.array(values, arrow_type(kind))


def _record(width: int, said: dict[int, int]) -> list[int]:
    return [said.get(at, 0) for at in range(width)]


def _integers(records: Sequence[Sequence[int]], width: int) -> Integers:
    return np.array(records, dtype=np.int64).reshape(len(records), width)
