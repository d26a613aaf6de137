"""MATCH_RECOGNIZE as a query: one clause over the rows of a table, on the general matcher.

The road: sort the rows, evaluate what rows decide (`conditions`), match partition by partition (`matcher`), and
make columns of what was found (`measuring`). DuckDB evaluates expressions, so every type and function that it has may
stand in them; the order of rows, the automaton and the navigation are ours.

    clause, end = parse_clause(passage, offset)
    recognise(clause, table)
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from patterns.binding.bound import Register
from patterns.binding.program import ProgramTooLarge, Tables, compile_pattern, tabulate
from patterns.binding.registers import Change, Update, initial, live_registers, update_of
from patterns.engine.matcher import Block, Event, Found, Machine, Matcher, Partition, runs
from patterns.engine.skipping import skip_error
from patterns.errors import LimitError, MatchError, SkipError
from patterns.language.syntax import (
    Alternation,
    Clause,
    Concatenation,
    Exclusion,
    Identifier,
    Ordering,
    Pattern,
    Permutation,
    Repetition,
    RowsPerMatch,
)
from patterns.limits import Limits
from patterns.querying.conditions import Conditions, conditions_of
from patterns.querying.duck import Duck, first_line, quoted, sql_of
from patterns.querying.measuring import MatchedRows, Measures, Places
from patterns.querying.ordered import OrderedRows, ordered
from patterns.querying.symbols import Symbols

_STRIDE = 1_000
_STEPS_A_ROW = 10
"""How many steps for each row of the input a search may take, where that is more than the limit."""


def recognise(
    clause: Clause,
    table: pa.Table,
    params: Mapping[str, Any] | None = None,
    limits: Limits | None = None,
    ambiguous: Mapping[str, str] | None = None,
) -> pa.Table:
    """What the clause gives for the table.

    Columns: with ONE ROW PER MATCH those of PARTITION BY, then the measures; with ALL ROWS PER MATCH those of
    PARTITION BY, of ORDER BY, the measures, then the table's others. Rows come partition by partition, in the order
    in which matches were found.

    Args:
        clause: The clause, as `parse_clause` reads it.
        table: The rows.
        params: Values of `$name` and `:name`.
        limits: What the clause may use.
        ambiguous: Names of columns, in lower case, that the clause must not say, as several tables of its input have
            them; and which these are.

    Raises:
        RuleError: The clause is not right: a name that is not there, an expression that DuckDB does not take.
        SkipError: AFTER MATCH SKIP has no row to go to.
        LimitError: A limit was reached.
        MatchError: An expression fails on a row.
    """
    limits = limits or Limits()
    duck = Duck(limits.questions)
    try:
        return _Recognition(duck, clause, table, dict(params or {}), limits, ambiguous or {}).result()
    finally:
        duck.close()


@dataclass(slots=True)
class _Output:
    """What the search puts out, in order; see `MatchedRows` and `Places`."""

    rows: list[int] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)
    bounds: list[int] = field(default_factory=lambda: [0])
    numbers: list[int] = field(default_factory=list)
    matches: list[int] = field(default_factory=list)
    places: list[int] = field(default_factory=list)
    sources: list[int] = field(default_factory=list)

    def put(self, match: int, place: int, source: int) -> None:
        """One row of the result: its match, its matched row, and the input's row that it stands beside."""
        self.matches.append(match)
        self.places.append(place)
        self.sources.append(source)

    def matched(self) -> MatchedRows:
        arrays = (np.array(each, dtype=np.int64) for each in (self.rows, self.labels, self.bounds, self.numbers))
        return MatchedRows(*arrays)

    def where(self) -> Places:
        return Places(np.array(self.matches, dtype=np.int64), np.array(self.places, dtype=np.int64))


