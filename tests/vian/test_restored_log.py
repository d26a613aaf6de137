"""What goes on in a log after it was restored: extraction begins anew in the new epoch, and no track's name returns."""

from pathlib import Path

import pytest

from events import TrackPoint, decode
from store import Log, back_up, restore, verify
from tests.conftest import MakeLog
from tests.vian.samples import reopened
from tests.vian.test_extraction import job
from vian.extraction import extract_motion

pytestmark = pytest.mark.usefixtures("decoded_once")


class Stopped(Exception):
    """The process was stopped here."""


def stop(_done: int, _expected: int | None) -> None:
    raise Stopped


def tracks(log: Log) -> dict[int, set[int]]:
    """Names of the tracks of each epoch."""
    found: dict[int, set[int]] = {}
    for segment in log.read_all(types=[TrackPoint.type_name]):
        names = decode(segment, log.catalogue).data.column("track_id").to_pylist()
        found.setdefault(segment.header.epoch, set()).update(names)
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
