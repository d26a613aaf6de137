"""What the log has said of the cameras: frame sizes, shared zones and lines, calibrations and what ends them.

A site learns from events in the order in which they stand in the log, so what it knows depends on
the log alone. Rows are judged by what is known when they become final; for each version of a zone,
line or calibration the site remembers from which event time on rows were judged by it, and which
event said it, so that a match can name what it was judged by.

A calibration is of the view that its camera had at its time, whichever is said first. One from before the newest move
is of a view that is no more, and is left out; of two that are valid the one that was said last counts.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from events import CameraCalibrated, EventType, SceneChanged, VideoAdded, ZoneDefined, ZoneRemoved
from events.segment import microseconds
from patterns.errors import MatchError
from patterns.scene.geometry import FrameSize, Line, Zone
from patterns.scene.ground import Calibration

Shape = Zone | Line

SITE_TYPES: tuple[type[EventType], ...] = (VideoAdded, ZoneDefined, ZoneRemoved, CameraCalibrated, SceneChanged)
"""The event types that a site learns from."""
VERSIONS_MOST = 100
"""Versions of one zone, line or calibration that are remembered for lineage; older ones are forgotten."""
CALIBRATION = ""
"""The name under which a source's calibration is kept, beside its zones and lines."""


@dataclass(frozen=True, slots=True)
class Version:
    """One version of a zone, line or calibration of a source.

    Attributes:
        said: What was said; None: it was removed.
        stream: Stream of the event that said it; empty where no event did.
        sequence: The event's sequence there.
        from_us: Rows of this event time and later were judged by it, in microseconds; None: all rows before, too.
        epoch: The epoch of its station: in each of them sequences begin at 1.
        time_us: When a calibration begins to be valid, in microseconds; None: nothing says it.
    """

    said: Shape | Calibration | None
    stream: str = ""
    sequence: int = 0
    from_us: int | None = None
    epoch: int = 1
    time_us: int | None = None

    def comes_after(self, known: "Version") -> bool:
        """Whether it counts from now on where the other is what is known."""
        if self.stream != known.stream or not self.stream:
            return True
        mine, other = (self.epoch, self.sequence), (known.epoch, known.sequence)
        if mine == other:
            return False  # It was known before its turn, and has held since then.
        if self.time_us is None or known.time_us is None:
            return True
        return mine > other or self.time_us < known.time_us


