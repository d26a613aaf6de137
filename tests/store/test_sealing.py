"""Sealing: what moves, what stays, and that nothing leaves before its copy was read back."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from events import Segment
from store import Log, verify
from store.sealing import Sealer
from tests.store.samples import GATE, YARD, append, on_both, query

LATER = datetime.now(UTC) + timedelta(days=1)


@pytest.fixture
def filled(log: Log) -> Log:
    for _ in range(6):
        append(log, GATE, 2)
        append(log, YARD, 3, 1)
    return log


@on_both
def test_a_log_reads_the_same_before_and_after(filled: Log, tmp_path: Path) -> None:
    before = list(filled.read_all())
    sealed = list(Sealer(filled, str(tmp_path)).seal(LATER))
    assert [(each.first_position, each.last_position) for each in sealed] == [(1, 18)]
    assert query(filled, "select count(*) from segments") == [(0,)]
    assert list(filled.read_all()) == before
    append(filled, GATE, 1)
    assert verify(filled).is_sound, verify(filled)
    assert len(list(filled.read(GATE))) == 7
