"""Clauses over small tables, as tests write them."""

from collections.abc import Sequence
from typing import Any

import duckdb
import pyarrow as pa

from patterns.language.parser import parse_clause
from patterns.language.text import Passage
from patterns.querying.recognition import recognise


def recognised(clause: str, rows: str, columns: str = "id, value", **more: Any) -> pa.Table:
    """What MATCH_RECOGNIZE (clause) gives for the rows, written as VALUES writes them."""
    table = duckdb.sql(f"SELECT * FROM (VALUES {rows}) AS t({columns})").to_arrow_table()
    return recognised_in(clause, table, **more)


def recognised_in(clause: str, table: pa.Table, **more: Any) -> pa.Table:
    """What MATCH_RECOGNIZE (clause) gives for the table."""
    text = f"MATCH_RECOGNIZE ({clause})"
    parsed, end = parse_clause(Passage.alone(text), 0)
    assert end == len(text)
    return recognise(parsed, table, **more)


def tuples(table: pa.Table, *names: str) -> list[Sequence[Any]]:
    """The rows of these columns, or of all."""
    columns = [table.column(name).to_pylist() for name in names or table.column_names]
    return list(zip(*columns, strict=True)) if columns else [()] * table.num_rows
