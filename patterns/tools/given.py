"""The rows that a test gives, inline or as a CSV file beside it: read, checked and typed.

Each row knows where in which file it says what, so that an unknown column or a value of another type is
named with its place. Nothing here knows what rows mean; what is not given is filled in by who asks.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa

from patterns.binding.columns import arrow_type
from patterns.binding.expressions import Kind
from patterns.durations import parse_duration
from patterns.errors import RuleError
from patterns.language.text import Document, Passage, did_you_mean

Located = Callable[..., Passage]
"""(keys below `given`) -> where the value under them stands."""


@dataclass(frozen=True, slots=True)
class GivenRow:
    """One row of a test.

    Attributes:
        number: Which row, from 1.
        values: What it says, by column; what it leaves out is not among them.
        at: Where the value of a column stands; or, asked for `[key]` behind it, the column's name.
    """

    number: int
    values: Mapping[str, Any]
    at: Located

    def error(self, message: str, *keys: str) -> RuleError:
        """The error that points at the value of a column, or at the row."""
        return self.at(*keys).error(f"row {self.number}: {message}", 0)

    def typed(self, column: str, kind: Kind) -> Any:
        """The value of a column as one of this type; None if it is NULL or not given.

        Raises:
            RuleError: It is of another type.
        """
        value = self.values.get(column)
        if value is None:
            return None
        try:
            return typed(value, kind)
        except ValueError as error:
            raise self.at(column).error(f"row {self.number}, column {column}: {error}", 0) from error


def given_rows(given: str | Sequence[Mapping[str, Any]], folder: Path, at: Located) -> list[GivenRow]:
    """The rows of a test.

    Args:
        given: The name of a CSV file, or the rows.
        folder: Where the file lies.
        at: Where the test says it.

    Raises:
        RuleError: The file cannot be read, has no header, or a row has more cells than the header.
    """
    if isinstance(given, str):
        return _from_csv(folder / given, at())
    return [
        GivenRow(number, row, lambda *keys, index=number - 1: at(str(index), *keys))
        for number, row in enumerate(given, start=1)
    ]


def check_columns(rows: Iterable[GivenRow], known: Iterable[str]) -> None:
    """Checks that the rows have these columns only, and say their time.

    Raises:
        RuleError: A row has another column, or no time.
    """
    names = set(known)
    for row in rows:
        for column in row.values:
            if column not in names:
                have = ", ".join(sorted(names)) + did_you_mean(str(column), names)
                raise row.error(f"unknown column {column!r}; there are: {have}", str(column), "[key]")
        if row.values.get("time") is None:
            raise row.error("it has no `time`. Next: add one, such as time: 2026-01-01T10:00:00Z")


def _from_csv(path: Path, named: Passage) -> list[GivenRow]:
    """The rows of a CSV file, empty cells left out but for the first row, whose columns are the file's."""
    try:
        text = path.read_text(encoding="utf-8")
        document = Document(str(path), text)
        reader = csv.reader(io.StringIO(text), strict=True)
        lines = [(reader.line_num, cells) for cells in reader if cells]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise named.error(f"cannot read {path}: {error}", 0) from error
    if not lines:
        raise named.error(f"{path} is empty; its first line names the columns", 0)
    header_line, header = lines[0]
    twice = next((name for index, name in enumerate(header) if name in header[:index]), None)
    if twice is not None:
        raise _cell(document, header_line, header, len(header) - 1 - header[::-1].index(twice)).error(
            f"the column {twice!r} stands twice", 0
        )
    rows = []
    for number, (line, cells) in enumerate(lines[1:], start=1):
        if len(cells) > len(header):
            message = f"row {number}: {len(cells)} cells, and the header names {len(header)} columns"
            raise _cell(document, line, cells, len(header)).error(message, 0)
        is_first = number == 1
        values = {
            name: cell or None for name, cell in zip(header, cells, strict=False) if cell != "" or is_first
        }  # fmt: skip
        rows.append(GivenRow(number, values, _located(document, (header_line, header), (line, cells))))
    return rows


def _located(document: Document, header: tuple[int, list[str]], row: tuple[int, list[str]]) -> Located:
    """Where the columns of a row stand, and their names in the header."""

    def at(*keys: str) -> Passage:
        line, cells = header if keys[1:] else row
        return _cell(document, line, cells, header[1].index(keys[0]) if keys else 0)

    return at


def _cell(document: Document, line: int, cells: Sequence[str], index: int) -> Passage:
    """The place of a cell; of one behind a quoted cell, which may be written otherwise than it reads, its line's."""
    written = document.lines[line - 1]
    start = sum(len(cell) + 1 for cell in cells[:index])
    is_plain = written.rstrip("\r") == ",".join(cells)
    return Passage(document, "", ((line - 1, start if is_plain else 0),))


def typed(value: Any, kind: Kind) -> Any:
    """A cell of a test as a value of this type.

    Raises:
        ValueError: It is not one.
    """
    if kind is Kind.TIME:
        return time_of(value)
    if kind is Kind.DURATION:
        return _duration(value)
    if kind is Kind.BOOL:
        return _truth(value)
    if kind in (Kind.INT, Kind.FLOAT):
        return _number(value, kind)
    return value if kind is Kind.NULL else str(value)


def _truth(value: Any) -> bool:
    if isinstance(value, bool):
        return value
    if not isinstance(value, str) or value.lower() not in ("true", "false"):
        raise ValueError(f"wanted true or false, got {value!r}")
    return value.lower() == "true"


def _number(value: Any, kind: Kind) -> int | float:
    try:
        if isinstance(value, bool | datetime | timedelta):
            raise ValueError
        number = float(value) if kind is Kind.FLOAT else int(value)
    except ValueError:
        raise ValueError(f"wanted {_NUMBERS[kind]}, got {value!r}") from None
    if kind is Kind.INT and isinstance(value, float) and value != number:
        raise ValueError(f"wanted {_NUMBERS[kind]}, got {value!r}")
    return number


_NUMBERS = {Kind.INT: "a whole number", Kind.FLOAT: "a number"}


def _duration(value: Any) -> timedelta:
    if isinstance(value, timedelta):
        return value
    if not isinstance(value, str):
        raise ValueError(f"wanted a duration such as 10 s, got {value!r}")
    return parse_duration(value)


def time_of(value: Any) -> datetime:
    """A cell of a test as a time, in UTC unless it says another offset.

    Raises:
        ValueError: It is none.
    """
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        time = None
    if not isinstance(time, datetime):
        raise ValueError(f"wanted a time such as 2026-01-01T10:00:00Z, got {value!r}")
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def column_type(kind: Kind) -> Any:
    """The Arrow type in which a test's rows hold values of this kind."""
    return {Kind.TIME: pa.timestamp("us", "UTC"), Kind.DURATION: pa.duration("us")}.get(kind) or arrow_type(kind)
