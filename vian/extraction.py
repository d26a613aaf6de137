"""One extraction: a video or a live stream in, its process's events in the log.

Contract: the process is named by what goes in (source, video, extractor, version, configuration),
so the same command run again after a kill goes on with the same process and ends with the same
events; run again after its end it does nothing. What an extractor said before an error stays, and
`process_failed` says what stopped it.

A live stream cannot be read again: after a kill the next run is a new process on new footage. It goes
on behind the last stored sequence, and says what lies between as an interruption.
"""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from events import (
    ActivityInterval,
    Appearance,
    CameraCalibrated,
    EventBatch,
    EventType,
    HorizonEstimate,
    HorizonVote,
    ProcessFailed,
    ProcessFinished,
    ProcessProgressed,
    ProcessStarted,
    Producer,
    SceneChanged,
    StreamInterrupted,
    StreamName,
    StreamResumed,
    TrackEnded,
    TrackPoint,
    VideoAdded,
    batch_of,
    encode,
    source_name,
    station_name,
)
from extractors import motion, video
from extractors.addresses import Address
from extractors.errors import ExtractorError
from extractors.horizon import FrameSize
from extractors.live import Live, LiveLimits
from extractors.media import Frame, Gap, GapReason, Shape, VideoInfo
from store import Appender, Log, SequenceConflict
from vian.calibrating import calibrations_in, check_inside, standing_calibration
from vian.camera_folds import CameraConfig, CameraFolds, Resized
from vian.errors import WorldFailed, WrongUsage
from vian.exclusive import exclusively
from vian.resuming import resume
from vian.said import Said

_SAID_BY_A_PROCESS = (
    TrackPoint,
    TrackEnded,
    Appearance,
    ActivityInterval,
    HorizonVote,
    HorizonEstimate,
    SceneChanged,
    VideoAdded,
    ProcessProgressed,
    ProcessFinished,
    ProcessFailed,
)
"""Event types of the streams that a process alone appends to while it runs."""

_TRIES = 5
"""So often an append is tried with calibrations in it: people may calibrate the same camera at that moment."""

PROGRESS_EVERY_S = 10.0
"""Media time between two `process_progressed`, in seconds."""

NOTES_OF_A_KIND_MAX = 5
"""So many gaps of one kind are told while the work goes on; all of them are in the log."""

_ALL_NOTES = 'vian query "select source, time, note from process_progressed"'

_YEARS = range(1970, 2200)
"""Years in which a video can have been recorded: clocks that were never set say 1904, or 9999."""

Stamp = Callable[[datetime], datetime]
"""From the media's time to the time that a process's event bears."""


def wall_clock(_: datetime) -> datetime:
    """Now: what a process does happens when it does it."""
    return datetime.now(UTC)


def media_clock(media_time: datetime) -> datetime:
    """The media's time: a replay whose log depends on its input alone."""
    return media_time


@dataclass(frozen=True, slots=True)
class Extraction:
    """What an extraction came to."""

    process: str
    source: str
    video: VideoAdded
    frames: int
    events: int
    gaps: int
    was_done: bool
    """The process had finished in an earlier run; nothing was appended now."""


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be extracted."""

    log: Log
    station: str
    source: str
    path: Path | Address
    """a video, a folder of pictures, or a live stream"""
    started_at: datetime | None = None
    """wall-clock time of the first frame; from the file's metadata or its modification time by default, of a
    live stream from itself"""
    config: motion.MotionConfig = field(default_factory=motion.MotionConfig)
    detector: motion.Detector | None = None
    """finds the objects, where `config.detector` is a model's hash"""
    camera: CameraConfig = field(default_factory=CameraConfig)
    """how horizon and calibration are found meanwhile"""
    shape: Shape = field(default_factory=Shape)
    ignored: motion.IgnoredArea | None = None
    live: LiveLimits = field(default_factory=LiveLimits)
    ca_file: Path | None = None
    """certificates that a live stream over TLS must have one of, or of those whom they vouch for; None: any will do"""
    stamp: Stamp = wall_clock
    run: int = 1
    """1 for the first time, more for a repetition of the same extraction as a new process"""
    database_wait_s: float = 60.0
    on_progress: Callable[[int, int | None], None] | None = None
    """told the frames done and expected"""
    on_note: Callable[[str], None] | None = None
    """told what people should know"""
    is_stopped: Callable[[], bool] = lambda: False
    """asked while a live stream is read whether to come to an end"""

    @property
    def options(self) -> dict[str, Any]:
        """What was asked for of the pictures besides the configuration; part of what names the process."""
        asked = asdict(self.shape) | {"ignored": self.ignored.sha256 if self.ignored else None}
        return {name: value for name, value in asked.items() if value is not None}

    def note(self, text: str) -> None:
        """Tell people, if anybody listens."""
        if self.on_note is not None:
            self.on_note(text)

    @property
    def said(self) -> Said:
        """What the log holds of the source."""
        return Said(self.log, self.station, self.source)

    def stream(self, event_type: type[EventType]) -> StreamName:
        """The stream of this source in an event type."""
        return StreamName.of(self.station, self.source, event_type.type_name)


