"""A log of tracks that walk in and out of a yard, and rules over it, for the tests of the processor."""

from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Any

from events import (
    EventType,
    ProcessFinished,
    Producer,
    SituationDetected,
    StreamName,
    TrackPoint,
    VideoAdded,
    batch_of,
    decode,
    encode,
    events_of,
)
from patterns.files.loading import parse_rule
from patterns.files.rule import Rule
from store import Log

T0 = datetime(2026, 1, 1, 10, tzinfo=UTC)
STATION = "brno"
PRODUCER = Producer("motion", "1", bytes(32))


def rule(name: str = "enters", *, version: int = 1, source: str = "gate", **changed: str) -> Rule:
    """A track comes into the right half of the picture."""
    parts = {
        "partition": "source, track_id",
        "measures": "inside.time AS entered_at, inside.x AS x",
        "pattern": "(outside inside)",
        "skip": "SKIP PAST LAST ROW",
        "time": "{lateness: 1 s}",
        "more": "",
    } | changed
    return parse_rule(f"""
rule: {name}
version: {version}
title: "track {{track_id}} came in"
severity: warning
zones: {{yard: {{source: {source}, polygon: [[0.5, 0], [1, 0], [1, 1], [0.5, 1]]}}}}
time: {parts["time"]}
{parts["more"]}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY {parts["partition"]} ORDER BY time, sequence
    MEASURES {parts["measures"]}
    ONE ROW PER MATCH AFTER MATCH {parts["skip"]}
    PATTERN {parts["pattern"]}
    DEFINE outside AS NOT in_zone(outside.x, outside.y, 'yard'), inside AS in_zone(inside.x, inside.y, 'yard'))
""")


def point(track: int, second: float, x: float) -> TrackPoint:
    """Where a track is."""
    rest = dict.fromkeys(("y", "x1", "y1", "x2", "y2", "vx", "vy"), 10.0)
    return TrackPoint(
        time=T0 + timedelta(seconds=second), track_id=track, frame=int(second * 10), x=x, confidence=1.0, **rest
    )


def say(log: Log, source: str, *events: EventType) -> None:
    """Append the events as one segment."""
    stream = StreamName.of(STATION, source, events[0].type_name)
    log.append([encode(stream, batch_of(events), PRODUCER)])


def add_video(log: Log, source: str) -> None:
    """The source's frames have 100 x 100 pixels."""
    size: dict[str, Any] = {"width": 100, "height": 100, "fps": 10.0, "frames_expected": 10, "codec": "h264"}
    say(log, source, VideoAdded(time=T0, video="00", path="v", started_at=T0, **size))


def end(log: Log, source: str, second: float = 60.0) -> None:
    """The source will say no more."""
    at = T0 + timedelta(seconds=second)
    say(log, source, ProcessFinished(time=at, process="p", frames=1, events=1, gaps=0))


def walk(log: Log, seconds: Iterable[int], source: str = "gate", tracks: int = 3) -> None:
    """Tracks that go in and out of the right half, a second a segment."""
    for second in seconds:
        inside = [(track + second) % 4 < 2 for track in range(tracks)]
        say(log, source, *(point(t + 1, second, 80 if i else 20) for t, i in enumerate(inside)))


def walkers(log: Log, source: str = "gate", tracks: int = 3, seconds: int = 12) -> None:
    """A whole video of such tracks."""
    add_video(log, source)
    walk(log, range(seconds), source, tracks)
    end(log, source)


def said(log: Log, type_name: str) -> list[Any]:
    """All events of a type, in order of position."""
    segments = log.read_all(types=[type_name])
    return [event for segment in segments for event in events_of(decode(segment, log.catalogue))]


def situations(log: Log) -> list[SituationDetected]:
    """All situations, in order of position."""
    return said(log, "situation_detected")


def heads(log: Log) -> list[tuple[str, int, bytes]]:
    """Where every stream stands, with its chain."""
    return [(str(head.stream), head.sequence, head.chain_hash) for head in log.streams()]