class _Recognition:
    """One clause over one table; the steps in the order in which `result` takes them."""

    def __init__(
        self,
        duck: Duck,
        clause: Clause,
        table: pa.Table,
        params: Mapping[str, Any],
        limits: Limits,
        ambiguous: Mapping[str, str],
    ) -> None:
        self.clause = clause
        self.duck = duck
        self.table = table
        self.limits = limits
        self.symbols = Symbols.of(clause, duck, duck.column_types(table), params, ambiguous)
        self.computed: dict[str, str] = {}

    def result(self) -> pa.Table:
        clause, symbols = self.clause, self.symbols
        partition_by = [self.key(column, "PARTITION BY") for column in clause.partition_by]
        order_by = [self.key(each.column, "ORDER BY") for each in clause.order_by]
        self.compute_keys()
        self.check_exclusion()
        self.check_names(partition_by)
        tables = self.tables()
        conditions = conditions_of(symbols)
        measures = Measures(symbols)
        within_us = self.within()
        self.check_columns()
        terms = [_term(column, each) for column, each in zip(order_by, clause.order_by, strict=True)]
        rows = ordered(self.duck, self.table, partition_by, terms)
        output = self.searched(rows, tables, conditions, within_us)
        is_all_rows = clause.rows is not RowsPerMatch.ONE
        measured = measures.evaluated(rows, output.matched(), output.where(), is_all_rows)
        return self.arranged(rows, output, measured, partition_by, order_by)

    def key(self, name: Identifier, clause: str) -> str:
        """The column that this place of PARTITION BY or ORDER BY means; of an expression one of its own."""
        column, sql = self.symbols.key(name, clause)
        if sql == quoted(column):
            return column
        while column.lower() in self.symbols.columns and self.computed.get(column) != sql:
            column += "_"
        self.computed[column] = sql
        return column

    def compute_keys(self) -> None:
        """Give the table the columns that expressions of PARTITION BY and ORDER BY are."""
        for name, values in zip(
            self.computed, self.duck.columns(self.table, list(self.computed.values())), strict=True
        ):
            self.table = self.table.append_column(name, values)

    # What is checked before any row is looked at.

    def check_exclusion(self) -> None:
        if self.clause.rows is RowsPerMatch.ALL_WITH_UNMATCHED and _has_exclusion(self.clause.pattern):
            message = "WITH UNMATCHED ROWS shows every row, so PATTERN must not have {- -}"
            raise self.clause.passage.error(message, self.clause.rows_at)

    def check_names(self, partition_by: Sequence[str]) -> None:
        """Each column of the result has a name of its own."""
        is_one = self.clause.rows is RowsPerMatch.ONE
        taken = {name.lower(): "a column of PARTITION BY" for name in partition_by}
        taken |= {} if is_one else {name.lower(): "a column of the input" for name in self.symbols.types}
        for measure in self.clause.measures:
            name = measure.name.name
            if name.lower() in taken:
                message = (
                    f"MEASURES: {name!r} is the name of {taken[name.lower()]} already; the result would have it twice"
                )
                raise self.clause.passage.error(message, measure.name.at)
            taken[name.lower()] = "another measure"

    def check_columns(self) -> None:
        """The result has a column, as any table must."""
        clause = self.clause
        if clause.rows is RowsPerMatch.ONE and not clause.partition_by and not clause.measures:
            message = "the result has no column; name a measure, or say PARTITION BY or ALL ROWS PER MATCH"
            raise clause.passage.error(message, clause.at)

    def tables(self) -> Tables:
        try:
            program = compile_pattern(self.clause.pattern, self.symbols.variables, self.limits.positions)
        except ProgramTooLarge as error:
            raise self.clause.passage.error(f"PATTERN: {error}", self.clause.pattern_at) from error
        return tabulate(program)

    def within(self) -> int | None:
        """WITHIN in microseconds; it counts on the first column of ORDER BY."""
        scalar = self.clause.within
        if scalar is None:
            return None
        passage = self.clause.passage
        order = self.clause.order_by
        if not order or order[0].is_descending:
            raise passage.error("WITHIN needs ORDER BY with a time, ascending, in the first place", scalar.at)
        kind = self.duck.column_types(self.table)[self.key(order[0].column, "ORDER BY")]
        if not kind.startswith(("TIMESTAMP", "DATE")):
            raise passage.error(f"WITHIN needs ORDER BY with a time in the first place, got {kind}", scalar.at)
        length = f"epoch_us(TIMESTAMP '2000-01-01' + ({sql_of(self.symbols.checked('WITHIN', scalar))}))"
        try:
            value = self.duck.value(f"{length} - epoch_us(TIMESTAMP '2000-01-01')")
        except duckdb.Error as error:
            raise passage.error(f"WITHIN: wanted a constant duration: {first_line(error)}", scalar.at) from error
        if value is None or value <= 0:
            raise passage.error("WITHIN: wanted a constant duration above zero", scalar.at)
        return int(value)

    # The search.

    def searched(self, rows: OrderedRows, tables: Tables, conditions: Conditions, within_us: int | None) -> _Output:
        """Every match, empty match and row of none, in the order in which the search meets them."""
        able, values = conditions.evaluated(self.symbols, rows)
        machine = self.machine(rows, tables, conditions, within_us)
        bits = np.zeros(rows.table.num_rows, dtype=object if len(able) > 62 else np.int64)
        for variable, truth in enumerate(able):
            bits = bits | (truth.astype(bits.dtype) << variable)
        begins = np.zeros(rows.table.num_rows, dtype=bool)
        for position in tables.firsts():
            begins |= able[tables.variables[position]]
        times = self.times(rows) if within_us is not None else [0] * rows.table.num_rows
        events = [(0, row, time) for row, time in enumerate(times)]
        block = Block(bits.tolist(), events, values, np.flatnonzero(begins).tolist())
        search = _Search(machine, block, conditions.number is not None, self.limits)
        output = _Output()
        for begin, end in zip(rows.bounds[:-1].tolist(), rows.bounds[1:].tolist(), strict=True):
            self.put(search, output, tables, begin, end)
        return output

    def times(self, rows: OrderedRows) -> list[int]:
        column = self.key(self.clause.order_by[0].column, "ORDER BY")
        (times,) = self.duck.columns(rows.table, [f"epoch_us({quoted(column)})"])
        if times.null_count:
            raise MatchError(f"WITHIN: the column {column} of a row must not be NULL")
        found: list[int] = times.to_pylist()
        return found

    def skip_error(self, rows: OrderedRows, first: Event, last: Event, is_there: bool) -> SkipError:
        """The error of a match that cannot be skipped from, which names its first and last row by their keys."""
        names = [self.key(each, "PARTITION BY") for each in self.clause.partition_by]
        names += [self.key(each.column, "ORDER BY") for each in self.clause.order_by]

        def told(event: Event) -> str:
            row = event[1]
            keys = ", ".join(f"{name} {rows.table.column(name)[row].as_py()}" for name in names)
            return keys or f"row {row + 1}"

        return skip_error(self.clause, f"{told(first)} to {told(last)}", is_there)

    def machine(self, rows: OrderedRows, tables: Tables, conditions: Conditions, within_us: int | None) -> Machine:
        count = len(self.symbols.variables)
        registers = conditions.registers
        reads = [set(each) for each in conditions.reads]
        live = live_registers(tables, registers, reads)
        updates = [
            tuple(self.update(index, each, variable) for index, each in enumerate(registers) if each.takes(variable))
            for variable in range(count)
        ]
        target = self.clause.skip.variable
        skipped = () if target is None else self.symbols.indices(self.symbols.frames[target.key]) or ()
        # A row's variable and whether it is excluded are one label, so that runs of rows keep both.
        labels = tuple(
            variable + count * excluded for variable, excluded in zip(tables.variables, tables.excluded, strict=True)
        )
        return Machine(
            tables=replace(tables, variables=labels),
            masks=tuple(1 << variable for variable in tables.variables),
            guards=tuple(conditions.guards[variable] for variable in tables.variables),
            updates=tuple(updates[variable] for variable in tables.variables),
            live=live,
            registers=(*(initial(each) for each in registers), *([0] if conditions.number is not None else [])),
            within_us=within_us,
            skip=self.clause.skip.mode,
            skip_variables=(*skipped, *(variable + count for variable in skipped)),
            threads_most=self.limits.threads,
            skip_error=partial(self.skip_error, rows),
        )

    def update(self, index: int, register: Register, variable: int) -> Update:
        """How a row of this variable changes the register; extremes as DuckDB has them."""
        index, change, slot = update_of(index, register, variable, self.limits.listed)
        return index, _EXTREMES.get(register.how, change), slot

    def put(self, search: "_Search", output: _Output, tables: Tables, begin: int, end: int) -> None:
        """One partition."""
        kind = self.clause.rows
        covered_to = begin
        number = 0
        wants_all = kind is RowsPerMatch.ALL_WITH_UNMATCHED or any(tables.accepts[tables.start :])
        for row, found in search.partition(begin, end, wants_all, tables):
            if found is not None:
                number += 1
                self.put_match(output, found, number, row)
                covered_to = max(covered_to, begin + found.ending.ordinal + 1)
            elif tables.accepts[tables.starting(row == begin)]:
                number += 1
                self.put_empty(output, number, row)
            elif kind is RowsPerMatch.ALL_WITH_UNMATCHED and row >= covered_to:
                output.put(-1, -1, row)

    def put_match(self, output: _Output, found: Found, number: int, row: int) -> None:
        count = len(self.symbols.variables)
        match = len(output.numbers)
        first = len(output.rows)
        is_all_rows = self.clause.rows is not RowsPerMatch.ONE
        for _, label, _, low, high, _, _ in runs(found.ending.trace):
            if is_all_rows and label < count:
                for at in range(low, high + 1):
                    output.put(match, len(output.rows) + at - low, at)
            output.rows += range(low, high + 1)
            output.labels += [label % count] * (high - low + 1)
        output.numbers.append(number)
        output.bounds.append(len(output.rows))
        if not is_all_rows:
            output.put(match, len(output.rows) - 1, row)
        assert len(output.rows) > first, "a match that is not empty has rows"

    def put_empty(self, output: _Output, number: int, row: int) -> None:
        match = len(output.numbers)
        output.numbers.append(number)
        output.bounds.append(len(output.rows))
        if self.clause.rows is not RowsPerMatch.ALL_OMIT_EMPTY:
            output.put(match, -1, row)

    # The result.

    def arranged(
        self,
        rows: OrderedRows,
        output: _Output,
        measured: Sequence[pa.ChunkedArray],
        partition_by: Sequence[str],
        order_by: Sequence[str],
    ) -> pa.Table:
        names = list(partition_by)
        rest: list[str] = []
        if self.clause.rows is not RowsPerMatch.ONE:
            names += [name for name in order_by if name not in self.computed]
            rest = [name for name in self.symbols.types if name not in names]
        sources = pa.array(output.sources, pa.int64())
        columns = {name: rows.table.column(name).take(sources) for name in (*names, *rest)}
        arrays = [*(columns[name] for name in names), *measured, *(columns[name] for name in rest)]
        measures = [measure.name.name for measure in self.clause.measures]
        return pa.Table.from_arrays(arrays, names=_apart([*names, *measures, *rest]))


