"""Where Flink differs from the standard, which is why such patterns are refused; a newer Flink may differ less."""

import os
from pathlib import Path
from typing import Any

import pytest

from patterns import match
from patterns.binding.binder import bind
from patterns.flink.tables import create_table
from tests.flink.equality import json_rows, run_in_flink
from tests.patterns.samples import SCHEMAS, letter_rule, letters, spans

needs_flink = pytest.mark.skipif("VIAN_FLINK" not in os.environ, reason="Flink runs with `make flink-test`")

DEFINE = "A AS A.letter = 'a', B AS B.letter = 'b' OR B.letter = 'x', C AS C.letter = 'c' OR C.letter = 'x'"
WAITING = "A AS A.letter = 'a' OR A.letter = 'b', C AS C.letter = 'z' OR (C.letter = 'c' AND A.letter = 'b')"
CASES = {
    # name: rows, pattern, conditions, WITHIN; first and last row of the standard's matches, and of Flink's
    "an optional variable is left out": ("axc", "A B? C", DEFINE, "", [(0, 2)], [(0, 1)]),
    "a greedy variable does not go back": ("abx", "A B* C", DEFINE, "", [(0, 2)], []),
    "what waits behind an attempt waits for ever": ("abcbc", "A B*? C", WAITING, "", [(1, 2), (3, 4)], []),
    "or until a WITHIN ends the attempt": (
        "abcbc", "A B*? C", WAITING, "WITHIN INTERVAL '100' DAY(3)", [(1, 2), (3, 4)], [(1, 2), (3, 4)],
    ),
}  # fmt: skip


def _job(name: str, folder: Path) -> dict[str, Any]:
    rows, pattern, define, within, _, _ = CASES[name]
    file = folder / f"{name}.json"
    file.write_text("\n".join(json_rows(letters(rows))), encoding="utf-8")
    columns = {"time": "TIMESTAMP_LTZ(6)", "sequence": "BIGINT", "letter": "STRING", "key": "BIGINT"}
    connector = {"connector": "filesystem", "path": str(file), "format": "json"}
    table = create_table("letters", columns, connector | {"json.timestamp-format.standard": "ISO-8601"}, 0)
    view = (
        "CREATE TEMPORARY VIEW found AS SELECT * FROM letters MATCH_RECOGNIZE (PARTITION BY `key` ORDER BY rowtime "
        "MEASURES FIRST(`sequence`) AS first_sequence, LAST(`sequence`) AS last_sequence "
        f"AFTER MATCH SKIP PAST LAST ROW PATTERN ({pattern}) {within} DEFINE {define})"
    )
    return {"name": name, "statements": [table, view], "result": "found"}


def test_the_standard_s_matches_are_ours() -> None:
    for rows, pattern, define, _, wanted, _ in CASES.values():
        assert spans(match(bind(letter_rule(pattern, define), SCHEMAS), letters(rows))) == wanted


@needs_flink
@pytest.mark.timeout(600)
def test_flink_s_matches_are_others(tmp_path: Path) -> None:
    found = run_in_flink([_job(name, tmp_path) for name in CASES], tmp_path)
    spans_found = {
        name: sorted((int(row["first_sequence"]), int(row["last_sequence"])) for row in rows)
        for name, rows in found.items()
    }
    assert spans_found == {name: case[5] for name, case in CASES.items()}
