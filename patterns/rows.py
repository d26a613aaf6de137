"""Rows as the engine takes them: of one shape whatever the batch looked like, in the total order.

A rule's rows are an Arrow table with three columns of ours (`@stream`, the
stream's number; `@time`, in microseconds; `@sequence`) and the columns that
the rule reads, times and durations as whole microseconds and numbers as
float64 or int64.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from patterns.columns import arrow_type
from patterns.errors import MatchError
from patterns.expressions import Kind

STREAM, TIME, SEQUENCE = "@stream", "@time", "@sequence"
_ENVELOPE = ("time", "sequence", "source", "station", "type")


@dataclass(slots=True)
class StreamNumbers:
    """Numbers for stream names, in the order in which they were met; and their ranks by name."""

    names: list[str] = field(default_factory=list)
    _numbers: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, names: Sequence[str]) -> "StreamNumbers":
        """The numbers that were given to these names, in this order."""
        return cls(list(names), {name: number for number, name in enumerate(names)})

    def numbers(self, batch: pa.Table) -> NDArray[np.int64]:
        """For each row its stream's number."""
        parts = [batch.column(name).cast(pa.string()) for name in ("station", "source", "type")]
        names = pc.binary_join_element_wise(*parts, "/").combine_chunks().dictionary_encode()
        lookup = np.array([self._number(name) for name in names.dictionary.to_pylist()], dtype=np.int64)
        numbers: NDArray[np.int64] = lookup[names.indices.to_numpy(zero_copy_only=False)]
        return numbers

    def ranks(self) -> NDArray[np.int64]:
        """For each number the place of its name among all names, sorted."""
        ranks = np.empty(len(self.names), dtype=np.int64)
        ranks[np.argsort(np.array(self.names, dtype=object), kind="stable")] = np.arange(len(self.names))
        return ranks

    def _number(self, name: str) -> int:
        number = self._numbers.get(name)
        if number is None:
            number = self._numbers[name] = len(self.names)
            self.names.append(name)
        return number


def check_envelope(batch: pa.Table) -> None:
    """Checks that the rows say when, where and what they are.

    Raises:
        MatchError: A column of the envelope is missing or has a NULL.
    """
    missing = [name for name in _ENVELOPE if name not in batch.column_names]
    if missing:
        raise MatchError(f"rows need the columns {', '.join(_ENVELOPE)}; {', '.join(missing)} is missing")
    for name in _ENVELOPE:
        if batch.column(name).null_count:
            raise MatchError(f"the column {name} of a row must not be NULL")


def normalised(batch: pa.Table, columns: Mapping[str, Kind], streams: StreamNumbers) -> pa.Table:
    """The batch in the engine's shape; `columns` are those that the rule reads.

    Raises:
        MatchError: A column that the rule reads is missing or of another type than it was bound to.
    """
    arrays = [
        pa.array(streams.numbers(batch)),
        _converted(batch, "time", Kind.TIME),
        _converted(batch, "sequence", Kind.INT),
    ]
    arrays += [_converted(batch, name, kind) for name, kind in columns.items()]
    return pa.table(arrays, names=[STREAM, TIME, SEQUENCE, *columns])


def in_total_order(rows: pa.Table, streams: StreamNumbers) -> pa.Table:
    """The rows by time, stream name and sequence."""
    time, sequence = (rows.column(name).to_numpy() for name in (TIME, SEQUENCE))
    rank = streams.ranks()[rows.column(STREAM).to_numpy()]
    if _is_sorted(time, rank, sequence):
        return rows
    return rows.take(pa.array(np.lexsort((sequence, rank, time))))


def newest_by_source(batch: pa.Table) -> list[tuple[str, int]]:
    """For each source its newest time in microseconds."""
    times = batch.column("time").cast(pa.timestamp("us", batch.column("time").type.tz)).cast(pa.int64())
    sources = batch.column("source")
    newest = []
    for source in sources.unique().to_pylist():
        newest.append((source, pc.max(times.filter(pc.equal(sources, source))).as_py()))
    return newest


def partition_codes(rows: pa.Table, keys: Sequence[str]) -> NDArray[np.int64]:
    """For each row a number that rows of equal partition columns, and only these, share; NULL equals NULL."""
    codes = np.zeros(rows.num_rows, dtype=np.int64)
    for key in keys:
        encoded = rows.column(key).combine_chunks().dictionary_encode(null_encoding="encode")
        cardinality = max(len(encoded.dictionary), 1)
        codes = codes * cardinality + encoded.indices.to_numpy(zero_copy_only=False)
        if cardinality > 1:
            codes = np.unique(codes, return_inverse=True)[1].astype(np.int64)
    return codes


def _is_sorted(time: NDArray[np.int64], rank: NDArray[np.int64], sequence: NDArray[np.int64]) -> bool:
    later = time[1:] > time[:-1]
    tied = time[1:] == time[:-1]
    after = (rank[1:] > rank[:-1]) | ((rank[1:] == rank[:-1]) & (sequence[1:] >= sequence[:-1]))
    return bool(np.all(later | (tied & after)))


def _converted(batch: pa.Table, name: str, kind: Kind) -> Any:
    """The column as the engine's type of this kind."""
    if name not in batch.column_names:
        raise MatchError(f"the rule reads the column {name}, which the rows do not have")
    column = batch.column(name)
    try:
        if pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        if kind is Kind.TIME and pa.types.is_timestamp(column.type):
            column = column.cast(pa.timestamp("us", column.type.tz))
        if kind is Kind.DURATION and pa.types.is_duration(column.type):
            column = column.cast(pa.duration("us"))
        return column.cast(arrow_type(kind)).combine_chunks()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise MatchError(f"the column {name} is not a column of type {kind.value}: {error}") from error
