"""Random whole clauses over random rows: the engine's answer is the oracle's, row for row."""

from functools import cache
from itertools import accumulate
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import assume, given, note
from hypothesis import strategies as st

from patterns import SkipError
from patterns.language.parser import parse_clause
from patterns.language.text import Passage
from patterns.querying.recognition import recognise
from tests.patterns import oracle
from tests.patterns.examples import examples
from tests.patterns.oracle import Clause, Expression
from tests.patterns.reference import SkipFails, TooSlow, Tree, children, variables

SKIPS = ["PAST LAST ROW", "PAST LAST ROW", "TO NEXT ROW", "TO NEXT ROW", "TO FIRST", "TO LAST"]
ROWS_PER_MATCH = ["", "ONE ROW PER MATCH", "ALL ROWS PER MATCH", "ALL ROWS PER MATCH SHOW EMPTY MATCHES",
                  "ALL ROWS PER MATCH OMIT EMPTY MATCHES", "ALL ROWS PER MATCH WITH UNMATCHED ROWS"]  # fmt: skip
QUANTIFIERS = [(0, None), (1, None), (0, 1), (2, 2), (1, 2), (2, None), (0, 2), (1, 3)]


@cache
def trees(names: str) -> st.SearchStrategy[Tree]:
    """Patterns with everything that the language has."""
    leaves = st.one_of(
        *[st.sampled_from(names).map(lambda name: ("var", name))] * 6,
        st.sampled_from([("start",), ("end",), ("empty",)]),
    )

    def grown(inner: st.SearchStrategy[Tree]) -> st.SearchStrategy[Tree]:
        several = st.lists(inner, min_size=2, max_size=3).map(tuple)
        repeated = st.tuples(inner, st.sampled_from(QUANTIFIERS), st.booleans())
        return st.one_of(
            several.map(lambda parts: ("cat", parts)),
            several.map(lambda parts: ("alt", parts)),
            repeated.map(lambda each: ("rep", each[0], each[1][0], each[1][1], each[2])),
            several.map(lambda parts: ("perm", parts)),
            inner.map(lambda body: ("excl", body)),
        )

    tree = st.recursive(leaves, grown, max_leaves=5)
    row = st.sampled_from(names).map(lambda name: ("var", name))
    repeated_row = st.tuples(row, st.sampled_from(QUANTIFIERS)).map(lambda each: ("rep", each[0], *each[1], True))
    return st.one_of(
        st.tuples(tree, repeated_row).map(lambda parts: ("cat", parts)),
        st.tuples(repeated_row, tree, row).map(lambda parts: ("cat", parts)),
        tree,
    )


def excludes(tree: Tree) -> bool:
    return tree[0] == "excl" or any(excludes(part) for part in children(tree))


@st.composite
def numbers(draw: st.DrawFn, names: list[str | None], is_measure: bool) -> Expression:
    """An expression whose value is a number."""
    variable, kind = draw(st.sampled_from(names)), draw(st.integers(0, 7))
    view = draw(st.sampled_from([None, False, True])) if is_measure else None
    one, two = draw(st.integers(0, 2)), draw(st.integers(0, 2))
    flag, other = draw(st.booleans()), draw(st.booleans())
    if kind == 0:
        return oracle.column("n", variable)
    if kind == 1:
        return oracle.logical("n", variable, flag, one, view)
    if kind == 2:
        return oracle.physical("n", variable, draw(st.sampled_from([None, 0, 1, 2])), flag)
    if kind == 3:
        return oracle.nested("n", variable, flag, one, two, other)
    if kind == 4:
        return oracle.within_navigation(variable, flag)
    if kind == 5:
        return oracle.match_number()
    return oracle.aggregate(draw(st.sampled_from(["sum", "min", "max", "count", "count_rows"])), variable, view)


@st.composite
def conditions(draw: st.DrawFn, names: list[str | None]) -> Expression:
    """What DEFINE may say."""
    kind = draw(st.integers(0, 5))
    if kind <= 1:
        sign = draw(st.sampled_from(["=", "<>", "<="]))
        return oracle.compared(oracle.column("letter", None), sign, oracle.constant(draw(st.sampled_from("abc"))))
    if kind == 2:
        variable = draw(st.sampled_from(names))
        letter = oracle.constant(draw(st.sampled_from("ABC")))
        return oracle.compared(oracle.classifier(variable), draw(st.sampled_from(["=", "<>"])), letter)
    left = draw(numbers(names, is_measure=False))
    if kind == 3:
        return oracle.is_null(left)
    right = draw(st.one_of(st.integers(0, 3).map(oracle.constant), numbers(names, is_measure=False)))
    return oracle.compared(left, draw(st.sampled_from(["<", "<=", "=", "<>"])), right)


