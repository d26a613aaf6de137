"""What the kernel remembered of a rule, as the general matcher remembers it.

Where the kernel is not compiled (a new machine, or a new version of it), a rule that ran on it goes on at once on the
general matcher. Contract: what the saved state says, the state that comes of it says too. The kernel keeps a row that
only the next row can make the beginning of a match as its partition's last row; the general matcher begins a
partial match there, and so does this.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from patterns.binding.bound import BoundRule
from patterns.binding.columns import arrow_type
from patterns.binding.expressions import Kind
from patterns.binding.registers import UNSET, Registers
from patterns.binding.rows import SEQUENCE, STREAM, TIME
from patterns.engine import kernel as k
from patterns.engine import saved as general
from patterns.engine.engine import Key, Open, machine_of
from patterns.engine.interning import Texts, as_values, key_columns
from patterns.engine.kernel import Integers
from patterns.engine.lane_state import Saved, decoded, integers_of, own_layout
from patterns.engine.matcher import Attempt, Block, Ending, Event, Matcher, Partition, Thread, Trace
from patterns.engine.packed import Packed
from patterns.engine.records import ROW_COLUMNS, STREAM_COLUMNS
from patterns.scene.places import Places
from patterns.scene.site import Site


def moved_from_kernel(packed: Packed, state: bytes) -> bytes:
    """The state of a rule that ran in a lane, for a `RuleRun`.

    Raises:
        StateError: Not such a state.
    """
    saved = decoded(state)
    bound = packed.bound
    kept = ("rule", "columns", "streams", "site", "clock", "emitter", "counts")
    header = {name: saved.header[name] for name in kept}
    partitions = _Remembered(packed, saved).partitions()
    header["partitions"] = [
        general.partition_to_json(key, each) for key, each in partitions if each.partition.attempts or bound.looks_back
    ]  # fmt: skip
    waiting = saved.tables["waiting"]
    rows = _whole(bound, waiting, header["streams"]) if waiting.num_rows else None
    return general.encode(general.Saved(header, rows))


@dataclass(frozen=True, slots=True)
class _Pools:
    """The kernel's records as lists."""

    cells: list[list[int]]
    attempts: list[list[int]]
    threads: list[list[int]]
    registers: list[Registers]
    traces: list[list[int]]


