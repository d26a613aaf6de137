"""The row tables' upkeep inside a server."""

import threading
from collections.abc import Iterator
from datetime import datetime
from typing import Any

import pytest

from store import Log, Projector, RowPolicy, Upkeep, maintain, row_tables
from tests.vian.samples import append, points
from vian.parts import Parts
from vian.rows import row_policy, upkeep_part
from vian.settings import load_settings


def test_the_settings_say_what_upkeep_sees_to(log: Log) -> None:
    assert row_policy(log, load_settings()) == RowPolicy(None, {}, 2, 6.0)
    given = load_settings(
        rows_keep_days=90, rows_keep_days_by_type={"track_point": 7}, rows_ahead_days=0, rows_close_after_h=1.5
    )
    assert row_policy(log, given) == RowPolicy(90, {"track_point": 7}, 0, 1.5)


def test_a_server_sees_to_the_row_tables_again_and_again(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    append(log, points(3))
    Projector(log).catch_up()
    twice = threading.Semaphore(0)

    def watched(log: Log, policy: RowPolicy, now: datetime) -> Iterator[Upkeep]:
        yield from maintain(log, policy, now)
        twice.release()

    monkeypatch.setattr("vian.rows.maintain", watched)
    settings: Any = load_settings(rows_close_after_h=0).model_copy(update={"rows_upkeep_s": 0.01})
    with Parts([upkeep_part(log, settings)]):
        assert twice.acquire(timeout=60)
        assert twice.acquire(timeout=60)
    (table,) = [table for table in row_tables(log) if table.partitions]
    assert (table.type, table.closed) == ("track_point", 1)
