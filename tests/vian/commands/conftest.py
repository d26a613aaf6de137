"""A log for the commands to read."""

import pytest

from store import Log
from tests.vian.samples import YARD, append, points


@pytest.fixture
def filled(log: Log) -> Log:
    """A log of two streams, one of them in two segments."""
    append(log, points(30))
    append(log, points(5), YARD)
    append(log, points(5, first_frame=30))
    return log