def extract_motion(job: Job) -> Extraction:
    """Run motion detection and tracking on the job's video, or go on with it.

    Raises:
        InvalidName: The station or the source cannot be one.
        ExtractorError: The video cannot be read, or the extractor stopped; recorded as
            `process_failed` if the process had started.
        WrongUsage: The log knows the video with another start.
        WorldFailed: The process failed in an earlier run, or another one is at work on the source.
        LogUnavailable: The database stayed away.
    """
    station_name(job.station), source_name(job.source)
    if isinstance(job.path, Address):
        if job.path.is_over_tls and job.ca_file is None:
            job.note(
                f"{job.path.shown}: nobody checks the camera's certificate, so whoever answers gets the login. "
                "Next: VIAN_LIVE_CA_FILE=FILE with its certificate"
            )
        live = Live(job.path, job.live, job.shape, ca_file=job.ca_file, is_stopped=job.is_stopped)
        with live, _alone(job):
            return _extract_live(job, live)
    info = video.probe(job.path, shape=job.shape)
    with _alone(job):
        return _extract(job, job.path, info)


def _alone(job: Job) -> AbstractContextManager[None]:
    return exclusively(job.log, f"source {job.source} of station {job.station}")


def _extract_live(job: Job, live: Live) -> Extraction:
    assert isinstance(job.path, Address)
    _check_fits(job, live.info)
    started_at = _checked_start(job.started_at or live.started_at)
    added = _live_added(job, live.info, started_at)
    if job.started_at is not None and job.said.newest_about(VideoAdded, added.video) is not None:
        raise WrongUsage(
            f"source {job.source} has footage of {job.path.shown} that began at {started_at.isoformat()}: times would "
            "come twice. Next: leave --start out; a live stream says its time itself"
        )
    process = process_name(job, added.video)
    unfinished = _unfinished(job)
    given_up = _given_up(job, added, unfinished, process) if unfinished else ()
    position = _start(job, added, process, [*given_up, *_interruption(job, added, unfinished), added])[1]
    return _Run(job, live.info, added, process, position, live).whole(live.frames())


def _extract(job: Job, path: Path, info: VideoInfo) -> Extraction:
    _check_fits(job, info)
    added = _added(job, path, info)
    process = process_name(job, added.video)
    begun = job.said.newest_about(ProcessStarted, process)
    if begun is None:
        newest = job.said.newest_about(VideoAdded, added.video)
        if newest is not None and (newest[0].width, newest[0].height) != (added.width, added.height):
            _append_first(job, added)  # an earlier process met another size within the video
        unfinished = _unfinished(job)
        begun = _start(job, added, process, _given_up(job, added, unfinished, process) if unfinished else ())
    elif finished := job.said.newest_about(ProcessFinished, process):
        done = finished[0]
        return Extraction(process, job.source, added, done.frames, done.events, done.gaps, was_done=True)
    elif failed := job.said.newest_about(ProcessFailed, process):
        raise WorldFailed(
            f"process {process} on {job.path} failed before, after {failed[0].frames} frames: {failed[0].error}. "
            f"What it said until then is in the log. Next: mend the video, or repeat it with --again {job.run + 1}"
        )
    return _Run(job, info, added, process, begun[1]).whole(video.frames(path, shape=job.shape))


