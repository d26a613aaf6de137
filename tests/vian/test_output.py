import io
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

import pytest
from rich.console import Console

from vian.output import Output, printable, to_json

HOSTILE = "\x1b[2J[red]\x9b31m[/nothing]"


def output(*, is_json: bool = False, is_terminal: bool = False) -> Output:
    consoles = (Console(file=io.StringIO(), width=200, force_terminal=is_terminal) for _ in range(2))
    return Output(is_json, *consoles)


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize(
    "value, text",
    [
        (datetime(2026, 1, 1, tzinfo=UTC), '"2026-01-01T00:00:00+00:00"'),
        (b"\x01\xff", '"01ff"'),
        (Decimal(12), "12"),
        (Decimal("1.5"), "1.5"),
        ({"a": [float("nan"), 1.5, -float("inf")]}, '{"a": ["nan", 1.5, "-inf"]}'),
        ("žluť", '"žluť"'),
        ("\x9b\x7f", '"\\u009b\\u007f"'),
    ],
)
def test_json_is_json_whatever_the_value(value: Any, text: str) -> None:
    assert to_json(value) == text
    json.loads(to_json(value), parse_constant=pytest.fail)


def test_results_go_to_standard_output_and_notes_to_standard_error() -> None:
    both = output()
    both.note("note")
    both.result({"a": 1, "b": 2}, "said")
    both.result({"a": 1, "b": 2})
    assert printed(both.out) == "said\na: 1  b: 2\n"
    assert printed(both.err) == "note\n"


def test_json_prints_one_object_a_line() -> None:
    lines = output(is_json=True)
    lines.result({"a": 1}, "for people")
    lines.table("title", ("x", "y"), [(1, None), (2, "b")])
    assert [json.loads(line) for line in printed(lines.out).splitlines()] == [
        {"a": 1},
        {"x": 1, "y": None},
        {"x": 2, "y": "b"},
    ]


def test_a_table_shows_values_as_they_are_and_steers_no_terminal() -> None:
    tables = output(is_terminal=True)
    tables.table("", ("name[/x]", HOSTILE), [(HOSTILE, None), (datetime(2026, 1, 1, tzinfo=UTC), 5)])
    text = printed(tables.out)
    assert "[red]" in text
    assert "[/nothing]" in text
    assert "name[/x]" in text
    assert "2026-01-01T00:00:00+00:00" in text
    assert "\x1b[2J" not in text
    assert "\x9b" not in text


@pytest.mark.parametrize("text", ["plain\nlines", "žluť [x]"])
def test_what_is_printable_stays(text: str) -> None:
    assert printable(text) == text


def rows() -> Sequence[Sequence[Any]]:
    return [("a" * 300, 1)]


def test_a_table_into_a_pipe_is_as_wide_as_its_longest_word_needs() -> None:
    tables = output()
    tables.table("", ("x", "y"), rows())
    assert printed(tables.out).count("a") == 300


def test_progress_is_shown_on_a_terminal_only() -> None:
    for is_terminal in (True, False):
        bars = output(is_terminal=is_terminal)
        with bars.progress("frames", None) as bar:
            bar.at(5, 10)
            bar.at(10, 10)
        assert ("10/10" in printed(bars.err)) is is_terminal
        assert printed(bars.out) == ""


WIDE = [f"column_{number}" for number in range(40)]


def test_a_single_row_that_is_too_wide_is_turned_on_its_side() -> None:
    wide = output()
    wide.table("", WIDE, [[*range(39), HOSTILE]])
    lines = printed(wide.out).splitlines()
    assert lines[:2] == ["column_0:  0", "column_1:  1"]
    assert lines[-1] == f"column_39: {printable(HOSTILE)}"


@pytest.mark.parametrize("columns, rows", [(WIDE, [range(40), range(40)]), (["a", "b"], [(1, 2)]), (WIDE, [])])
def test_other_tables_stand_upright(columns: list[str], rows: list[Sequence[Any]]) -> None:
    table = output()
    table.table("", columns, rows)
    assert "┃" in printed(table.out)
