"""Zones, lines and calibrations that rules share: what stands in the log, and how it is changed.

Contract: each change is one event of the source that it belongs to. Definitions of a name are counted
from 1 in versions; two writers who define the same at once do not overwrite each other unseen: the
second gets a conflict and says so.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from events import (
    CameraCalibrated,
    EventType,
    Producer,
    SceneChanged,
    StreamName,
    TrackPoint,
    VideoAdded,
    ZoneDefined,
    ZoneRemoved,
    batch_of,
    decode,
    encode,
    events_of,
)
from patterns.errors import MatchError, RuleError
from patterns.files.loading import read_document, read_text
from patterns.files.rule import Name
from patterns.language.text import Document, did_you_mean
from patterns.scene.geometry import Line, Zone
from patterns.scene.ground import Calibration
from patterns.scene.site import shape_of
from store import Log
from vian.errors import WrongUsage
from vian.said import Said
from vian.version import VERSION

Shape = Zone | Line
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Standing:
    """A zone or line as it stands in the log."""

    name: str
    source: str
    shape: Shape
    event: ZoneDefined
    stream: str
    sequence: int


class Zones(BaseModel):
    """A file of zones and lines, written as rules write them."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    zones: Mapping[Name, Zone] = Field(default_factory=dict)
    lines: Mapping[Name, Line] = Field(default_factory=dict)


class GroundPoint(BaseModel):
    """One point that is known in the picture and on the ground."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    px: tuple[float, float]
    m: tuple[float, float]


class Points(BaseModel):
    """Points of the ground plane from which a source is calibrated.

    Attributes:
        points: Four or more, no three of the four on one line; `px` in the picture, `m` east and north.
        frame: Width and height in pixels of the picture; that of the source's newest video where it is not given.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    points: tuple[GroundPoint, ...] = Field(min_length=4)
    frame: tuple[int, int] | None = None


def standing(log: Log, station: str | None) -> dict[tuple[str, str], Standing]:
    """The zones and lines of a station (None: of all) that stand, by source and name; not those that were removed."""
    found: dict[tuple[str, str], Standing] = {}
    for event, stream, sequence in _said(log, station, (ZoneDefined, ZoneRemoved)):
        source = stream.split("/")[1]
        if isinstance(event, ZoneRemoved):
            found.pop((source, event.zone), None)
        elif isinstance(event, ZoneDefined):
            try:
                shape = shape_of(event, stream, sequence)
            except MatchError:
                continue  # rules that use it are told when they meet it
            found[source, event.zone] = Standing(event.zone, source, shape, event, stream, sequence)
    return found


def define(
    log: Log, station: str, shapes: Mapping[str, Shape], at: datetime, *, author: str | None, reason: str | None
) -> list[ZoneDefined]:
    """Record the zones and lines that are new or differ from what stands; what was recorded.

    Args:
        log: The log.
        station: This station.
        shapes: By name, each of its own source.
        at: The time of the change.
        author: Who drew them.
        reason: Why.
    """
    known = standing(log, station)
    versions = _versions(log, station)
    recorded = []
    for name, shape in shapes.items():
        now = known.get((shape.source, name))
        if now is not None and now.shape == shape:
            continue
        event = ZoneDefined(
            time=at, zone=name, kind="zone" if isinstance(shape, Zone) else "line",
            zone_version=versions.get((shape.source, name), 0) + 1, points=json.dumps(points_of(shape)),
            units=shape.units, author=author, reason=reason,
        )  # fmt: skip
        _append(log, station, shape.source, event)
        recorded.append(event)
    return recorded


def remove(
    log: Log, station: str, name: str, source: str, at: datetime, *, author: str | None, reason: str | None
) -> ZoneRemoved:
    """Record that the zone or line stands no longer.

    Raises:
        WrongUsage: The source has none of this name.
    """
    known = standing(log, station)
    if (source, name) not in known:
        raise WrongUsage(f"{source} has no zone or line {name!r}; {_there_are(known)}")
    version = known[source, name].event.zone_version
    event = ZoneRemoved(time=at, zone=name, zone_version=version, author=author, reason=reason)
    _append(log, station, source, event)
    return event


