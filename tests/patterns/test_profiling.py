"""What a rule costs and remembers: whose the time is, and the most that was remembered."""

from pathlib import Path

import pytest

import patterns
from patterns.binding.binder import bind
from patterns.processor import schemas
from patterns.tools.profiling import PARTS, Function, measured, profiled, shares_of, steps_of
from store import Log
from tests.patterns.walkers import rule, walkers

HOME = Path(patterns.__file__).parent


def at(module: str, name: str) -> Function:
    return (str(HOME / f"{module}.py"), 1, name)


def test_time_outside_the_package_belongs_to_those_that_called_it() -> None:
    take, truth, numpy, arrow = (
        at("running", "take"),
        at("columns", "truth"),
        ("numpy.py", 1, "sort"),
        ("~", 0, "kernel"),
    )
    stats = {
        take: (1, 1, 1.0, 9.0, {}),
        truth: (1, 1, 2.0, 6.0, {take: (1, 1, 2.0, 6.0)}),
        numpy: (2, 2, 1.0, 5.0, {take: (1, 1, 0.5, 1.0), truth: (1, 1, 0.5, 4.0)}),
        arrow: (1, 1, 4.0, 4.0, {numpy: (1, 1, 4.0, 4.0)}),
        ("elsewhere.py", 1, "loop"): (1, 1, 7.0, 7.0, {}),
    }
    shares = shares_of(stats)
    assert shares == pytest.approx({"ordering": 2 / 8, "predicates": 6 / 8, "matcher": 0, "emission": 0})


def test_a_function_that_calls_itself_belongs_to_its_other_callers() -> None:
    run, inner = at("matcher", "run"), ("~", 0, "walk")
    stats = {run: (1, 1, 0.0, 3.0, {}), inner: (9, 1, 3.0, 3.0, {inner: (8, 0, 2.0, 2.0), run: (1, 1, 1.0, 3.0)})}
    assert shares_of(stats)["matcher"] == 1.0
    assert shares_of({}) == dict.fromkeys(PARTS, 0.0)


def test_events_situations_and_the_most_that_was_remembered_are_counted(log: Log) -> None:
    walkers(log)
    bound = bind(rule(pattern="(outside inside inside?)"), schemas(log.catalogue))

    def steps() -> list[object]:
        return list(steps_of(log.read_all(), bound.types, log.catalogue))

    cost = measured(bound, steps(), len(steps()), profiled(bound, steps()))  # type: ignore[arg-type]

    assert (cost.events, cost.matches) == (36, 8)
    assert cost.partitions_most in (2, 3)  # the kernel remembers the last row of a partition, too
    assert cost.rows_waiting_most >= 3
    assert cost.state_bytes_most > 100
    assert sum(cost.shares.values()) == pytest.approx(1.0)
    assert cost.event_us > 0
