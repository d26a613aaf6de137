"""Calibrations that follow from a source's tracks, on their way into the log.

Contract: each calibration that a running extraction finds is appended once, also when it goes on after a kill. Of the
points that a log holds already each view has one, from the view's beginning; what was said last is not said again.
Track points are never touched: what they mean on the ground is a query (`track_ground`). The stream has several
writers: people calibrate a camera while its extraction runs.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from events import (
    CameraCalibrated,
    EventBatch,
    EventType,
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
    source_name,
    station_name,
)
from extractors import motion
from extractors.calibration import NAME, VERSION, CalibrationConfig, KnownLength, Scale
from extractors.horizon import OTHER_VIEWS, FrameSize
from patterns.scene.site import is_move
from store import Log
from vian.camera_folds import CameraConfig, CameraFolds
from vian.errors import WorldFailed, WrongUsage
from vian.exclusive import exclusively
from vian.said import Said
from vian.settings import station_option
from vian.zoning import filmed, frame_size_of

_READ = tuple(each.type_name for each in (VideoAdded, TrackPoint, SceneChanged))
"""Event types that a calibration is found from; a video says the frame's size."""


@dataclass(frozen=True, slots=True)
class Calibrating:
    """What it came to.

    Attributes:
        tracks: Tracks read.
        points: Their points.
        newest: The calibration of this run that stands now; None: the tracks of the present view decide none.
        appended: Events appended now.
        reason: Why the last look said nothing new.
    """

    tracks: int
    points: int
    newest: CameraCalibrated | None
    appended: int
    reason: str


def calibrate_from_tracks(
    log: Log, station: str, source: str, config: CalibrationConfig, scale: Scale | None, *, is_replacing: bool = False
) -> Calibrating:
    """Read the source's track points and record the calibrations that follow.

    Raises:
        InvalidName: The station or the source cannot be one.
        WorldFailed: The log has no track points or no video of the source, another process is at it, or they would
            replace one by hand and that is not wanted.
    """
    station_name(station), source_name(source)
    size = frame_size_of(log, station, source)
    if size is None:
        raise WorldFailed(
            f"the log has no video of source {source} of station {station}, and so no size of its frames. "
            f"Next: {_next(log, station, source)}"
        )
    check_inside(scale, FrameSize(*size))
    with exclusively(log, f"calibration of source {source} of station {station}"):
        folds = CameraFolds(FrameSize(*size), CameraConfig(horizon=None, calibration=config, scale=scale))
        tracks: set[int] = set()
        found = list(_of_views(folds, _noted(_batches(log, station, source), tracks)))
        points = sum(life.sequence for life in log.lives(StreamName.of(station, source, TrackPoint.type_name)))
        if not points:
            raise WorldFailed(
                f"the log has no track points of source {source} of station {station}. "
                f"Next: vian extract motion VIDEO --source {source}{station_option(station)}"
            )
        stream = StreamName.of(station, source, CameraCalibrated.type_name)
        said = [event for event, _ in Said(log, station, source).every(CameraCalibrated)]
        new = found if said[len(said) - len(found) :] != found else []
        standing = standing_calibration(log, station, source)
        if new and standing is not None and standing.covariance is None and not is_replacing:
            raise WorldFailed(
                f"{source} has a calibration by hand, which what its tracks say would replace; nothing was recorded. "
                f"Next: vian extract calibration --source {source}{station_option(station)} --replace, if it shall"
            )
        if new:
            producer = Producer(NAME, VERSION, config.config_hash)
            log.append([encode(stream, batch_of(new), producer)], [log.stream_head(stream).sequence])
        newest = found[-1] if found and found[-1] == standing_calibration(log, station, source) else None
        return Calibrating(len(tracks), points, newest, len(new), folds.reason)


def config_for(log: Log, station: str, source: str) -> CalibrationConfig:
    """The parameters for the boxes of the source's newest extraction: a model's, or blobs.

    Raises:
        InvalidName: The station or the source cannot be one.
    """
    started = [event for event, _ in Said(log, station, source).every(ProcessStarted) if event.extractor == motion.NAME]
    is_of_a_model = bool(started) and json.loads(started[-1].configuration).get("detector") is not None
    return CalibrationConfig.of_boxes() if is_of_a_model else CalibrationConfig()


