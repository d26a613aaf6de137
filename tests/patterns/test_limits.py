"""What a rule remembers is bounded, and what that costs is said; on the kernel and on the general matcher alike."""

from datetime import timedelta

import pytest

from patterns import BoundRule, LimitError, Outcome, RuleSetRun, bind, match
from patterns.binding.rows import Units
from patterns.engine.compiling import compile_kernel
from patterns.engine.ruleset import merged
from patterns.limits import Limits
from tests.patterns.samples import SCHEMAS, define_letters, letter_rows, letter_rule, letters, spans

MORE = "time: {lateness: 0 s}"


@pytest.fixture(params=[False, True], ids=["general", "kernel"])
def is_on_kernel(request: pytest.FixtureRequest) -> bool:
    """Which road rules run on."""
    if request.param:
        compile_kernel()
    return bool(request.param)


def _bound(pattern: str = "A B", limits: Limits | None = None, name: str = "sample", **more: str) -> BoundRule:
    define = more.pop("define", define_letters("AB"))
    rule = letter_rule(pattern, define, more=MORE, **more)
    return bind(rule.model_copy(update={"rule": name}), SCHEMAS, limits=limits)


def _pushed(run: RuleSetRun, keys: range, second: float, letter: str = "a") -> Outcome:
    """One row a key at this second, and what it leads to."""
    rows = [{"us": round(second * 1e6) + at, "key": key, "letter": letter, "n": 0} for at, key in enumerate(keys)]
    return run.push(letter_rows(rows)).get("sample", Outcome())


def test_more_partitions_than_the_limit_are_given_up_from_the_longest_silent_on(is_on_kernel: bool) -> None:
    run = RuleSetRun([_bound(limits=Limits(partitions=10))], uses_kernel=is_on_kernel)
    assert _pushed(run, range(10), 0).given_up == ()
    assert _pushed(run, range(3), 1, "a").given_up == (), "rows of partitions that are known are no more partitions"
    outcome = _pushed(run, range(100, 103), 2)
    outcome += _pushed(run, range(103, 104), 3)
    (lost,) = outcome.given_up
    # Of 12 or 13, 5 stay: the newest, which are 0 to 2 and those from 100 on.
    assert lost.why.endswith("partitions are remembered; the limit `partitions` is 10")
    assert lost.partition == {"key": 3}, "the longest silent is named"
    assert lost.partitions == int(lost.why.split()[0]) - 5
    assert lost.since == letters("aaa").column("time")[0].as_py() + timedelta(microseconds=3)
    found = _pushed(run, range(200), 4, "b") + run.finish().get("sample", Outcome())
    kept = {match.partition["key"] for match in found.matches}
    assert {100, 101, 102} <= kept
    assert kept.isdisjoint(range(3, 10))
    assert not run.failures


def test_a_partition_without_a_row_for_the_expiry_is_given_up_and_said(is_on_kernel: bool) -> None:
    limits = Limits(expiry=timedelta(seconds=16))
    run = RuleSetRun([_bound(limits=limits)], uses_kernel=is_on_kernel)
    _pushed(run, range(5), 0)
    lost: tuple[object, ...] = ()
    for second in range(1, 16):
        lost += _pushed(run, range(4, 6), second).given_up
    assert lost == ()
    outcome = _pushed(run, range(5, 6), 16.5) + _pushed(run, range(5, 6), 18)
    (cost,) = outcome.given_up
    assert (cost.partition, cost.partitions, cost.partial_matches) == ({"key": 0}, 4, 0 if is_on_kernel else 4)
    assert cost.why == "a partition had no row for 0:00:16, which is the limit `expiry`"
    found = _pushed(run, range(6), 19, "b") + run.finish()["sample"]
    assert {match.partition["key"] for match in found.matches} == {4, 5}


def test_without_an_expiry_nothing_is_too_old(is_on_kernel: bool) -> None:
    run = RuleSetRun([_bound()], uses_kernel=is_on_kernel)
    _pushed(run, range(3), 0)
    assert _pushed(run, range(9, 10), 1e9).given_up == ()
    found = _pushed(run, range(3), 1e9 + 1, "b") + run.finish()["sample"]
    assert len(found.matches) == 3


