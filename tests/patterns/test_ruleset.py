"""A set of rules: for each rule what it finds alone, whoever comes, goes or fails."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from patterns import BoundRule, Match, Outcome, PatternError, RuleRun, RuleSetRun, SkipError, bind, match
from patterns.binding.expressions import Const, Expr, walk
from patterns.engine.compiling import compile_kernel
from patterns.engine.packed import Assembly, Packed
from patterns.engine.records import RowEvaluator
from patterns.engine.ruleset import Outcomes, merged
from tests.patterns.examples import examples
from tests.patterns.samples import SCHEMAS, define_letters, letter_rows, letter_rule, letters
from tests.patterns.test_online import RULES, Record, pieces, records


def _named(name: str) -> BoundRule:
    rule = RULES[name]
    return bind(rule.model_copy(update={"rule": name.replace(" ", "-")}), SCHEMAS)


BOUNDS = [_named(name) for name in RULES]
FAILING = bind(letter_rule("A B? C", define_letters("ABC"), skip="TO LAST B", more="time: {lateness: 4 us}"), SCHEMAS)


def _alone(bound: BoundRule, parts: list[list[Record]]) -> Outcome:
    run = RuleRun(bound)
    whole = Outcome()
    for part in parts:
        whole += run.push(letter_rows(part))
    return whole + run.finish()


@examples(0.03)
@given(rows=records(), cuts=st.lists(st.integers(0, 100), max_size=5), restarts=st.sets(st.integers(0, 5)))
def test_a_set_gives_for_each_rule_what_it_gives_alone(rows: list[Record], cuts: list[int], restarts: set[int]) -> None:
    arriving = sorted(rows, key=lambda row: row["us"] + row["delay"])
    parts = pieces(arriving, cuts)
    group = RuleSetRun(BOUNDS)
    steps: list[Outcomes] = []
    for index, part in enumerate(parts):
        steps.append(group.push(letter_rows(part)))
        if index in restarts:
            states = {name: group.state(name) for name in group.rules}
            group = RuleSetRun()
            for bound in BOUNDS:
                group.add(bound, states[bound.rule.rule])
    steps.append(group.finish())
    assert group.failures == {}
    found = merged(steps)
    for bound in BOUNDS:
        assert found.get(bound.rule.rule, Outcome()) == _alone(bound, parts), bound.rule.rule


@examples(0.015)
@given(rows=records(), came=st.integers(0, 3), went=st.integers(0, 3))
def test_rules_that_come_and_go_change_nothing_for_the_others(rows: list[Record], came: int, went: int) -> None:
    parts = pieces(rows, [len(rows) // 4, len(rows) // 2, len(rows) * 3 // 4])
    stays, comes, goes = BOUNDS[0], BOUNDS[1], BOUNDS[2]
    group = RuleSetRun([stays, goes])
    steps = []
    for index, part in enumerate(parts):
        if index == came:
            group.add(comes)
        if index == went:
            group.remove(goes.rule.rule)
        steps.append(group.push(letter_rows(part)))
    found = merged([*steps, group.finish()])
    assert found.get(stays.rule.rule, Outcome()) == _alone(stays, parts)
    assert found.get(comes.rule.rule, Outcome()) == _alone(comes, parts[came:])
    run = RuleRun(goes)
    alone = [match for part in parts[:went] for match in run.push(letter_rows(part)).matches]
    assert list(found.get(goes.rule.rule, Outcome()).matches) == alone


def _matches(outcomes: Outcomes, bound: BoundRule) -> tuple[Match, ...]:
    return outcomes.get(bound.rule.rule, Outcome()).matches


def test_a_rule_that_raises_is_set_aside_and_named_and_the_others_go_on() -> None:
    group = RuleSetRun([FAILING, BOUNDS[0]])
    found = merged([group.push(letters("aabac")), group.push(letters("abac")), group.finish()])
    assert list(group.failures) == ["sample"]
    assert isinstance(group.failures["sample"], SkipError)
    assert group.rules == (BOUNDS[0].rule.rule,)
    assert len(_matches(found, BOUNDS[0])) > 0
    group.add(FAILING)
    assert group.failures == {}, "a rule that comes back is tried anew"


@pytest.mark.parametrize("skip", ["TO LAST B", "TO FIRST A"])
@pytest.mark.parametrize("uses_kernel", [True, False])
def test_a_skip_to_nowhere_names_the_match_on_either_road(skip: str, uses_kernel: bool) -> None:
    failing = bind(letter_rule("A B? C", define_letters("ABC"), skip=skip), SCHEMAS)
    rows = letters("bac" if skip == "TO LAST B" else "babc")
    with pytest.raises(SkipError) as alone:
        match(failing, rows)
    group = RuleSetRun([failing], uses_kernel=uses_kernel)
    group.push(rows)
    group.finish()
    assert str(group.failures["sample"]) == str(alone.value)
    assert "match from 2026-01-01T10:00:01Z (sequence 1) to 2026-01-01T10:00:0" in str(alone.value)


@pytest.mark.parametrize("uses_kernel", [True, False])
def test_rows_whose_key_is_no_number_are_one_partition_whenever_they_come(uses_kernel: bool) -> None:
    rule = letter_rule("A X*? B", "A AS n = 1, X AS n = 7, B AS n = 2", partition="v", more="emit: {cooldown: 1 h}")
    bound = bind(rule, SCHEMAS)
    values = [(1, math.nan), (0, 1.0), (2, math.nan), (0, 2.0), (1, math.nan), (2, math.nan), (0, 3.0)]
    rows = [{"us": at, "n": n, "v": v, "sequence": at} for at, (n, v) in enumerate(values)]
    group = RuleSetRun([bound], uses_kernel=uses_kernel)
    found: list[Match] = []
    for row in rows:
        found += group.push(letter_rows([row])).get("sample", Outcome()).matches
        state = group.state("sample")
        group = RuleSetRun(uses_kernel=uses_kernel)
        group.add(bound, state)
    found += group.finish().get("sample", Outcome()).matches
    assert [each.first.sequence for each in found] == [each.first.sequence for each in match(bound, letter_rows(rows))]
    assert [each.first.sequence for each in found] == [0], "the second is within the cooldown of the first"


@pytest.mark.parametrize("uses_kernel", [True, False])
def test_a_sum_has_64_bits_as_all_integers_have(uses_kernel: bool) -> None:
    bound = bind(letter_rule("A B", "A AS n > 0, B AS SUM(n) < 0"), SCHEMAS)
    group = RuleSetRun([bound], uses_kernel=uses_kernel)
    rows = letter_rows([{"us": 1, "n": 2**62}, {"us": 2, "n": 2**62}])
    found = merged([group.push(rows), group.finish()])
    assert (group.failures, len(found["sample"].matches)) == ({}, 1)


def test_a_rule_that_comes_later_knows_the_frame_sizes() -> None:
    sizes: dict[str, Any] = {}
    for late in (False, True):
        group = RuleSetRun([] if late else BOUNDS[:1])
        group.set_frame_size("cam-01", 640, 480)
        if late:
            group.add(BOUNDS[0])
        sizes[str(late)] = group.state(BOUNDS[0].rule.rule)
    assert sizes["False"] == sizes["True"]


def test_two_rules_of_one_name_need_another_name_for_one() -> None:
    group = RuleSetRun(BOUNDS[:1])
    with pytest.raises(PatternError, match="has a rule greedy already"):
        group.add(BOUNDS[0])
    group.add(BOUNDS[0], name="greedy@2")
    found = merged([group.push(letters("aab")), group.finish()])
    assert found["greedy"] == found["greedy@2"]


def test_a_rule_that_is_not_there_is_named_with_those_that_are() -> None:
    group = RuleSetRun(BOUNDS[:1])
    with pytest.raises(PatternError, match="no rule other; there are: greedy"):
        group.remove("other")
    group.remove("greedy")
    assert group.rules == ()
    assert group.push(letters("aab")) == {}


def test_status_says_how_a_rule_stands() -> None:
    ticks = iter(range(100))
    group = RuleSetRun(BOUNDS[:1], clock=lambda: float(next(ticks)))
    group.push(letters("ab", step_s=0.000001))
    status = group.status("greedy")
    assert (status.counts.rows, status.rows_waiting, status.partitions_open) == (2, 2, 0)
    assert status.watermark is not None
    assert status.spent_s > 0


def test_the_cost_of_rules_that_run_together_is_theirs_who_cause_it() -> None:
    compile_kernel()
    slow = letter_rule(
        "A X* B", "A AS letter = 'a', X AS n >= A.n, B AS letter = 'b'", within="INTERVAL '1' HOUR", skip="TO NEXT ROW"
    )
    cheap = letter_rule("A B", "A AS letter = 'b', B AS letter = 'c'")
    bounds = [bind(cheap.model_copy(update={"rule": f"cheap-{at}"}), SCHEMAS) for at in range(4)]
    group = RuleSetRun([bind(slow, SCHEMAS), *bounds], uses_kernel=True)
    group.push(letters("ccc"))
    before_s = {name: group.status(name).spent_s for name in group.rules}  # to load the kernel is no rule's cost
    group.push(letter_rows([{"us": 3_600_000_000 + at, "letter": "a", "n": 0} for at in range(3000)]))
    group.push(letter_rows([{"us": 7_000_000_000, "letter": "c"}]))
    spent_s = {name: group.status(name).spent_s - before_s[name] for name in group.rules}
    others = [value for name, value in spent_s.items() if name != "sample"]
    # A thousand partial matches a row against none: the slow one is named whatever the machine is doing.
    assert spent_s["sample"] > 10 * max(others) > 0
    assert max(others) < 3 * min(others)


@pytest.mark.parametrize("method", ["truth", "column"])
def test_what_one_rule_asks_of_a_row_fails_that_rule_alone(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    original = getattr(RowEvaluator, method)

    def overflowing(self: RowEvaluator, expr: Expr) -> Any:
        if any(isinstance(part, Const) and part.value == 77 for part in walk(expr)):
            raise OverflowError("too large")
        return original(self, expr)

    monkeypatch.setattr(RowEvaluator, method, overflowing)
    good = letter_rule("A B", "A AS n = 1, B AS n = 2").model_copy(update={"rule": "good"})
    bad = letter_rule("A B", "A AS n = 1, B AS n + 77 > A.n AND n <> 77").model_copy(update={"rule": "bad"})
    group = RuleSetRun([bind(each, SCHEMAS) for each in (good, bad)], uses_kernel=True)
    found = merged([group.push(letter_rows([{"us": 1, "n": 1}, {"us": 2, "n": 2}])), group.finish()])
    assert len(found["good"].matches) == 1
    assert {name: repr(error) for name, error in group.failures.items()} == {"bad": "OverflowError('too large')"}


def test_a_rule_of_which_the_kernel_has_no_tables_runs_without_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    original = Assembly._add

    def overflowing(self: Assembly, number: int, rule: Packed, is_strict: bool) -> None:
        if rule.bound.rule.rule == "wide":
            raise OverflowError("too large")
        original(self, number, rule, is_strict)

    monkeypatch.setattr(Assembly, "_add", overflowing)
    rule = letter_rule("A B", "A AS n = 1, B AS n = 2")
    bounds = [bind(rule.model_copy(update={"rule": name}), SCHEMAS) for name in ("good", "wide")]
    group = RuleSetRun(bounds, uses_kernel=True)
    found = merged([group.push(letter_rows([{"us": 1, "n": 1}, {"us": 2, "n": 2}])), group.finish()])
    assert [len(found[name].matches) for name in ("good", "wide")] == [1, 1]
    assert "rule wide runs without the kernel: too large" in caplog.text
    assert not group.failures
