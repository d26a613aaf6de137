"""The compiled kernel and the general matcher agree: random rules, random rows, random splits."""

from itertools import accumulate
from typing import Any

import pytest
from hypothesis import assume, given, note
from hypothesis import strategies as st

from patterns import Outcome, PatternError, RuleRun, RuleSetRun
from patterns.binding.bound import BoundRule
from patterns.binding.rows import Units
from patterns.engine.compiling import compile_kernel
from patterns.engine.packed import pack
from patterns.engine.ruleset import merged
from tests.patterns.examples import examples
from tests.patterns.reference import Tree, rendered
from tests.patterns.samples import bound_unless_empty, letter_rows, letter_rule, trees
from tests.patterns.test_online import LATENESS_US, Record, pieces, records

CONDITIONS = [
    "{0}.letter = 'a'", "letter = 'b'", "letter <> PREV(letter)", "{0}.letter IN ('a', 'c')", "{0}.n > PREV({0}.n)",
    "n <= PREV(n, 2)", "source = 'cam-01'", "{0}.source <> PREV({0}.source)", "{0}.n >= {1}.n",
    "{0}.n <= FIRST({1}.n) + 1", "{0}.n * 2 - 3 < {1}.n / 2", "{0}.n >= FIRST({0}.n)", "COUNT({1}.*) <= 1",
    "COUNT({0}.n) <= 2", "COUNT(*) <= 3", "{1}.n IS NULL", "NOT ({0}.n + {1}.n > 3)", "COALESCE({1}.n, 2) = 2",
    "{0}.letter = {1}.letter", "{0}.letter <> FIRST({1}.letter)", "{0}.time - {1}.time < INTERVAL '4' MICROSECOND",
    "{0}.v < {1}.v", "{0}.v * {1}.v > 0.5", "SQRT({0}.v - {1}.v) >= 0", "GREATEST({0}.n, {1}.n) = 2",
    "CASE WHEN {1}.n > 1 THEN {0}.n = 1 WHEN {1}.n = 0 THEN TRUE ELSE {0}.n IS NULL END", "{0}.flag = {1}.flag",
    "({0}.n > 1 OR {1}.n > 1)", "{0}.n % 2 = {1}.n % 2", "ABS({0}.n - {1}.n) <= 1", "-{0}.n < LEAST({1}.n, 1)",
    "({0}.time - {1}.time) * 1.5 < INTERVAL '4' MICROSECOND", "LAST({1}.n) = PREV({0}.n)",

]  # fmt: skip
MEASURES = [
    "FIRST({0}.n) AS m1", "LAST({1}.letter) AS m2", "COUNT(*) AS m3", "{0}.v + {1}.v AS m4", "LAST(flag) AS m5",
    "PREV({0}.letter) AS m6", "{1}.time - FIRST({0}.time) AS m7",
]  # fmt: skip


@st.composite
def rules(draw: st.DrawFn, name: str = "sample") -> BoundRule | None:
    """A random rule over letters, of random shape."""
    tree = draw(trees("ABC"))
    used = sorted(_variables(tree))
    define = []
    for own in used:
        parts = draw(st.lists(st.sampled_from(CONDITIONS), max_size=2))
        other = draw(st.sampled_from(used))
        if parts:
            define.append(f"{own} AS " + " AND ".join(part.format(own, other) for part in parts))
    pair = (draw(st.sampled_from(used)), draw(st.sampled_from(used)))
    chosen = draw(st.lists(st.sampled_from(MEASURES), max_size=3, unique=True))
    skip = draw(
        st.sampled_from(["PAST LAST ROW", "PAST LAST ROW", "TO NEXT ROW", f"TO FIRST {pair[0]}", f"TO LAST {pair[1]}"])
    )
    within = draw(st.sampled_from(["", "", "INTERVAL '3' MICROSECOND", "INTERVAL '7' MICROSECOND"]))
    partition = draw(st.sampled_from(["key", "key", "key, source", "", "letter", "n", "v, flag"]))
    emit = draw(st.sampled_from(["", "", "emit: {cooldown: 3 us}"]))
    rule = letter_rule(
        rendered(tree), ", ".join(define), ", ".join(each.format(*pair) for each in chosen), skip, within, partition,
        more=f"time: {{lateness: {LATENESS_US} us}}\n{emit}",
        source=draw(st.sampled_from(["letter", "letter", "(SELECT * FROM letter WHERE v >= 0 OR flag)"])),
    )  # fmt: skip
    note(rule.match)
    return bound_unless_empty(rule.model_copy(update={"rule": name}))


def _variables(tree: Tree) -> set[str]:
    if tree[0] == "var":
        return {tree[1]}
    return _variables(tree[1]) if tree[0] == "rep" else {name for part in tree[1] for name in _variables(part)}


def _with_more(rows: list[Record], seed: int) -> list[Record]:
    """Rows with values in the other columns, too."""
    values = [None, 0.0, 0.5, 1.5, -1.0]
    return [
        {**row, "v": values[(seed + 3 * at) % 5], "flag": [None, True, False][(seed + at) % 3]}
        for at, row in enumerate(rows)
    ]


