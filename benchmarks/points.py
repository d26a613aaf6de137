"""Realistic track points: a hundred cameras, people who walk, boxes that tremble. The same for the same seed."""

from datetime import UTC, datetime
from functools import cache

import numpy as np
import pyarrow as pa

from events import EventBatch, Producer, StreamName, TrackPoint, schema_of

CAMERAS = 100
TRACKS = 12
"""tracks that a camera sees at once"""
PRODUCER = Producer("motion", "1.0", bytes(range(32)))
START = datetime(2026, 1, 1, tzinfo=UTC)
_START_US = int(START.timestamp()) * 1_000_000
_FRAME_US = 40_000


def stream(camera: int) -> StreamName:
    """The stream of a camera, whatever its number."""
    return StreamName.of("brno", f"cam-{camera % CAMERAS:03}", "track_point")


@cache
def points(count: int, seed: int) -> EventBatch:
    """So many consecutive track points of one camera: frame by frame, track by track."""
    rng = np.random.default_rng(seed)
    index = np.arange(count)
    track, frame = index % TRACKS, index // TRACKS
    frames = -(-count // TRACKS)
    path = rng.normal(0, 1.5, (TRACKS, frames, 2)).cumsum(axis=1) + rng.uniform(100, 900, (TRACKS, 1, 2))
    x, y = path[track, frame].T
    width, height = rng.uniform(20, 40, TRACKS)[track], rng.uniform(50, 110, TRACKS)[track]
    tremble = rng.normal(0, 0.7, (4, count))
    columns = {
        "time": pa.array(_START_US + (seed * frames + frame) * _FRAME_US, pa.timestamp("us", "UTC")),
        "track_id": 1 + seed * TRACKS + track,
        "frame": seed * frames + frame,
        "x": x,
        "y": y,
        "x1": x - width / 2 + tremble[0],
        "y1": y - height + tremble[1],
        "x2": x + width / 2 + tremble[2],
        "y2": y + tremble[3],
        "vx": rng.normal(0, 40, count),
        "vy": rng.normal(0, 15, count),
        "confidence": rng.uniform(0.4, 1.0, count),
    }
    schema = schema_of(TrackPoint)
    arrays = [pa.array(columns[field.name]).cast(field.type, safe=False) for field in schema]
    return EventBatch(TrackPoint, pa.RecordBatch.from_arrays(arrays, schema=schema))


def row_batch(batch: EventBatch, camera: int, first_sequence: int) -> pa.RecordBatch:
    """The batch as rows of a table that has to say whose they are: source and sequence in front."""
    count = len(batch)
    front = [
        pa.repeat(pa.scalar(stream(camera).source, pa.string()), count),
        pa.array(np.arange(first_sequence, first_sequence + count, dtype=np.int64)),
    ]
    names = ["source", "sequence", *batch.data.schema.names]
    return pa.RecordBatch.from_arrays([*front, *batch.data.columns], names=names)


def whole_row_batch(batch: EventBatch, camera: int, first_sequence: int) -> pa.RecordBatch:
    """The batch as rows that say what a segment says of its events: station, epoch and when recorded, too."""
    rows = row_batch(batch, camera, first_sequence)
    count = len(batch)
    front = [
        pa.repeat(pa.scalar(stream(camera).station, pa.string()), count),
        pa.repeat(pa.scalar(1, pa.int32()), count),
        pa.repeat(pa.scalar(START, pa.timestamp("us", "UTC")), count),
    ]
    names = ["station", "epoch", "recorded_at", *rows.schema.names]
    return pa.RecordBatch.from_arrays([*front, *rows.columns], names=names)
