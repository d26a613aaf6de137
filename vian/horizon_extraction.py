"""The horizon from a log: the track points of a source in, a process's votes and estimates into the same log.

Contract: the process is named by what goes in (source, extractor, version, configuration, points there were
when it started). Run again after a kill it goes on with the same points and ends with the same events; run
again after its end it does nothing until there are more points.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime

from events import (
    EventBatch,
    EventType,
    HorizonEstimate,
    HorizonVote,
    ProcessFinished,
    ProcessStarted,
    Producer,
    SceneChanged,
    StreamName,
    TrackPoint,
    VideoAdded,
    batch_of,
    decode,
    encode,
    source_name,
    station_name,
)
from extractors.horizon import NAME, VERSION, FrameSize, Horizon, HorizonConfig
from store import Appender, Log, SequenceConflict
from vian.errors import WorldFailed, WrongUsage
from vian.exclusive import exclusively
from vian.extraction import Stamp, wall_clock
from vian.resuming import resume
from vian.said import Said

_READ = tuple(each.type_name for each in (VideoAdded, TrackPoint, SceneChanged))
"""Event types that the horizon is found from; a video says the frame's size."""
_SAID = (HorizonVote, HorizonEstimate, ProcessFinished)
"""Event types of the streams that the process appends to behind its start."""


@dataclass(frozen=True, slots=True)
class HorizonExtraction:
    """What an extraction came to."""

    process: str
    source: str
    events: int
    """votes and estimates that the process said"""
    estimate: HorizonEstimate | None
    """the newest estimate of the source; None where there is none"""
    was_done: bool
    """The process had finished in an earlier run; nothing was appended now."""


@dataclass(frozen=True, slots=True)
class HorizonJob:
    """Of which source the horizon is wanted."""

    log: Log
    station: str
    source: str
    config: HorizonConfig = field(default_factory=HorizonConfig.of_blobs)
    stamp: Stamp = wall_clock
    run: int = 1
    """1 for the first time, more for a repetition over the same points as a new process"""
    database_wait_s: float = 60.0
    on_note: Callable[[str], None] | None = None
    """told what people should know"""

    @property
    def said(self) -> Said:
        """What the log holds of the source."""
        return Said(self.log, self.station, self.source)

    def stream(self, event_type: type[EventType]) -> StreamName:
        """The stream of this source in an event type."""
        return StreamName.of(self.station, self.source, event_type.type_name)

    def note(self, text: str) -> None:
        """Tell people, if anybody listens."""
        if self.on_note is not None:
            self.on_note(text)

    @property
    def producer(self) -> Producer:
        """Who says it."""
        return Producer(NAME, VERSION, self.config.config_hash)


def extract_horizon(job: HorizonJob) -> HorizonExtraction:
    """Find the horizon by the source's track points, or go on with it.

    Raises:
        InvalidName: The station or the source cannot be one.
        WrongUsage: The log holds no track points of the source.
        WorldFailed: Another process is at work on the source.
        LogUnavailable: The database stayed away.
    """
    station_name(job.station), source_name(job.source)
    with exclusively(job.log, f"source {job.source} of station {job.station}"):
        return _extract(job)


def _extract(job: HorizonJob) -> HorizonExtraction:
    video = job.said.newest(VideoAdded)
    points = sum(life.sequence for life in job.log.lives(job.stream(TrackPoint)))
    if video is None or not points:
        raise WrongUsage(
            f"the log holds no track points of source {job.source} of station {job.station}. "
            f"Next: vian extract motion VIDEO --source {job.source}"
        )
    started, at = (_unfinished(job) if job.run == 1 else None) or _begun(job, process_name(job, points), video[0])
    done = job.said.newest_about(ProcessFinished, started.process)
    finished = done[0] if done else _finished(job, started.process, at, video[0].started_at)
    estimate = job.said.newest(HorizonEstimate)
    return HorizonExtraction(
        process=started.process,
        source=job.source,
        events=finished.events,
        estimate=estimate[0] if estimate else None,
        was_done=done is not None,
    )