@dataclass(slots=True)
class Site:
    """All that is known of the cameras.

    Attributes:
        frame_sizes: For each source, (width, height) in pixels.
        versions: For each source and name (of a zone or line, or `CALIBRATION`) the versions, oldest first.
        moved_us: For each source when its camera was moved last, in microseconds.
    """

    frame_sizes: dict[str, FrameSize] = field(default_factory=dict)
    versions: dict[tuple[str, str], list[Version]] = field(default_factory=dict)
    moved_us: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        frame_sizes: Mapping[str, FrameSize] | None = None,
        shapes: Mapping[str, Iterable[Shape]] | None = None,
        calibrations: Mapping[str, Calibration] | None = None,
    ) -> "Site":
        """A site where these hold from the beginning; `shapes` are by shared name, each for its own source."""
        site = cls(dict(frame_sizes or {}))
        for name, each in (shapes or {}).items():
            for shape in each:
                site.versions[shape.source, name] = [Version(shape)]
        for source, calibration in (calibrations or {}).items():
            site.versions[source, CALIBRATION] = [Version(calibration)]
        return site

    def copy(self) -> "Site":
        """The same, to change without changing this one."""
        versions = {key: list(each) for key, each in self.versions.items()}
        return Site(dict(self.frame_sizes), versions, dict(self.moved_us))

    def take(self, other: "Site") -> None:
        """Takes in all that the other knows; where both know something, the other's word counts."""
        self.frame_sizes.update(other.frame_sizes)
        self.versions.update({key: list(each) for key, each in other.versions.items()})
        self.moved_us.update(other.moved_us)

    def shapes(self, name: str, kind: type[Zone] | type[Line]) -> list[Shape]:
        """The zones or lines that bear this shared name now, one for each source that has it."""
        found = [each[-1].said for (_, known), each in self.versions.items() if known == name and name != CALIBRATION]
        return [each for each in found if isinstance(each, kind) and isinstance(each, Zone | Line)]

    def calibration(self, source: str) -> Calibration | None:
        """The source's calibration now."""
        versions = self.versions.get((source, CALIBRATION))
        said = versions[-1].said if versions else None
        return said if isinstance(said, Calibration) else None

    def learn(
        self, event: EventType, stream: str, sequence: int, from_us: int | None = None, *, epoch: int = 1
    ) -> bool:
        """Takes in an event; whether it changed anything that is known. Events of other types change nothing.

        Args:
            event: The event.
            stream: Its stream, as station/source/type.
            sequence: Its sequence there.
            from_us: Rows before this event time have been judged already; None: none has.
            epoch: The epoch of the stream's station.

        Raises:
            MatchError: The event says no zone, line or calibration.
        """
        source = stream.split("/")[1]
        if isinstance(event, VideoAdded):
            changed = self.frame_sizes.get(source) != (event.width, event.height)
            self.frame_sizes[source] = (event.width, event.height)
            return changed
        if isinstance(event, ZoneDefined | ZoneRemoved):
            said = shape_of(event, stream, sequence) if isinstance(event, ZoneDefined) else None
            return self._add((source, event.zone), Version(said, stream, sequence, from_us, epoch))
        if isinstance(event, CameraCalibrated):
            said_of, time_us = calibration_of(event, stream, sequence), microseconds(event.time)
            if time_us < self.moved_us.get(source, time_us):
                return False
            return self._add((source, CALIBRATION), Version(said_of, stream, sequence, from_us, epoch, time_us))
        if not is_move(event):
            return False
        moved_us = microseconds(event.time)
        is_newest = moved_us > self.moved_us.get(source, moved_us - 1)
        if is_newest:
            self.moved_us[source] = moved_us
        if not self._is_calibrated_before(source, moved_us):
            return is_newest
        return self._add((source, CALIBRATION), Version(None, stream, sequence, from_us, epoch))

    def judged_by(self, name: str, sources: Iterable[str], first_us: int, last_us: int) -> list[Version]:
        """The versions, said by events, that rows of these sources and times (both inclusive) were judged by."""
        found: dict[tuple[str, int], Version] = {}
        for source in sorted(sources):
            versions = self.versions.get((source, name), [])
            ends = [each.from_us for each in versions[1:]] + [None]
            for version, end_us in zip(versions, ends, strict=False):
                begins = version.from_us is None or version.from_us <= last_us
                if begins and (end_us is None or end_us > first_us) and version.said is not None and version.stream:
                    found.setdefault((version.stream, version.sequence), version)
        return list(found.values())

    def to_json(self) -> dict[str, Any]:
        """What `from_json` takes."""
        return {
            "frame_sizes": self.frame_sizes,
            "versions": [
                [source, name, [_version_json(each) for each in versions]]
                for (source, name), versions in self.versions.items()
            ],
            "moved_us": self.moved_us,
        }

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> "Site":
        """The site that `to_json` gave."""
        sizes = {source: (width, height) for source, (width, height) in saved["frame_sizes"].items()}
        versions = {
            (source, name): [Version(_said(said), *rest) for said, *rest in each]
            for source, name, each in saved["versions"]
        }
        return cls(sizes, versions, dict(saved.get("moved_us", {})))

    def _is_calibrated_before(self, source: str, time_us: int) -> bool:
        """Whether the source's calibration now is of an earlier time, or of none that is known."""
        if self.calibration(source) is None:
            return False
        since_us = self.versions[source, CALIBRATION][-1].time_us
        return since_us is None or since_us < time_us

    def _add(self, key: tuple[str, str], version: Version) -> bool:
        versions = self.versions.setdefault(key, [])
        if versions and not version.comes_after(versions[-1]):
            return False
        self.versions[key] = [*versions, version][-VERSIONS_MOST:]
        return True


def is_move(event: EventType) -> bool:
    """Whether the event says that the camera was moved, so that its calibration holds no longer."""
    return isinstance(event, SceneChanged) and event.cause == "moved"


def shape_of(event: ZoneDefined, stream: str, sequence: int) -> Shape:
    """The zone or line that the event draws.

    Raises:
        MatchError: It is none.
    """
    source = stream.split("/")[1]
    try:
        points = json.loads(event.points)
        if event.kind == "zone":
            return Zone(source=source, units=event.units, polygon=points)
        return Line(source=source, units=event.units, points=points)
    except (ValidationError, ValueError) as error:
        raise MatchError(f"{stream}/{sequence} defines no {event.kind} {event.zone!r}: {_first(error)}") from error


def calibration_of(event: CameraCalibrated, stream: str, sequence: int) -> Calibration:
    """The calibration that the event says.

    Raises:
        MatchError: It is none.
    """
    try:
        rows = [tuple(float(value) for value in row) for row in json.loads(event.homography)]
        first, second, third = rows
        return Calibration((first, second, third), (event.width, event.height))  # type: ignore[arg-type]  # it checks that each has three
    except (TypeError, ValueError) as error:
        raise MatchError(f"{stream}/{sequence} says no calibration: {error}") from error


def _first(error: ValueError) -> str:
    return (
        str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        if isinstance(error, ValidationError)
        else str(error)
    )


def _version_json(each: Version) -> list[Any]:
    return [_said_json(each.said), each.stream, each.sequence, each.from_us, each.epoch, each.time_us]


def _said_json(said: Shape | Calibration | None) -> Any:
    if said is None:
        return None
    if isinstance(said, Calibration):
        return {"matrix": said.matrix, "frame_size": said.frame_size}
    return said.model_dump(mode="json")


def _said(saved: Any) -> Shape | Calibration | None:
    if saved is None:
        return None
    if "matrix" in saved:
        first, second, third = (tuple(row) for row in saved["matrix"])
        width, height = saved["frame_size"]
        return Calibration((first, second, third), (width, height))
    return (Zone if "polygon" in saved else Line).model_validate(saved)
