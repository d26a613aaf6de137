"""SQL's three values, in both evaluators: over columns and over single values."""

import re
from datetime import timedelta
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from patterns import Match, Rule, RuleError, bind, match
from tests.patterns.samples import SCHEMAS, letter_rows, letter_rule

ROW: dict[str, Any] = {
    "us": 0, "letter": "b", "n": 3, "v": 2.5, "flag": True, "gap": timedelta(seconds=10), "key": 0, "sequence": 0,
}  # fmt: skip
NULLS = {"us": 0, "letter": None, "n": None, "v": None, "flag": None, "gap": None, "key": 0, "sequence": 0}

VALUES = [
    ("n + 1", 4), ("n - 5", -2), ("n * 2", 6), ("n / 2", 1), ("-n / 2", -1), ("n % 2", 1), ("-n % 2", -1),
    ("n + 0.5", 3.5), ("v * 2", 5.0), ("v / 2", 1.25), ("n / 2.0", 1.5), ("n / 0", None), ("v / 0", None),
    ("n % 0", None), ("ABS(-n)", 3), ("ABS(-2.5)", 2.5), ("SQRT(n + 1)", 2.0), ("SQRT(-n)", None),
    ("LEAST(n, 1)", 1), ("LEAST(n, v)", 2.5), ("GREATEST(n, 7, 5)", 7), ("GREATEST(n, NULL)", None),
    ("COALESCE(NULL, n)", 3), ("COALESCE(n, 1)", 3), ("n + NULL", None), ("-v", -2.5),
    ("CASE WHEN n > 2 THEN 'big' ELSE 'small' END", "big"), ("CASE WHEN n > 5 THEN 'big' END", None),
    ("CASE n WHEN 1 THEN 'one' WHEN 3 THEN 'three' END", "three"), ("CASE WHEN NULL THEN 1 ELSE 2 END", 2),
    ("CASE WHEN n > 2 THEN n ELSE v END", 3.0), ("LEAST(gap, INTERVAL '1' SECOND)", timedelta(seconds=1)),
    ("gap + INTERVAL '1.5' SECOND", timedelta(seconds=11.5)), ("gap - INTERVAL '1' MINUTE", timedelta(seconds=-50)),
    ("gap * 2", timedelta(seconds=20)), ("3 * gap", timedelta(seconds=30)), ("gap / 4", timedelta(seconds=2.5)),
    ("gap * 0.25", timedelta(seconds=2.5)), ("gap / 0.5", timedelta(seconds=20)), ("gap / 0.0", None),
    ("gap / INTERVAL '4' SECOND", 2.5), ("gap / INTERVAL '0' SECOND", None), ("-gap", timedelta(seconds=-10)),
    ("time - time", timedelta(0)), ("(time + gap) - time", timedelta(seconds=10)), ("gap + gap", timedelta(seconds=20)),
    ("ABS(INTERVAL '1' HOUR - INTERVAL '1' DAY)", timedelta(hours=23)), (":dwell + gap", timedelta(seconds=12)),
    ("letter", "b"), ("flag", True), ("1e3", 1000.0), ("\"n\"", 3), ("N", 3), (":word", "abc"), (":many", 5),
    ("9223372036854775807 + n", -9223372036854775806), ("gap * 1e30", None),
]  # fmt: skip
CONDITIONS = [
    ("n = 3", True), ("n <> 3", False), ("n != 4", True), ("n < 3", False), ("n <= 3", True), ("n > 2.5", True),
    ("n >= 4", False), ("letter < 'c'", True), ("letter = 'B'", False), ("flag", True), ("NOT flag", False),
    ("n BETWEEN 1 AND 3", True), ("n NOT BETWEEN 1 AND 3", False), ("n IN (1, 2, 3)", True), ("n NOT IN (1, 2)", True),
    ("n IN (1, NULL)", None), ("n IN (3, NULL)", True), ("n IS NULL", False), ("n IS NOT NULL", True),
    ("NULL IS NULL", True), ("n = NULL", None), ("NOT (n = NULL)", None), ("FALSE AND n = NULL", False),
    ("TRUE AND n = NULL", None), ("TRUE OR n = NULL", True), ("FALSE OR n = NULL", None), ("NULL", None),
    ("gap > INTERVAL '9' SECOND", True), ("time < time + :dwell", True), ("n > 1 AND v > 2 OR letter = 'x'", True),
    ("flag = TRUE", True), ("TRUE", True), ("1 < 2", True), ("COALESCE(NULL, FALSE)", False), ("n > :many", False),
]  # fmt: skip
MORE = "params: {dwell: 2 s, word: abc, many: 5}"


@pytest.mark.parametrize("sql,wanted", VALUES)
def test_values(sql: str, wanted: object) -> None:
    rule = letter_rule("A", measures=f"{sql} AS over_columns, {_single(sql)} AS over_values", more=MORE)
    (found,) = match(bind(rule, SCHEMAS), letter_rows([ROW]))
    assert found.measures == {"over_columns": wanted, "over_values": wanted}
    assert {type(value) for value in found.measures.values()} == {type(wanted)}


@pytest.mark.parametrize("sql,wanted", [*CONDITIONS, *((f"({sql}) IS NULL", want is None) for sql, want in VALUES)])
def test_conditions_over_columns_and_over_single_values_agree(sql: str, wanted: bool | None) -> None:
    for condition, expected in ((sql, wanted), (f"NOT ({sql})", None if wanted is None else not wanted)):
        over_columns = letter_rule("B A+?", f"A AS {condition}", more=MORE)
        over_values = letter_rule("B A+?", f"A AS {_single(condition)}", more=MORE)
        rows = letter_rows([{**ROW}, {**ROW, "us": 1, "sequence": 1}])
        for rule in (over_columns, over_values):
            assert bool(_found(rule, rows)) == (expected is True), rule.match