def _finished(job: HorizonJob, process: str, started_position: int, begun_at: datetime) -> ProcessFinished:
    try:
        return _Run(job, process, started_position, begun_at).whole()
    except SequenceConflict as error:
        raise WorldFailed(
            f"somebody else appends to source {job.source}: {error}. What this process stored stays. "
            "Next: let that end, then run this again with --again 2"
        ) from error


def process_name(job: HorizonJob, points: int) -> str:
    """Name of the process: 16 hexadecimal digits of a hash of what goes into it."""
    said = [job.source, NAME, VERSION, job.config.config_hash.hex(), job.run, points]
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]


class _Run:
    """The process at work, from its beginning or behind what an earlier run stored."""

    def __init__(self, job: HorizonJob, process: str, started_position: int, begun_at: datetime) -> None:
        self._job, self._process, self._at_start = job, process, started_position
        self._appender = Appender(
            job.log, job.producer, wait_s=job.database_wait_s, on_wait=lambda error: job.note(f"waiting: {error}")
        )
        self._events = self._frames = 0
        self._last_time = begun_at

    def whole(self) -> ProcessFinished:
        """Fold all points that were there at the start; what the process said last."""
        for event_type in _SAID:
            resume(self._job.log, self._appender, self._job.stream(event_type), self._at_start)
        horizon: Horizon | None = None
        size: FrameSize | None = None
        for batch in self._batches():
            if batch.type is VideoAdded:
                (width, height) = (int(batch.data.column(name)[-1].as_py()) for name in ("width", "height"))
                if size != FrameSize(width, height):
                    size = FrameSize(width, height)
                    self._end(horizon)
                    horizon = Horizon(size, self._job.config)
            elif horizon is not None:
                horizon.take_in(batch)
                if batch.type is TrackPoint:
                    self._last_time = batch.data.column("time")[-1].as_py()
                self._append(horizon.take())
        self._end(horizon)
        time = self._job.stamp(self._last_time)
        finished = ProcessFinished(time=time, process=self._process, frames=self._frames, events=self._events, gaps=0)
        self._append((batch_of([finished]),))
        return finished

    def _batches(self) -> Iterator[EventBatch]:
        log, job = self._job.log, self._job
        segments = log.read_all(types=_READ, sources=[job.source], stations=[job.station], to_position=self._at_start)
        for segment in segments:
            yield decode(segment, log.catalogue)

    def _end(self, horizon: Horizon | None) -> None:
        if horizon is not None:
            horizon.finish()
            self._frames += horizon.frames
            self._append(horizon.take())

    def _append(self, batches: tuple[EventBatch, ...]) -> None:
        self._events += sum(len(batch) for batch in batches)
        if batches:
            self._appender.append([(self._job.stream(batch.type), batch) for batch in batches])


def _begun(job: HorizonJob, process: str, video: VideoAdded) -> tuple[ProcessStarted, int]:
    """The start of the process, and its position; said now if it was not."""
    found = job.said.newest_about(ProcessStarted, process)
    if found is not None:
        return found
    event = ProcessStarted(
        time=job.stamp(video.started_at),
        process=process,
        extractor=NAME,
        extractor_version=VERSION,
        configuration=json.dumps(job.config.model_dump(mode="json"), sort_keys=True),
        video=video.video,
    )
    stream = job.stream(ProcessStarted)
    draft = encode(stream, batch_of([event]), job.producer)
    return event, job.log.append([draft], [job.log.stream_head(stream).sequence])[0].position


def _unfinished(job: HorizonJob) -> tuple[ProcessStarted, int] | None:
    """The source's newest process if it is such a one, not at its end: it goes on with the points it began with."""
    newest = job.said.newest(ProcessStarted)
    if newest is None or newest[0].extractor != NAME or job.said.newest_about(ProcessFinished, newest[0].process):
        return None
    return newest if json.loads(newest[0].configuration) == job.config.model_dump(mode="json") else None
