from datetime import timedelta

from store import Log
from tests.store.samples import GATE, YARD, append, on_both, owner


@on_both
def test_a_clock_that_was_set_back_does_not_take_recorded_at_with_it(log: Log) -> None:
    append(log, GATE, 1)
    (first,) = log.read_all()
    with owner(log) as connection:
        # As after a day in which the clock was a day ahead.
        connection.execute("update log_head set recorded_at = recorded_at + interval '1 day'")
    append(log, YARD, 1, 1)
    _, second, third = log.read_all()
    assert second.recorded_at == third.recorded_at == first.recorded_at + timedelta(days=1)
