"""What a command prints: for people with Rich, or JSON lines for machines.

Contract: results go to standard output; progress, notes and errors to standard error, so that a
pipe gets results only. With `--json` every result is one JSON object a line.
"""

import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from decimal import Decimal
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

_PIPE_COLUMNS = 240
"""Width of tables where nobody's terminal sets one."""
_CONTROLS = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]")
"""Control characters but the end of line."""


def _console(file: TextIO) -> Console:
    width = None if file.isatty() else _PIPE_COLUMNS
    return Console(file=file, soft_wrap=True, highlight=False, width=width)


def to_json(value: Any) -> str:
    """The value as one line of JSON; times in ISO 8601, bytes in hexadecimal, no control characters, no NaN."""
    try:
        text = json.dumps(value, default=_plain, ensure_ascii=False, allow_nan=False)
    except ValueError:
        text = json.dumps(_without_nan(value), default=_plain, ensure_ascii=False)
    return _CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def printable(text: str) -> str:
    """The text with control characters escaped: what another station wrote must not steer this terminal."""
    return _CONTROLS.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


def counted(number: int, noun: str) -> str:
    """The number with its noun: `1 test`, `2 tests`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    return str(value)


def _without_nan(value: Any) -> Any:
    """The value with the numbers that JSON lacks as text: "nan", "inf"."""
    if isinstance(value, Mapping):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(each) for each in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True, slots=True)
class Output:
    """Where and how a command prints."""

    is_json: bool = False
    out: Console = field(default_factory=lambda: _console(sys.stdout))
    err: Console = field(default_factory=lambda: _console(sys.stderr))

    @property
    def stream(self) -> TextIO:
        """Standard output itself, for formats that are not ours to lay out."""
        return self.out.file  # type: ignore[return-value]  # made of a TextIO

    def note(self, text: str) -> None:
        """Tell people something on standard error."""
        self.err.print(text, markup=False, style="dim")

    def result(self, values: Mapping[str, Any], text: str | None = None) -> None:
        """Print one result."""
        if self.is_json:
            self.line(to_json(values))
        else:
            self.line(text if text is not None else "  ".join(f"{name}: {value}" for name, value in values.items()))

    def line(self, text: str) -> None:
        """Print one line as it is."""
        self.stream.write(text + "\n")
        self.stream.flush()

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Print rows: a table for people, an object a line for machines.

        A single row that is wider than the terminal is turned on its side: a line for each value.
        """
        if self.is_json:
            for row in rows:
                self.line(to_json(dict(zip(columns, row, strict=True))))
            return
        shown = [_cells(row) for row in rows]
        table = _table(title, columns, shown)
        if len(shown) == 1 and _width(columns, shown[0]) > self.out.width:
            self._on_its_side(columns, shown[0])
        else:
            self.out.print(table)

    def _on_its_side(self, columns: Sequence[str], cells: Sequence[Text]) -> None:
        width = max(len(printable(column)) for column in columns)
        for column, cell in zip(columns, cells, strict=True):
            self.line(f"{printable(column) + ':':{width + 1}} {cell.plain}".rstrip())

    @contextmanager
    def progress(self, what: str, total: float | None) -> Iterator["Bar"]:
        """A progress bar on standard error, shown on a terminal only."""
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self.err, disable=self.is_json or not self.err.is_terminal) as bars:
            yield Bar(bars, bars.add_task(what, total=total))


@dataclass(frozen=True, slots=True)
class Bar:
    """One progress bar."""

    bars: Progress
    task: Any

    def at(self, done: float, total: float | None = None) -> None:
        """Show that so much is done, of a total that may be known only now."""
        self.bars.update(self.task, completed=done, total=total)


def laid_out(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Table:
    """The rows as a table for people."""
    return _table(title, columns, [_cells(row) for row in rows])


def _table(title: str, columns: Sequence[str], shown: Iterable[Sequence[Text]]) -> Table:
    table = Table(title=title or None, title_justify="left")
    for column in columns:
        table.add_column(Text(printable(column)), overflow="fold")
    for cells in shown:
        table.add_row(*cells)
    return table


def _cells(row: Sequence[Any]) -> list[Text]:
    return [Text(printable(_cell(value))) for value in row]


def _width(columns: Sequence[str], cells: Sequence[Text]) -> int:
    """Columns of the terminal that a table of one row takes when nothing in it is folded."""
    return sum(max(len(printable(name)), cell.cell_len) + 3 for name, cell in zip(columns, cells, strict=True)) + 1


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return value.isoformat() if isinstance(value, datetime) else str(value)
