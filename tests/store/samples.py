"""Events, drafts and owner's access that the tests of the log share."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import psycopg
import pytest

from events import (
    ActivityInterval,
    Appearance,
    CameraCalibrated,
    CheckpointCountersigned,
    CheckpointSigned,
    Draft,
    EventBatch,
    EventType,
    GroupSeen,
    HorizonEstimate,
    HorizonVote,
    LossRecorded,
    MatchedRange,
    Occupancy,
    PairDistance,
    PlateRead,
    ProcessFailed,
    ProcessFinished,
    ProcessProgressed,
    ProcessStarted,
    Producer,
    QueryAnswered,
    RequestRefused,
    RuleDeployed,
    RuleMissed,
    RuleRetired,
    SceneChanged,
    SegmentsPruned,
    SegmentsRepaired,
    SituationDetected,
    SituationShadowed,
    StageDeployed,
    StationEnrolled,
    StationRevoked,
    StreamInterrupted,
    StreamName,
    StreamResumed,
    SyncPlanned,
    Tally,
    TrackEnded,
    TrackPoint,
    VideoAdded,
    ZoneDefined,
    ZoneRemoved,
    batch_of,
    encode,
)
from store import Log

on_both = pytest.mark.parametrize("server", ["embedded", "15"], indirect=True)
"""Run on the embedded PostgreSQL and on PostgreSQL 15, the oldest that is supported."""

GOLDEN = Path(__file__).parents[1] / "events" / "golden"
NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)
PRODUCER = Producer("motion", "1.0", bytes(range(32)))
GATE = StreamName.of("brno", "gate", "track_point")
YARD = StreamName.of("brno", "yard", "track_point")


def point(frame: int, *, time: datetime | None = None, x: float = 0.0, y: float = 0.0) -> TrackPoint:
    """A track point; its frame tells it from the others."""
    return TrackPoint(
        time=time or NOON + timedelta(milliseconds=40 * frame),
        track_id=1,
        frame=frame,
        x=x,
        y=y,
        x1=1,
        y1=2,
        x2=3,
        y2=4,
        vx=5,
        vy=6,
        confidence=0.5,
    )


def points(first: int, last: int) -> EventBatch:
    """Track points of the frames `first` to `last`."""
    return batch_of([point(frame) for frame in range(first, last + 1)])


def draft(stream: StreamName, first: int, last: int) -> Draft:
    """A draft of the track points of the frames `first` to `last`."""
    return encode(stream, points(first, last), PRODUCER)


def draft_of(event: EventType, source: str = "gate", station: str = "brno") -> Draft:
    """A draft of one event, in the stream of its type."""
    return encode(StreamName.of(station, source, type(event).type_name), batch_of([event]), PRODUCER)


def append(log: Log, stream: StreamName, *counts: int) -> None:
    """Append segments of so many track points each; frames count on from the stream's head."""
    at = log.stream_head(stream).sequence
    for count in counts:
        log.append([draft(stream, at + 1, at + count)], [at])
        at += count


@contextmanager
def owner(log: Log) -> Iterator[psycopg.Connection[Any]]:
    """A connection as the database's owner."""
    with psycopg.connect(log.dsn, autocommit=True) as connection:
        yield connection


def query(log: Log, statement: str, *parameters: Any) -> list[tuple[Any, ...]]:
    """What the database's owner sees."""
    with owner(log) as connection:
        return connection.execute(statement, parameters).fetchall()


def _golden(event_type: type[EventType]) -> EventType:
    """The first of the type's golden events."""
    path = GOLDEN / f"{event_type.type_name}.v{event_type.version}.json"
    return event_type.model_validate_json(json.dumps(json.loads(path.read_text(encoding="utf-8"))[0]))


