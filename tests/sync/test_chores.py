"""A daemon's further work: what fails is told, and the rest goes on."""

from datetime import datetime

import pytest

from events import CorruptSegment
from store import ChainBroken, LogUnavailable
from sync import FilterFailed
from sync.station.chores import Chores
from tests.sync.conftest import NOON, stream_of


class Work:
    """Says that it has nothing more to do, or fails."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error
        self.steps = 0

    def step(self, now: datetime) -> bool:
        del now
        self.steps += 1
        if self.error is not None:
            raise self.error
        return False


def run(chores: Chores) -> None:
    chores.wake()
    while chores.step(NOON):
        pass


@pytest.mark.parametrize(
    "error", [FilterFailed("it overflows"), CorruptSegment("bad bytes"), ChainBroken(stream_of(), 7, 3, "bad bytes")]
)
def test_one_that_fails_is_told_and_the_others_go_on(error: Exception) -> None:
    failing, other = Work(error), Work()
    chores = Chores([failing, other])
    run(chores)
    assert (chores.notes, other.steps) == ((str(error),), 1)
    failing.error = None
    run(chores)
    assert (chores.notes, failing.steps, other.steps) == ((), 2, 2)


def test_a_database_that_is_away_is_the_daemon_s_matter() -> None:
    chores = Chores([Work(LogUnavailable("away"))])
    with pytest.raises(LogUnavailable):
        chores.step(NOON)
    assert chores.notes == ()
