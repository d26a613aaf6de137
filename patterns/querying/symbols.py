"""The names of one MATCH_RECOGNIZE clause in a query: variables, unions of variables, columns, parameters.

Checks the clause's own names, and turns expressions as written into expressions over the input's columns.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from typing import Any, NoReturn

import duckdb
import pyarrow as pa
from sqlglot import exp

from patterns.durations import microseconds
from patterns.errors import MatchError
from patterns.language.frames import frames_of
from patterns.language.navigation import (
    NAVIGATION,
    Names,
    Reader,
    column_parts,
    function_name,
    identifier_key,
    offset_of,
)
from patterns.language.pattern_variables import pattern_variables
from patterns.language.syntax import Clause, Identifier, Scalar
from patterns.language.text import did_you_mean
from patterns.querying.duck import Duck, aggregates, first_line, quoted, sql_of, unsteady_functions

_UNKNOWN_FUNCTION = re.compile(r"Function with name (\w+) does not exist")
_OF_PATTERNS = ("PREV", "NEXT", "FIRST", "LAST", "CLASSIFIER", "MATCH_NUMBER")

_OF_SEVERAL_ROWS = ("UNNEST", "GENERATE_SUBSCRIPTS")


@dataclass(frozen=True)
class Symbols:
    """What the names of a clause mean.

    Attributes:
        clause: The clause.
        duck: The evaluator.
        columns: The input's columns by lower-case name: DuckDB tells names apart without regard to case.
        types: Their types, by name.
        variables: The pattern's variables, by index.
        frames: What each variable and each SUBSET stands for.
        params: Values of parameters, by name.
        ambiguous: Names that several columns of the input had, in lower case, and which.
    """

    clause: Clause
    duck: Duck
    columns: Mapping[str, str]
    types: Mapping[str, str]
    variables: tuple[str, ...]
    frames: Mapping[str, tuple[str, ...]]
    params: Mapping[str, Any]
    ambiguous: Mapping[str, str]

    @classmethod
    def of(
        cls,
        clause: Clause,
        duck: Duck,
        types: Mapping[str, str],
        params: Mapping[str, Any],
        ambiguous: Mapping[str, str] | None = None,
    ) -> "Symbols":
        """The symbols of a clause over an input of these columns and types.

        Raises:
            RuleError: A SUBSET, DEFINE or SKIP TO names a variable that is not there, or one twice.
        """
        columns = {name.lower(): name for name in types}
        frames = frames_of(clause)
        variables = tuple(dict.fromkeys(name.key for name in pattern_variables(clause.pattern)))
        return cls(clause, duck, columns, types, variables, frames, params, ambiguous or {})

    def index(self, variable: str) -> int:
        """The variable's index."""
        return self.variables.index(variable)

    def indices(self, frame: tuple[str, ...] | None) -> tuple[int, ...] | None:
        """The indices of the frame's variables, ascending; None: of all rows."""
        return None if frame is None else tuple(sorted(self.index(name) for name in frame))

    def reader(self, clause: str, scalar: Scalar) -> Reader:
        """What finds the readings of an expression of this clause."""
        names = Names(self.clause.passage, clause, self.frames, aggregates(), self.number)
        return Reader(names, scalar.at)

    def column(self, identifier: Identifier, clause: str) -> str:
        """The column of this name.

        Raises:
            RuleError: There is none.
        """
        self._check_one(identifier.name, clause, identifier.at)
        found = self.columns.get(identifier.name.lower())
        if found is None:
            have = ", ".join(self.types) + did_you_mean(identifier.name, self.types)
            message = f"{clause}: unknown column {identifier.name!r}; there are: {have}"
            raise self.clause.passage.error(message, identifier.at)
        return found

    def checked(self, clause: str, scalar: Scalar) -> exp.Expr:
        """The expression, without parameters.

        Raises:
            RuleError: It holds a sub-query, a window, a function of no fixed value, or an unknown parameter.
        """
        for node in scalar.node.walk():
            if isinstance(node, exp.Query | exp.Exists | exp.Subquery) or node.args.get("query"):
                message = "a sub-query must not stand here, but in MEASURES as a value, in EXISTS or behind IN"
                self._fail(clause, message, node, scalar)
            if isinstance(node, exp.Star) and not _is_counted(node):
                self._fail(clause, "* stands in COUNT only", node, scalar)
            if isinstance(node, exp.Comprehension):
                self._fail(clause, "a list comprehension must not stand here; write list_transform(...)", node, scalar)
            if isinstance(node, exp.Explode | exp.Unnest) or function_name(node) in _OF_SEVERAL_ROWS:
                self._fail(clause, "UNNEST makes several rows of one; unnest the result outside", node, scalar)
            if isinstance(node, exp.Window):
                self._fail(clause, "a window function must not stand here", node, scalar)
            if function_name(node) in unsteady_functions():
                name = function_name(node)
                message = f"{name} has another value at each call, which no match can be built on"
                self._fail(clause, message, node, scalar)
        return scalar.node.transform(lambda node: self._without_parameter(node, clause, scalar))

    def _without_parameter(self, node: exp.Expr, clause: str, scalar: Scalar) -> exp.Expr:
        if not isinstance(node, exp.Placeholder | exp.Parameter):
            return node
        name = node.name
        if name not in self.params:
            have = ", ".join(sorted(self.params)) or "none"
            self._fail(clause, f"unknown parameter {name!r}; there are: {have}", node, scalar)
        return _literal(self.params[name])

    def over_columns(self, operand: exp.Expr, clause: str, at: int) -> exp.Expr:
        """The operand with each of its columns as the input's, without the variable before it.

        Raises:
            RuleError: There is no such column.
        """

        def resolved(node: exp.Expr) -> exp.Expr:
            return self._input_column(node, clause, at) if isinstance(node, exp.Column) else node

        return operand.transform(resolved)

    def _input_column(self, column: exp.Expr, clause: str, at: int) -> exp.Expr:
        parts = column_parts(column)
        if len(parts) > 1 and (identifier_key(parts[0]) in self.frames or self._is_source(parts[0])):
            parts = parts[1:]
        at = offset_of(column, at)
        self._check_one(parts[0].name, clause, at)
        name = self.columns.get(parts[0].name.lower())
        if name is None:
            if len(parts) > 1:
                have = (", ".join(self.frames) or "none") + did_you_mean(parts[0].name, self.frames)
                message = f"{clause}: unknown pattern variable {parts[0].name!r}; there are: {have}"
            else:
                have = ", ".join(self.types) + did_you_mean(parts[0].name, self.types)
                message = f"{clause}: unknown column {parts[0].name!r}; there are: {have}"
            raise self.clause.passage.error(message, at)
        found: exp.Expr = exp.Column(this=exp.to_identifier(name, quoted=True))
        for field in parts[1:]:
            found = exp.Dot(this=found, expression=exp.to_identifier(field.name, quoted=True))
        return found

    def _check_one(self, name: str, clause: str, at: int) -> None:
        """Checks that one column of the input bears the name.

        Raises:
            RuleError: Several do.
        """
        where = self.ambiguous.get(name.lower())
        if where is not None:
            message = f"{clause}: {name!r} is ambiguous, as the input has it twice: {where}"
            raise self.clause.passage.error(f"{message}. Next: give one of them another name, in a sub-query", at)

    def _is_source(self, identifier: exp.Expr) -> bool:
        """Whether this is the input's name, which no variable has."""
        return self.clause.source is not None and identifier.name.lower() == self.clause.source.lower()

    def key(self, name: Identifier, clause: str) -> tuple[str, str]:
        """What a place of PARTITION BY or ORDER BY is called, and its SQL over the input's columns.

        Raises:
            RuleError: It reads a match, or names a column that is not there.
        """
        scalar = self.clause.keys.get(name.at)
        if scalar is None:
            column = self.column(name, clause)
            return column, quoted(column)
        tree = self.checked(clause, scalar)
        for node in tree.walk():
            if function_name(node) in NAVIGATION or function_name(node) in aggregates():
                what = f"{function_name(node)} must not stand here: there is no match to look at yet"
                self._fail(clause, what, node, scalar)
        if not any(isinstance(node, exp.Column) for node in tree.walk()):
            self._fail(clause, f"{sql_of(tree)} is the same for every row; name a column", tree, scalar)
        resolved = self.over_columns(tree, clause, scalar.at)
        self.check_types(clause, scalar, resolved, self.types)
        return resolved.name if isinstance(resolved, exp.Column) else name.name, sql_of(resolved)

    def number(self, node: exp.Expr) -> int | None:
        """The value of an expression that is a constant whole number; None if it is none."""
        if any(isinstance(part, exp.Column | exp.Query) for part in node.walk()):
            return None
        try:
            value = self.duck.value(sql_of(node))
        except duckdb.Error:
            return None
        return value if type(value) is int else None

    def check_types(self, clause: str, scalar: Scalar, expression: exp.Expr, columns: Mapping[str, str]) -> str:
        """The type of an expression over columns of these types.

        Raises:
            RuleError: DuckDB does not take it.
        """
        try:
            return self.duck.types([sql_of(expression)], columns)[0]
        except duckdb.Error as error:
            message = f"{clause}: {first_line(error)}{_meant_function(error)}"
            raise self.clause.passage.error(message, scalar.at) from error

    def evaluated(
        self, table: pa.Table, expressions: Sequence[str], clause: str, at: Sequence[int]
    ) -> list[pa.ChunkedArray]:
        """For each expression its value at each row of the table; `at` is where each was written.

        Raises:
            MatchError: An expression fails on a row; it is named with its place.
        """
        try:
            return self.duck.columns(table, expressions)
        except MatchError:
            for expression, place in zip(expressions, at, strict=True):
                with self.placed(clause, place):
                    self.duck.columns(table, [expression])
            raise

    @contextmanager
    def placed(self, clause: str, at: int) -> Iterator[None]:
        """A failure of an expression in the block gets the expression's place; a limit keeps its own words."""
        try:
            yield
        except MatchError as error:
            if type(error) is not MatchError:
                raise
            raise MatchError(str(self.clause.passage.error(f"{clause}: {error}", at))) from error

    def _fail(self, clause: str, message: str, node: exp.Expr, scalar: Scalar) -> NoReturn:
        raise self.clause.passage.error(f"{clause}: {message}", offset_of(node, scalar.at))


def _meant_function(error: duckdb.Error) -> str:
    """The function of row patterns that was meant, where DuckDB does not know one and it is like that."""
    found = _UNKNOWN_FUNCTION.search(str(error)) if isinstance(error, duckdb.CatalogException) else None
    return did_you_mean(found[1], _OF_PATTERNS) if found else ""


def _is_counted(star: exp.Star) -> bool:
    """Whether it is that of COUNT(*), or of v.*, which whoever reads an aggregate judges."""
    around = star.parent
    return isinstance(around, exp.Column) or (around is not None and function_name(around) == "COUNT")


def _literal(value: Any) -> exp.Expr:
    """A parameter's value as SQL."""
    if isinstance(value, timedelta):
        return exp.Anonymous(this="to_microseconds", expressions=[exp.Literal.number(microseconds(value))])
    if isinstance(value, datetime | date):
        return exp.cast(exp.Literal.string(value.isoformat()), _time_type(value))
    return exp.convert(value)


def _time_type(value: datetime | date) -> str:
    if not isinstance(value, datetime):
        return "DATE"
    return "TIMESTAMP" if value.tzinfo is None else "TIMESTAMPTZ"