class _Search:
    """Searches partitions for matches: all starts together, or one after the other where DEFINE asks for the number."""

    def __init__(self, machine: Machine, block: Block, is_numbered: bool, limits: Limits) -> None:
        self.machine = machine
        self.matcher = Matcher(machine)
        self.block = block
        self.is_start = frozenset(block.starts) if is_numbered else frozenset()
        self.is_numbered = is_numbered
        self.limits = limits
        self.steps = 0

    def partition(self, begin: int, end: int, wants_all: bool, tables: Tables) -> Iterator[tuple[int, Found | None]]:
        """The rows at which the search began, with the match that it found there; None: none but perhaps an empty one.

        Without `wants_all`, rows at which there was none are left out.
        """
        if self.is_numbered:
            yield from self.one_by_one(begin, end, tables)
            return
        state = Partition()
        found = [*self.matcher.run(state, self.block, begin, end), *self.matcher.finish(state)]
        row = begin
        for each in found:
            first = each.first[1]
            if wants_all:
                yield from ((at, None) for at in range(row, first))
            yield first, each
            row = begin + self.matcher.resume(each.first, first - begin, each.ending)
        if wants_all:
            yield from ((at, None) for at in range(row, end))

    def one_by_one(self, begin: int, end: int, tables: Tables) -> Iterator[tuple[int, Found | None]]:
        row, number = begin, 0
        while row < end:
            found = self.at(row, begin, end, number + 1) if row in self.is_start else None
            yield row, found
            number += found is not None or tables.accepts[tables.starting(row == begin)]
            row = row + 1 if found is None else begin + self.matcher.resume(found.first, row - begin, found.ending)

    def at(self, row: int, begin: int, end: int, number: int) -> Found | None:
        """The match that begins at the row, as the one of this number."""
        registers = (*self.machine.registers[:-1], number)
        matcher = Matcher(replace(self.machine, registers=registers))
        block = replace(self.block, starts=[row])
        state = Partition(ordinal=row - begin)
        at, stride = row, 1
        found: list[Found] = []
        while not found and at < end and (at == row or state.attempts):
            step = min(end, at + stride)
            found = matcher.run(state, block, at, step)
            self.count((step - at) * max(1, sum(len(attempt.threads) for attempt in state.attempts)))
            at, stride = step, min(2 * stride, _STRIDE)
        found = found or matcher.finish(state)
        return found[0] if found else None

    def count(self, steps: int) -> None:
        self.steps += steps
        rows = len(self.block.bits)
        most = max(self.limits.steps, _STEPS_A_ROW * rows)
        if self.steps > most:
            raise LimitError(
                "MATCH_NUMBER in DEFINE makes the search go start by start, each over all rows until it is decided: "
                f"{self.steps:,} steps so far over {rows:,} rows, and the limit `steps` is {most:,}. Next: ask for the "
                "number in MEASURES, or let a start fail sooner, by WITHIN or a condition"
            )


