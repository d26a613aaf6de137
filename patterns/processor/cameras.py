"""What a log says of its cameras, for rules that read it from a position on: also what it says only later.

Contract: what the log says up to the position is known there. Of what it says first behind that, the first word holds
from the beginning on: a zone that was drawn when the footage was in the log already holds for all of it. Calibrations
hold for one view of the camera, from one move to the next:

- one that people gave, the first of its view, for the view's whole footage, if nothing else was known of it by then;
- one that was found afterwards, which is dated at the beginning of what it was found from (footage, or a change of the
  scene), from there on: it is learnt with the event that begins there;
- one that was found while the footage came, from its turn on, as it did then.

How far the log was read for that is a position, too: who reads again from the same position, as far, learns the same,
whatever has been said since.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from events import (
    CameraCalibrated,
    Catalogue,
    EventType,
    SceneChanged,
    Segment,
    UnknownType,
    VideoAdded,
    ZoneDefined,
    ZoneRemoved,
    decode,
    events_of,
)
from patterns.scene.site import SITE_TYPES, is_move
from store import Log

EventId = tuple[str, int, int]
"""Stream, epoch and sequence."""


@dataclass(frozen=True, slots=True)
class SiteEvent:
    """An event that says something of a camera, and where it stands in the log."""

    event: EventType
    stream: str
    sequence: int
    epoch: int = 1
    position: int = 0

    @property
    def id(self) -> EventId:
        """What it has alone in the whole log."""
        return self.stream, self.epoch, self.sequence

    @property
    def source(self) -> str:
        """The source of its stream."""
        return self.stream.split("/")[1]

    @property
    def camera(self) -> str:
        """The station and source of its stream."""
        return self.stream.rsplit("/", 1)[0]

    @property
    def about(self) -> tuple[object, ...]:
        """What it is about: a camera's frames, moves or calibration, or one of its zones or lines."""
        what: str = self.event.type_name
        if isinstance(self.event, ZoneDefined | ZoneRemoved):
            what = "zone"
        return self.camera, what, getattr(self.event, "zone", None)


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of the cameras at a position of the log.

    Attributes:
        said: What is known there, in the order in which it is learnt.
        words: What is learnt with an event that follows, by the event's id.
        read_to: How far the log was read; None: to its end.
    """

    said: tuple[SiteEvent, ...] = ()
    words: Mapping[EventId, SiteEvent] = field(default_factory=dict)
    read_to: int | None = None

    @property
    def to_position(self) -> int:
        """Behind this position of the log nothing is known before its turn; 0: nothing is anywhere."""
        return max((each.position for each in (*self.said, *self.words.values())), default=0)


def known_at(log: Log, position: int, to_position: int | None = None) -> Known:
    """What is known of the cameras when the log is read from a position on.

    Args:
        log: The log.
        position: What is said up to there is known.
        to_position: How far the log is read for what holds before its turn; None: to its end.
    """
    said: list[SiteEvent] = []
    later: dict[tuple[object, ...], SiteEvent] = {}
    cameras: dict[str, _Camera] = {}
    for each in _said_of_cameras(log, to_position if to_position is None else max(position, to_position)):
        cameras.setdefault(each.camera, _Camera()).add(each)
        if each.position <= position:
            said.append(each)
        elif not isinstance(each.event, CameraCalibrated | SceneChanged):
            later.setdefault(each.about, each)
    about = {each.about for each in said}
    said += [each for each in later.values() if each.about not in about]
    said += [word for camera in cameras.values() if (word := camera.word_at(position)) is not None]
    words = {key: word for each in cameras.values() for key, word in each.words_behind(position)}
    return Known(tuple(said), words, to_position)


@dataclass(slots=True)
class _Part:
    """Footage of one camera from one event on, in which calibrations may be said to begin."""

    by: SiteEvent | None
    began: datetime | None
    is_view: bool
    """whether a move began it, or nothing did"""
    given: SiteEvent | None = None
    found: SiteEvent | None = None

    @property
    def word(self) -> SiteEvent | None:
        """What holds from its beginning."""
        return self.given if self.found is None else self.found


@dataclass(slots=True)
class _Camera:
    """The parts of one camera's footage, in the order of the log; the first begins with its first video."""

    parts: list[_Part] = field(default_factory=lambda: [_Part(None, None, is_view=True)])
    said: list[SiteEvent] = field(default_factory=list)

    def add(self, said: SiteEvent) -> None:
        event = said.event
        if isinstance(event, VideoAdded):
            if self.parts[0].began is None:
                self.parts[0].began = event.started_at
            self.parts.append(_Part(said, event.started_at, is_view=False))
        elif isinstance(event, SceneChanged):
            self.parts.append(_Part(said, event.time, is_view=is_move(event)))
        elif isinstance(event, CameraCalibrated):
            self.said.append(said)
            self._calibrate(said, event)

    def _calibrate(self, said: SiteEvent, event: CameraCalibrated) -> None:
        if event.covariance is None:
            views = [part for part in self.parts if part.is_view and (part.by is None or _since(part) <= event.time)]
            view = _newest(views)
            view.given = view.given or said
            return
        for part in self.parts:
            if event.time == part.began or (part.by is None and self._is_before_footage(event.time)):
                part.found = said

    def _is_before_footage(self, time: datetime) -> bool:
        """Whether it is before the first footage, which no older footage has followed."""
        began = [_since(part) for part in self.parts if part.by is not None and isinstance(part.by.event, VideoAdded)]
        return bool(began) and time <= began[0] == min(began)

    def word_at(self, position: int) -> SiteEvent | None:
        """What holds there and is said only behind it; None: nothing."""
        begun = [part for part in self.parts if part.by is None or part.by.position <= position]
        view = _newest([part for part in begun if part.is_view])
        of_view = [part.found for part in begun if part is view or _is_since(part, view)]
        found = [each for each in of_view if each is not None]
        word = max(found, key=lambda each: (each.position, each.sequence)) if found else view.given
        if word is None or word.position <= position:
            return None
        return word if found or not self._stands_at(position, view) else None

    def _stands_at(self, position: int, view: _Part) -> bool:
        """Whether a calibration of the view was said by then."""
        said = (each for each in self.said if each.position <= position)
        return any(view.by is None or each.event.time >= _since(view) for each in said)

    def words_behind(self, position: int) -> Iterator[tuple[EventId, SiteEvent]]:
        """What is learnt with each event behind the position that begins a part."""
        for part in self.parts:
            if part.by is not None and part.by.position > position and part.word is not None:
                yield part.by.id, part.word


