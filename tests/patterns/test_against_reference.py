from typing import Any

import pytest
from hypothesis import assume, given, note
from hypothesis import strategies as st

from patterns import SkipError, bind, match
from tests.patterns.examples import examples
from tests.patterns.reference import Condition, Reference, SkipFails, TooSlow, Tree, rendered, variables
from tests.patterns.samples import SCHEMAS, bound_unless_empty, classified, letter_rows, letter_rule, partitions, trees

Choice = tuple[str, Condition]


def _and(left: bool | None, right: bool | None) -> bool | None:
    if left is False or right is False:
        return False
    return None if left is None or right is None else True


def _or(left: bool | None, right: bool | None) -> bool | None:
    if left is True or right is True:
        return True
    return None if left is None or right is None else False


def _compare(op: str, left: Any, right: Any) -> bool | None:
    if left is None or right is None:
        return None
    return bool({">": left > right, ">=": left >= right, "<=": left <= right, "=": left == right}[op])


def _plus(left: Any, right: Any) -> Any:
    return None if left is None or right is None else left + right


def _choices(own: str, other: str) -> list[Choice]:
    """Conditions as SQL and as Python; `own` is the variable defined."""
    return [
        (f"{own}.letter = 'a'", lambda s: s.current("letter") == "a"),
        ("letter = 'b'", lambda s: s.current("letter") == "b"),
        (f"{own}.letter IN ('a', 'c')", lambda s: s.current("letter") in ("a", "c")),
        (f"{own}.n > PREV({own}.n)", lambda s: _compare(">", s.current("n"), s.prev("n"))),
        ("n <= PREV(n, 2)", lambda s: _compare("<=", s.current("n"), s.prev("n", 2))),
        (f"{own}.n < NEXT({own}.n)", lambda s: _compare(">", s.value("n", s.at, 1), s.current("n"))),
        ("NEXT(letter, 2) IS NULL", lambda s: s.value("letter", s.at, 2) is None),
        (f"{own}.n <= NEXT({other}.n)", lambda s: _compare("<=", s.current("n"), s.value("n", s.place(other), 1))),
        (f"{own}.n >= {other}.n", lambda s: _compare(">=", s.current("n"), s.last(other, "n"))),
        (f"{own}.n <= FIRST({other}.n) + 1", lambda s: _compare("<=", s.current("n"), _plus(s.first(other, "n"), 1))),
        (f"{own}.n >= FIRST({own}.n)", lambda s: _compare(">=", s.current("n"), s.first(own, "n"))),
        (f"COUNT({other}.*) <= 1", lambda s: s.count(other) <= 1),
        (f"COUNT({own}.*) <= 2", lambda s: s.count(own) <= 2),
        ("COUNT(*) <= 3", lambda s: len(s.mapped) <= 3),
        (f"{other}.n IS NULL", lambda s: s.last(other, "n") is None),
        (f"NOT ({own}.n + {other}.n > 3)", lambda s: _not(_compare(">", _plus(s.current("n"), s.last(other, "n")), 3))),
        (f"COALESCE({other}.n, 2) = 2", lambda s: s.last(other, "n") in (None, 2)),
        (f"LAST({other}.n) = PREV({own}.n)", lambda s: _compare("=", s.last(other, "n"), s.prev("n"))),
    ]


def _not(value: bool | None) -> bool | None:
    return None if value is None else not value


@st.composite
def conditions(draw: st.DrawFn, variables: str) -> dict[str, Choice]:
    chosen: dict[str, Choice] = {}
    for own in variables:
        if draw(st.booleans()):
            choices = _choices(own, draw(st.sampled_from([each for each in variables if each != own])))
            sql, condition = draw(st.sampled_from(choices))
            if draw(st.integers(0, 2)) == 0:
                word, join = draw(st.sampled_from([("AND", _and), ("OR", _or)]))
                second_sql, second = draw(st.sampled_from(choices))
                sql = f"{sql} {word} {second_sql}"
                condition = _joined(join, condition, second)
            chosen[own] = (sql, condition)
    return chosen


def _joined(join: Any, left: Condition, right: Condition) -> Condition:
    return lambda seen: join(left(seen), right(seen))


@examples(0.3)
@given(
    tree=trees("ABC"),
    chosen=conditions("ABC"),
    rows=partitions(),
    skip=st.sampled_from(["PAST LAST ROW", "TO NEXT ROW", "TO FIRST", "TO LAST"]),
    target=st.sampled_from("ABC"),
    within=st.one_of(st.none(), st.integers(1, 6)),
)
def test_the_engine_finds_what_the_definition_says(
    tree: Tree,
    chosen: dict[str, Choice],
    rows: list[list[dict[str, Any]]],
    skip: str,
    target: str,
    within: int | None,
) -> None:
    used = variables(tree)
    # Conditions may name variables that the pattern lacks: those are errors, tried elsewhere.
    chosen = {own: choice for own, choice in chosen.items() if own in used}
    assume(all(f"{other}." not in sql for sql, _ in chosen.values() for other in {"A", "B", "C"} - used))
    variable = target if skip in ("TO FIRST", "TO LAST") else None
    assume(variable is None or variable in used)
    rule = letter_rule(
        rendered(tree),
        ", ".join(f"{own} AS {sql}" for own, (sql, _) in chosen.items()),
        skip=f"{skip} {variable}" if variable else skip,
        within=f"INTERVAL '{within}' MICROSECOND" if within else "",
    )
    note(rule.match)
    reference = Reference(tree, {own: condition for own, (_, condition) in chosen.items()}, (skip, variable), within)
    table = letter_rows([record for partition in rows for record in partition])
    try:
        wanted = [reference.matches(partition) for partition in rows]
    except TooSlow:
        assume(False)
    except SkipFails:
        with pytest.raises(SkipError):
            match(bind(rule, SCHEMAS), table)
        return
    bound = bound_unless_empty(rule)
    found = match(bound, table) if bound else []
    for key, partition in enumerate(wanted):
        expected = [
            {own.variable: [key * 1000 + each.at for each in mapped if each.variable == own.variable] for own in mapped}
            for mapped in partition
        ]
        assert [classified(each) for each in found if each.partition["key"] == key] == expected
