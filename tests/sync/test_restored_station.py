"""A station that was restored from a backup replicates on: both of its histories stay at central."""

from pathlib import Path

import pytest

from events import Catalogue
from store import Log, back_up, restore, verify
from sync import HeadsDisagree
from tests.conftest import MakeLog
from tests.sync.conftest import MakeDaemon, append_points, heads, stored, stream_of


@pytest.fixture
def restored(make_log: MakeLog) -> Log:
    """A log of its own, to restore into."""
    log = make_log()
    log.close()
    return log


def restored_from(folder: Path, target: Log) -> Log:
    restore(target.dsn, folder)
    return Log(target.dsn, Catalogue.shipped())


def test_central_keeps_what_came_after_the_backup_and_takes_the_new_epoch(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, restored: Log, tmp_path: Path
) -> None:
    append_points(station_log, stream_of(), [3])
    back_up(station_log, tmp_path / "backup")
    append_points(station_log, stream_of(), [2])
    make_daemon().catch_up()
    before = stored(central_log)
    with restored_from(tmp_path / "backup", restored) as log:
        append_points(log, stream_of(), [4, 1])
        daemon = make_daemon(log=log)
        daemon.catch_up()
        status = {(each.stream, each.epoch): each for each in daemon.status().streams}
        of_both = [status[stream_of(), epoch] for epoch in (1, 2)]
        assert [(each.error, each.backlog, each.is_apart) for each in of_both] == [(None, 0, False)] * 2
    points = [(head.epoch, head.sequence) for head in central_log.streams() if head.stream == stream_of()]
    assert points == [(1, 5), (2, 5)]
    after = stored(central_log)
    assert all(after[name][: len(segments)] == segments for name, segments in before.items())
    assert verify(central_log).is_sound


def test_what_central_lacked_of_the_old_epoch_is_sent_by_the_restored_station(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, restored: Log, tmp_path: Path
) -> None:
    append_points(station_log, stream_of(), [3])
    make_daemon().catch_up()
    append_points(station_log, stream_of(), [2])
    back_up(station_log, tmp_path / "backup")
    with restored_from(tmp_path / "backup", restored) as log:
        append_points(log, stream_of(), [1])
        make_daemon(log=log).catch_up()
        assert heads(central_log) == heads(log)
        assert stored(central_log) == stored(log)


def test_another_history_in_the_same_epoch_is_still_told(
    station_log: Log, make_daemon: MakeDaemon, restored: Log, tmp_path: Path
) -> None:
    append_points(station_log, stream_of(), [3])
    back_up(station_log, tmp_path / "backup")
    with restored_from(tmp_path / "backup", restored) as log:
        append_points(log, stream_of(), [2, 2])
        make_daemon(log=log).catch_up()
    log.close()
    station_log.close()
    with Log(station_log.dsn, Catalogue.shipped()) as other:
        # A second log that took the same epoch, as two restores of a read-only copy would.
        other.epoch = 2
        append_points(other, stream_of(), [1])
        with pytest.raises(HeadsDisagree):
            make_daemon(log=other).catch_up()
