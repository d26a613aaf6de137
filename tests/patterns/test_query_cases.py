"""Queries and their answers, kept as data: `cases/README.md` has the format."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import duckdb
import pyarrow as pa
import pytest

from patterns import MatchError, RuleError
from patterns.querying.queries import query

CASES = Path(__file__).parent / "cases"
MARKER = re.compile(r"^--- (\w+) ?(.*)$")


@dataclass
class Case:
    """One query and what it comes to: an answer, an error with its place, or a failure."""

    title: str
    sql: str = ""
    tables: dict[str, pa.Table] = field(default_factory=dict)
    wanted: list[str] | None = None
    error: str = ""
    fails: str = ""


def cases(text: str) -> Iterator[Case]:
    """The cases of a file."""
    shared: dict[str, pa.Table] = {}
    case: Case | None = None
    for marker, rest, body in sections(text):
        tables = case.tables if case else shared
        if marker == "case":
            if case:
                yield case
            case = Case(rest, body, dict(shared))
        elif marker == "table":
            tables[rest] = typed(body)
        elif marker == "letters":
            name, letters = rest.split(" ", 1) if " " in rest else (rest, "")
            tables[name] = lettered(letters)
            if case:
                case.sql += body
        else:
            assert case, f"{marker} before the first case"
            if marker == "wanted":
                case.wanted = body.strip().splitlines()
            elif marker == "error":
                case.error = rest
            else:
                assert marker == "fails", f"no such line: --- {marker}"
                case.fails = rest
    if case:
        yield case


def sections(text: str) -> Iterator[tuple[str, str, str]]:
    """Each marker, what stands behind it, and the lines below it."""
    marker, rest, body = "", "", ""
    for line in text.splitlines(keepends=True):
        found = MARKER.match(line)
        if not found:
            body += line
            continue
        if marker:
            yield marker, rest, body
        marker, rest, body = found[1], found[2].strip(), ""
    if marker:
        yield marker, rest, body


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split(" | ")]


def lettered(letters: str) -> pa.Table:
    values = [None if letter == "-" else letter for letter in letters]
    return pa.table({"id": pa.array(range(1, len(values) + 1), pa.int32()), "x": pa.array(values, pa.string())})


def typed(body: str) -> pa.Table:
    """The table that a header with types and rows of text say."""
    header, *rows = body.strip().splitlines()
    columns = [cell.rsplit(" ", 1) for cell in cells(header)]
    table = pa.table(
        {name: pa.array([text(row, i) for row in rows], pa.string()) for i, (name, _) in enumerate(columns)}
    )
    casts = ", ".join(f'cast("{name}" as {kind}) as "{name}"' for name, kind in columns)
    return reader().from_arrow(table).project(casts).to_arrow_table()


def text(row: str, index: int) -> str | None:
    cell = cells(row)[index]
    return None if cell == "NULL" else "" if cell == "''" else cell


def shown(table: pa.Table) -> tuple[list[str], list[list[str]], list[str]]:
    """Names, rows as DuckDB's text, and types."""
    relation = reader().from_arrow(table)
    types = [str(each).lower() for each in relation.types]
    texts = [
        f"coalesce(nullif(cast(#{index} as varchar), ''), case when #{index} is null then 'NULL' else '''''' end)"
        for index in range(1, table.num_columns + 1)
    ]
    return table.column_names, [list(row) for row in relation.project(", ".join(texts)).fetchall()], types


@cache
def reader() -> duckdb.DuckDBPyConnection:
    """What reads and writes tables as text; one, since opening takes longer than a case."""
    connection = duckdb.connect(config={"threads": 1})
    connection.execute("set timezone = 'UTC'")
    return connection


ALL = [
    pytest.param(case, id=f"{file.stem}: {case.title}")
    for file in sorted(CASES.glob("*.sql"))
    for case in cases(file.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize("case", ALL)
def test_a_query_comes_to_what_its_case_says(case: Case) -> None:
    assert sum((case.wanted is not None, bool(case.error), bool(case.fails))) == 1, "one of wanted, error, fails"
    if case.wanted is not None:
        holds_the_wanted(query(case.sql, case.tables), case.wanted)
    elif case.error:
        is_refused(case.sql, case.tables, case.error)
    else:
        with pytest.raises(MatchError, match=re.escape(case.fails)):
            query(case.sql, case.tables)


def holds_the_wanted(answer: pa.Table, wanted: list[str]) -> None:
    names, rows, types = shown(answer)
    header = [cell.split(" ", 1) for cell in cells(wanted[0])]
    assert names == [each[0] for each in header]
    assert rows == [cells(line) for line in wanted[1:]]
    assert [each[1].lower() if each[1:] else kind for each, kind in zip(header, types, strict=True)] == types


def is_refused(marked: str, tables: Mapping[str, pa.Table], words: str) -> None:
    before, sign, after = marked.partition("▸")
    assert sign, "▸ says where"
    with pytest.raises(RuleError) as caught:
        query(before + after, tables)
    error = caught.value
    assert words in error.message
    place = (before.count("\n") + 1, len(before.rpartition("\n")[2]) + 1)
    assert (error.line, error.column) == place
    assert str(error).startswith(f"<query>:{place[0]}:{place[1]}: ")


def test_no_two_cases_bear_one_title() -> None:
    titles = [str(each.id) for each in ALL]
    assert sorted(titles) == sorted(set(titles))
