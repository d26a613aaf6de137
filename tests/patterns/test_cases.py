"""Cases as text: SQL and rows in, matches out."""

from pathlib import Path
from typing import Any

import pytest

from patterns import Rule, bind, match
from tests.patterns.samples import SCHEMAS, letter_rows


def _cases() -> dict[str, tuple[str, list[str], list[str]]]:
    text = (Path(__file__).parent / "cases" / "matches.txt").read_text()
    cases = {}
    for part in text.split("\n--- ")[1:]:
        name, _, body = part.partition("\n")
        sql, _, rest = body.partition("\nrows\n")
        rows, _, wanted = rest.partition("wanted\n")
        cases[name] = (sql, rows.splitlines(), wanted.splitlines())
    return cases


def _value(text: str) -> Any:
    if text == "-":
        return None
    return int(text) if text.lstrip("-").isdigit() else text


@pytest.mark.parametrize("name", _cases())
def test_case(name: str) -> None:
    sql, rows, wanted = _cases()[name]
    rule = Rule(rule="case", version=1, title="case", severity="info", match=sql)
    records = []
    for row in rows:
        second, key, letter, n = row.split()
        records.append(
            {"us": round(float(second) * 1e6), "key": _value(key), "letter": _value(letter), "n": _value(n)}
        )  # fmt: skip
    found = [
        " ".join(
            [str(each.first.sequence), str(each.last.sequence)]
            + [f"{name}={'-' if value is None else value}" for name, value in each.measures.items()]
        )
        for each in match(bind(rule, SCHEMAS), letter_rows(records))
    ]
    assert found == wanted
