"""Events and looks at a log that the tests of the composition root share."""

import json
from datetime import UTC, datetime, timedelta
from typing import Any

from events import Catalogue, EventBatch, Producer, StreamName, TrackPoint, batch_of, encode
from store import Log

START = datetime(2026, 1, 1, 10, tzinfo=UTC)
GATE = StreamName.of("brno", "gate", "track_point")
YARD = StreamName.of("brno", "yard", "track_point")
PRODUCER = Producer("tests", "1", bytes(32))


def reopened(log: Log) -> Log:
    """Another handle on the same log, as another process has it."""
    return Log(log.dsn, Catalogue.shipped())


def points(count: int, *, first_frame: int = 0, x: float = 1.0) -> EventBatch:
    """Track points, one a second from `START`."""
    return batch_of([_point(first_frame + number, x) for number in range(count)])


def _point(frame: int, x: float) -> TrackPoint:
    time = START + timedelta(seconds=frame)
    return TrackPoint(time=time, track_id=1, frame=frame, x=x, y=2, x1=0, y1=0, x2=2, y2=2, vx=0, vy=0, confidence=0.5)


def append(log: Log, batch: EventBatch, stream: StreamName = GATE) -> None:
    """Append a batch behind the head of a stream."""
    log.append([encode(stream, batch, PRODUCER)], [log.stream_head(stream).sequence])


def heads(log: Log) -> dict[str, tuple[int, str]]:
    """Sequence and chain hash of each stream."""
    return {str(head.stream): (head.sequence, head.chain_hash.hex()) for head in log.streams()}


def objects(out: str) -> list[dict[str, Any]]:
    """What a command printed with --json, one object a line."""
    return [json.loads(line) for line in out.splitlines()]
