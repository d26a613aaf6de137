"""What goes on in a log after it was restored: extraction begins anew in the new epoch, and no track's name returns."""

from pathlib import Path

import pytest

from events import ProcessFailed, ProcessFinished, ProcessStarted, TrackPoint, decode
from store import Log, back_up, restore, verify
from tests.conftest import MakeLog
from tests.vian.samples import reopened
from tests.vian.test_extraction import Stopped, job, said, stop_at
from vian.extraction import extract_motion

pytestmark = pytest.mark.usefixtures("decoded_once")


def stop(_done: int, _expected: int | None) -> None:
    raise Stopped


def tracks(log: Log) -> dict[int, set[int]]:
    """Names of the tracks of each epoch."""
    found: dict[int, set[int]] = {}
    for segment in log.read_all(types=[TrackPoint.type_name]):
        names = decode(segment, log.catalogue).data.column("track_id").to_pylist()
        found.setdefault(segment.header.epoch, set()).update(names)
    return found


def frames(log: Log) -> list[tuple[int, int]]:
    """Track and frame of each point, of all epochs."""
    found: list[tuple[int, int]] = []
    for segment in log.read_all(types=[TrackPoint.type_name]):
        batch = decode(segment, log.catalogue).data
        found += zip(batch.column("track_id").to_pylist(), batch.column("frame").to_pylist(), strict=True)
    return found


@pytest.fixture
def restored(make_log: MakeLog) -> Log:
    log = make_log()
    log.close()
    return log


@pytest.mark.parametrize("is_whole", [True, False])
def test_an_extraction_after_a_restore_has_tracks_of_its_own(
    log: Log, restored: Log, clip: Path, tmp_path: Path, is_whole: bool
) -> None:
    extract_motion(job(log, clip))
    back_up(log, tmp_path / "b")
    restore(restored.dsn, tmp_path / "b")
    with reopened(restored) as other:
        again = extract_motion(job(other, clip))
        assert again.was_done, "what the backup holds whole is not said again"
        more = job(other, clip, run=2)
        if not is_whole:
            with pytest.raises(Stopped):
                extract_motion(job(other, clip, run=2, on_progress=stop))
        assert not extract_motion(more).was_done
        names = tracks(other)
        assert sorted(names) == [1, 2]
        assert names[1].isdisjoint(names[2])
        assert names[2]
        assert verify(other).is_sound
        assert extract_motion(job(other, clip)).was_done, "an earlier life said it"
        assert extract_motion(more).was_done


@pytest.mark.parametrize("calls", [1, 4])
def test_an_extraction_that_a_backup_found_at_work_goes_on_behind_what_it_said(
    log: Log, restored: Log, clip: Path, tmp_path: Path, calls: int
) -> None:
    with pytest.raises(Stopped):
        extract_motion(job(log, clip, on_progress=stop_at(calls)))
    back_up(log, tmp_path / "b")
    restore(restored.dsn, tmp_path / "b")
    undisturbed = extract_motion(job(log, clip))
    with reopened(restored) as other:
        with pytest.raises(Stopped):
            extract_motion(job(other, clip, on_progress=stop_at(2)))
        done = extract_motion(job(other, clip))
        assert (done.process, done.events, done.was_done) == (undisturbed.process, undisturbed.events, False)
        assert frames(other) == frames(log)
        assert len(said(other, ProcessStarted)) == len(said(other, ProcessFinished)) == 1
        assert verify(other).is_sound


def test_an_extraction_that_a_backup_found_at_work_is_given_up_when_another_begins(
    log: Log, restored: Log, clip: Path, tmp_path: Path
) -> None:
    with pytest.raises(Stopped):
        extract_motion(job(log, clip, on_progress=stop))
    back_up(log, tmp_path / "b")
    restore(restored.dsn, tmp_path / "b")
    with reopened(restored) as other:
        extract_motion(job(other, clip, run=2))
        (unfinished, _) = said(other, ProcessStarted)
        assert [event.process for event in said(other, ProcessFailed)] == [unfinished.process]