def _found(rule: Rule, rows: pa.Table) -> list[Match]:
    """The matches; none of a rule that is refused because it can never match."""
    try:
        bound = bind(rule, SCHEMAS)
    except RuleError as error:
        if "can never match" not in error.message:
            raise
        return []
    return match(bound, rows)


def _single(sql: str) -> str:
    """The same of a match's first A, in a form of which no part can be evaluated over columns."""
    columns = r"(?<![:'\w])(\"n\"|N|n|v|letter|flag|gap|time)(?![\w'(])"
    return re.sub(columns, r"COALESCE(FIRST(A.\1))", sql)


SCALARS = st.sampled_from(["n", "v", "n + 1", "v * 2", "n / v", "n % 2", "ABS(n - 2)", "SQRT(v)", "LEAST(n, v)",
                           "COALESCE(n, 0)", "-n", "n - v", "1", "NULL", "n * n"])  # fmt: skip


@st.composite
def conditions(draw: st.DrawFn, depth: int = 2) -> str:
    if depth == 0 or draw(st.booleans()):
        left, right = draw(SCALARS), draw(SCALARS)
        form = draw(st.sampled_from(["{0} = {1}", "{0} < {1}", "{0} >= {1}", "{0} IS NULL", "{0} IN (1, {1})",
                                     "{0} BETWEEN {1} AND 3"]))  # fmt: skip
        return str(form.format(left, right))
    left, right = draw(conditions(depth - 1)), draw(conditions(depth - 1))
    return draw(st.sampled_from([f"({left}) AND ({right})", f"({left}) OR ({right})", f"NOT ({left})",
                                 f"CASE WHEN {left} THEN {right} ELSE FALSE END"]))  # fmt: skip


@settings(max_examples=150)
@given(
    sql=conditions(),
    cells=st.lists(
        st.tuples(st.one_of(st.none(), st.integers(-3, 3)), st.one_of(st.none(), st.floats(-2, 2))),
        min_size=1, max_size=6,
    ),
)  # fmt: skip
def test_random_conditions_mean_the_same_in_both_evaluators(
    sql: str, cells: list[tuple[int | None, float | None]]
) -> None:
    rows = letter_rows([{"us": at, "n": n, "v": v, "sequence": at} for at, (n, v) in enumerate(cells)])
    over_columns = letter_rule("A", f"A AS {sql}")
    over_values = letter_rule("A", f"A AS {_single(sql)}")
    assert [m.first.sequence for m in _found(over_columns, rows)] == [
        m.first.sequence for m in _found(over_values, rows)
    ]


@pytest.mark.parametrize("sql,wanted", [("n", None), ("letter", None), ("COALESCE(n, 4)", 4), ("COUNT(A.n)", 0)])
def test_nulls_are_remembered_as_nulls(sql: str, wanted: object) -> None:
    (found,) = match(bind(letter_rule("A", measures=f"{sql} AS value"), SCHEMAS), letter_rows([NULLS]))
    assert found.measures == {"value": wanted}


def test_first_of_a_null_is_null_not_the_first_value_there_is() -> None:
    rule = letter_rule("A A B?", measures="FIRST(A.n) AS first, LAST(A.n) AS last, COUNT(A.n) AS many, "
                       "COUNT(A.*) AS rows, COUNT(*) AS all_rows, B.n AS none, COUNT(B.*) AS no_rows")  # fmt: skip
    rows = letter_rows([{**NULLS}, {**ROW, "us": 1, "sequence": 1}])
    (found,) = match(bind(rule, SCHEMAS), rows)
    assert found.measures == {
        "first": None, "last": 3, "many": 1, "rows": 2, "all_rows": 2, "none": None, "no_rows": 0,
    }  # fmt: skip


def test_prev_in_measures_is_physical() -> None:
    rule = letter_rule("B", "B AS letter = 'b'", "PREV(B.n) AS one, PREV(B.n, 2) AS two, PREV(B.n, 0) AS none")
    rows = letter_rows([{"us": at, "letter": letter, "n": at} for at, letter in enumerate("ab")])
    (found,) = match(bind(rule, SCHEMAS), rows)
    assert found.measures == {"one": 0, "two": None, "none": 1}


def test_prev_of_a_reference_goes_back_from_its_row() -> None:
    rule = letter_rule("B+ C", "B AS letter = 'b', C AS PREV(FIRST(B.n)) = 0 AND PREV(B.n + 1) = 2")
    rows = letter_rows([{"us": at, "letter": letter, "n": at} for at, letter in enumerate("abbc")])
    assert [(m.first.sequence, m.last.sequence) for m in match(bind(rule, SCHEMAS), rows)] == [(1, 3)]


def test_names_fold_as_sql_folds_them() -> None:
    rule = letter_rule('start "Start" START', "\"Start\" AS LETTER = 'b'", 'Start.N AS n, "Start".n AS other')
    rows = letter_rows([{"us": at, "letter": letter, "n": at} for at, letter in enumerate("aba")])
    (found,) = match(bind(rule, SCHEMAS), rows)
    assert found.measures == {"n": 2, "other": 1}
    assert list(found.lineage) == ["start", "Start"]
