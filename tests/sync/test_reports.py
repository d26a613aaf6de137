import pytest

from store import Log
from sync import Status, StreamStatus, WireError
from sync.protocol.reports import CHECKPOINT, saved_status
from tests.sync.conftest import BRNO, NOON, Faults, MakeDaemon, append_points, stream_of

STREAMS = (
    StreamStatus(stream_of(), 1, 30, 9, 4, 5, None, NOON, 31.5),
    StreamStatus(stream_of("yard"), 2, 0, 9, None, None, "stopped: why"),
)
STATUS = Status(BRNO, "https://central", STREAMS, NOON, -3.5, 2, "no answer", "waiting", saved_at=NOON, daemon="a1")


def test_a_status_is_kept_and_read_again(station_log: Log) -> None:
    assert saved_status(station_log) is None
    with station_log.transaction() as transaction:
        transaction.save_checkpoint(CHECKPOINT, 0, STATUS.to_json())

    assert saved_status(station_log) == STATUS


def test_what_a_newer_release_adds_is_passed_over() -> None:
    newer = STATUS.to_json().replace(b'{"station"', b'{"more": [1], "station"', 1)

    assert Status.from_json(newer) == STATUS


def test_garbage_is_no_status(station_log: Log) -> None:
    with pytest.raises(WireError, match="cannot be read"):
        Status.from_json(b"{}")
    with station_log.transaction() as transaction:
        transaction.save_checkpoint(CHECKPOINT, 0, b"of a newer ViAn")
    assert saved_status(station_log) is None


def test_a_daemon_begins_with_what_the_one_before_it_said(
    station_log: Log, faults: Faults, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [5])
    first = make_daemon()
    first.catch_up()
    said = first.status()
    append_points(station_log, stream_of(), [2])
    again = make_daemon()
    faults.next = "cut before sending"
    while again.step().did != "failed":
        pass
    kept = again.status()
    assert (kept.last_contact, kept.rate_bps) == (said.last_contact, said.rate_bps)
    assert kept.clock_offset_s == said.clock_offset_s
    points = next(each for each in kept.streams if each.stream == stream_of())
    assert (points.sequence, points.cursor, points.backlog) == (7, 5, 2)
