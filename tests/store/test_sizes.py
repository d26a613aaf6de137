"""How much a part of the log is: of what PostgreSQL holds to the event, of sealed files shared out by events."""

from pathlib import Path

import pytest

from events import StreamName
from store import Log
from store.sizes import SEQUENCE_MAX, Part, Size, sizes
from tests.store.samples import append
from tests.store.tiered import seal_all

GATE = StreamName.of("brno", "gate", "track_point")


@pytest.fixture
def filled(log: Log) -> Log:
    append(log, GATE, 10, 10, 10, 10)
    return log


@pytest.mark.parametrize(
    "after, until, without, events",
    [
        (0, SEQUENCE_MAX, (), 40),
        (10, SEQUENCE_MAX, (), 30),
        (0, 20, (), 20),
        (10, 30, (), 20),
        (10, 30, ((10, 20),), 10),
        (40, SEQUENCE_MAX, (), 0),
    ],
)
@pytest.mark.parametrize("is_sealed", [False, True])
def test_a_part_is_a_range_of_a_stream_but_for_what_is_left_out(
    filled: Log, tmp_path: Path, after: int, until: int, without: tuple[tuple[int, int], ...], events: int,
    is_sealed: bool,
) -> None:  # fmt: skip
    if is_sealed:
        seal_all(filled, tmp_path)
    (found,) = sizes(filled, [Part(GATE, 1, without=without, after=after, until=until)])
    assert found.events == events
    assert (found.payload_bytes > 0) == (events > 0)
    assert found.is_exact == (not is_sealed or not events)
    assert (found.recorded_from is not None) == (not is_sealed and events > 0)


def test_the_oldest_of_a_sum_is_the_oldest_of_its_parts(filled: Log) -> None:
    older, newer = sizes(filled, [Part(GATE, 1, until=10), Part(GATE, 1, after=10)])
    assert (newer + older).recorded_from == older.recorded_from
    assert (Size() + newer).recorded_from == newer.recorded_from
