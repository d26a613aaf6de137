"""Live streams into a real log: interruptions, kills, and nothing of a login anywhere."""

import ssl
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from events import (
    EventType,
    ProcessFailed,
    ProcessFinished,
    ProcessProgressed,
    ProcessStarted,
    StreamInterrupted,
    StreamResumed,
    TrackPoint,
    VideoAdded,
    decode,
    events_of,
)
from extractors.addresses import Address, parsed
from extractors.errors import DecoderStalled
from extractors.live import LiveLimits
from extractors.media import Shape
from store import Log
from tests.certificates import self_signed
from tests.extractors.streams import Camera, rtsp
from vian.errors import WrongUsage
from vian.extraction import Job, extract_motion

LIMITS = LiveLimits(connect_s=20, stall_s=1, retry_s_min=0.1, retry_s_max=0.4)


class Killed(Exception):
    """The process was killed here."""


def job(log: Log, url: str, **changes: Any) -> Job:
    place = parsed(url)
    assert isinstance(place, Address)
    return replace(Job(log=log, station="brno", source="gate", path=place, live=LIMITS), **changes)


def until(frames: int) -> dict[str, Callable[..., Any]]:
    """What ends a job once so many frames were worked on."""
    done: list[int] = [0]
    return {
        "on_progress": lambda count, _: done.append(count),
        "is_stopped": lambda: done[-1] >= frames,
    }


def said(log: Log, event_type: type[EventType]) -> list[Any]:
    segments = log.read_all(types=[event_type.type_name])
    return [event for segment in segments for event in events_of(decode(segment, log.catalogue))]


def test_a_live_stream_becomes_events_until_it_is_stopped(log: Log) -> None:
    with rtsp(Camera(login="user:geheim")) as url:
        done = extract_motion(job(log, url.replace("//", "//user:geheim@"), **until(30)))
    (added,) = said(log, VideoAdded)
    assert (added.path, added.width, added.height) == (url, 160, 120)
    (finished,) = said(log, ProcessFinished)
    assert finished.frames == done.frames >= 30
    assert all(
        "geheim" not in repr(event) for segment in log.read_all() for event in events_of(decode(segment, log.catalogue))
    )


def test_an_interruption_is_recorded_when_it_begins_and_when_it_ends(log: Log) -> None:
    with rtsp(Camera(frames=60)) as url:
        extract_motion(job(log, url, **until(70)))
    (added,) = said(log, VideoAdded)
    lost, back = said(log, StreamInterrupted)[0], said(log, StreamResumed)[0]
    assert lost.video == back.video == added.video
    assert lost.why == "the live stream is interrupted: the other side ended it"
    assert added.started_at < lost.time == back.interrupted_at < back.time
    notes = [event.note for event in said(log, ProcessProgressed) if event.note]
    assert any("is back after" in note for note in notes)
    assert not [point for point in said(log, TrackPoint) if lost.time < point.time < back.time]


def test_a_change_of_size_is_new_footage(log: Log) -> None:
    with rtsp(Camera(frames=40, sizes=((160, 120), (192, 144)))) as url:
        extract_motion(job(log, url, **until(50)))
    small, large, *_ = said(log, VideoAdded)
    assert [(each.width, each.height) for each in (small, large)] == [(160, 120), (192, 144)]
    assert small.video != large.video
    assert small.started_at < large.started_at


def test_after_a_kill_the_next_run_goes_on_and_says_what_is_missing(log: Log) -> None:
    def kill(done: int, _: int | None) -> None:
        if done >= 30:
            raise Killed

    with rtsp(Camera()) as url:
        with pytest.raises(Killed):
            extract_motion(job(log, url, on_progress=kill))
        before = said(log, TrackPoint)
        extract_motion(job(log, url, **until(30)))
    first, second = said(log, ProcessStarted)
    (failed,), (finished,) = said(log, ProcessFailed), said(log, ProcessFinished)
    assert (failed.process, finished.process) == (first.process, second.process)
    old, new = said(log, VideoAdded)
    (lost,), (back,) = said(log, StreamInterrupted), said(log, StreamResumed)
    assert (lost.video, back.video) == (old.video, new.video)
    assert old.started_at < lost.time == back.interrupted_at <= back.time == new.started_at
    points = said(log, TrackPoint)
    assert points[: len(before)] == before
    assert all(a.time <= b.time for a, b in pairwise(points))
    assert not {p.track_id for p in before} & {p.track_id for p in points[len(before) :]}


