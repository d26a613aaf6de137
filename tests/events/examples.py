"""One plain event of a few types, with any field changed by name."""

from datetime import UTC, datetime
from typing import Any

from events import (
    CameraCalibrated,
    Draft,
    EventBatch,
    MatchedRange,
    Producer,
    RuleDeployed,
    SituationDetected,
    StreamName,
    SyncPlanned,
    TrackPoint,
)
from events.segment import draft_of, encode_payload

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)
PRODUCER = Producer("motion", "1.0.0", bytes(range(32)))


def unchecked(stream: StreamName, batch: EventBatch) -> Draft:
    """The batch as a draft without the door's questions: what an older program may have stored."""
    return draft_of(stream, batch, PRODUCER, encode_payload(batch))


def track_point(**changed: Any) -> TrackPoint:
    plain = {"time": NOON, "track_id": 1, "frame": 0, "confidence": 1.0}
    plain |= dict.fromkeys(("x", "y", "x1", "y1", "x2", "y2", "vx", "vy"), 0.0)
    return TrackPoint(**(plain | changed))


def camera_calibrated(**changed: Any) -> CameraCalibrated:
    plain = {"time": NOON, "homography": "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "width": 100, "height": 100}
    plain |= {"method": "points", "rms_m": None, "scale": "points", "covariance": None}
    plain |= dict.fromkeys(("focal_px", "pitch_rad", "roll_rad", "height_m"))
    return CameraCalibrated(**(plain | changed))


def rule_deployed(**changed: Any) -> RuleDeployed:
    plain = {"time": NOON, "rule": "dwell", "rule_version": 1, "rule_hash": "00", "text": "rule: dwell"}
    return RuleDeployed(**(plain | changed))


def sync_planned(**changed: Any) -> SyncPlanned:
    plain = {"time": NOON, "central": "https://central.example", "plan": "[]", "plan_hash": "00"}
    return SyncPlanned(**(plain | changed))


def situation(*variables: str, **changed: Any) -> SituationDetected:
    lineage = tuple(
        MatchedRange(variable=name, stream="s/cam/track_point", first_sequence=1, last_sequence=2, events=2)
        for name in variables
    )
    plain = {
        "time": NOON,
        "situation": "00",
        "rule": "dwell",
        "rule_version": 1,
        "rule_hash": "00",
        "severity": "info",
        "title": "dwells",
        "partition": "{}",
        "measures": "{}",
        "began_at": NOON,
        "ended_at": NOON,
        "lineage": lineage,
    }
    return SituationDetected(**(plain | changed))