def alone(bound: BoundRule, parts: list[list[Record]]) -> Outcome | str:
    """What the general matcher finds, or how it fails."""
    run = RuleRun(bound)
    whole = Outcome()
    try:
        for part in parts:
            whole += run.push(letter_rows(part))
        return whole + run.finish()
    except PatternError as error:
        return str(error)


@pytest.fixture(scope="module", autouse=True)
def kernel() -> None:
    """The kernel, compiled: half a minute, once for each change of it."""
    compile_kernel()


@examples(0.075)
@given(
    data=st.data(), rows=records(), cuts=st.lists(st.integers(0, 100), max_size=4), seed=st.integers(0, 14),
    restarts=st.sets(st.integers(0, 4), max_size=2),
)  # fmt: skip
def test_the_kernel_finds_what_the_general_matcher_finds(
    data: st.DataObject, rows: list[Record], cuts: list[int], seed: int, restarts: set[int]
) -> None:
    bounds = [bound for at in range(3) if (bound := data.draw(rules(f"rule-{at}"))) is not None]
    assume(bounds)
    for bound in bounds:
        pack(bound)
    arriving = _with_more(sorted(rows, key=lambda row: row["us"] + row["delay"]), seed)
    parts = pieces(arriving, cuts)
    group = RuleSetRun(bounds, is_strict=True, uses_kernel=True)
    steps = []
    for index, part in enumerate(parts):
        steps.append(group.push(letter_rows(part)))
        if index in restarts and not group.failures:
            states = {name: group.state(name) for name in group.rules}
            group = RuleSetRun(is_strict=True, uses_kernel=True)
            for bound in bounds:
                group.add(bound, states[bound.rule.rule])
    found = merged([*steps, group.finish()])
    for bound in bounds:
        name = bound.rule.rule
        wanted: Any = alone(bound, parts)
        failure = group.failures.get(name)
        assert (str(failure) if failure else found.get(name, Outcome())) == wanted, name


@examples(0.02)
@given(
    data=st.data(), rows=records(), cuts=st.lists(st.integers(0, 100), min_size=5, max_size=5), seed=st.integers(0, 14),
    places=st.lists(st.integers(0, 7), min_size=6, max_size=6),
)  # fmt: skip
def test_rules_go_on_from_matcher_to_kernel_and_back(
    data: st.DataObject, rows: list[Record], cuts: list[int], seed: int, places: list[int]
) -> None:
    bounds = [bound for at in range(3) if (bound := data.draw(rules(f"rule-{at}"))) is not None]
    assume(bounds)
    arriving = _with_more(sorted(rows, key=lambda row: row["us"] + row["delay"]), seed)
    parts = pieces(arriving, cuts)
    group = RuleSetRun(bounds, uses_kernel=False)
    steps = []
    for place, part in zip(places, parts, strict=True):
        steps.append(group.push(letter_rows(part)))
        states = {name: group.state(name) for name in group.rules}
        group = RuleSetRun()
        for at, bound in enumerate(bounds):
            if bound.rule.rule in states:
                group._uses_kernel = bool(place >> at & 1)
                group.add(bound, states[bound.rule.rule])
                assert group.state(bound.rule.rule).startswith(b"VRS2" if place >> at & 1 else b"VRS1")
    found = merged([*steps, group.finish()])
    for bound in bounds:
        wanted: Any = alone(bound, parts)
        if not isinstance(wanted, str):
            assert found.get(bound.rule.rule, Outcome()) == wanted, bound.rule.rule


@examples(0.075)
@given(
    data=st.data(), rows=records(), cuts=st.lists(st.integers(0, 100), max_size=7), seed=st.integers(0, 14),
    groups=st.lists(st.integers(1, 4), min_size=8, max_size=8), is_late=st.booleans(),
)  # fmt: skip
def test_units_of_arrival_pushed_together_lead_to_what_each_leads_to(
    data: st.DataObject, rows: list[Record], cuts: list[int], seed: int, groups: list[int], is_late: bool
) -> None:
    bounds = [bound for at in range(3) if (bound := data.draw(rules(f"rule-{at}"))) is not None]
    assume(bounds)
    arriving = _with_more(rows if is_late else sorted(rows, key=lambda row: row["us"] + row["delay"]), seed)
    parts = pieces(arriving, cuts)
    each_alone, together = (RuleSetRun(bounds, uses_kernel=True) for _ in range(2))
    wanted = [each_alone.push(letter_rows(part)) for part in parts]
    found: list[Any] = []
    for count in groups:
        few = parts[len(found) : len(found) + count]
        if few:
            ends = list(accumulate(map(len, few), initial=0))
            found += together.push_units([Units(letter_rows([row for part in few for row in part]), ends)])
    assume(not each_alone.failures)
    assert together.failures == {}
    assert found == wanted
    for name in together.rules:
        assert together.status(name).rows_waiting == each_alone.status(name).rows_waiting
        assert together.status(name).counts == each_alone.status(name).counts
    assert together.finish() == each_alone.finish()
