"""Extraction into a real log: on short clips of known content, on bad files, and with stops anywhere."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import psycopg
import pytest

from events import (
    CameraCalibrated,
    EventType,
    InvalidName,
    ProcessFailed,
    ProcessFinished,
    ProcessProgressed,
    ProcessStarted,
    Producer,
    SceneChanged,
    StreamName,
    TrackPoint,
    VideoAdded,
    batch_of,
    decode,
    encode,
    events_of,
)
from extractors import video
from extractors.calibration import CalibrationConfig, CameraHeight
from extractors.errors import DecoderDied, MaskUnreadable, VideoUnreadable
from extractors.horizon import HorizonConfig
from extractors.media import Frame, Gap, GapReason, Shape
from store import Log, LogUnavailable
from tests.conftest import Server
from tests.events.examples import camera_calibrated
from tests.extractors.films import film_of_two_sizes
from tests.extractors.motion.views import view
from tests.vian.clips import Walk, write_clip
from tests.vian.samples import START, heads, reopened
from vian import extraction
from vian.calibrating import standing_calibration
from vian.camera_folds import CameraConfig
from vian.errors import WorldFailed, WrongUsage
from vian.extraction import Job, extract_motion, media_clock

pytestmark = pytest.mark.usefixtures("decoded_once")


class Stopped(Exception):
    """The process was stopped here."""


def job(log: Log, path: Path, **changes: Any) -> Job:
    return replace(
        Job(log=log, station="brno", source="gate", path=path, started_at=START, stamp=media_clock), **changes
    )


def said(log: Log, event_type: type[EventType], source: str = "gate") -> list[Any]:
    segments = log.read_all(types=[event_type.type_name], sources=[source])
    return [event for segment in segments for event in events_of(decode(segment, log.catalogue))]


def stop_at(call: int) -> Callable[[int, int | None], None]:
    calls = 0

    def on_progress(_done: int, _expected: int | None) -> None:
        nonlocal calls
        calls += 1
        if calls == call:
            raise Stopped

    return on_progress


@pytest.fixture(scope="module")
def undisturbed(clip: Path, servers: Any, decoded_once: None) -> dict[str, tuple[int, str]]:
    """The heads after an extraction of the clip that nothing disturbed."""
    server = servers.get("embedded")
    name = server.create_database()
    with reopened_at(server.dsn(name)) as log:
        extract_motion(job(log, clip))
        found = heads(log)
    server.drop_database(name)
    return found


def reopened_at(dsn: str) -> Log:
    class At:
        def __init__(self) -> None:
            self.dsn = dsn

    return reopened(At())  # type: ignore[arg-type]


def test_a_video_becomes_events_between_start_and_finish(log: Log, clip: Path) -> None:
    told: list[tuple[int, int | None]] = []
    done = extract_motion(job(log, clip, on_progress=lambda *progress: told.append(progress)))
    assert (done.source, done.frames, done.gaps, done.was_done) == ("gate", 60, 0, False)
    (added,) = said(log, VideoAdded)
    assert (added.video, added.width, added.height, added.started_at) == (done.video.video, 320, 240, START)
    (started,) = said(log, ProcessStarted)
    assert (started.process, started.video, started.extractor) == (done.process, added.video, "motion")
    (finished,) = said(log, ProcessFinished)
    assert (finished.frames, finished.events, finished.gaps) == (60, done.events, 0)
    sizes = heads(log)
    kinds = ("track_point", "track_ended", "appearance", "activity_interval", "horizon_vote", "horizon_estimate")
    assert done.events == sum(sizes.get(f"brno/gate/{kind}", (0, ""))[0] for kind in kinds)
    assert sizes["brno/gate/track_point"][0] > 30
    assert told[-1] == (60, 60)
    assert [frames for frames, _ in told] == sorted(frames for frames, _ in told)


def test_two_logs_of_one_clip_are_the_same(
    log: Log, clip: Path, undisturbed: dict[str, tuple[int, str]], tmp_path: Path
) -> None:
    copy = shutil.copy(clip, tmp_path / "elsewhere.mp4")
    extract_motion(job(log, clip))
    assert heads(log) == undisturbed
    assert Path(copy) != clip


@pytest.mark.parametrize("call", range(1, 7))
def test_a_stop_at_any_batch_is_made_good(
    log: Log, clip: Path, undisturbed: dict[str, tuple[int, str]], call: int
) -> None:
    with pytest.raises(Stopped):
        extract_motion(job(log, clip, on_progress=stop_at(call)))
    assert heads(log) != undisturbed
    done = extract_motion(job(log, clip))
    assert not done.was_done
    assert heads(log) == undisturbed


def test_many_stops_are_made_good(log: Log, clip: Path, undisturbed: dict[str, tuple[int, str]]) -> None:
    for call in (1, 1, 3, 2, 5):
        with pytest.raises(Stopped):
            extract_motion(job(log, clip, on_progress=stop_at(call)))
    extract_motion(job(log, clip))
    assert heads(log) == undisturbed


@pytest.mark.parametrize("call", range(1, 8))
def test_a_stop_between_any_two_appends_is_made_good(
    log: Log,
    clip: Path,
    undisturbed: dict[str, tuple[int, str]],
    call: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = 0
    append = Log.append

    def counted(self: Log, *arguments: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise Stopped
        return append(self, *arguments, **named)

    with monkeypatch.context() as patched:
        patched.setattr(Log, "append", counted)
        try:
            extract_motion(job(log, clip))
        except Stopped:
            assert heads(log) != undisturbed
    assert calls >= call, "the clip has so many appends"
    extract_motion(job(log, clip))
    assert heads(log) == undisturbed


GUESSING = CameraConfig(
    horizon=None,
    calibration=CalibrationConfig(
        camera=HorizonConfig(
            update_s=0.5,
            tracks_min=1,
            vote_places_min=3,
            vote_significance=0.01,
            noise_max=100,
            deviation_share_max=1e9,
            roll_spread_deg=60,
            roll_learnt_min=0,
        ),
        aspect_min=0.01,
        aspect_max=100,
        focal_error_max=100,
        height_error_max=100,
    ),
)
"""Says a calibration wherever two have walked, right or wrong: here it is about when it is said, and how often."""


LANES = [(0.5, 110, 28), (1.0, 150, 40), (1.5, 190, 52), (2.0, 230, 64)]
FOUR = [Walk(at, at + 3.5, (20, y), (300, y), (size // 2, size)) for at, y, size in LANES]


@pytest.fixture(scope="module")
def four_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "four.mp4", FOUR)


def test_the_camera_is_calibrated_while_its_tracks_are_made_and_a_stop_is_made_good(log: Log, four_walk: Path) -> None:
    asked = job(log, four_walk, camera=GUESSING)
    stops = 0
    for call in (3, 4, 5, 6):
        try:
            extract_motion(replace(asked, on_progress=stop_at(call)))
        except Stopped:
            stops += 1
    assert stops
    done = extract_motion(asked)
    found = said(log, CameraCalibrated)
    assert found
    assert len({event.model_dump_json() for event in found}) == len(found)
    assert {event.method for event in found} == {"tracks"}
    again = extract_motion(job(log, four_walk, camera=GUESSING, source="yard"))
    assert said(log, CameraCalibrated, "yard") == found
    assert (done.events, done.frames) == (again.events, again.frames)
    extract_motion(job(log, four_walk, camera=replace(GUESSING, calibration=None), source="door"))
    assert not said(log, CameraCalibrated, "door")


def calibrate_by_hand(log: Log) -> CameraCalibrated:
    event = camera_calibrated(time=START)
    stream = StreamName.of("brno", "gate", "camera_calibrated")
    log.append([encode(stream, batch_of([event]), Producer("tests", "1", bytes(32)))], [0])
    return event


def test_what_people_say_of_a_camera_while_it_is_extracted_stands(log: Log, four_walk: Path) -> None:
    by_hand: list[CameraCalibrated] = []

    def calibrate(_done: int, _expected: int | None) -> None:
        if not by_hand:
            by_hand.append(calibrate_by_hand(log))

    done = extract_motion(job(log, four_walk, camera=GUESSING, on_progress=calibrate))
    assert said(log, CameraCalibrated) == by_hand
    kinds = ("track_point", "track_ended", "appearance", "activity_interval")
    assert done.events == sum(heads(log)[f"brno/gate/{kind}"][0] for kind in kinds), "what was not said does not count"
    extract_motion(job(log, four_walk, camera=GUESSING, run=2))
    assert said(log, CameraCalibrated) == by_hand


def test_what_was_withheld_of_a_view_is_not_said_of_the_next_after_a_kill(log: Log, tmp_path: Path) -> None:
    turned = write_clip(tmp_path / "turned.mp4", FOUR, seconds=10, seen=lambda at_s: view(300 if at_s < 6.5 else 340))
    by_hand: list[CameraCalibrated] = []

    def calibrate_and_be_killed(_done: int, _expected: int | None) -> None:
        if not by_hand:
            by_hand.append(calibrate_by_hand(log))
        if said(log, SceneChanged):
            raise Stopped

    with pytest.raises(Stopped):
        extract_motion(job(log, turned, camera=GUESSING, on_progress=calibrate_and_be_killed))
    assert [change.cause for change in said(log, SceneChanged)] == ["moved"]
    done = extract_motion(job(log, turned, camera=GUESSING))
    assert said(log, CameraCalibrated) == by_hand
    extract_motion(job(log, turned, camera=GUESSING, source="yard"))
    assert said(log, CameraCalibrated, "yard"), "there was something to withhold"
    assert done.frames == 100


@pytest.mark.parametrize("what, causes", [("zoomed", ["unknown", "moved"]), ("a lorry before it", ["unknown"])])
def test_metres_end_where_another_view_came_and_not_where_something_was_before_it(
    log: Log, tmp_path: Path, what: str, causes: list[str]
) -> None:
    def looks(at_s: float) -> npt.NDArray[np.uint8]:
        if what == "zoomed" and at_s >= 2:
            return np.asarray(cv2.resize(view(300)[60:180, 80:240], (320, 240)), np.uint8)
        is_hidden = what != "zoomed" and 2 <= at_s < 5
        return view(900 + 80 * at_s) if is_hidden else view(300)

    path = write_clip(tmp_path / "other.mp4", [], seconds=9, seen=looks)
    by_hand = calibrate_by_hand(log)
    extract_motion(job(log, path))
    assert [change.cause for change in said(log, SceneChanged)] == causes
    assert standing_calibration(log, "brno", "gate") == (by_hand if causes == ["unknown"] else None)


def zoomed(at_s: float, since_s: float = 5.0) -> npt.NDArray[np.uint8]:
    image = view(300)
    return image if at_s < since_s else np.asarray(cv2.resize(image[60:180, 80:240], (320, 240)), np.uint8)


def test_a_view_that_is_lost_at_the_end_of_a_file_has_no_metres_in_the_next(log: Log, tmp_path: Path) -> None:
    first = write_clip(tmp_path / "first.mp4", [], seconds=8, seen=zoomed)
    calibrate_by_hand(log)
    extract_motion(job(log, first))
    assert [change.cause for change in said(log, SceneChanged)] == ["unknown", "moved"]
    assert standing_calibration(log, "brno", "gate") is None
    second = write_clip(tmp_path / "second.mp4", [], seconds=5, seen=lambda at_s: zoomed(at_s, 0))
    extract_motion(job(log, second, started_at=START + timedelta(minutes=1)))
    assert len(said(log, SceneChanged)) == 2


def killed_once(what: Callable[[], bool]) -> Callable[[int, int | None], None]:
    """Kills a process when this has come."""
    kills: list[int] = []

    def kill(done: int, _expected: int | None) -> None:
        if what() and not kills:
            kills.append(done)
            raise Stopped

    return kill


@pytest.mark.parametrize("is_back", [False, True])
def test_nor_has_it_after_a_process_that_was_killed_before_the_view_came_back(
    log: Log, tmp_path: Path, is_back: bool
) -> None:
    def looks(at_s: float) -> npt.NDArray[np.uint8]:
        return view(300) if is_back and at_s >= 7 else zoomed(at_s, 3)

    walks = [Walk(12, 15, (20, 100), (300, 100))] if is_back else []
    first = write_clip(tmp_path / "first.mp4", walks, seconds=17 if is_back else 8, seen=looks)
    by_hand = calibrate_by_hand(log)
    kill = killed_once(lambda: bool(said(log, TrackPoint if is_back else SceneChanged)))
    with pytest.raises(Stopped):
        extract_motion(job(log, first, on_progress=kill))
    assert [change.cause for change in said(log, SceneChanged)] == ["unknown"]
    second = write_clip(tmp_path / "second.mp4", [], seconds=5, seen=lambda _: view(300))
    kill = killed_once(lambda: True)
    with pytest.raises(Stopped):
        extract_motion(job(log, second, started_at=START + timedelta(minutes=1), on_progress=kill))
    done = extract_motion(job(log, second, started_at=START + timedelta(minutes=1)))
    assert [change.cause for change in said(log, SceneChanged)] == ["unknown", *([] if is_back else ["moved"])]
    assert standing_calibration(log, "brno", "gate") == (by_hand if is_back else None)
    assert done.frames == 50


def test_a_second_run_does_nothing(log: Log, clip: Path) -> None:
    first = extract_motion(job(log, clip))
    before = heads(log)
    second = extract_motion(job(log, clip))
    assert second.was_done
    assert (second.process, second.frames, second.events) == (first.process, first.frames, first.events)
    assert heads(log) == before


def test_again_is_a_process_of_its_own_with_tracks_of_its_own(log: Log, clip: Path) -> None:
    first = extract_motion(job(log, clip))
    again = extract_motion(job(log, clip, run=2))
    assert again.process != first.process
    assert again.events == first.events
    tracks = [row.track_id for row in said(log, extraction.TrackPoint)]
    assert len(set(tracks[: len(tracks) // 2]) & set(tracks[len(tracks) // 2 :])) == 0
    assert len(said(log, VideoAdded)) == 1


def test_another_way_to_metres_is_a_process_of_its_own(log: Log, clip: Path) -> None:
    first = extract_motion(job(log, clip))
    other = extract_motion(job(log, clip, camera=CameraConfig(scale=CameraHeight(6.5, 0.1))))
    assert (other.process == first.process, other.was_done) == (False, False)


def test_another_video_on_the_same_source_follows(log: Log, clip: Path, tmp_path: Path) -> None:
    extract_motion(job(log, clip))
    other = write_clip(tmp_path / "other.mp4", [Walk(1.5, 4.5, (300, 120), (20, 200))], seconds=5, seed=8)
    done = extract_motion(job(log, other, started_at=START + timedelta(hours=1)))
    assert len(said(log, ProcessFinished)) == 2
    assert done.frames == 50


def test_a_process_left_unfinished_is_given_up_when_another_begins(log: Log, clip: Path, tmp_path: Path) -> None:
    with pytest.raises(Stopped):
        extract_motion(job(log, clip, on_progress=stop_at(3)))
    (unfinished,) = said(log, ProcessStarted)
    notes: list[str] = []
    other = write_clip(tmp_path / "other.mp4", seconds=3, seed=8)
    extract_motion(job(log, other, on_note=notes.append))
    (failed,) = said(log, ProcessFailed)
    assert failed.process == unfinished.process
    assert "given up" in failed.error
    assert any(unfinished.process in note for note in notes)
    before = heads(log)
    with pytest.raises(WorldFailed, match=r"failed before.*given up.*Next: .*--again 2"):
        extract_motion(job(log, clip))
    assert heads(log) == before


def test_two_extractions_on_one_source_at_once_are_one_error(
    log: Log, clip: Path, undisturbed: dict[str, tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extraction, "exclusively", _impatiently(extraction.exclusively))
    refused: list[str] = []

    def second(done: int, _: int | None) -> None:
        if done == 20:
            with reopened(log) as other, pytest.raises(WorldFailed) as caught:
                extract_motion(job(other, clip))
            refused.append(str(caught.value))

    extract_motion(job(log, clip, on_progress=second))
    assert refused == [
        "another command is at work on source gate of station brno. Next: wait until it has ended, then run this again"
    ]
    assert heads(log) == undisturbed


def _impatiently(exclusively: Callable[..., Any]) -> Callable[..., Any]:
    return lambda log, what: exclusively(log, what, patience_s=0.1)


def test_two_sources_at_once_do_not_hinder_each_other(log: Log, clip: Path) -> None:
    def second(done: int, _: int | None) -> None:
        if done == 20:
            extract_motion(job(log, clip, source="yard"))

    extract_motion(job(log, clip, on_progress=second))
    assert [len(said(log, ProcessFinished, source)) for source in ("gate", "yard")] == [1, 1]


def test_who_appends_to_the_source_meanwhile_is_told_of(log: Log, clip: Path) -> None:
    def meddle(done: int, _: int | None) -> None:
        if done == 30:
            stream = job(log, clip).stream(extraction.TrackPoint)
            segment = next(log.read(stream))
            log.append([extraction.encode(stream, decode(segment, log.catalogue), segment.header.producer)])

    with pytest.raises(
        WorldFailed, match=r"somebody else appends to source gate: stream brno/gate/track_point .*Next: "
    ):
        extract_motion(job(log, clip, on_progress=meddle))
    assert said(log, ProcessFailed) == []


def test_the_start_is_the_files_modification_time_if_need_be(log: Log, clip: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(clip, tmp_path / "copy.mp4"))
    os.utime(copy, (0, START.timestamp()))
    notes: list[str] = []
    done = extract_motion(job(log, copy, started_at=None, on_note=notes.append))
    assert done.video.started_at == START
    assert [note for note in notes if "modification time" in note] == notes
    assert len(notes) == 1


@pytest.mark.parametrize("year", [1, 1969, 2200, 9999])
def test_a_start_in_which_no_video_was_recorded_is_refused(log: Log, clip: Path, year: int) -> None:
    with pytest.raises(WrongUsage, match="--start must lie in the years 1970 to 2199, got "):
        extract_motion(job(log, clip, started_at=datetime(year, 12, 31, 23, 59, 59, tzinfo=UTC)))
    assert log.head() == 0


def test_times_are_exact_however_late_the_start(log: Log, clip: Path) -> None:
    start = datetime(2199, 1, 1, microsecond=1, tzinfo=UTC)
    extract_motion(job(log, clip, started_at=start))
    first, (ended, *_) = said(log, extraction.TrackPoint)[0], said(log, extraction.TrackEnded)
    assert first.time == ended.began_at
    assert (first.time - start) % timedelta(milliseconds=1) == timedelta()


def test_a_file_name_that_is_not_utf8_is_kept_as_far_as_it_can_be(log: Log, clip: Path, tmp_path: Path) -> None:
    name = os.fsdecode(os.fsencode(tmp_path) + b"/gate\xff.mp4")
    shutil.copy(clip, name)
    done = extract_motion(job(log, Path(name)))
    assert done.video.path.endswith("gate\N{REPLACEMENT CHARACTER}.mp4")


def test_another_start_for_a_known_video_is_refused(log: Log, clip: Path) -> None:
    extract_motion(job(log, clip))
    with pytest.raises(WrongUsage, match=r"with the start 2026-01-01T10:00:00\+00:00, got 2026-01-01T11:00:00\+00:00"):
        extract_motion(job(log, clip, started_at=START + timedelta(hours=1)))
    assert extract_motion(job(log, clip, started_at=None)).was_done


def test_the_work_bears_the_wall_clocks_time_unless_told_otherwise(log: Log, clip: Path) -> None:
    before = datetime.now(UTC)
    extract_motion(Job(log=log, station="brno", source="gate", path=clip, started_at=START))
    (finished,) = said(log, ProcessFinished)
    assert before <= finished.time <= datetime.now(UTC)
    assert {point.time.year for point in said(log, extraction.TrackPoint)} == {2026}
    assert said(log, extraction.TrackPoint)[0].time < START + timedelta(seconds=6)


def test_progress_is_said_now_and_then(log: Log, tmp_path: Path) -> None:
    long = write_clip(tmp_path / "long.mp4", seconds=21, size=(160, 120))
    extract_motion(job(log, long))
    progress = said(log, ProcessProgressed)
    assert [event.note for event in progress] == [None, None]
    assert [(event.time - START).total_seconds() // 10 for event in progress] == [1, 2]


@pytest.mark.parametrize("name, value", [("source", "a b"), ("source", ""), ("station", "a/b")])
def test_a_name_outside_the_grammar_is_refused(log: Log, clip: Path, name: str, value: str) -> None:
    with pytest.raises(InvalidName):
        extract_motion(job(log, clip, **{name: value}))
    assert log.head() == 0


@pytest.mark.parametrize("bad", ["missing", "directory", "empty", "text", "noise"])
def test_what_is_no_video_leaves_no_trace(log: Log, tmp_path: Path, bad: str) -> None:
    path = tmp_path / bad
    contents = {"empty": b"", "text": b"this is not a video\n" * 50, "noise": bytes(range(256)) * 40}
    if bad == "directory":
        path.mkdir()
    elif bad != "missing":
        path.write_bytes(contents[bad])
    with pytest.raises(VideoUnreadable, match=str(path)):
        extract_motion(job(log, path))
    assert log.head() == 0


def test_a_video_that_breaks_off_gives_what_is_there_and_a_gap(log: Log, tmp_path: Path, clip: Path) -> None:
    whole = write_clip(tmp_path / "whole.avi", seconds=6)
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    done = extract_motion(job(log, cut))
    assert 20 < done.frames < 40
    assert done.gaps >= 1
    notes = [event.note for event in said(log, ProcessProgressed) if event.note]
    assert len(notes) == done.gaps
    assert notes[-1].startswith(f"before frame {done.frames}: ")
    (finished,) = said(log, ProcessFinished)
    assert finished.gaps == done.gaps


def test_gaps_are_recorded_where_they_are(log: Log, clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gap = Gap(25, GapReason.CORRUPT, "3 packets did not decode")
    monkeypatch.setattr(extraction.video, "frames", _changed(video.frames, lambda frame: frame.index == 25, gap))
    done = extract_motion(job(log, clip))
    assert (done.frames, done.gaps) == (60, 1)
    assert [event.note for event in said(log, ProcessProgressed)] == ["before frame 25: 3 packets did not decode"]


def test_gaps_are_told_unless_there_are_very_many(log: Log, clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gap, notes = Gap(25, GapReason.CORRUPT, "3 packets did not decode"), list[str]()
    monkeypatch.setattr(extraction.video, "frames", _changed(video.frames, lambda frame: frame.index >= 25, gap))
    done = extract_motion(job(log, clip, on_note=notes.append))
    assert done.gaps == 35
    assert notes == [str(gap)] * extraction.NOTES_OF_A_KIND_MAX + [notes[-1]]
    assert "corrupt: more of the kind are not told here, but recorded. Next: vian query" in notes[-1]


def test_a_video_that_fails_halfway_keeps_what_was_said(log: Log, clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        died = DecoderDied(f"{clip}: the decoder was ended by signal SIGSEGV after frame 44")
        patched.setattr(extraction.video, "frames", _changed(video.frames, lambda frame: frame.index == 45, died))
        with pytest.raises(DecoderDied):
            extract_motion(job(log, clip))
    (failed,) = said(log, ProcessFailed)
    assert (failed.frames, failed.error) == (45, str(died))
    points = said(log, extraction.TrackPoint)
    assert points
    assert failed.events >= len(points)
    before = heads(log)
    with pytest.raises(WorldFailed, match=r"failed before, after 45 frames: .*SIGSEGV.*--again 2"):
        extract_motion(job(log, clip))
    assert heads(log) == before
    assert extract_motion(job(log, clip, run=2)).frames == 60


def _changed(frames: Callable[..., Iterator[Frame | Gap]], is_there: Callable[[Frame], bool], what: Any) -> Any:
    """The function `frames`, with a gap or an error before a frame."""

    def changed(path: Path, **asked: Any) -> Iterator[Frame | Gap]:
        for item in frames(path, **asked):
            if isinstance(item, Frame) and is_there(item):
                if isinstance(what, Exception):
                    raise what
                yield what
            yield item

    return changed


@pytest.mark.parametrize("frame", [10, 20, 30, 50])
def test_a_database_that_goes_away_and_comes_back_is_waited_for(
    log: Log, clip: Path, undisturbed: dict[str, tuple[int, str]], server: Server, frame: int
) -> None:
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        allow_connections(log, server)

    extract_motion(job(log, clip, on_progress=cut_off(log, server, frame), on_note=note))
    assert heads(log) == undisturbed
    assert len(notes) == 1
    assert notes[0].startswith("waiting: ")


def test_a_database_that_stays_away_is_told_with_the_next_step(
    log: Log, clip: Path, undisturbed: dict[str, tuple[int, str]], server: Server
) -> None:
    with pytest.raises(LogUnavailable, match=r"waited 0\.1 s for it.*run the same command again"):
        extract_motion(job(log, clip, on_progress=cut_off(log, server), database_wait_s=0.1))
    allow_connections(log, server)
    extract_motion(job(log, clip))
    assert heads(log) == undisturbed


def cut_off(log: Log, server: Server, frame: int = 30) -> Callable[[int, int | None], None]:
    """Takes the database away after so many frames."""
    name = psycopg.conninfo.conninfo_to_dict(log.dsn)["dbname"]

    def on_progress(done: int, _: int | None) -> None:
        if done == frame:
            server.execute(f"alter database {name} allow_connections false")
            server.execute(f"select pg_terminate_backend(pid, 10000) from pg_stat_activity where datname = '{name}'")

    return on_progress


def allow_connections(log: Log, server: Server) -> None:
    name = psycopg.conninfo.conninfo_to_dict(log.dsn)["dbname"]
    server.execute(f"alter database {name} allow_connections true")


def test_a_folder_of_pictures_is_extracted(log: Log, clip: Path, tmp_path: Path) -> None:
    for item in video.frames(clip):
        if isinstance(item, Frame):
            time = START + timedelta(microseconds=item.time_us)
            cv2.imwrite(str(tmp_path / time.strftime("gate_%Y%m%d_%H%M%S_%f.png")), item.image)
    done = extract_motion(job(log, tmp_path, started_at=None))
    assert (done.frames, done.video.started_at, done.video.codec) == (60, START, "pictures")
    assert len({point.track_id for point in said(log, extraction.TrackPoint)}) == 1


def test_what_is_asked_of_the_pictures_names_another_process(log: Log, clip: Path) -> None:
    whole = extract_motion(job(log, clip))
    half = extract_motion(job(log, clip, shape=Shape(fps=5, width_max=160)))
    assert half.process != whole.process
    assert (whole.frames, half.frames) == (60, 30)
    assert extract_motion(job(log, clip, shape=Shape(fps=5, width_max=160))).was_done
    points = said(log, extraction.TrackPoint)
    all_x, half_x = (
        [p.x for p in points if (p.track_id == points[0].track_id) == is_first] for is_first in (True, False)
    )
    assert max(half_x) == pytest.approx(max(all_x), abs=20), "px of the video, not of the smaller picture"
    hashes = {segment.header.producer.configuration_hash for segment in log.read_all(types=["track_point"])}
    assert len(hashes) == 2


def test_another_size_within_a_video_is_said_in_the_videos_own_pixels(log: Log, tmp_path: Path) -> None:
    """Reckoned back from the smaller picture it would be 250x141."""
    both = film_of_two_sizes(tmp_path, second=(250, 142))
    extract_motion(job(log, both, shape=Shape(width_max=64)))
    assert [(added.width, added.height) for added in said(log, VideoAdded)] == [(160, 120), (250, 142)]


def test_an_area_that_does_not_fit_leaves_no_trace(log: Log, clip: Path) -> None:
    area = extraction.motion.IgnoredArea("area.png", np.zeros((90, 160), np.uint8))
    with pytest.raises(MaskUnreadable, match=r"area\.png: is 160x90 px, and the video's pictures are 320x240"):
        extract_motion(job(log, clip, ignored=area))
    assert log.head() == 0


def test_the_hostile_video_is_survived(log: Log, vian_data: Path) -> None:
    done = extract_motion(job(log, vian_data / "video/hostile/bgs_demo.avi"))
    assert (done.frames, done.video.width, done.video.height) == (51, 48, 48)
    assert len(said(log, ProcessFinished)) == 1


def test_a_real_video_has_tracks_of_plausible_size(log: Log, vian_data: Path) -> None:
    done = extract_motion(job(log, vian_data / "video/intel_previews_gif/person-bicycle-car-detection.gif"))
    assert (done.video.width, done.video.height) == (480, 270)
    assert done.frames == 41
    assert said(log, ProcessFinished)[0].events == done.events
