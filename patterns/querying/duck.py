"""DuckDB as the evaluator of expressions that stand in queries: over columns, and over single values.

One `Duck` is one connection without tables of its own, for one clause. Divisions of integers give integers, as the
standard has it; everything else is as DuckDB says.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import duckdb
import pyarrow as pa
from sqlglot import exp

from patterns.errors import LimitError, MatchError
from patterns.language.dialect import ClauseDialect
from patterns.querying.values import given_back, values_of, written

_NO_AGGREGATES = frozenset(
    ("CUME_DIST", "DENSE_RANK", "FILL", "FIRST", "FIRST_VALUE", "LAG", "LAST", "LAST_VALUE", "LEAD", "NTH_VALUE",
     "NTILE", "PERCENT_RANK", "RANK", "RANK_DENSE", "ROW_NUMBER")
)  # fmt: skip
_MEMO_MOST = 100_000


@cache
def _instance() -> duckdb.DuckDBPyConnection:
    """The DuckDB that has all connections: to open one takes longer than to answer a small query.

    Each connection has settings and registered tables of its own.
    """
    return duckdb.connect(config={"threads": 1})


class Duck:
    """Evaluates SQL expressions. Not for several threads at once."""

    def __init__(self, questions_most: int) -> None:
        """Opens the connection; `questions_most` is the limit `questions`."""
        self.questions_most = questions_most
        self.questions = 0
        self.names = 0
        self.connection = _instance().cursor()
        self.connection.execute("SET integer_division = true; SET TimeZone = 'UTC'")

    def close(self) -> None:
        """Gives the connection back."""
        self.connection.close()

    def new_name(self) -> str:
        """A name that no prepared statement has yet."""
        self.names += 1
        return f"question_{self.names}"

    def count_question(self) -> None:
        """Counts one question about a partial match.

        Raises:
            LimitError: There were too many.
        """
        self.questions += 1
        if self.questions > self.questions_most:
            raise LimitError(
                f"DEFINE asked DuckDB {self.questions} times about partial matches; the limit `questions` is "
                f"{self.questions_most}. Next: arithmetic, comparisons, CASE, differences of times, COUNT, SUM, MIN, "
                "MAX and AVG, which need no question"
            )

    def columns(self, table: pa.Table, expressions: Sequence[str]) -> list[pa.ChunkedArray]:
        """For each expression its value at each row of the table.

        Raises:
            MatchError: An expression fails on a row.
        """
        if not expressions:
            return []
        wanted = ", ".join(f"{text} AS c{index}" for index, text in enumerate(expressions))
        found = self.table(f"SELECT {wanted} FROM rows_at_hand", rows_at_hand=table)
        return list(found.columns)

    def table(self, query: str, **tables: pa.Table) -> pa.Table:
        """What the query gives; `tables` are its tables by name.

        Raises:
            MatchError: The query fails on a row.
        """
        for name, table in tables.items():
            register(self.connection, name, table)
        try:
            return self.connection.execute(query).to_arrow_table()
        except duckdb.Error as error:
            raise MatchError(f"DuckDB: {first_line(error)}") from error
        finally:
            for name in tables:
                self.connection.unregister(name)

    def types(self, expressions: Sequence[str], columns: Mapping[str, str]) -> list[str]:
        """The type of each expression over columns of these types.

        Raises:
            duckdb.Error: DuckDB does not take an expression.
        """
        if not expressions:
            return []
        wanted = ", ".join(f"{text} AS c{index}" for index, text in enumerate(expressions))
        typed = ", ".join(f"NULL::{kind} AS {quoted(name)}" for name, kind in columns.items()) or "1 AS nothing"
        query = f"DESCRIBE SELECT {wanted} FROM (SELECT {typed}) WHERE false"
        return [row[1] for row in self.connection.execute(query).fetchall()]

    def column_types(self, table: pa.Table) -> dict[str, str]:
        """The type that DuckDB has for each column."""
        register(self.connection, "described", table)
        found = self.connection.execute("DESCRIBE described").fetchall()
        self.connection.unregister("described")
        return {row[0]: "INTEGER" if row[1] == '"NULL"' else row[1] for row in found}

    def value(self, expression: str, params: Mapping[str, Any] | None = None) -> Any:
        """The value of an expression without columns.

        Raises:
            duckdb.Error: DuckDB does not take it.
        """
        found = self.connection.execute(f"SELECT {expression} AS c0", params or None)
        return values_of(found.to_arrow_table().column(0))[0]


class Remembered:
    """One expression over single values, by DuckDB, once for each combination of them."""

    def __init__(self, duck: Duck, expression: str, columns: Mapping[str, str]) -> None:
        """Prepares the question; `columns` are the names and types of what the expression reads."""
        typed = ", ".join(f"CAST(${at} AS {kind}) AS {quoted(name)}"
                          for at, (name, kind) in enumerate(columns.items(), start=1))  # fmt: skip
        self.query = f"SELECT {expression} AS c0 FROM (SELECT {typed})"
        self.duck = duck
        self.memo: dict[str, Any] = {}
        self.prepared = ""

    def __call__(self, values: Sequence[Any]) -> Any:
        """The expression's value where the columns, in their order, have these.

        Raises:
            LimitError: DuckDB was asked too often.
            MatchError: DuckDB cannot evaluate it.
        """
        key = repr(values)
        if key not in self.memo:
            if len(self.memo) >= _MEMO_MOST:
                self.memo.clear()
            self.memo[key] = self.evaluated(values)
        return self.memo[key]

    def evaluated(self, values: Sequence[Any]) -> Any:
        """As called, without looking into the memory."""
        self.duck.count_question()
        texts = [written(value) for value in values]
        try:
            if values and None not in texts:
                found = self.duck.connection.execute(f"EXECUTE {self.name()}({', '.join(filter(None, texts))})")
            else:
                found = self.duck.connection.execute(self.query, [given_back(value) for value in values])
            return values_of(found.to_arrow_table().column(0))[0]
        except duckdb.Error as error:
            raise MatchError(f"DuckDB: {first_line(error)}") from error

    def name(self) -> str:
        """The question as a prepared statement, which takes a quarter of the time."""
        if not self.prepared:
            self.prepared = self.duck.new_name()
            self.duck.connection.execute(f"PREPARE {self.prepared} AS {self.query}")
        return self.prepared


class Aggregated:
    """One aggregate over lists of values, one value a row, by DuckDB."""

    def __init__(self, duck: Duck, expression: str, columns: Mapping[str, str]) -> None:
        """Prepares the question; `columns` are the names and types of what the aggregate reads of a row."""
        typed = ", ".join(f"CAST({quoted(name)} AS {kind}) AS {quoted(name)}" for name, kind in columns.items())
        self.query = f"SELECT {expression} AS c0 FROM (SELECT {typed} FROM listed_rows)"
        self.names = tuple(columns)
        self.duck = duck

    def __call__(self, lists: Sequence[Sequence[Any]]) -> Any:
        """The aggregate over rows of these values, column by column.

        Raises:
            LimitError: DuckDB was asked too often.
            MatchError: DuckDB cannot evaluate it.
        """
        self.duck.count_question()
        given = [[given_back(value) for value in values] for values in lists]
        rows = pa.table({name: pa.array(values) for name, values in zip(self.names, given, strict=True)})
        return values_of(self.duck.table(self.query, listed_rows=rows).column(0))[0]


def register(connection: duckdb.DuckDBPyConnection, name: str, table: pa.Table) -> None:
    """Makes a table that DuckDB gave known by this name; an ENUM, which it gives as a dictionary, is one again."""
    enums = {field.name: _enum(table.column(at)) for at, field in enumerate(table.schema)}
    casts = [f"CAST({quoted(column)} AS {kind}) AS {quoted(column)}" for column, kind in enums.items() if kind]
    if not casts:
        connection.register(name, table)
        return
    connection.register(name, connection.from_arrow(table).project(f"* REPLACE ({', '.join(casts)})"))


def _enum(column: pa.ChunkedArray) -> str | None:
    """The type ENUM of a column; None: it has another, or no value."""
    if not pa.types.is_dictionary(column.type) or not pa.types.is_string(column.type.value_type):
        return None
    values = max((chunk.dictionary for chunk in column.chunks), key=len, default=())
    texts = ["'" + value.as_py().replace("'", "''") + "'" for value in values]
    return f"ENUM({', '.join(texts)})" if texts else None


@cache
def aggregates() -> frozenset[str]:
    """The names, in upper case, of DuckDB's aggregate functions."""
    return _functions("function_type = 'aggregate'") - _NO_AGGREGATES


@cache
def unsteady_functions() -> frozenset[str]:
    """The names, in upper case, of functions whose value changes from call to call or from query to query."""
    return _functions("stability <> 'CONSISTENT'")


def _functions(condition: str) -> frozenset[str]:
    with duckdb.connect() as connection:
        found = connection.execute(
            f"SELECT DISTINCT upper(function_name) FROM duckdb_functions() WHERE {condition}"
        ).fetchall()
    return frozenset(name for (name,) in found)


def sql_of(node: exp.Expr) -> str:
    """The expression as DuckDB reads it."""
    return node.sql(dialect=ClauseDialect)


def quoted(name: str) -> str:
    """The name as a quoted identifier."""
    return '"' + name.replace('"', '""') + '"'


def first_line(error: Exception) -> str:
    """What DuckDB complains of, without its drawing and without a column's name, which is ours."""
    return str(error).split("\n", 1)[0].split(" when casting from source column", 1)[0]
