"""The compiled kernel and the general matcher agree: random rules, random rows, random splits."""

import re
from datetime import timedelta
from itertools import accumulate
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import assume, given, note
from hypothesis import strategies as st

from patterns import Outcome, PatternError, RuleRun, RuleSetRun, bind, parse_rule
from patterns.binding.bound import BoundRule
from patterns.binding.rows import Units
from patterns.engine.compiling import compile_kernel
from patterns.engine.lane_state import decoded, encoded
from patterns.engine.packed import pack
from patterns.engine.ruleset import merged
from tests.patterns.examples import examples
from tests.patterns.reference import Tree, rendered
from tests.patterns.samples import BEGINNING, SCHEMAS, bound_unless_empty, letter_rows, letter_rule, trees
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


def without_rows(failure: Any) -> Any:
    """The failure without the rows that it names: of partitions that fail at one time, either may be told first."""
    return re.sub(r"\S+ \(sequence \d+\)", "a row", failure) if isinstance(failure, str) else failure


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
        if failure:
            assert without_rows(str(failure)) == without_rows(wanted), name
        else:
            assert found.get(name, Outcome()) == wanted, name


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


def _zoned(name: str, x: str, right: float = 9.0) -> BoundRule:
    """A track comes into a yard; whether it does is asked of this column."""
    return bind(parse_rule(f"""
rule: {name}
version: 1
title: sample
severity: info
zones: {{yard: {{source: cam-01, units: pixels, polygon: [[0, 0], [{right}, 0], [{right}, 9], [0, 9]]}}}}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY track_id ORDER BY time, sequence
    PATTERN (o i) DEFINE o AS NOT in_zone(o.{x}, o.y, 'yard'), i AS in_zone(i.{x}, i.y, 'yard'))
"""), SCHEMAS)  # fmt: skip


def _points(second: int, x: float) -> pa.Table:
    """A row of a track."""
    schema = SCHEMAS["track_point"]
    values: dict[str, Any] = {**dict.fromkeys(schema.names, x), "track_id": 1, "frame": 0}
    values["time"] = BEGINNING + timedelta(seconds=second)
    envelope = {"sequence": second, "source": "cam-01", "station": "here", "subject": None, "type": "track_point"}
    rows = {name: pa.array([value], schema.field(name).type) for name, value in values.items()}
    return pa.table(rows | {name: [value] for name, value in envelope.items()})


def _joined(group: RuleSetRun, bound: BoundRule, rows: list[pa.Table]) -> None:
    """The rule joins the lane of the others, which have seen these rows, with what it remembers of them."""
    other = RuleSetRun([bound], uses_kernel=True)
    for each in rows:
        other.push(each)
    group.add(bound, other.state(bound.rule.rule))
    assert len(group._lanes) == 1


@pytest.mark.parametrize("is_joined", [False, True])
def test_a_rule_that_leaves_takes_its_zones_and_columns_along(is_joined: bool) -> None:
    stays, leaves, joins = _zoned("stays", "x"), _zoned("leaves", "x1"), _zoned("joins", "x2", 8)
    group = RuleSetRun([stays, leaves], uses_kernel=True)
    if is_joined:
        group.push(_points(1, 20.0))
    group.status("stays")
    group.remove("leaves")
    if is_joined:
        _joined(group, joins, [_points(1, 20.0)])
    found = merged([group.push(_points(second, x)) for second, x in ((2, 20.0), (3, 5.0))] + [group.finish()])
    assert group.failures == {}
    assert {name: len(outcome.matches) for name, outcome in found.items()} == dict.fromkeys(group.rules, 1)


def test_a_rule_that_leaves_takes_the_columns_along_that_it_looked_back_at() -> None:
    looks_back = _lettered("looks-back", "X AS letter <> PREV(letter)", "X")
    leaves, joins = _lettered("leaves", "X AS n = 1, Y AS n = 2"), _lettered("joins", "X AS n = 1, Y AS n = 3")
    rows = [letter_rows([{"us": n, "n": n, "letter": "q", "sequence": n}]) for n in range(1, 5)]
    group = RuleSetRun([looks_back, leaves], uses_kernel=True)
    group.push(rows[0])
    group.remove("looks-back")
    _joined(group, joins, rows[:1])
    found = merged([*(group.push(each) for each in (rows[2], rows[3])), group.finish()])
    assert group.failures == {}
    assert {name: len(outcome.matches) for name, outcome in found.items()} == {"joins": 1}


