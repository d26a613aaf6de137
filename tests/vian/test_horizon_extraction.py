"""The horizon from a log: scenes of known horizon as track points, with stops, more points and other sizes."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from events import (
    EventBatch,
    EventType,
    HorizonEstimate,
    HorizonVote,
    ProcessFinished,
    ProcessStarted,
    Producer,
    StreamName,
    TrackPoint,
    VideoAdded,
    batch_of,
    decode,
    encode,
    events_of,
    schema_of,
)
from extractors.horizon import FrameSize, HorizonConfig, Line
from store import Appender, Log
from store.epochs import begin_epoch
from tests.extractors.horizon.larger import error_of
from tests.extractors.horizon.scenes import Camera, Scene, random_walks, scene
from tests.vian.samples import START, heads
from vian.errors import WrongUsage
from vian.extraction import media_clock
from vian.horizon_extraction import HorizonJob, extract_horizon

CAMERA = Camera(np.radians(20), np.radians(3), 700, 5, FrameSize(640, 480))
CONFIG = HorizonConfig(update_s=50)


class Stopped(Exception):
    """The process was stopped here."""


@pytest.fixture(scope="module")
def walked() -> Scene:
    random = np.random.default_rng(1)
    return scene(random_walks(random), CAMERA, random)


def job(log: Log, **changes: Any) -> HorizonJob:
    return replace(HorizonJob(log=log, station="brno", source="gate", config=CONFIG, stamp=media_clock), **changes)


def append(log: Log, batch: EventBatch) -> None:
    stream = StreamName.of("brno", "gate", batch.type.type_name)
    log.append([encode(stream, batch, Producer("tests", "1", bytes(32)))], [log.stream_head(stream).sequence])


def add_video(log: Log, size: FrameSize, name: str = "00") -> None:
    event = VideoAdded(
        time=START, video=name, path="gate.mp4", width=size.width, height=size.height, fps=5.0, frames_expected=None,
        codec="h264", started_at=START,
    )  # fmt: skip
    append(log, batch_of([event]))


def points_of(made: Scene, *, after: timedelta = timedelta(0), segments: int = 5) -> list[EventBatch]:
    points, count = made.points, len(made.points)
    x1, y1, x2, y2 = points.boxes_xyxy.T
    start_us = int((START + after - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(microseconds=1))
    columns = {
        "time": points.time_us + start_us, "track_id": points.track_id, "frame": points.frame,
        "x": (x1 + x2) / 2, "y": y2, "x1": x1, "y1": y1, "x2": x2, "y2": y2,
        "vx": np.zeros(count), "vy": np.zeros(count), "confidence": points.confidence,
    }  # fmt: skip
    schema = schema_of(TrackPoint)
    arrays = [pa.array(columns[field.name]).cast(field.type) for field in schema]
    whole = pa.RecordBatch.from_arrays(arrays, schema=schema)
    cuts = np.linspace(0, count, segments + 1).astype(int)
    return [EventBatch(TrackPoint, whole.slice(a, b - a)) for a, b in pairwise(cuts.tolist())]


def fill(log: Log, made: Scene) -> None:
    add_video(log, made.camera.size)
    for batch in points_of(made):
        append(log, batch)


def said(log: Log, event_type: type[EventType]) -> list[Any]:
    segments = log.read_all(types=[event_type.type_name], sources=["gate"])
    return [event for segment in segments for event in events_of(decode(segment, log.catalogue))]


def test_the_horizon_of_a_log_is_found(log: Log, walked: Scene) -> None:
    fill(log, walked)
    found = extract_horizon(job(log))
    assert found.estimate is not None
    assert error_of(Line(found.estimate.slope, found.estimate.offset_px), CAMERA) < 0.04
    (started,), (finished,) = said(log, ProcessStarted), said(log, ProcessFinished)
    assert (started.process, started.extractor, started.video) == (found.process, "horizon", "00")
    assert (finished.process, finished.frames) == (found.process, len(np.unique(walked.points.frame)))
    assert finished.events == found.events == len(said(log, HorizonVote)) + len(said(log, HorizonEstimate))


def test_the_same_again_does_nothing_and_more_points_do(log: Log, walked: Scene) -> None:
    fill(log, walked)
    first = extract_horizon(job(log))
    before = heads(log)
    again = extract_horizon(job(log))
    assert (again.process, again.was_done, again.estimate) == (first.process, True, first.estimate)
    assert heads(log) == before
    assert extract_horizon(job(log, run=2)).process != first.process
    append(log, points_of(walked, after=timedelta(hours=1))[0])
    assert extract_horizon(job(log)).was_done is False


@pytest.mark.parametrize("call", range(3))
def test_a_stop_anywhere_is_made_good(log: Log, walked: Scene, call: int, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(log, walked)
    stop_at(call, log, monkeypatch)
    append(log, points_of(walked, after=timedelta(hours=1))[0])  # comes too late for this process
    extract_horizon(job(log))
    check_said_once(log)


def test_again_after_a_kill_is_a_process_of_its_own(log: Log, walked: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(log, walked)
    stop_at(1, log, monkeypatch)
    again = extract_horizon(job(log, run=2))
    killed, second = said(log, ProcessStarted)
    (finished,) = said(log, ProcessFinished)
    assert again.process == finished.process == second.process != killed.process


def test_a_process_goes_on_in_a_new_life_of_the_log(log: Log, walked: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(log, walked)
    stop_at(2, log, monkeypatch)
    votes = len(said(log, HorizonVote))
    assert votes > 0
    log.close()
    begin_epoch(log.dsn, 2)
    with Log(log.dsn, log.catalogue) as after:
        extract_horizon(job(after))
        assert len(said(after, HorizonVote)) > votes
        check_said_once(after)
        extract_horizon(job(after))
        check_said_once(after)


def stop_at(call: int, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """Extract, and stop at one of the appends."""
    calls = 0
    append_really = Appender.append

    def append_or_stop(self: Appender, batches: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call + 1:
            raise Stopped
        return append_really(self, batches)

    with monkeypatch.context() as patched:
        patched.setattr(Appender, "append", append_or_stop)
        with pytest.raises(Stopped):
            extract_horizon(job(log))


def check_said_once(log: Log) -> None:
    (finished,) = said(log, ProcessFinished)
    assert finished.events == len(said(log, HorizonVote)) + len(said(log, HorizonEstimate))
    assert len({(vote.track_id, vote.time) for vote in said(log, HorizonVote)}) == len(said(log, HorizonVote))


def test_a_video_of_another_size_begins_anew(log: Log, walked: Scene) -> None:
    fill(log, walked)
    random = np.random.default_rng(2)
    other = scene(random_walks(random), replace(CAMERA, size=FrameSize(1280, 960), focal=1400), random)
    add_video(log, other.camera.size, "01")
    for batch in points_of(other, after=timedelta(hours=1)):
        append(log, batch)
    extract_horizon(job(log))
    widths = [estimate.width for estimate in said(log, HorizonEstimate)]
    assert widths == sorted(widths)
    assert set(widths) == {640, 1280}


def test_a_source_without_points_is_refused(log: Log) -> None:
    with pytest.raises(WrongUsage, match="no track points of source gate"):
        extract_horizon(job(log))
