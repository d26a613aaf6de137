"""The last rows of each partition: what PREV looks back at across batches."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from patterns.binding.columns import arrow_type
from patterns.binding.expressions import Kind
from patterns.binding.rows import SEQUENCE, STREAM, TIME
from patterns.engine.kernel import Integers, chained
from patterns.engine.records import Arrived

_ALWAYS = (STREAM, TIME, SEQUENCE)
"""columns that are kept of every row"""


class Tails:
    """By partition its last `reach` rows, newest first; of each the columns that are looked back at."""

    def __init__(self, reach: int, columns: Mapping[str, Kind]) -> None:
        self.reach = reach
        self.kinds: dict[str, Kind] = {**dict.fromkeys(_ALWAYS, Kind.INT), **columns}
        self.clear()

    def clear(self) -> None:
        """Forgets all rows."""
        self.counts = np.zeros(0, dtype=np.int64)
        self.values: dict[str, Any] = {
            name: np.empty((0, self.reach), _dtype(kind)) for name, kind in self.kinds.items()
        }
        self.is_null = {name: np.zeros((0, self.reach), dtype=np.bool_) for name in self.kinds}

    def make_room(self, partitions: int) -> None:
        """Makes room for so many partitions."""
        more = partitions - len(self.counts)
        if self.reach == 0 or more <= 0:
            return
        self.counts = np.concatenate((self.counts, np.zeros(more, dtype=np.int64)))
        for name, values in self.values.items():
            self.values[name] = np.concatenate((values, np.zeros((more, self.reach), dtype=values.dtype)))
            # What no restored rule said of a row is NULL, not a value.
            self.is_null[name] = np.concatenate((self.is_null[name], np.ones((more, self.reach), dtype=np.bool_)))

    def keep_partitions(self, kept: Integers) -> None:
        """Keeps these partitions, numbered in this order."""
        if self.reach == 0:
            return
        self.counts = self.counts[kept]
        for held in (self.values, self.is_null):
            for name, values in held.items():
                held[name] = values[kept]

    def narrow(self, reach: int, columns: Mapping[str, Kind]) -> None:
        """Remembers no more than so many rows and these columns, all of which it remembers."""
        self.reach = reach
        self.kinds = {name: kind for name, kind in self.kinds.items() if name in columns or name in _ALWAYS}
        if reach == 0:
            self.clear()
            return
        self.counts = np.minimum(self.counts, reach)
        self.values = {name: self.values[name][:, :reach].copy() for name in self.kinds}
        self.is_null = {name: self.is_null[name][:, :reach].copy() for name in self.kinds}

    def covers(self, reach: int, columns: Mapping[str, Kind]) -> bool:
        """Whether these columns of so many rows are remembered."""
        return self.reach >= reach and columns.keys() <= self.kinds.keys()

    def table(self, partitions: Integers, columns: Sequence[str]) -> pa.Table:
        """What is remembered of these partitions and columns, newest rows first; `@count` says how many."""
        if self.reach == 0:
            return pa.table({})
        said = {"@count": pa.array(self.counts[partitions])}
        for name, kind in self.kinds.items():
            if name in columns or name in _ALWAYS:
                for age in range(self.reach):
                    is_null = self.is_null[name][partitions, age] | (self.counts[partitions] <= age)
                    said[f"{age}/{name}"] = pa.array(self.values[name][partitions, age], arrow_type(kind), mask=is_null)
        return pa.table(said)

    def insert(self, partitions: Integers, saved: pa.Table) -> None:
        """Remembers what `table` gave, beside what is remembered; of one row both say the same."""
        if self.reach == 0 or saved.num_columns == 0:
            return
        counts = np.minimum(saved.column("@count").to_numpy(), self.reach)
        self.counts[partitions] = np.maximum(self.counts[partitions], counts)
        for age in range(self.reach):
            rows = np.flatnonzero(counts > age)
            for name in self.kinds:
                if f"{age}/{name}" in saved.column_names:
                    self._write(name, partitions[rows], age, saved.column(f"{age}/{name}").combine_chunks(), rows)

    def before(
        self, rows: pa.Table, partitions: Integers, bounds: Integers, order: Integers, names: Sequence[str]
    ) -> Arrived:
        """The rows after those that their partitions remember."""
        streams = rows.column(STREAM).to_numpy()
        if self.reach == 0:
            return Arrived(rows, 0, None, streams, names)
        counts = self.counts[partitions]
        fresh = int(counts.sum())
        groups = np.repeat(np.arange(len(partitions)), counts)
        firsts = np.cumsum(counts) - counts
        ages = counts[groups] - 1 - (np.arange(fresh) - firsts[groups])
        before = np.empty(fresh + rows.num_rows, dtype=np.int64)
        chained(counts, bounds, order, fresh, before)
        if fresh == 0:
            return Arrived(rows, 0, before, streams, names)
        earlier = self._rows(partitions[groups], ages, rows.schema)
        table = pa.concat_tables([earlier, rows]).combine_chunks()
        return Arrived(table, fresh, before, table.column(STREAM).to_numpy(), names)

    def keep(self, arrived: Arrived, partitions: Integers, bounds: Integers, order: Integers) -> None:
        """Remembers the last rows of these partitions."""
        if self.reach == 0:
            return
        assert arrived.before is not None
        rows = arrived.fresh + order[bounds[1:] - 1]
        self.counts[partitions] = 0
        for age in range(self.reach):
            is_there = rows >= 0
            there, taken = partitions[is_there], rows[is_there]
            self.counts[there] += 1
            for name in self.kinds:
                self._write(name, there, age, arrived.table.column(name).combine_chunks(), taken)
            rows = np.where(is_there, arrived.before[rows], -1)

    def _write(self, name: str, partitions: Integers, age: int, column: Any, rows: Integers) -> None:
        kind = self.kinds[name]
        if kind is Kind.STRING or column.null_count:
            column = column.take(pa.array(rows))
            self.is_null[name][partitions, age] = np.asarray(column.is_null())
            values = column.to_numpy(zero_copy_only=False) if kind is Kind.STRING else _filled(column)
        else:
            self.is_null[name][partitions, age] = False
            values = column.to_numpy(zero_copy_only=False)[rows]
        self.values[name][partitions, age] = values

    def _rows(self, partitions: Integers, ages: Integers, schema: pa.Schema) -> pa.Table:
        columns = []
        for each in schema:
            if each.name in self.kinds:
                is_null = self.is_null[each.name][partitions, ages]
                columns.append(pa.array(self.values[each.name][partitions, ages], each.type, mask=is_null))
            else:
                columns.append(pa.nulls(len(partitions), each.type))
        return pa.table(columns, schema=schema)


def _filled(column: Any) -> Any:
    """The values, 0 where NULL."""
    return column.fill_null(False if pa.types.is_boolean(column.type) else 0).to_numpy(zero_copy_only=False)


def _dtype(kind: Kind) -> Any:
    return object if kind is Kind.STRING else arrow_type(kind).to_pandas_dtype()
