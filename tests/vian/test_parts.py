import threading
from types import SimpleNamespace
from typing import Any

import pytest

from store import LogUnavailable
from vian import parts
from vian.parts import Part, Parts, stepping

SECONDS_MAX = 60.0


class FakeLog(SimpleNamespace):
    """A log that comes back at the n-th revival."""

    def revive(self) -> None:
        self.revivals -= 1
        if self.revivals > 0:
            raise LogUnavailable("still away")


def test_parts_run_until_the_block_ends() -> None:
    ended = []

    def run(stop: threading.Event) -> None:
        stop.wait(SECONDS_MAX)
        ended.append("run")

    with Parts([Part("one", run, lambda: ended.append("close"))]) as running:
        assert running.wait(0)
        running.check()
    assert ended == ["run", "close"]


def test_stop_ends_all_parts() -> None:
    with Parts([Part("one", lambda stop: assert_set(stop)), Part("two", lambda stop: assert_set(stop))]) as running:
        running.stop()
        assert not running.wait(SECONDS_MAX)


def assert_set(stop: threading.Event) -> None:
    assert stop.wait(SECONDS_MAX)


def test_a_part_that_fails_stops_the_others_and_is_raised() -> None:
    def fail(_: threading.Event) -> None:
        raise KeyError("what went wrong")

    with pytest.raises(KeyError, match="what went wrong"), Parts([Part("bad", fail), Part("good", assert_set)]) as all_:
        assert not all_.wait(SECONDS_MAX)


def test_check_raises_the_failure_where_the_work_is() -> None:
    def fail(_: threading.Event) -> None:
        raise KeyError("x")

    def work() -> None:
        with Parts([Part("bad", fail)]) as running:
            running.wait(SECONDS_MAX)
            running.check()
            reached.append("the work after the failure")

    reached: list[str] = []
    with pytest.raises(KeyError):
        work()
    assert reached == []


def test_the_error_of_the_block_comes_before_that_of_a_part() -> None:
    def fail(_: threading.Event) -> None:
        raise KeyError("x")

    def work() -> None:
        with Parts([Part("bad", fail)]) as running:
            running.wait(SECONDS_MAX)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()


def test_a_part_steps_until_it_is_stopped_and_then_closes() -> None:
    steps: list[int] = []
    enough = threading.Event()

    def step() -> None:
        steps.append(1)
        if len(steps) == 3:
            enough.set()

    log: Any = FakeLog()
    with Parts([stepping("one", step, log, lambda: steps.append(0))]):
        assert enough.wait(SECONDS_MAX)
    assert steps.count(0) == 1
    assert steps[-1] == 0


def test_a_database_that_is_away_is_waited_for_ever_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(parts, "_BACKOFF_SECONDS_MAX", 1.0)
    log: Any = FakeLog(revivals=3)
    failures = iter(range(6))

    def step() -> None:
        if next(failures, None) is not None:
            raise LogUnavailable("away")
        stop.set()

    class Stop(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            pauses.append(timeout or 0)
            return self.is_set()

    stop = Stop()
    stepping("one", step, log).run(stop)
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]
    assert log.revivals == -3


def test_after_a_step_that_went_well_the_pause_is_short_again() -> None:
    pauses: list[float] = []
    outcomes = iter([False, False, True, False])
    log: Any = FakeLog(revivals=0)

    class Stop(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            pauses.append(timeout or 0)
            return self.is_set()

    stop = Stop()

    def step() -> None:
        outcome = next(outcomes, None)
        if outcome is None:
            stop.set()
        elif not outcome:
            raise LogUnavailable("away")

    stepping("one", step, log).run(stop)
    assert pauses == [0.1, 0.2, 0.1]


def test_any_other_error_of_a_step_is_no_reason_to_wait() -> None:
    def step() -> None:
        raise KeyError("defect")

    log: Any = FakeLog(revivals=0)
    with pytest.raises(KeyError, match="defect"), Parts([stepping("one", step, log)]) as running:
        assert not running.wait(SECONDS_MAX)