@st.composite
def defines(draw: st.DrawFn, used: list[str], names: list[str | None]) -> dict[str, Expression]:
    found = {}
    for name in used:
        count = draw(st.sampled_from([0, 0, 1, 1, 2]))
        parts = [draw(conditions(names)) for _ in range(count)]
        if draw(st.integers(0, 5)) == 0:
            parts = [oracle.negated(part) for part in parts]
        if parts:
            found[name] = (
                parts[0]
                if count == 1
                else oracle.joined(parts[0], draw(st.sampled_from(["AND", "OR", "OR"])), parts[1])
            )
    return found


@st.composite
def measures(draw: st.DrawFn, names: list[str | None]) -> dict[str, Expression]:
    found = [oracle.match_number(), oracle.classifier(None)]
    for _ in range(draw(st.integers(0, 3))):
        view = draw(st.sampled_from([None, False, True]))
        variable = draw(st.sampled_from(names))
        kind = draw(st.integers(0, 5))
        if kind == 0:
            found.append(oracle.classifier(variable))
        elif kind == 1:
            found.append(oracle.classifiers(variable, view))
        elif kind == 2:
            found.append(oracle.aggregate(draw(st.sampled_from(["avg", "array_agg"])), variable, view))
        elif kind == 3:
            found.append(oracle.logical("letter", variable, draw(st.booleans()), draw(st.integers(0, 2)), view))
        else:
            found.append(draw(numbers(names, is_measure=True)))
    return {f"m{index}": each for index, each in enumerate(found)}


@st.composite
def clauses(draw: st.DrawFn) -> Clause:
    tree = draw(trees("ABC").filter(variables))
    used = sorted(variables(tree))
    subsets = (
        {"U": "".join(draw(st.lists(st.sampled_from(used), min_size=1, unique=True)))} if draw(st.booleans()) else {}
    )
    names: list[str | None] = [None, *used, *subsets]
    mode = draw(st.sampled_from(SKIPS))
    target = draw(st.sampled_from([*used, *subsets])) if mode in ("TO FIRST", "TO LAST") else None
    allowed = ROWS_PER_MATCH[:-1] if excludes(tree) else ROWS_PER_MATCH
    return Clause(
        tree,
        draw(defines(used, names)),
        draw(measures(names)),
        draw(st.sampled_from(allowed)),
        (mode, target),
        draw(st.sampled_from([None, None, None, 1, 3, 6])),
        subsets,
    )


@st.composite
def partitions(draw: st.DrawFn) -> list[list[dict[str, Any]]]:
    """Rows enough to match, of one or two partitions, with times that tie and numbers that are NULL."""
    number = st.one_of(st.none(), st.integers(0, 3), st.integers(0, 3))
    row = st.tuples(st.integers(0, 2), st.sampled_from("aaabbc"), number)
    result = []
    for key in range(draw(st.sampled_from([1, 1, 2]))):
        rows = draw(st.lists(row, min_size=draw(st.sampled_from([5, 3, 0])), max_size=8))
        times = accumulate(step for step, _, _ in rows)
        result.append(
            [{"key": key, "us": us, "letter": letter, "n": n} for us, (_, letter, n) in zip(times, rows, strict=True)]
        )
    return result


def table_of(rows: list[dict[str, Any]]) -> pa.Table:
    """The rows, `us` as times."""
    columns = {
        "key": pa.array([row["key"] for row in rows], pa.int64()),
        "us": pa.array([row["us"] for row in rows], pa.timestamp("us")),
        "n": pa.array([row["n"] for row in rows], pa.int64()),
        "letter": pa.array([row["letter"] for row in rows], pa.string()),
    }
    return pa.table(columns)


@examples(0.2)
@given(clause=clauses(), parts=partitions())
def test_the_answer_is_what_the_definition_says(clause: Clause, parts: list[list[dict[str, Any]]]) -> None:
    note(clause.sql)
    parsed, _ = parse_clause(Passage.alone(clause.sql), 0)
    table = table_of([row for rows in parts for row in rows])
    try:
        wanted = [answer for rows in parts for answer in clause.answer(rows)]
    except TooSlow:
        assume(False)
    except SkipFails:
        with pytest.raises(SkipError):
            recognise(parsed, table)
        return
    answer = recognise(parsed, table)
    assert answer.column_names == clause.columns
    if "us" in clause.columns:
        answer = answer.set_column(1, "us", answer.column("us").cast(pa.int64()))
    found = list(zip(*(column.to_pylist() for column in answer.columns), strict=True))
    assert sorted(found, key=lambda row: row[0]) == wanted