def zones_of_file(path: Path) -> dict[str, Shape]:
    """The zones and lines of a file.

    Raises:
        WrongUsage: It is not one, which is told with the place, cannot be read, has none, or two of one name.
    """
    read = _read(path, Zones, "vian zones import")
    both = sorted(set(read.zones) & set(read.lines))
    if both:
        raise WrongUsage(f"{path}: {both[0]!r} names both a zone and a line. Next: rename one")
    shapes: dict[str, Shape] = {**read.zones, **read.lines}
    if not shapes:
        raise WrongUsage(
            f"{path} has neither zones nor lines; wanted `zones:` or `lines:` as in a rule file. "
            f"Next: write one into it, or vian zones define NAME --source SOURCE --zone POINTS"
        )
    return shapes


def points_of_file(path: Path) -> Points:
    """The points of a file.

    Raises:
        WrongUsage: It is not one, which is told with the place, or cannot be read.
    """
    return _read(path, Points, "vian zones calibrate")


def calibrated(points: Sequence[GroundPoint], frame_size: tuple[int, int]) -> tuple[Calibration, float]:
    """The homography that maps the points to the ground, and how well: root mean square distance in m.

    The direct linear transform over normalised points, by singular value decomposition.

    Raises:
        WrongUsage: The points lie on a line, or on both sides of the horizon that follows from them.

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, algorithm 4.2.
    """
    image = np.array([point.px for point in points], dtype=np.float64)
    ground = np.array([point.m for point in points], dtype=np.float64)
    (from_px, scaled_px), (from_m, scaled_m) = _normalised(image), _normalised(ground)
    rows = []
    for (x, y), (east, north) in zip(scaled_px, scaled_m, strict=True):
        rows.append([-x, -y, -1, 0, 0, 0, east * x, east * y, east])
        rows.append([0, 0, 0, -x, -y, -1, north * x, north * y, north])
    _, sizes, vectors = np.linalg.svd(np.array(rows))
    if sizes[7] < 1e-9 * sizes[0]:
        raise WrongUsage("the points do not fix a calibration: three of the four lie on a line. Next: choose others")
    matrix = np.linalg.inv(from_m) @ vectors[-1].reshape(3, 3) @ from_px
    depth = np.column_stack([image, np.ones(len(image))]) @ matrix[2]
    if np.any(np.sign(depth) != np.sign(depth[0])):
        raise WrongUsage("the points lie on both sides of the horizon that follows from them. Next: check the pairs")
    matrix = matrix / np.abs(depth).max() * np.sign(depth[0])
    first, second, third = (tuple(float(value) for value in row) for row in matrix)
    calibration = Calibration((first, second, third), frame_size)  # type: ignore[arg-type]  # of a matrix of 3 x 3
    east_m, north_m = calibration.ground(image[:, 0], image[:, 1], None)
    return calibration, float(np.sqrt(np.mean((east_m - ground[:, 0]) ** 2 + (north_m - ground[:, 1]) ** 2)))


def calibrate(log: Log, station: str, source: str, calibration: Calibration, rms_m: float, now: datetime) -> int:
    """Record the source's calibration; its position in the log.

    It is of the view that the source's newest footage shows, and dated so: in a recording that may be long ago, and
    other footage of the past can show another view.
    """
    width, height = calibration.frame_size
    event = CameraCalibrated(
        time=_newest_footage(log, station, source) or now,
        homography=json.dumps(calibration.matrix),
        width=width,
        height=height,
        method="points",
        rms_m=rms_m,
        focal_px=None,
        pitch_rad=None,
        roll_rad=None,
        height_m=None,
        covariance=None,
        scale="points",
    )
    return _append(log, station, source, event)


def _newest_footage(log: Log, station: str, source: str) -> datetime | None:
    """The time of the source's newest footage that the log knows of; None: it has none."""
    types = [TrackPoint.type_name, SceneChanged.type_name]
    streams = [StreamName.of(station, source, each) for each in types]
    last = [each for stream in streams for each in log.read(stream, log.stream_head(stream).sequence)]
    times = [each.header.time_max for each in last]
    times += [event.started_at for event, _ in Said(log, station, source).every(VideoAdded)]
    newest = max(times, default=None)  # of streams in the order of time; the few segments behind it tell of others
    later = log.read_all(types=types, sources=[source], stations=[station], since=newest)
    return max((each.header.time_max for each in later), default=newest)


def frame_size_of(log: Log, station: str, source: str) -> tuple[int, int] | None:
    """Width and height of the source's newest video; None: it has none."""
    size = None
    for event, stream, _ in _said(log, station, (VideoAdded,)):
        if stream.split("/")[1] == source and isinstance(event, VideoAdded):
            size = (event.width, event.height)
    return size


