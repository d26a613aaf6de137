from pathlib import Path

import pytest

from store import Log, LogUnavailable
from tests.vian.samples import GATE, PRODUCER, points
from vian.appending import shared_appender
from vian.settings import load_settings


def test_an_extractor_appends_by_the_settings(log: Log, tmp_path: Path) -> None:
    settings = load_settings(data_dir=tmp_path, append_window_ms=60_000.0, append_events_max=3)
    with shared_appender(log, settings) as appender:
        first = appender.submit(GATE, points(2), PRODUCER)
        assert not first.done(), "the window is long, and there is room for one more"
        appender.of("brno", "gate", PRODUCER).append(points(1, first_frame=2))
        assert first.result(30).is_in_log
    assert log.stream_head(GATE).sequence == 3
    assert (tmp_path / "journal.sqlite").exists()


def test_one_process_uses_a_journal(log: Log, tmp_path: Path) -> None:
    settings = load_settings(journal=tmp_path / "elsewhere.sqlite")
    with (
        shared_appender(log, settings),
        pytest.raises(LogUnavailable, match=r"elsewhere\.sqlite cannot be opened: .*another process uses it"),
        shared_appender(log, settings),
    ):
        pass
