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

from patterns.dialect import ClauseDialect
from patterns.errors import MatchError

_NO_AGGREGATES = frozenset(
    ("CUME_DIST", "DENSE_RANK", "FILL", "FIRST", "FIRST_VALUE", "LAG", "LAST", "LAST_VALUE", "LEAD", "NTH_VALUE",
     "NTILE", "PERCENT_RANK", "RANK", "RANK_DENSE", "ROW_NUMBER")
)  # fmt: skip
_MEMO_MOST = 100_000


@cache
def _functions(kind: str) -> frozenset[str]:
    """See `Duck.functions`; which there are is settled when DuckDB is built, and asking takes a tenth of a second."""
    condition = "function_type = 'aggregate'" if kind == "aggregate" else "stability <> 'CONSISTENT'"
    with duckdb.connect() as connection:
        found = connection.execute(
            f"SELECT DISTINCT upper(function_name) FROM duckdb_functions() WHERE {condition}"
        ).fetchall()
    return frozenset(name for (name,) in found) - (_NO_AGGREGATES if kind == "aggregate" else frozenset())


class Duck:
    """Evaluates SQL expressions. Not for several threads at once."""

    def __init__(self) -> None:
        self.connection = duckdb.connect(config={"threads": 1})
        self.connection.execute("SET integer_division = true; SET TimeZone = 'UTC'")

    def close(self) -> None:
        """Gives the connection back."""
        self.connection.close()

    def functions(self, kind: str) -> frozenset[str]:
        """The names, in upper case, of the `aggregate` functions, or of those that are not `steady`."""
        return _functions(kind)

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
            self.connection.register(name, table)
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
        self.connection.register("described", table.slice(0, 0))
        found = self.connection.execute("DESCRIBE described").fetchall()
        self.connection.unregister("described")
        return {row[0]: "INTEGER" if row[1] == '"NULL"' else row[1] for row in found}

    def value(self, expression: str, params: Mapping[str, Any] | None = None) -> Any:
        """The value of an expression without columns.

        Raises:
            duckdb.Error: DuckDB does not take it.
        """
        found = self.connection.execute(f"SELECT {expression} AS c0", params or None)
        return found.to_arrow_table().column(0)[0].as_py()


class Remembered:
    """One expression over single values, by DuckDB, once for each combination of them."""

    def __init__(self, duck: Duck, expression: str, columns: Mapping[str, str], lists: Mapping[str, str]) -> None:
        """Prepares the question.

        Args:
            duck: The evaluator.
            expression: Over the columns; where there are lists, an aggregate.
            columns: Names and types of those with one value.
            lists: Names and types of those with a list of values, one a row.
        """
        typed = [f"unnest(CAST(${at} AS {kind}[])) AS {quoted(name)}" for at, (name, kind) in
                 enumerate(lists.items(), start=1)]  # fmt: skip
        typed += [f"CAST(${at} AS {kind}) AS {quoted(name)}" for at, (name, kind) in
                  enumerate(columns.items(), start=len(lists) + 1)]  # fmt: skip
        self.query = f"SELECT {expression} AS c0 FROM (SELECT {', '.join(typed)})"
        self.duck = duck
        self.memo: dict[str, Any] = {}

    def __call__(self, values: Sequence[Any]) -> Any:
        """The expression's value where lists and columns, in this order, have these.

        Raises:
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
        try:
            found = self.duck.connection.execute(self.query, list(values))
            return found.to_arrow_table().column(0)[0].as_py()
        except duckdb.Error as error:
            raise MatchError(f"DuckDB: {first_line(error)}") from error


def sql_of(node: exp.Expr) -> str:
    """The expression as DuckDB reads it."""
    return node.sql(dialect=ClauseDialect)


def quoted(name: str) -> str:
    """The name as a quoted identifier."""
    return '"' + name.replace('"', '""') + '"'


def first_line(error: Exception) -> str:
    """What DuckDB complains of, without its drawing."""
    return str(error).split("\n", 1)[0]