def standing_calibration(
    log: Log, station: str, source: str, to_position: int | None = None
) -> CameraCalibrated | None:
    """The newest calibration of the view that the source has, as the log says up to a position; None: it has none."""
    said = Said(log, station, source)
    moves = [(event, position) for event, position in said.every(SceneChanged) if is_move(event)]
    newest: CameraCalibrated | None = None
    moved_at: datetime | None = None
    for event, position in sorted([*said.every(CameraCalibrated), *moves], key=lambda each: each[1]):
        if to_position is not None and position > to_position:
            break
        if isinstance(event, SceneChanged):
            moved_at = max(event.time, moved_at or event.time)
            newest = newest if newest is not None and newest.time >= moved_at else None
        elif isinstance(event, CameraCalibrated) and (moved_at is None or event.time >= moved_at):
            newest = event
    return newest


def check_inside(scale: Scale | None, size: FrameSize) -> None:
    """Refuse a known length with points outside the picture: they are of another frame size.

    Raises:
        WrongUsage: One lies outside.
    """
    if not isinstance(scale, KnownLength):
        return
    for x, y in (scale.xy, scale.other_xy):
        if not (0 <= x <= size.width and 0 <= y <= size.height):
            raise WrongUsage(
                f"--length: the point {x:g},{y:g} lies outside the frame of {size.width} x {size.height} px"
            )


def _of_views(folds: CameraFolds, batches: Iterable[EventBatch]) -> Iterator[CameraCalibrated]:
    """Of each view the last calibration, which is the surest; it holds from the view's beginning."""
    began: datetime | None = None
    newest: CameraCalibrated | None = None
    for batch in batches:
        ended = _end_of_view(batch, folds.size)
        newest = next(reversed(calibrations_in(_folded(folds, batch))), newest)
        if ended is not None:
            yield from _dated(newest, began)
            began, newest = ended, None
        elif began is None:
            began = _beginning(batch)
    yield from _dated(next(reversed(calibrations_in(folds.finish())), newest), began)


def _dated(newest: CameraCalibrated | None, began: datetime | None) -> list[CameraCalibrated]:
    return [newest.model_copy(update={"time": began})] if newest is not None else []


def _end_of_view(batch: EventBatch, size: FrameSize) -> datetime | None:
    """When the view or the frames' size changed last, as the batch says; None: neither did."""
    if batch.type is TrackPoint:
        return None
    return next((since for event in reversed(events_of(batch)) if (since := _changed(event, size)) is not None), None)


def _changed(event: EventType, size: FrameSize) -> datetime | None:
    if isinstance(event, VideoAdded):
        return event.started_at if FrameSize(event.width, event.height) != size else None
    return event.time if isinstance(event, SceneChanged) and event.cause in OTHER_VIEWS else None


def _beginning(batch: EventBatch) -> datetime | None:
    """When what the batch speaks of begins; None if it speaks of no footage."""
    first = next(iter(events_of(batch.slice(0, 1))), None)
    if isinstance(first, VideoAdded):
        return first.started_at
    return first.time if isinstance(first, TrackPoint) else None


def _folded(folds: CameraFolds, batch: EventBatch) -> tuple[EventBatch, ...]:
    if batch.type is not VideoAdded:
        return folds.add([batch])
    width, height = (int(batch.data.column(name)[-1].as_py()) for name in ("width", "height"))
    return () if folds.size == FrameSize(width, height) else folds.resize(FrameSize(width, height))


def _batches(log: Log, station: str, source: str) -> Iterator[EventBatch]:
    for segment in log.read_all(types=_READ, sources=[source], stations=[station]):
        yield decode(segment, log.catalogue)


def _next(log: Log, station: str, source: str) -> str:
    """The command for a source that has no video here: for that of the same name of another station, or a video."""
    others = sorted(of for of, name in filmed(log) if name == source)
    if others:
        return f"vian extract calibration --source {source}{station_option(others[0])}"
    return f"vian extract motion VIDEO --source {source}{station_option(station)}"


def _noted(batches: Iterable[EventBatch], tracks: set[int]) -> Iterator[EventBatch]:
    """The same batches; whose tracks they are is noted."""
    for batch in batches:
        if batch.type is TrackPoint:
            tracks.update(batch.data.column("track_id").unique().to_pylist())
        yield batch


def calibrations_in(batches: Sequence[EventBatch]) -> list[CameraCalibrated]:
    """The calibrations among the events."""
    said = [batch for batch in batches if batch.type is CameraCalibrated]
    return [event for batch in said for event in events_of(batch) if isinstance(event, CameraCalibrated)]
