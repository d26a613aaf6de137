"""What can wait waits for what is urgent, within its patience."""

import threading

from store.subscription import Delivery
from vian.precedence import Precedence

FOREVER = 60.0
CAUGHT_UP = Delivery([], 1, is_caught_up=True)
BEHIND = Delivery([], 1, is_caught_up=False)


def test_a_step_runs_at_once_where_nothing_is_urgent() -> None:
    assert Precedence(FOREVER).yielding(lambda: CAUGHT_UP)() is CAUGHT_UP


def test_a_step_waits_until_nothing_urgent_runs_any_more() -> None:
    precedence = Precedence(FOREVER, quiet_s=0.0)
    order: list[str] = []
    begins = threading.Event()

    def step() -> Delivery:
        order.append("step")
        return CAUGHT_UP

    def waits() -> None:
        begins.set()
        precedence.yielding(step)()

    thread = threading.Thread(target=waits)
    with precedence.urgent():
        with precedence.urgent():
            thread.start()
            assert begins.wait(FOREVER)
        order.append("urgent")
    thread.join(FOREVER)
    assert order == ["urgent", "step"]


def test_a_step_whose_patience_is_over_runs_though_something_is_urgent() -> None:
    precedence = Precedence(0.0)
    with precedence.urgent():
        assert precedence.yielding(lambda: CAUGHT_UP)() is CAUGHT_UP


def test_steps_that_were_held_back_too_long_are_not_held_back_until_they_have_caught_up() -> None:
    precedence = Precedence(0.05, quiet_s=FOREVER)
    step = precedence.yielding(lambda: BEHIND)
    with precedence.urgent():
        for _ in range(1000):  # held back once, and not a thousand times
            step()