def test_an_expiry_that_a_save_lies_before_comes_at_the_same_event(is_on_kernel: bool) -> None:
    bound = _bound("A X* B", Limits(expiry=timedelta(seconds=16)), define="A AS letter = 'a', B AS letter = 'b'")
    whole, saved = (RuleSetRun([bound], uses_kernel=is_on_kernel) for _ in range(2))
    outcomes = [Outcome(), Outcome()]
    for second in range(0, 60, 3):
        restored = RuleSetRun(uses_kernel=is_on_kernel)
        restored.add(bound, saved.state("sample"))
        saved = restored
        for at, run in enumerate((whole, saved)):
            outcomes[at] += _pushed(run, range(second, second + 2), second)
    assert outcomes[0] == outcomes[1]
    assert sum(lost.partitions for lost in outcomes[0].given_up) > 20


def test_too_many_partial_matches_of_a_partition_are_given_up_and_the_rule_goes_on(is_on_kernel: bool) -> None:
    bound = _bound("A X* B", Limits(threads=50), define="X AS n >= A.n, B AS letter = 'b'", within="INTERVAL '1' HOUR")
    run = RuleSetRun([bound], uses_kernel=is_on_kernel)
    outcome = run.push(letters("a" * 60))["sample"] + run.push(letters("c" * 61 + "ab")).get("sample", Outcome())
    outcome += run.finish()["sample"]
    (lost,) = outcome.given_up
    assert lost.partial_matches == 51
    assert lost.why == "a partition has 51 partial matches; the limit `threads` is 50"
    assert spans(list(outcome.matches))[-1] == (51, 62), "what begins behind the row that was too much"
    assert not run.failures


def test_a_timer_rule_gives_up_too_many_partial_matches() -> None:
    bound = _bound(
        "A X* T", Limits(threads=5), define="A AS letter = 'a', T AS TIMER(A.time, INTERVAL '100' SECOND)",
        skip="TO NEXT ROW",
    )  # fmt: skip
    run = RuleSetRun([bound])
    outcome = run.push(letters("aaaaaaaac")).get("sample", Outcome()) + _pushed(run, range(7, 8), 1000)
    (lost,) = outcome.given_up
    assert (lost.partial_matches, lost.partitions) == (6, 1)
    assert len(outcome.matches) == 2


def test_what_is_looked_back_at_is_given_up_too(is_on_kernel: bool) -> None:
    bound = _bound("A", Limits(partitions=10), define="A AS n > PREV(n)")
    run = RuleSetRun([bound], uses_kernel=is_on_kernel)
    outcome = _pushed(run, range(20), 0) + _pushed(run, range(30, 40), 1)
    assert [lost.partial_matches for lost in outcome.given_up][-1] == 0
    assert run.status("sample").partitions_open <= 10


def test_in_batch_a_limit_is_an_error() -> None:
    rows = letter_rows([{"us": key, "key": key, "letter": "a", "n": 0} for key in range(11)])
    with pytest.raises(LimitError, match="11 partitions are remembered; the limit `partitions` is 10"):
        match(_bound(limits=Limits(partitions=10)), rows)
    strict = RuleSetRun([_bound(limits=Limits(partitions=10))], is_strict=True)
    for second, keys in ((0, range(11)), (1, range(12)), (2, range(12))):
        _pushed(strict, keys, second)
    assert isinstance(strict.failures["sample"], LimitError)


def test_what_is_given_up_does_not_depend_on_which_units_come_together(is_on_kernel: bool) -> None:
    limits = Limits(partitions=12, expiry=timedelta(seconds=16))
    bound = _bound("A X* B", limits, define="A AS letter = 'a', B AS letter = 'b'")
    units = [
        letter_rows([
            {"us": second * 1_000_000 + key, "key": key * (1 + second % 3), "letter": "ab"[second % 7 == 0], "n": 0}
            for key in range(3 + second % 5)
        ])
        for second in range(40)
    ]  # fmt: skip
    one_by_one, together = (RuleSetRun([bound], uses_kernel=is_on_kernel) for _ in range(2))
    wanted = merged(one_by_one.push(unit) for unit in units)["sample"]
    found = merged(together.push_units([Units.one(unit) for unit in units]))["sample"]
    assert found == wanted
    assert sum(lost.partitions for lost in wanted.given_up) > 5