class _Remembered:
    """What a saved state says of partitions."""

    def __init__(self, packed: Packed, saved: Saved) -> None:
        self.packed = packed
        self.bound = packed.bound
        self.saved = saved
        self.texts = Texts(saved.header["texts"])
        tables = {
            name: integers_of(table) for name, table in saved.tables.items() if name != "waiting" and name != "tails"
        }
        self.last_rows, self.ordinals = tables["last_rows"], tables["last_ordinals"]
        self.keys = tables["keys"]
        registers = self._registers(tables["registers"], tables["threads"])
        lists = {name: tables[name].tolist() for name in ("cells", "attempts", "threads", "traces")}
        self.pools = _Pools(registers=registers, **lists)

    def partitions(self) -> list[tuple[Key, Open]]:
        """By key, what is remembered."""
        kinds = [self.bound.columns[name] for name in self.bound.keys]
        columns = key_columns(self.keys, kinds, Texts(self.saved.header["key_texts"]))
        keys = list(zip(*columns, strict=True)) if columns else [()] * len(self.keys)
        tails = self._tails()
        cells = {cell[k.C_PARTITION]: cell for cell in self.pools.cells}
        begun = self._begun()
        found = []
        for number, (key, ordinal) in enumerate(zip(keys, self.ordinals[:, 0].tolist(), strict=True)):
            attempts = self._attempts(cells[number]) if number in cells else []
            resume = cells[number][k.C_RESUME] if number in cells else 0
            attempt = begun[number]
            if attempt is not None and resume <= ordinal and all(each.ordinal != ordinal for each in attempts):
                attempts.append(attempt)
            partition = Partition(attempts, ordinal + 1, self._event(number), key)
            found.append((key, Open(partition, tails[number])))
        return found

    def _event(self, number: int) -> Event:
        record = self.last_rows[number]
        return int(record[k.R_STREAM]), int(record[k.R_SEQUENCE]), int(record[k.R_TIME])

    # Partial matches.

    def _attempts(self, cell: list[int]) -> list[Attempt]:
        found = []
        at = cell[k.C_FIRST]
        while at >= 0:
            record = self.pools.attempts[at]
            event = (record[k.A_STREAM], record[k.A_SEQUENCE], record[k.A_TIME])
            found.append(Attempt(event, record[k.A_ORDINAL], self._threads(record), self._ending(record)))
            at = record[k.A_NEXT]
        return found

    def _threads(self, attempt: list[int]) -> list[Thread]:
        found = []
        at = attempt[k.A_THREAD]
        while at >= 0:
            record = self.pools.threads[at]
            found.append((record[k.T_POSITION], self.pools.registers[at], self._trace(record[k.T_TRACE])))
            at = record[k.T_NEXT]
        return found

    def _ending(self, attempt: list[int]) -> Ending | None:
        at = attempt[k.E_THREAD]
        if at < 0:
            return None
        trace = self._trace(self.pools.threads[at][k.T_TRACE])
        assert trace is not None, "a match has rows"
        event = (attempt[k.E_STREAM], attempt[k.E_SEQUENCE], attempt[k.E_TIME])
        return Ending(self.pools.registers[at], trace, event, attempt[k.E_ORDINAL])

    def _trace(self, at: int) -> Trace | None:
        records = []
        while at >= 0:
            records.append(self.pools.traces[at])
            at = records[-1][k.X_PARENT]
        trace: Trace | None = None
        for record in reversed(records):
            _, variable, stream, first, last, ordinal, rows, *_ = record
            trace = (trace, variable, stream, first, last, ordinal, rows)
        return trace

    def _registers(self, words: Integers, threads: Integers) -> list[Registers]:
        columns = []
        for at, register in enumerate(self.bound.registers):
            is_null, is_unset = (threads[:, each] >> at & 1 != 0 for each in (k.T_NULLS, k.T_UNSET))
            is_count = register.how in ("rows", "values") or register.slot is None
            kind = Kind.INT if is_count or register.slot is None else self.bound.slots[register.slot].kind
            values = as_values(words[:, at], is_null, kind, self.texts)
            columns.append([UNSET if unset else value for value, unset in zip(values, is_unset.tolist(), strict=True)])
        return list(zip(*columns, strict=True)) if columns else [()] * len(threads)

    def _begun(self) -> list[Attempt | None]:
        """For each partition the partial match that its last row may have begun."""
        bound, count = self.bound, len(self.last_rows)
        masks = tuple(sum(1 << at for at in each.predicates) for each in bound.conditions)
        matcher = Matcher(machine_of(bound, Places({}, {}, Site()), masks))
        block = Block(self._bits(), [self._event(number) for number in range(count)], self._values(), range(count))
        begun: list[Attempt | None] = []
        for number, ordinal in enumerate(self.ordinals[:, 0].tolist()):
            partition = Partition(ordinal=ordinal)
            found = matcher.run(partition, block, number, number + 1)
            begun.append(partition.attempts[0] if partition.attempts and not found else None)
        return begun

    def _bits(self) -> list[int]:
        """Of each partition's last row which row-local conditions are true."""
        layout = own_layout(self.packed)
        pairs = zip(self.bound.conditions, self.packed.conditions, strict=True)
        named = {at: expr for own, exprs in pairs for at, expr in zip(own.predicates, exprs, strict=True)}
        bits = [0] * len(self.last_rows)
        for at, expr in named.items():
            word, bit = layout.bits[expr]
            for row, is_true in enumerate((self.last_rows[:, k.R_BITS + word] >> bit & 1).tolist()):
                bits[row] |= is_true << at
        return bits

    def _values(self) -> list[tuple[Any, ...]]:
        """Of each partition's last row the slots."""
        layout = own_layout(self.packed)
        columns = []
        for slot in self.packed.slots:
            number = layout.slots[slot]
            is_null = self.last_rows[:, k.R_NULLS] >> number & 1 != 0
            words = self.last_rows[:, k.R_BITS + layout.words + number]
            columns.append(as_values(words, is_null, slot.kind, self.texts))
        return list(zip(*columns, strict=True)) if columns else [()] * len(self.last_rows)

    # Rows.

    def _tails(self) -> list[list[tuple[Any, ...]]]:
        """For each partition its last rows, oldest first."""
        table, reach = self.saved.tables["tails"], self.bound.reach
        tails: list[list[tuple[Any, ...]]] = [[] for _ in range(len(self.keys))]
        if reach == 0 or table.num_columns == 0:
            return tails
        counts = table.column("@count").to_pylist()
        for age in range(reach):
            names = {name: f"{age}/{name}" for name in (STREAM, TIME, SEQUENCE, *self.bound.columns)}
            there = np.array([count > age for count in counts], dtype=bool)
            rows = pa.table({n: table.column(o) for n, o in names.items() if o in table.column_names}).filter(there)
            columns = [each.to_pylist() for each in _whole(self.bound, rows, self.saved.header["streams"]).columns]
            for number, row in zip(np.flatnonzero(there).tolist(), zip(*columns, strict=True), strict=True):
                tails[number].insert(0, row)
        return tails


def _whole(bound: BoundRule, rows: pa.Table, streams: list[str]) -> pa.Table:
    """The rows with all columns that the rule reads: a lane leaves out what the stream and the order say."""
    columns = {name: rows.column(name) for name in (STREAM, TIME, SEQUENCE)}
    for name, kind in bound.columns.items():
        if name in rows.column_names:
            columns[name] = rows.column(name)
        elif name in ROW_COLUMNS:
            columns[name] = rows.column(ROW_COLUMNS[name])
        elif name in STREAM_COLUMNS:
            parts = [stream.split("/")[STREAM_COLUMNS[name]] for stream in streams]
            columns[name] = pa.array([parts[at] for at in rows.column(STREAM).to_pylist()], pa.string())
        else:
            columns[name] = pa.nulls(rows.num_rows, arrow_type(kind))
    return pa.table(columns)
