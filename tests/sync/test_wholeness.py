"""From where on a log holds a stream with all its payloads, in whatever order it came and wherever it lies."""

from pathlib import Path

import pytest

from store import Log
from store.payloads import take_off
from sync.keeping.held import runs_of
from sync.keeping.wholeness import Wholeness
from sync.runs import Point, StreamKey
from tests.store.tiered import seal_all
from tests.sync.conftest import BRNO, append_points, stream_of

KEY = StreamKey(stream_of(), 1)


@pytest.mark.parametrize("is_sealed", [False, True])
def test_what_came_first_and_is_sealed_counts_though_what_lies_below_it_came_later(
    station_log: Log, central_log: Log, tmp_path: Path, is_sealed: bool
) -> None:
    append_points(station_log, KEY.stream, [3, 3, 3])
    with station_log.transaction() as transaction:
        take_off(transaction, [2])
    first, second, third = station_log.read(KEY.stream, with_hollow=True)
    central_log.append([second.draft(), third.draft()], [3, 6], epochs=[1, 1], bases=[first.chain_hash, None])
    if is_sealed:
        seal_all(central_log, tmp_path, file_bytes=1_000_000)
    assert bool(central_log.archive.files()) == is_sealed
    central_log.append([first.draft()], [0], epochs=[1])
    (run,) = runs_of(central_log, [KEY])[KEY]

    wholeness = Wholeness(central_log, BRNO)
    assert wholeness.after(KEY, run, 9) == Point(6, second.chain_hash)
    wholeness.save()
    assert Wholeness(central_log, BRNO).after(KEY, run, 9) == Point(6, second.chain_hash)
    assert Wholeness(central_log, BRNO).after(KEY, run, 3) == Point(0, bytes(32))