def filmed(log: Log) -> set[tuple[str, str]]:
    """Station and source of what the log has videos of."""
    streams = [head.stream for head in log.streams() if head.stream.type == VideoAdded.type_name]
    return {(str(each.station), str(each.source)) for each in streams}


def undefined(log: Log, shared: Iterable[str]) -> list[str]:
    """What is to be said of each shared name that no source of the log has defined."""
    names = {name for _, name in standing(log, None)}
    return [
        f"no source of this log has defined the shared zone or line {name!r} that it uses{did_you_mean(name, names)}. "
        f"Next: vian zones define {name} --source SOURCE --zone POINTS"
        for name in shared
        if name not in names
    ]


def points_of(shape: Shape) -> list[list[float]]:
    """The corners of a zone or the two points of a line."""
    return [list(point) for point in (shape.polygon if isinstance(shape, Zone) else shape.points)]


def parsed_points(option: str, text: str) -> list[list[float]]:
    """The points that an option writes as `x,y x,y ...`, or as `x,y,x,y,...` like `vian rules new`.

    Raises:
        WrongUsage: It does not.
    """
    points = []
    parts = text.split()
    if len(parts) == 1:
        numbers = text.strip().split(",")
        parts = [",".join(numbers[at : at + 2]) for at in range(0, len(numbers), 2)]
    for part in parts:
        numbers = part.split(",")
        try:
            x, y = (float(number) for number in numbers)
        except ValueError as error:
            raise WrongUsage(
                f"{option} must be points such as '0.1,0.5 0.6,0.5 0.6,0.9', got {part!r}. Next: write them so"
            ) from error
        points.append([x, y])
    return points


def _read(path: Path, model: type[M], command: str) -> M:
    """What the YAML file says, which the command takes."""
    try:
        read, _ = read_document(Document(str(path), read_text(path)), model)
    except OSError as error:
        raise WrongUsage(f"{path} cannot be read: {error.strerror}. Next: give a YAML file") from error
    except RuleError as error:
        raise WrongUsage(f"{error}\nNext: correct {path}; {command} --help says what it holds") from error
    return read


def _normalised(points: Any) -> tuple[Any, Any]:
    """The similarity that moves the points to mean 0 and mean distance sqrt 2, and the points so moved."""
    mean = points.mean(axis=0)
    spread = float(np.sqrt(((points - mean) ** 2).sum(axis=1)).mean()) or 1.0
    scale = np.sqrt(2) / spread
    similarity = np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])
    return similarity, (points - mean) * scale


def _said(log: Log, station: str | None, types: tuple[type[EventType], ...]) -> list[tuple[EventType, str, int]]:
    """The events of these types of a station (None: of all), in the order of the log, with stream and sequence."""
    names = {str(each.type_name) for each in types}
    stations = {head.stream.station for head in log.streams()} if station is None else {station}
    streams = [head.stream for head in log.streams() if head.stream.type in names and head.stream.station in stations]
    segments = [segment for stream in streams for segment in log.read_lives(stream)]
    return [
        (event, str(segment.stream), segment.header.first_sequence + at)
        for segment in sorted(segments, key=lambda each: each.position)
        for at, event in enumerate(events_of(decode(segment, log.catalogue)))
    ]


def _versions(log: Log, station: str) -> dict[tuple[str, str], int]:
    """The highest version that each source's name ever had."""
    found: dict[tuple[str, str], int] = {}
    for event, stream, _ in _said(log, station, (ZoneDefined,)):
        assert isinstance(event, ZoneDefined)
        key = (stream.split("/")[1], event.zone)
        found[key] = max(found.get(key, 0), event.zone_version)
    return found


def _append(log: Log, station: str, source: str, event: EventType) -> int:
    """Append the event; its position."""
    stream = StreamName.of(station, source, type(event).type_name)
    expected = log.stream_head(stream).sequence
    return log.append([encode(stream, batch_of([event]), _producer())], [expected])[0].position


def _producer() -> Producer:
    return Producer("zones", VERSION, hashlib.sha256(b"zones").digest())


def _there_are(known: Mapping[tuple[str, str], Standing]) -> str:
    have = ", ".join(f"{source}/{name}" for source, name in sorted(known)) or "none"
    return f"there are: {have}"
