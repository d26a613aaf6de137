"""The language in rules: what registers can hold, in batch and online, with a restart between any two rows."""

import re
from typing import Any

import pytest

from patterns import RuleError, RuleRun, bind, match
from tests.patterns.samples import SCHEMAS, classified, define_letters, letter_rule, letters


def _found(pattern: str, define: str, measures: str, text: str, **more: Any) -> list[dict[str, Any]]:
    """The measures of the matches in batch, which must be those of a run that is saved and restored at every row."""
    bound = bind(letter_rule(pattern, define, measures, **more), SCHEMAS)
    table = letters(text)
    whole = match(bound, table)
    run = RuleRun(bound)
    online = []
    for row in range(table.num_rows):
        online += run.push(table.slice(row, 1)).matches
        state = run.state()
        run = RuleRun(bound)
        run.restore(state)
    online += run.finish().matches
    assert [each.situation_id for each in online] == [each.situation_id for each in whole]
    assert [each.measures for each in online] == [each.measures for each in whole]
    return [each.measures for each in whole]


@pytest.mark.parametrize(
    "measure,wanted",
    [
        ("CLASSIFIER()", "C"),
        ("CLASSIFIER(U)", "B"),
        ("FIRST(CLASSIFIER(U), 1)", "B"),
        ("LAST(U.n, 1)", 1),
        ("FIRST(B.n, 1)", 2),
        ("FIRST(n, 7)", None),
        ("PREV(LAST(B.n), 2)", 0),
        ("PREV(FIRST(C.n), 1)", 2),
        ("FINAL LAST(n) - RUNNING FIRST(n)", 3),
        ("LAST(n * 2 + 1)", 7),
        ("COUNT(U.*)", 3),
        ("COUNT(CLASSIFIER(B))", 2),
        ("SUM(n)", 6),
        ("SUM(U.n + 1)", 6),
        ("MIN(B.n)", 1),
        ("MAX(letter)", "c"),
        ("AVG(U.n)", 1.0),
        ("SUM(D.n)", None),
        ("AVG(D.n)", None),
    ],
)
def test_measures(measure: str, wanted: Any) -> None:
    define = define_letters("ABCD")
    more = {"subset": "U = (A, B)"}
    assert _found("A B+ C D?", define, f"{measure} AS m", "abbc", **more) == [{"m": wanted}]


@pytest.mark.parametrize(
    "define,rows",
    [
        ("B AS SUM(B.n) < 7", [1, 2, 3]),
        ("B AS AVG(n) <= 1.5", [1, 2, 3]),
        ("B AS MIN(U.n) = 0 AND MAX(B.n) < 3", [1, 2]),
        ("B AS COUNT(U.*) < 4", [1, 2]),
        ("B AS LAST(B.n, 1) IS NULL OR LAST(B.n, 1) < 2", [1, 2]),
        ("B AS FIRST(B.n, 1) IS NULL OR n <= FIRST(B.n, 1)", [1, 2]),
        ("B AS CLASSIFIER() = 'B' AND PREV(CLASSIFIER()) = 'A'", [1]),
        ("B AS LAST(CLASSIFIER(), 2) IS NULL OR n < 3", [1, 2]),
        ("B AS PREV(FIRST(U.n)) IS NULL AND PREV(n) < 2", [1, 2]),
    ],
)
def test_conditions(define: str, rows: list[int]) -> None:
    rule = letter_rule("A B+", f"A AS n = 0, {define}", subset="U = (A, B)")
    (found,) = match(bind(rule, SCHEMAS), letters("xxxxx"))
    assert classified(found)["B"] == rows
    _found("A B+", f"A AS n = 0, {define}", "COUNT(*) AS rows", "xxxxx", subset="U = (A, B)")


@pytest.mark.parametrize(
    "pattern,wanted",
    [
        ("^ A", [0]),
        ("A $", [4]),
        ("^ A+ $", [0]),
        ("A B | A", [0, 2, 4]),
        ("A ^ | B", [1, 3]),
        ("PERMUTE(B, A)", [0, 2]),
        ("{- A -} B", [0, 2]),
        ("(A B)+ A $", [0]),
        ("() | A", []),
    ],
)
def test_patterns(pattern: str, wanted: list[int]) -> None:
    text = "aaaaa" if pattern == "^ A+ $" else "ababa"
    if pattern == "() | A":
        with pytest.raises(RuleError, match="it can only match no row at all"):
            bind(letter_rule(pattern, define_letters("A")), SCHEMAS)
        return
    names = "AB" if "B" in pattern else "A"
    assert [each["n"] for each in _found(pattern, define_letters(names), "FIRST(n) AS n", text)] == wanted


def test_a_skip_can_go_to_a_union_of_variables() -> None:
    found = _found("A B C", define_letters("ABC").replace("A AS letter = 'a'", "A AS n >= 0"), "FIRST(n) AS n", "abcbc",
                   skip="TO LAST U", subset="U = (B, C)")  # fmt: skip
    assert found == [{"n": 0}, {"n": 2}]


def test_an_anchor_knows_the_first_row_however_long_ago_it_was() -> None:
    rule = letter_rule("^ A", define_letters("A"))
    bound = bind(rule, SCHEMAS)
    run = RuleRun(bound)
    found = []
    for part in (letters("ba").slice(0, 1), letters("ba").slice(1, 1)):
        found += run.push(part).matches
    assert [*found, *run.finish().matches] == []


@pytest.mark.parametrize(
    ("define", "far", "said"),
    [
        (
            "A AS n < :far",
            10**20,
            "DEFINE: :far: an integer is at least -2^63 and below 2^63, got 100000000000000000000",
        ),
        ("A AS n IN :far", [1, -(10**20)], "DEFINE: :far: an integer is at least -2^63"),
        ("A AS n = 1, B AS B.n < A.n + :far", 2**63, "DEFINE: :far: an integer is at least -2^63"),
        ("A AS gap < :far", "200000000 d", "DEFINE: :far: a duration is below 2^63 microseconds (106751991 d), got 2"),
    ],
)
def test_a_parameter_has_64_bits(define: str, far: Any, said: str) -> None:
    rule = letter_rule("A B", define, more=f"params: {{far: {far}}}")
    with pytest.raises(RuleError, match=re.escape(said)) as raised:
        bind(rule, SCHEMAS)
    assert raised.value.excerpt.endswith("^")


def test_the_least_and_the_greatest_of_64_bits_are_parameters() -> None:
    rule = letter_rule(
        "A B", "A AS n IN :ends, B AS n < :most", more=f"params: {{ends: [{-(2**63)}, 1], most: {2**63 - 1}}}"
    )
    assert bind(rule, SCHEMAS).variables == ("A", "B")


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"within": ":far", "more": "params: {far: 100000000 d}"}, "WITHIN: wanted at most 2^62 microseconds"),
        (
            {"more": "time: {lateness: 200000000 d}"},
            "lateness: wanted at most 2^62 microseconds (53375995 d), got 200000000 d",
        ),
        ({"more": "time: {idle: 200000000 d}"}, "idle: wanted at most 2^62 microseconds"),
        ({"more": "emit: {cooldown: 200000000 d}"}, "cooldown: wanted at most 2^62 microseconds"),
    ],
)
def test_what_is_added_to_a_time_leaves_it_64_bits(written: Any, said: str) -> None:
    with pytest.raises(RuleError, match=re.escape(said)):
        bind(letter_rule("A B", **written), SCHEMAS)