def test_what_rules_that_left_asked_is_asked_no_more_and_the_others_go_on_where_they_were() -> None:
    stays, last = _zoned("stays", "x"), _zoned("last", "x", 7)
    group = RuleSetRun([_zoned("first", "x", 6), stays], uses_kernel=True)
    rows = [_points(1, 20.0)]
    group.push(rows[0])
    for at in range(3):
        _joined(group, _zoned("comes-and-goes", "x", 8 + at / 10), rows)
        group.remove("comes-and-goes")
    group.remove("first")
    _joined(group, last, rows)
    (lane,) = group._lanes
    assert [len(picture.zones) for picture in lane.layout.pictures] == [2]
    assert len(lane.zones) == 2
    found = merged([group.push(_points(2, 6.5)), group.finish()])
    assert {name: len(outcome.matches) for name, outcome in found.items()} == {"stays": 1, "last": 1}


def _lettered(name: str, define: str, pattern: str = "X Y") -> BoundRule:
    rule = letter_rule(pattern, define, "X.n AS n")
    return bind(rule.model_copy(update={"rule": name}), SCHEMAS)


def test_a_rule_goes_on_beside_rules_that_have_seen_no_row() -> None:
    group = RuleSetRun([_lettered("sits", "X AS n = 1, Y AS n = 2")], uses_kernel=True)
    _joined(group, _lettered("joins", "X AS n = 1, Y AS n > 1"), [])
    rows = [{"us": n, "n": n, "letter": "pqr"[n], "sequence": n} for n in (1, 2)]
    found = merged([group.push(letter_rows(rows)), group.finish()])
    assert group.failures == {}
    assert {name: len(outcome.matches) for name, outcome in found.items()} == dict.fromkeys(group.rules, 1)


def test_a_state_that_cannot_be_taken_in_leaves_the_lane_as_it_was() -> None:
    sits, joins = _lettered("sits", "X AS n = 1, Y AS n = 2"), _lettered("joins", "X AS n = 1, Y AS n = 3")
    rows = [letter_rows([{"us": n, "n": n, "letter": "q", "sequence": n}]) for n in (1, 2)]
    group, other = (RuleSetRun([each], uses_kernel=True) for each in (sits, joins))
    for each in (group, other):
        each.push(rows[0])
    saved = decoded(other.state("joins"))
    del saved.header["emitter"]
    with pytest.raises(KeyError):
        group.add(joins, encoded(saved, None))
    assert group.rules == ("sits",)
    found = merged([group.push(rows[1]), group.finish()])
    assert group.failures == {}
    assert {name: len(outcome.matches) for name, outcome in found.items()} == {"sits": 1}


def test_texts_that_nothing_remembers_are_forgotten_and_those_remembered_are_not() -> None:
    pairs = bind(
        letter_rule("A B", "A AS n = 1, B AS n = 2", "FIRST(A.letter) AS begins, LAST(B.letter) AS ends"), SCHEMAS
    )
    group, whole = RuleSetRun([pairs], uses_kernel=True), RuleRun(pairs)
    steps, wanted = [], Outcome()
    for part in range(6):
        # The pairs of a key but the last, which begins and ends nothing before the last part: its first text is old.
        numbers = [1 + at % 2 for at in range(1000)]
        keys = [at // 2 % 3 for at in range(1000)]
        if part in (0, 5):
            keys[0], numbers[0] = 7, 1 if part == 0 else 2
        rows = [
            {"us": part * 1000 + at, "sequence": part * 1000 + at, "n": n, "key": key, "letter": f"plate-{part}-{at}"}
            for at, (n, key) in enumerate(zip(numbers, keys, strict=True))
        ]
        steps.append(group.push(letter_rows(rows)))
        wanted += whole.push(letter_rows(rows))
        assert len(group._lanes[0].texts.known) < 4096
    assert merged([*steps, group.finish()])["sample"] == wanted + whole.finish()


@pytest.mark.parametrize("uses_kernel", [False, True])
def test_an_event_that_is_late_for_several_arms_is_late_once(uses_kernel: bool) -> None:
    arms = [f"SELECT n, key FROM letter WHERE n >= {least}" for least in (0, 1)]
    rule = letter_rule("A B", "A AS n = 1, B AS n = 2", source=f"({' UNION ALL BY NAME '.join(arms)})")
    group = RuleSetRun([bind(rule, SCHEMAS)], uses_kernel=uses_kernel)
    group.push(letter_rows([{"us": 10, "n": 1}]))
    outcome = group.push(letter_rows([{"us": 1, "n": 1, "sequence": 7}]))["sample"]
    assert [event.sequence for event in outcome.late] == [7]
    assert group.status("sample").counts.late == 1
