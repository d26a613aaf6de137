"""MEASURES in queries: from finished matches to columns.

Navigation is arithmetic on the numbers of rows, aggregates are DuckDB's over the rows of the matches, and the rest of
each measure is one DuckDB expression over these columns: so a measure has the type that DuckDB gives it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from sqlglot import exp

from patterns.language.dialect import ClauseDialect
from patterns.language.navigation import (
    AggregateReading,
    Frame,
    MatchNumber,
    Reader,
    Reading,
    RowReading,
    function_name,
)
from patterns.language.syntax import Named
from patterns.querying.duck import sql_of
from patterns.querying.ordered import OrderedRows
from patterns.querying.symbols import Symbols

_MATCHED = "is_matched"
_WIDE = ("HUGEINT", "UHUGEINT")
"""Whole numbers that Arrow has no type for, so that they come back as decimals, which divide otherwise."""
_PLACE, _MATCH, _LABEL, _NUMBER = "matched place", "matched match", "matched label", "matched number"


@dataclass(frozen=True)
class MatchedRows:
    """The rows of all matches, one after the other.

    Attributes:
        rows: Their numbers among the input's rows.
        labels: The index of the variable of each.
        bounds: Where the rows of each match begin, and the end; an empty match has none.
        numbers: The number of each match in its partition, from 1.
    """

    rows: NDArray[np.int64]
    labels: NDArray[np.int64]
    bounds: NDArray[np.int64]
    numbers: NDArray[np.int64]

    @cached_property
    def matches(self) -> NDArray[np.int64]:
        """The match of each row."""
        return np.repeat(np.arange(len(self.numbers)), np.diff(self.bounds))


@dataclass(frozen=True)
class Places:
    """Where measures are evaluated, one place for each row that is put out.

    Attributes:
        matches: The match; -1: a row of no match.
        places: Which of the matched rows; -1: none, the match is empty or there is no match.
    """

    matches: NDArray[np.int64]
    places: NDArray[np.int64]


class Measures:
    """The measures of a clause, read and checked."""

    def __init__(self, symbols: Symbols) -> None:
        self.symbols = symbols
        self.columns: dict[str, Reading] = {}
        self.places: dict[str, int] = {}
        self.types: dict[str, str] = {}
        self.expressions = [self._taken_apart(measure) for measure in symbols.clause.measures]
        for measure, expression in zip(symbols.clause.measures, self.expressions, strict=True):
            symbols.check_types("MEASURES", measure.value, expression, self.types)

    def evaluated(
        self, rows: OrderedRows, matched: MatchedRows, places: Places, is_all_rows: bool
    ) -> list[pa.ChunkedArray]:
        """The measures at these places, in their order.

        Raises:
            MatchError: An expression fails.
        """
        reading = _Evaluation(self.symbols, rows, matched, places, is_all_rows)
        columns = {_MATCHED: pa.array(places.matches >= 0)}
        for name, each in self.columns.items():
            with self.symbols.placed("MEASURES", self.places[name]):
                columns[name] = reading.column(each)
        has_unmatched = bool((places.matches < 0).any())
        wanted = [_guarded(sql_of(expression), has_unmatched) for expression in self.expressions]
        at = [measure.value.at for measure in self.symbols.clause.measures]
        return self.symbols.evaluated(pa.table(columns), wanted, "MEASURES", at)

    def _taken_apart(self, measure: Named) -> exp.Expr:
        reader = self.symbols.reader("MEASURES", measure.value)
        tree = self.symbols.checked("MEASURES", measure.value)
        return tree.transform(lambda node: self._placed(node, reader, measure))

    def _placed(self, node: exp.Expr, reader: Reader, measure: Named) -> exp.Expr:
        reading = reader.reading(node)
        if reading is None:
            return node
        if isinstance(reading, RowReading) and _is_of_match(reading.operand):
            return self._pushed_down(reading, measure)
        if isinstance(reading, RowReading) and function_name(reading.operand) != "CLASSIFIER":
            operand = self.symbols.over_columns(reading.operand, "MEASURES", measure.value.at)
            kind = self.symbols.check_types("MEASURES", measure.value, operand, self.symbols.types)
            return self._named(replace(reading, operand=operand), kind, measure)
        if isinstance(reading, AggregateReading):
            return self._aggregate(reading, measure)
        return self._named(reading, "BIGINT" if isinstance(reading, MatchNumber) else "VARCHAR", measure)

    def _pushed_down(self, reading: RowReading, measure: Named) -> exp.Expr:
        """An operand with CLASSIFIER or MATCH_NUMBER in it: each part is read at the row, if there is one."""
        exists = self._named(replace(reading, operand=exp.Boolean(this=True)), "BOOLEAN", measure)

        def each(node: exp.Expr) -> exp.Expr:
            if function_name(node) == "MATCH_NUMBER":
                return self._named(MatchNumber(), "BIGINT", measure)
            if function_name(node) == "CLASSIFIER":
                return self._named(replace(reading, operand=node), "VARCHAR", measure)
            if isinstance(node, exp.Column):
                operand = self.symbols.over_columns(node, "MEASURES", measure.value.at)
                kind = self.symbols.check_types("MEASURES", measure.value, operand, self.symbols.types)
                return self._named(replace(reading, operand=operand), kind, measure)
            return node

        return exp.Case().when(exists, reading.operand.transform(each))

    def _aggregate(self, reading: AggregateReading, measure: Named) -> exp.Expr:
        def each(node: exp.Expr) -> exp.Expr:
            if function_name(node) == "MATCH_NUMBER":
                return exp.column(_NUMBER, quoted=True)
            if function_name(node) == "CLASSIFIER":
                return exp.column(_LABEL, quoted=True)
            if isinstance(node, exp.Column) and isinstance(node.this, exp.Star):
                return exp.Star()
            if isinstance(node, exp.Column):
                return self.symbols.over_columns(node, "MEASURES", measure.value.at)
            return node

        call = reading.call.transform(each)
        kinds = {**self.symbols.types, _LABEL: "VARCHAR", _NUMBER: "BIGINT"}
        kind = self.symbols.check_types("MEASURES", measure.value, call, kinds)
        return self._named(replace(reading, call=call), kind, measure)

    def _named(self, reading: Reading, kind: str, measure: Named) -> exp.Expr:
        name = next((name for name, known in self.columns.items() if known == reading), f"p{len(self.columns)}")
        self.columns[name] = reading
        self.places.setdefault(name, measure.value.at)
        self.types[name] = kind
        column = exp.column(name)
        return exp.cast(column, kind, dialect=ClauseDialect) if kind in _WIDE else column


class _Evaluation:
    """Readings at places, as columns."""

    def __init__(
        self, symbols: Symbols, rows: OrderedRows, matched: MatchedRows, places: Places, is_all_rows: bool
    ) -> None:
        self.symbols = symbols
        self.rows = rows
        self.matched = matched
        self.places = places
        self.is_all_rows = is_all_rows
        self.labels = pa.chunked_array([pa.array(symbols.variables, pa.string())])
        self.operands: dict[str, pa.ChunkedArray] = {}

    def column(self, reading: Reading) -> pa.ChunkedArray:
        if isinstance(reading, MatchNumber):
            return _taken(pa.chunked_array([pa.array(self.matched.numbers)]), self.places.matches)
        if isinstance(reading, AggregateReading):
            return self.aggregate(reading)
        return self.of_row(reading)

    # One row.

    def of_row(self, reading: RowReading) -> pa.ChunkedArray:
        target = self.target(reading)
        if function_name(reading.operand) == "CLASSIFIER":
            return self.label(target, reading.shift)
        has_row = target >= 0
        source = self.matched.rows[np.where(has_row, target, 0)] if len(self.matched.rows) else target
        if not len(self.rows.partitions):
            return self.rows.at(self.operand(reading.operand), source, source)
        partitions = self.rows.partitions[source]
        return self.rows.at(self.operand(reading.operand), np.where(has_row, source + reading.shift, -1), partitions)

    def target(self, reading: RowReading) -> NDArray[np.int64]:
        """For each place the matched row that the reading goes to, before its shift; -1: none."""
        begins, ends = self.spans(reading.is_final)
        mapped = self.mapped(reading.frame)
        low, high = np.searchsorted(mapped, begins), np.searchsorted(mapped, ends)
        wanted = low + reading.offset if reading.which == "first" else high - 1 - reading.offset
        found = np.full(len(begins), -1, dtype=np.int64)
        is_there = (wanted >= low) & (wanted < high)
        found[is_there] = mapped[wanted[is_there]]
        return found

    def spans(self, is_final: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """For each place the matched rows that it sees: from, and up to but not including."""
        matches = self.places.matches
        is_matched = matches >= 0
        known = np.where(is_matched, matches, 0)
        bounds = self.matched.bounds if len(self.matched.bounds) > 1 else np.zeros(2, dtype=np.int64)
        begins = np.where(is_matched, bounds[known], 0)
        ends = np.where(is_matched, bounds[known + 1], 0)
        if not is_final:
            ends = np.where(self.places.places >= 0, self.places.places + 1, begins)
        return begins, ends

    def mapped(self, frame: Frame) -> NDArray[np.int64]:
        """The matched rows of the frame's variables."""
        if frame is None:
            return np.arange(len(self.matched.rows))
        return np.flatnonzero(np.isin(self.matched.labels, [self.symbols.index(name) for name in frame]))

    def operand(self, operand: exp.Expr) -> pa.ChunkedArray:
        text = sql_of(operand)
        if text not in self.operands:
            (self.operands[text],) = self.symbols.duck.columns(self.rows.table, [text])
        return self.operands[text]

    def label(self, target: NDArray[np.int64], shift: int) -> pa.ChunkedArray:
        """The variable of the row so many rows from the target; NULL where that is no row of the match."""
        begins, ends = self.spans(is_final=True)
        there = target + shift
        is_inside = (target >= 0) & (there >= begins) & (there < ends)
        found = np.full(len(target), -1, dtype=np.int64)
        found[is_inside] = self.matched.labels[there[is_inside]]
        return _taken(self.labels, found)

    # Aggregates.

    def aggregate(self, reading: AggregateReading) -> pa.ChunkedArray:
        is_running = self.is_all_rows and not reading.is_final
        found = self.running(reading) if is_running else self.whole(reading)
        of_nothing = self.asked(f"SELECT {self.call(reading, 'false')} AS c0 FROM matched")
        joined = pa.chunked_array([*found.chunks, *of_nothing.cast(found.type).chunks])
        index = self.places.places if is_running else np.where(self.places.places >= 0, self.places.matches, -1)
        if not is_running:
            index = np.where(index >= 0, self.ranks()[np.where(index >= 0, index, 0)], -1) if len(found) else index
        is_empty = (self.places.matches >= 0) & (self.places.places < 0)
        return _taken(joined, np.where(is_empty, len(found), index))

    def ranks(self) -> NDArray[np.int64]:
        """For each match its place among those that have rows."""
        return np.cumsum(np.diff(self.matched.bounds) > 0) - 1

    def running(self, reading: AggregateReading) -> pa.ChunkedArray:
        window = f'PARTITION BY "{_MATCH}" ORDER BY "{_PLACE}" ROWS UNBOUNDED PRECEDING'
        return self.asked(f'SELECT {self.call(reading)} OVER ({window}) AS c0 FROM matched ORDER BY "{_PLACE}"')

    def whole(self, reading: AggregateReading) -> pa.ChunkedArray:
        return self.asked(f'SELECT {self.call(reading)} AS c0 FROM matched GROUP BY "{_MATCH}" ORDER BY "{_MATCH}"')

    def call(self, reading: AggregateReading, condition: str | None = None) -> str:
        """The call, restricted to the frame's rows."""
        call = reading.call
        conditions = [] if condition is None else [condition]
        if reading.frame is not None:
            labels = ", ".join(exp.Literal.string(name).sql() for name in reading.frame)
            conditions.append(f'"{_LABEL}" IN ({labels})')
        if isinstance(call, exp.Filter):
            conditions.append(f"({sql_of(call.expression.this)})")
            call = call.this
        return sql_of(call) + (f" FILTER (WHERE {' AND '.join(conditions)})" if conditions else "")

    def asked(self, query: str) -> pa.ChunkedArray:
        return self.symbols.duck.table(query, matched=self.table).column("c0")

    @cached_property
    def table(self) -> pa.Table:
        """The matched rows with their input columns."""
        matched = self.matched
        return pa.table(
            {
                **{name: self.rows.table.column(name).take(pa.array(matched.rows)) for name in self.symbols.types},
                _PLACE: pa.array(np.arange(len(matched.rows))),
                _MATCH: pa.array(matched.matches),
                _LABEL: self.labels.take(pa.array(matched.labels)),
                _NUMBER: pa.array(matched.numbers[matched.matches]),
            }
        )


def _taken(column: pa.ChunkedArray, indices: NDArray[np.int64]) -> pa.ChunkedArray:
    """The column's values at these indices; NULL at -1."""
    if len(column) == 0:
        return pa.chunked_array([pa.nulls(len(indices), column.type)])
    return column.take(pa.array(np.where(indices < 0, 0, indices), mask=indices < 0))


def _guarded(text: str, has_unmatched: bool) -> str:
    return f"CASE WHEN {_MATCHED} THEN {text} END" if has_unmatched else text


def _is_of_match(operand: exp.Expr) -> bool:
    """Whether the operand is more than CLASSIFIER alone, but has it or MATCH_NUMBER in it."""
    names = {function_name(part) for part in operand.walk()}
    return "MATCH_NUMBER" in names or ("CLASSIFIER" in names and function_name(operand) != "CLASSIFIER")