@pytest.mark.parametrize("call", range(1, 5))
def test_a_kill_amid_what_is_said_of_a_kill_loses_no_interruption(
    log: Log, call: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, append = 0, Log.append

    def kill(done: int, _: int | None) -> None:
        if done >= 30:
            raise Killed

    def append_or_die(self: Log, *arguments: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise Killed
        return append(self, *arguments, **named)

    with rtsp(Camera()) as url:
        with pytest.raises(Killed):
            extract_motion(job(log, url, on_progress=kill))
        with monkeypatch.context() as patched:
            patched.setattr(Log, "append", append_or_die)
            with pytest.raises(Killed):
                extract_motion(job(log, url))
        extract_motion(job(log, url, **until(10)))
    watched, starts = said(log, VideoAdded), said(log, ProcessStarted)
    lost, back = said(log, StreamInterrupted), said(log, StreamResumed)
    assert [each.video for each in starts] == [each.video for each in watched]
    assert [each.video for each in lost] == [each.video for each in watched[:-1]]
    assert [(each.video, each.time) for each in back] == [(each.video, each.started_at) for each in watched[1:]]
    assert [each.time for each in lost] == [each.interrupted_at for each in back]
    assert [each.process for each in said(log, ProcessFailed)] == [each.process for each in starts[:-1]]


def test_a_process_that_is_killed_while_its_stream_is_away_leaves_one_interruption(log: Log) -> None:
    def kill(note: str) -> None:
        if "is interrupted" in note:
            raise Killed

    with rtsp(Camera(frames=40)) as url:
        with pytest.raises(Killed):
            extract_motion(job(log, url, on_note=kill))
        extract_motion(job(log, url, **until(10)))
    (lost,), (back,) = said(log, StreamInterrupted), said(log, StreamResumed)
    assert lost.why == "the live stream is interrupted: the other side ended it"
    assert (back.interrupted_at, back.time) == (lost.time, said(log, VideoAdded)[-1].started_at)


def test_a_stream_that_was_away_when_its_process_ended_is_said_to_be_back(log: Log) -> None:
    notes: list[str] = []
    with rtsp(Camera(frames=40)) as url:
        gone = {"on_note": notes.append, "is_stopped": lambda: any("is interrupted" in note for note in notes)}
        extract_motion(job(log, url, **gone))
        assert (len(said(log, StreamInterrupted)), said(log, StreamResumed)) == (1, [])
        extract_motion(job(log, url, **until(10)))
    (lost,), (back,) = said(log, StreamInterrupted), said(log, StreamResumed)
    assert back.interrupted_at == lost.time <= back.time
    assert back.video == said(log, VideoAdded)[-1].video


def test_a_live_stream_does_not_begin_at_the_same_time_twice(log: Log) -> None:
    start = datetime(2026, 1, 1, tzinfo=UTC)
    with rtsp(Camera()) as url:
        extract_motion(job(log, url, started_at=start, **until(5)))
        head = log.head()
        with pytest.raises(WrongUsage, match=r"began at 2026-01-01T00:00:00\+00:00: .*Next: leave --start out"):
            extract_motion(job(log, url, started_at=start, **until(5)))
    assert log.head() == head


def test_a_camera_that_never_answers_leaves_no_trace(log: Log) -> None:
    with rtsp(Camera(is_mute=True)) as url, pytest.raises(DecoderStalled, match="Next: is the camera on"):
        extract_motion(job(log, url, live=replace(LIMITS, connect_s=1)))
    assert log.head() == 0


def test_that_nobody_checks_the_cameras_certificate_is_told(log: Log, tmp_path: Path) -> None:
    own, notes = self_signed(tmp_path / "camera.pem", "127.0.0.1"), list[str]()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(own)
    with rtsp(Camera(tls=context)) as url:
        for ca_file in (None, own):
            extract_motion(job(log, url, ca_file=ca_file, on_note=notes.append, **until(10)))
    (note,) = [note for note in notes if "certificate" in note]
    assert f"{url}: nobody checks the camera's certificate" in note
    assert "Next: VIAN_LIVE_CA_FILE=FILE" in note


def test_smaller_pictures_leave_events_in_the_videos_own_pixels(log: Log) -> None:
    with rtsp(Camera()) as url:
        extract_motion(job(log, url, shape=Shape(width_max=80), **until(30)))
    (added,) = said(log, VideoAdded)
    assert (added.width, added.height) == (160, 120)
    (started,) = said(log, ProcessStarted)
    assert '"width_max": 80' in started.configuration
