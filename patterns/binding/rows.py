"""Rows as the engine takes them: of one shape whatever the batch looked like, in the total order.

A rule's rows are an Arrow table with three columns of ours (`@stream`, the
stream's number; `@time`, in microseconds; `@sequence`) and the columns that
the rule reads, times and durations as whole microseconds and numbers as
float64 or int64.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from patterns.binding.columns import ROW_TIME, arrow_type
from patterns.binding.expressions import Kind
from patterns.errors import MatchError

STREAM, TIME, SEQUENCE = "@stream", ROW_TIME, "@sequence"
_ENVELOPE = ("time", "sequence", "source", "station", "type")


@dataclass(frozen=True, slots=True)
class Units:
    """Units of arrival, one after the other, in one table.

    Attributes:
        table: Their rows.
        bounds: Where each unit begins in the table, and the end.
    """

    table: pa.Table
    bounds: Sequence[int]

    @classmethod
    def one(cls, table: pa.Table) -> "Units":
        """All rows as one unit."""
        return cls(table, (0, table.num_rows))

    def __len__(self) -> int:
        """How many units there are."""
        return len(self.bounds) - 1

    def of(self, rows: pa.Table) -> list[pa.Table]:
        """Rows that are one each for those of the table, unit by unit."""
        if len(self) == 1:
            return [rows]
        return [rows.slice(begin, end - begin) for begin, end in pairwise(self.bounds)]


@dataclass(slots=True)
class StreamNumbers:
    """Numbers for stream names, in the order in which they were met; and their ranks by name."""

    names: list[str] = field(default_factory=list)
    _numbers: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, names: Sequence[str]) -> "StreamNumbers":
        """The numbers that were given to these names, in this order."""
        return cls(list(names), {name: number for number, name in enumerate(names)})

    def take(self, names: Sequence[str]) -> None:
        """Goes on from these numbers, in place."""
        self.names[:] = names
        self._numbers.clear()
        self._numbers.update({name: number for number, name in enumerate(names)})

    def numbers(self, batch: pa.Table) -> NDArray[np.int64]:
        """For each row its stream's number."""
        parts = [encoded(batch.column(name)) for name in ("station", "source", "type")]
        codes = np.zeros(batch.num_rows, dtype=np.int64)
        for part in parts:
            if len(part.dictionary) > 1:
                codes = codes * len(part.dictionary) + part.indices.to_numpy()
        if all(len(part.dictionary) == 1 for part in parts):
            return codes + self._number("/".join(part.dictionary[0].as_py() for part in parts))
        used, codes = _distinct(codes)
        names = [part.dictionary.to_pylist() for part in parts]
        lookup = np.array([self._number("/".join(_names_of(code, names))) for code in used.tolist()], dtype=np.int64)
        numbers: NDArray[np.int64] = lookup[codes]
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


def encoded(column: Any) -> Any:
    """The column as numbers and the texts that they stand for, each once."""
    if not pa.types.is_dictionary(column.type):
        whole = column.combine_chunks()
        if len(whole) and _is_constant(whole):
            return pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(whole), np.int32)), whole.slice(0, 1))
        column = column.dictionary_encode()
    column = column.combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = pa.DictionaryArray.from_arrays(pa.array([], pa.int32()), pa.array([], pa.string()))
    return column


def _is_constant(column: Any) -> bool:
    """Whether all rows have the same text: told from the bytes, a twentieth of what hashing them takes."""
    if isinstance(column, pa.ChunkedArray) or column.null_count or not pa.types.is_string(column.type):
        return False
    _, offsets, data = column.buffers()
    begins = np.frombuffer(offsets, dtype=np.int32)[column.offset : column.offset + len(column) + 1]
    length = int(begins[1] - begins[0])
    if length == 0 or data is None or int(begins[-1]) - int(begins[0]) != length * len(column):
        return False
    text = np.frombuffer(data, dtype=np.uint8)[begins[0] : begins[-1]]
    return bool(np.all(np.diff(begins) == length)) and bool(np.array_equal(text[length:], text[:-length]))


def with_envelope_encoded(batch: pa.Table) -> pa.Table:
    """The batch with the parts of its streams' names as numbers and texts, which many ask for."""
    for name in ("station", "source", "type"):
        at = batch.schema.get_field_index(name)
        batch = batch.set_column(at, name, encoded(batch.column(name)))
    return batch


def _distinct(codes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers that occur, ascending, and for each row the place of its number among them."""
    highest = int(codes.max(initial=0))
    if highest > 1 << 16:
        used, places = np.unique(codes, return_inverse=True)
        return used, places
    used = np.flatnonzero(np.bincount(codes, minlength=1))
    lookup = np.zeros(highest + 1, dtype=np.int64)
    lookup[used] = np.arange(len(used))
    return used, lookup[codes]


def _names_of(code: int, names: list[list[str]]) -> list[str]:
    """The station, source and type that one number for all three stands for."""
    parts = []
    for each in reversed(names):
        code, at = divmod(code, len(each))
        parts.append(each[at])
    return parts[::-1]


def findable(key: Iterable[Any]) -> tuple[Any, ...]:
    """The key with one object for every NaN, which equals nothing but itself: so a mapping finds the key again."""
    return tuple(math.nan if value != value else value for value in key)


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
    if batch.num_rows == 0:
        return []
    times = _microseconds(batch.column("time"))
    sources = encoded(batch.column("source"))
    if len(sources.dictionary) == 1:
        return [(sources.dictionary[0].as_py(), int(times.max()))]
    newest = np.full(len(sources.dictionary), np.iinfo(np.int64).min)
    numbers = sources.indices.to_numpy()
    np.maximum.at(newest, numbers, times)
    is_used = np.bincount(numbers, minlength=len(newest)) > 0
    named = zip(sources.dictionary.to_pylist(), newest.tolist(), is_used.tolist(), strict=True)
    return [(source, time) for source, time, used in named if used]


def _microseconds(times: pa.ChunkedArray) -> NDArray[np.int64]:
    """Times as whole microseconds since 1970."""
    whole: NDArray[np.int64] = times.cast(pa.timestamp("us", times.type.tz)).cast(pa.int64()).to_numpy()
    return whole


def newest_of_units(units: Units) -> list[list[tuple[str, int]]]:
    """For each unit, for each source its newest time in microseconds."""
    if len(units) == 1:
        return [newest_by_source(units.table)]
    sources = encoded(units.table.column("source"))
    numbers, names = sources.indices.to_numpy(), sources.dictionary.to_pylist()
    times = _microseconds(units.table.column("time"))
    newest: list[list[tuple[str, int]]] = []
    for begin, end in pairwise(units.bounds):
        own = numbers[begin:end]
        if end == begin:
            newest.append([])
        elif (own == own[0]).all():
            newest.append([(names[own[0]], int(times[begin:end].max()))])
        else:
            newest.append(newest_by_source(units.table.slice(begin, end - begin)))
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