ONE_OF_EACH: tuple[EventType, ...] = (
    VideoAdded(
        time=NOON,
        video="ab" * 32,
        path="/videos/ulice ě.mp4",
        width=640,
        height=480,
        fps=None,
        frames_expected=None,
        codec="h264",
        started_at=NOON,
    ),
    ProcessStarted(
        time=NOON,
        process="p1",
        extractor="motion",
        extractor_version="1.0",
        configuration=json.dumps({"threshold": 0.5, "note": "é"}),
        video="ab" * 32,
    ),
    ProcessProgressed(time=NOON, process="p1", frames=1, events=2, note=None),
    ProcessFinished(time=NOON, process="p1", frames=1, events=2, gaps=0),
    ProcessFailed(time=NOON, process="p1", frames=1, events=2, error="it broke"),
    point(7),
    TrackEnded(
        time=NOON,
        track_id=3,
        began_at=NOON - timedelta(seconds=3),
        first_frame=1,
        last_frame=2,
        points=2,
        path_px=1.5,
        x_entry=1,
        y_entry=2,
        x_exit=3,
        y_exit=4,
        reason="lost",
        displacement_px=2.5,
        duration_s=3.0,
        x1_mean=1,
        y1_mean=2,
        x2_mean=3,
        y2_mean=4.5,
    ),
    Appearance(time=NOON, track_id=3, method="tones-2x16", descriptor=bytes(range(32)), views=5),
    ActivityInterval(
        time=NOON,
        ended_at=NOON + timedelta(seconds=9),
        first_frame=1,
        last_frame=2,
        tracks_max=3,
        area_share_max=0.25,
    ),
    SituationDetected(
        time=NOON,
        situation="cd" * 32,
        rule="yard-dwell",
        rule_version=3,
        rule_hash="ef" * 32,
        severity="alarm",
        title="track 3 has been in the yard",
        partition=json.dumps({"track_id": 3}),
        measures=json.dumps({"entered_at": "2026-01-01T12:00:00Z"}),
        began_at=NOON,
        ended_at=NOON,
        lineage=(
            MatchedRange(variable="entry", stream=str(GATE), first_sequence=1, last_sequence=2, events=2),
            MatchedRange(variable="dwell", stream=str(GATE), first_sequence=3, last_sequence=3, events=1),
        ),
    ),
    RuleDeployed(time=NOON, rule="yard-dwell", rule_version=3, rule_hash="ef" * 32, text="rule: yard-dwell\n"),
    SyncPlanned(time=NOON, central="https://central:8443", plan=json.dumps([{"stream": "*"}]), plan_hash="01" * 32),
    CheckpointSigned(
        time=NOON,
        log_position=12,
        heads=json.dumps([{"station": "brno", "sequence": 3}]),
        heads_hash="23" * 32,
        previous="00" * 32,
        key_id="45" * 8,
        algorithm="ed25519",
        signature=bytes(range(64)),
    ),
    LossRecorded(
        time=NOON,
        stream=str(GATE),
        what="events",
        count=2,
        first_sequence=4,
        last_sequence=5,
        lost_from_at=NOON - timedelta(seconds=1),
        lost_until_at=None,
        reason="the disk was full",
        policy=None,
    ),
    PlateRead(
        time=NOON,
        plate="1AB2345",
        confidence=0.75,
        frame=7,
        x1=1,
        y1=2,
        x2=3,
        y2=4,
        country="CZ",
        region=None,
        candidates=json.dumps([{"plate": "1A82345", "confidence": 0.5}]),
    ),
    SituationShadowed(
        time=NOON,
        situation="67" * 32,
        rule="yard-dwell",
        rule_version=4,
        rule_hash="89" * 32,
        severity="info",
        title="track 4 has been in the yard",
        partition=json.dumps({"track_id": 4}),
        measures="{}",
        began_at=NOON,
        ended_at=NOON,
        lineage=(),
    ),
    RuleRetired(
        time=NOON,
        rule="yard-dwell",
        rule_version=3,
        why="replaced",
        open_matches="finished",
        reason="version 4 takes over",
    ),
    RuleMissed(
        time=NOON,
        rule="yard-dwell",
        rule_version=3,
        what="late_events",
        count=2,
        stream=str(GATE),
        first_sequence=4,
        last_sequence=5,
        began_at=NOON - timedelta(seconds=1),
        ended_at=NOON,
        partition=None,
        reason="later than time.lateness (2 s) allows",
    ),
    *(
        _golden(each)
        for each in (
            CameraCalibrated,
            GroupSeen,
            HorizonEstimate,
            HorizonVote,
            Occupancy,
            PairDistance,
            SceneChanged,
            StageDeployed,
            StreamInterrupted,
            StreamResumed,
            Tally,
            ZoneDefined,
            ZoneRemoved,
            CheckpointCountersigned,
            QueryAnswered,
            RequestRefused,
            SegmentsPruned,
            SegmentsRepaired,
            StationEnrolled,
            StationRevoked,
        )
    ),
)