def _newest(views: Sequence[_Part]) -> _Part:
    """Of views in the order of the log the one that began last; of several that began at once the first."""
    first, *moved = views
    return max(moved, key=_since, default=first)


def _is_since(part: _Part, view: _Part) -> bool:
    """Whether the part began with the view or later."""
    return part.by is not None and (view.by is None or _since(part) >= _since(view))


def _since(part: _Part) -> datetime:
    assert part.began is not None, "an event began it"
    return part.began


def _said_of_cameras(log: Log, to_position: int | None) -> Iterator[SiteEvent]:
    """All that the log says of the cameras, in order."""
    names = {str(each.type_name) for each in SITE_TYPES}
    streams = {head.stream for head in log.streams() if head.stream.type in names}
    segments = [each for stream in streams for each in log.read_lives(stream)]
    for segment in sorted(segments, key=lambda each: each.position):
        if to_position is None or segment.position <= to_position:
            yield from site_events(segment, _events(segment, log.catalogue))


def site_events(segment: Segment, events: Iterable[EventType]) -> Iterator[SiteEvent]:
    """The events of a segment, each with where it stands."""
    stream, epoch = str(segment.stream), segment.header.epoch
    for sequence, event in enumerate(events, segment.header.first_sequence):
        yield SiteEvent(event, stream, sequence, epoch, segment.position)


def _events(segment: Segment, catalogue: Catalogue) -> Iterator[EventType]:
    try:
        yield from events_of(decode(segment, catalogue))
    except UnknownType:
        return  # counted and logged where the segment is read in its turn