def _min(held: Any, value: Any) -> Any:
    if held is None or value is None:
        return value if held is None else held
    return held if held <= value or value != value else value


def _max(held: Any, value: Any) -> Any:
    if held is None or value is None:
        return value if held is None else held
    return held if held >= value or held != held else value


_EXTREMES: dict[str, Change] = {"min": _min, "max": _max}
"""To DuckDB NaN, which does not equal itself, is greater than every number."""


def _term(column: str, ordering: Ordering) -> str:
    direction = " DESC" if ordering.is_descending else " ASC"
    nulls = " NULLS FIRST" if ordering.nulls_first else " NULLS LAST"
    return quoted(column) + direction + nulls


def _apart(names: list[str]) -> list[str]:
    """The names, of which the later of two that are equal to DuckDB gets a number, as DuckDB does it."""
    seen: set[str] = set()
    found = []
    for name in names:
        number, free = 0, name
        while free.lower() in seen:
            number += 1
            free = f"{name}_{number}"
        seen.add(free.lower())
        found.append(free)
    return found


def _has_exclusion(pattern: Pattern) -> bool:
    match pattern:
        case Exclusion():
            return True
        case Concatenation(parts) | Alternation(parts) | Permutation(parts):
            return any(_has_exclusion(part) for part in parts)
        case Repetition(body):
            return _has_exclusion(body)
        case _:
            return False