def process_name(job: Job, video_hash: str) -> str:
    """Name of the process: 16 hexadecimal digits of a hash of what goes into it."""
    said: list[Any] = [job.source, video_hash, motion.NAME, motion.VERSION, job.config.config_hash.hex(), job.run]
    said.append(job.camera.description)
    if job.options:
        said.append(job.options)
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]


class _Run:
    """One process at work, from its beginning or behind what an earlier run stored."""

    def __init__(
        self,
        job: Job,
        info: VideoInfo,
        added: VideoAdded,
        process: str,
        started_position: int,
        live: Live | None = None,
    ) -> None:
        self._job = job
        self._info = info
        self._added = added
        self._process = process
        self._at_start = started_position
        self._live = live
        self._footage = added
        self._interrupted_at: datetime | None = None
        self._appender = Appender(
            job.log, _producer(job), wait_s=job.database_wait_s, on_wait=lambda error: job.note(f"waiting: {error}")
        )
        self._frames = 0
        self._time_us = 0
        self._events = 0
        self._gaps = 0
        self._told: Counter[GapReason] = Counter()
        self._progress_due_s = PROGRESS_EVERY_S
        standing = standing_calibration(job.log, job.station, job.source, to_position=started_position)
        self._folds = CameraFolds(FrameSize(info.width, info.height), job.camera, standing)
        self._resized: list[Resized] = []

    def whole(self, frames: Iterable[Frame | Gap]) -> Extraction:
        """Extract to the end of the frames."""
        first_track_id = 1 + self._resume_all()
        steps = motion.extract(
            self._watched(frames),
            self._job.config,
            start_time=self._added.started_at,
            first_track_id=first_track_id,
            detector=self._job.detector,
            ignored=self._job.ignored,
        )
        try:
            for step in steps:
                self._store(step)
            self._take_in(self._folds.finish())
        except ExtractorError as error:
            self._say(ProcessFailed(**self._state(), error=str(error)))
            raise
        except SequenceConflict as error:
            raise WorldFailed(
                f"somebody else appends to source {self._job.source}: {error}. What this process stored stays. "
                "Next: give each extraction a source of its own, then run this again"
            ) from error
        self._say(ProcessFinished(**self._state(), gaps=self._gaps))
        return Extraction(
            self._process, self._job.source, self._added, self._frames, self._events, self._gaps, was_done=False
        )

    def _store(self, step: motion.Extraction) -> None:
        """Append what one interval of the media brought, in one transaction."""
        self._frames, self._time_us = step.frames, step.time_us
        of_the_camera = self._folds.add(step.batches, self._resized)
        self._gaps += len(step.gaps)
        self._take_in((*step.batches, *of_the_camera), step)
        self._resized = []
        self._tell(step.gaps)
        if self._job.on_progress is not None:
            self._job.on_progress(self._frames, None if self._job.shape.fps else self._info.frames_expected)

    def _tell(self, gaps: Iterable[Gap]) -> None:
        """Tell people of the gaps, but not of each where there are very many of a kind."""
        for gap in gaps:
            self._told[gap.reason] += 1
            if self._told[gap.reason] <= NOTES_OF_A_KIND_MAX:
                self._job.note(str(gap))
            elif self._told[gap.reason] == NOTES_OF_A_KIND_MAX + 1:
                self._job.note(f"{gap.reason}: more of the kind are not told here, but recorded. Next: {_ALL_NOTES}")

    def _watched(self, frames: Iterable[Frame | Gap]) -> Iterator[Frame | Gap]:
        """The frames as they come; where their size changes, to what."""
        size: FrameSize | None = None
        for item in frames:
            if isinstance(item, Gap):
                size = FrameSize(*item.size) if item.size is not None else size
            elif size is not None:
                self._resized.append(Resized(item.index, item.time_us, size))
                size = None
            yield item

    def _take_in(self, found: Sequence[EventBatch], step: motion.Extraction | None = None) -> None:
        """Append what was found, with what is to be said of the step, in one transaction."""
        calibrations = calibrations_in(found)
        found = [batch for batch in found if batch.type is not CameraCalibrated]
        first, last = [*self._of_the_footage(), *found], [*self._of_the_stream(step.gaps)] if step is not None else []
        notes = self._notes(step) if step is not None else []
        events = self._events + sum(len(batch) for batch in found)
        for tries_left in reversed(range(_TRIES)):
            new, said = self._to_say(calibrations)
            self._events = events + len(new) + said
            try:
                self._append([*first, *self._remarks(notes), *last, *([batch_of(new)] if new else [])])
                return
            except SequenceConflict:
                if not (new and tries_left):
                    raise

    def _of_the_footage(self) -> Iterator[EventBatch]:
        """That the frames have come to another size, which zones and calibrations are laid by."""
        for change in self._resized:
            time = self._added.started_at + timedelta(microseconds=change.time_us)
            width, height = change.size.width, change.size.height
            if self._live is not None:
                self._footage = _live_added(self._job, replace(self._live.info, width=width, height=height), time)
            else:
                sizes = {"width": width, "height": height}
                self._footage = self._added.model_copy(update=sizes | {"time": self._job.stamp(time)})
            yield batch_of([self._footage])

    def _of_the_stream(self, gaps: Iterable[Gap]) -> Iterator[EventBatch]:
        """What is to be said of the live stream itself: that it was interrupted, or came back."""
        for gap in gaps:
            if self._live is None or gap.time_us is None:
                continue
            time, name = self._added.started_at + timedelta(microseconds=gap.time_us), self._footage.video
            if gap.reason is GapReason.INTERRUPTED:
                self._interrupted_at = time
                yield batch_of([StreamInterrupted(time=time, video=name, why=gap.detail)])
            elif gap.reason is GapReason.RESUMED and self._interrupted_at is not None:
                yield batch_of([StreamResumed(time=time, video=name, interrupted_at=self._interrupted_at)])

    def _notes(self, step: motion.Extraction) -> list[str | None]:
        """What is to be said of the work itself: gaps, and None for progress, now and then."""
        notes: list[str | None] = [str(gap) for gap in step.gaps]
        if step.time_us / 1e6 >= self._progress_due_s:
            self._progress_due_s = (step.time_us / 1e6 // PROGRESS_EVERY_S + 1) * PROGRESS_EVERY_S
            notes.append(None)
        return notes

    def _remarks(self, notes: Iterable[str | None]) -> list[EventBatch]:
        at = self._stamp(self._time_us)
        said = [
            ProcessProgressed(time=at, process=self._process, frames=self._frames, events=self._events, note=note)
            for note in notes
        ]
        return [batch_of(said)] if said else []

    def _append(self, batches: Sequence[EventBatch]) -> None:
        self._appender.append([(self._job.stream(batch.type), batch) for batch in batches if len(batch)])

    def _to_say(self, found: Sequence[CameraCalibrated]) -> tuple[list[CameraCalibrated], int]:
        """The calibrations that are still to be said, and how many of them this process said before it was killed."""
        if not found:
            return [], 0
        (told,) = self._appender.persistently(lambda: [self._told_of(found)])
        return told

    def _told_of(self, found: Sequence[CameraCalibrated]) -> tuple[list[CameraCalibrated], int]:
        job, stream = self._job, self._job.stream(CameraCalibrated)
        there = {event.model_dump_json(): at for event, at in job.said.every(CameraCalibrated)}
        said = sum(there.get(event.model_dump_json(), 0) > self._at_start for event in found)
        standing = standing_calibration(job.log, job.station, job.source)
        if standing is not None and standing.covariance is None:
            return [], said  # people have calibrated the camera meanwhile
        # What was withheld before the camera was moved, as its place was calibrated by hand, is not said after.
        moves = [
            event.time for event, at in job.said.every(SceneChanged) if event.cause == "moved" and at > self._at_start
        ]
        unsaid = [event for event in found if event.model_dump_json() not in there]
        self._appender.resume_at(stream, job.log.stream_head(stream).sequence)
        return [event for event in unsaid if not moves or event.time > max(moves)], said

    def _say(self, event: EventType) -> None:
        self._append([batch_of([event])])

    def _resume_all(self) -> int:
        """Let each stream go on from where it stood when the process started; how many track points there were."""
        # All at once, before the first frame: later the database may be away, and only appends wait for it.
        log, appender, at_start = self._job.log, self._appender, self._at_start
        streams = {event_type: self._job.stream(event_type) for event_type in _SAID_BY_A_PROCESS}
        return {each: resume(log, appender, stream, at_start) for each, stream in streams.items()}[TrackPoint]

    def _state(self) -> dict[str, Any]:
        return {
            "time": self._stamp(self._time_us),
            "process": self._process,
            "frames": self._frames,
            "events": self._events,
        }

    def _stamp(self, time_us: int) -> datetime:
        return self._job.stamp(self._added.started_at + timedelta(microseconds=time_us))


def _added(job: Job, path: Path, info: VideoInfo) -> VideoAdded:
    """The video as the log knows it; made known now if it was not."""
    known = job.said.newest_about(VideoAdded, info.sha256)
    if known is not None:
        _check_start(job, known[0])
        return known[0].model_copy(update={"width": info.width, "height": info.height})
    place = os.fsencode(path).decode(errors="replace")  # a name need not be UTF-8; it is for people
    event = _footage(job, info, info.sha256, place, _started_at(job, path, info))
    _append_first(job, event)
    return event


def _live_added(job: Job, info: VideoInfo, started_at: datetime) -> VideoAdded:
    """Footage of a live stream, named by where it comes from and when it began: nobody keeps its bytes."""
    assert isinstance(job.path, Address)
    said = [job.station, job.source, job.path.shown, started_at.isoformat()]
    name = hashlib.sha256(json.dumps(said).encode()).hexdigest()
    return _footage(job, info, name, job.path.shown, started_at)


def _footage(job: Job, info: VideoInfo, name: str, place: str, started_at: datetime) -> VideoAdded:
    return VideoAdded(
        time=job.stamp(started_at),
        video=name,
        path=place,
        width=info.width,
        height=info.height,
        fps=info.fps,
        frames_expected=info.frames_expected,
        codec=info.codec,
        started_at=started_at,
    )


def _check_fits(job: Job, info: VideoInfo) -> None:
    check_inside(job.camera.scale, FrameSize(info.width, info.height))
    if job.ignored is not None:
        job.ignored.check_fits(info.width, info.height)


def _check_start(job: Job, known: VideoAdded) -> None:
    """Refuse a start that differs from the one in the log, from which all times there follow."""
    if job.started_at not in (None, known.started_at):
        raise WrongUsage(
            f"source {job.source} has this video with the start {known.started_at.isoformat()}, got "
            f"{job.started_at.isoformat()}. Next: leave --start out to keep it, or give another --source"
        )


def _started_at(job: Job, path: Path, info: VideoInfo) -> datetime:
    """Wall-clock time of the first frame, by the best there is."""
    if job.started_at is not None:
        return _checked_start(job.started_at)
    if info.creation_time is not None and _is_plausible(info.creation_time):
        return info.creation_time
    modified = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    job.note(
        f"the video does not say when it was recorded: taking the file's modification time {modified.isoformat()}. "
        "Next time: --start TIME"
    )
    return modified


def _checked_start(start: datetime) -> datetime:
    if not _is_plausible(start):
        raise WrongUsage(f"--start must lie in the years {_YEARS.start} to {_YEARS.stop - 1}, got {start.isoformat()}")
    return start


def _is_plausible(start: datetime) -> bool:
    """Whether a video can have been recorded then; all times that follow from it can be stored."""
    return start.year in _YEARS


def _unfinished(job: Job) -> tuple[ProcessStarted, int] | None:
    """The source's newest process, with the position of its start, if it is not at its end."""
    newest = job.said.newest(ProcessStarted)
    if newest is None or any(job.said.newest_about(end, newest[0].process) for end in (ProcessFinished, ProcessFailed)):
        return None
    return newest


def _given_up(
    job: Job, added: VideoAdded, unfinished: tuple[ProcessStarted, int], successor: str
) -> Iterator[EventType]:
    """That a process has no end: what follows is another's; and that the view is another one, if it was left lost."""
    begun, position = unfinished
    job.note(f"process {begun.process} on source {job.source} was left unfinished and is given up")
    lost = _left_lost(job, position)
    if lost is not None:
        time = max(added.started_at, lost.time)  # footage that comes later may be older
        yield SceneChanged(time=time, cause="moved", changed_share=lost.changed_share, dx=None, dy=None)
    progress = job.said.newest_about(ProcessProgressed, begun.process)
    frames, events = (progress[0].frames, progress[0].events) if progress else (0, 0)
    yield ProcessFailed(
        time=job.stamp(added.started_at),
        process=begun.process,
        frames=frames,
        events=events,
        error=f"given up: it was not at its end when process {successor} began",
    )


def _left_lost(job: Job, position: int) -> SceneChanged | None:
    """The loss of its view behind which a process that began there saw nobody any more.

    Nobody remembers that view; in the dark it is still there, as a rule. Where it came back and nobody passed, metres
    end without need: wrong ones would be worse.
    """
    newest = job.said.newest(SceneChanged)
    if newest is None or newest[1] < position or newest[0].cause != "unknown":
        return None
    return None if any(time > newest[0].time for time in _newest_points(job)) else newest[0]


def _interruption(job: Job, added: VideoAdded, killed: tuple[ProcessStarted, int] | None) -> tuple[EventType, ...]:
    """What is to be said of the time in which nobody watched a live stream, up to the beginning of this footage.

    It was away when a process ended, or the process was killed.
    """
    newest = job.said.newest(StreamInterrupted)
    backs = {back.interrupted_at for back, _ in job.said.every(StreamResumed)}
    if newest is not None and newest[0].time not in backs and (killed is None or newest[1] > killed[1]):
        since = newest[0].time
        return (StreamResumed(time=max(added.started_at, since), video=added.video, interrupted_at=since),)
    if killed is None:
        return ()
    since = min(_last_sign(job, killed[0]), added.started_at)
    why = f"process {killed[0].process} came to no end: it was killed, or the machine stopped"
    return (
        StreamInterrupted(time=since, video=killed[0].video, why=why),
        StreamResumed(time=added.started_at, video=added.video, interrupted_at=since),
    )


def _last_sign(job: Job, killed: ProcessStarted) -> datetime:
    """When a process that was killed was last heard of."""
    progress = job.said.newest_about(ProcessProgressed, killed.process)
    return max([killed.time, *([progress[0].time] if progress else []), *_newest_points(job)])


def _newest_points(job: Job) -> list[datetime]:
    """When the source's newest track point was seen; empty where there is none."""
    points = job.stream(TrackPoint)
    return [segment.header.time_max for segment in job.log.read(points, job.log.stream_head(points).sequence)]


def _start(job: Job, added: VideoAdded, process: str, before: Iterable[EventType] = ()) -> tuple[ProcessStarted, int]:
    """Say that the process begins, and what is to be said before, at once: a kill leaves all of it or nothing."""
    configuration = job.config.model_dump(mode="json") | job.options | job.camera.description
    event = ProcessStarted(
        time=job.stamp(added.started_at),
        process=process,
        extractor=motion.NAME,
        extractor_version=motion.VERSION,
        configuration=json.dumps(configuration, sort_keys=True),
        video=added.video,
    )
    return event, _append_first(job, *before, event)


def _append_first(job: Job, *events: EventType) -> int:
    """Append events, each behind the head of its stream, in one transaction; the last one's position."""
    streams = [job.stream(type(event)) for event in events]
    drafts = [encode(stream, batch_of([event]), _producer(job)) for stream, event in zip(streams, events, strict=True)]
    return job.log.append(drafts, [job.log.stream_head(stream).sequence for stream in streams])[-1].position


def _producer(job: Job) -> Producer:
    configured = job.config.config_hash
    if job.options:
        configured = hashlib.sha256(configured + json.dumps(job.options, sort_keys=True).encode()).digest()
    return Producer(motion.NAME, motion.VERSION, configured)
