"""The rules that the pattern engine is measured with, and rows for them. The same for the same seed.

Tracks walk on closed paths of one to three minutes that lead through a zone and over a line; ten points a
second each. Plates are read at eight gates, each plate about once in a hundred seconds. A tenth of the
rows arrives late, by up to the lateness, so the arrival is not the order of time.
"""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

LATENESS_US = 2_000_000
SIZE_PX = 1000.0
STATION = "brno"
_START_US = int(datetime(2026, 1, 1, tzinfo=UTC).timestamp()) * 1_000_000
_POINT_US = 100_000
_GATES = 8

_ZONE_INTRUSION = """rule: NAME
version: 1
severity: warning
title: "track {track_id} has been in the zone since {entered_at:%H:%M:%S}"
time: {lateness: 2 s}
zones: {yard: {source: cam-01, units: pixels, polygon: POLYGON}}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY source, track_id
    ORDER BY time, sequence
    MEASURES entry.time AS entered_at, dwell.time AS fired_at
    ONE ROW PER MATCH
    AFTER MATCH SKIP PAST LAST ROW
    PATTERN (apart entry stay*? dwell) WITHIN INTERVAL '1' MINUTE
    DEFINE apart AS NOT in_zone(apart.x, apart.y, 'yard'),
           entry AS in_zone(entry.x, entry.y, 'yard'),
           stay AS in_zone(stay.x, stay.y, 'yard') AND stay.time < entry.time + INTERVAL '10' SECOND,
           dwell AS in_zone(dwell.x, dwell.y, 'yard') AND dwell.time >= entry.time + INTERVAL '10' SECOND)
"""
_YARD = "[[560, 320], [980, 360], [900, 700], [740, 560], [580, 690]]"

RULES: dict[str, str] = {
    "zone intrusion": _ZONE_INTRUSION.replace("NAME", "yard-dwell").replace("POLYGON", _YARD),
    "A then B": """rule: a-then-b
version: 1
severity: info
title: "plate {plate} was at A and then at B, {took} later"
time: {lateness: 2 s}
match: |
  SELECT * FROM plate_read MATCH_RECOGNIZE (
    PARTITION BY plate
    ORDER BY time, sequence
    MEASURES a.time AS at_a, b.time AS at_b, b.time - a.time AS took
    ONE ROW PER MATCH
    AFTER MATCH SKIP PAST LAST ROW
    PATTERN (a other*? b) WITHIN INTERVAL '60' SECOND
    DEFINE a AS a.source = 'gate-0',
           other AS other.source <> 'gate-1',
           b AS b.source = 'gate-1')
""",
    "line crossing": """rule: door
version: 1
severity: info
title: "track {track_id} crossed the line at {crossed_at:%H:%M:%S}"
time: {lateness: 2 s}
lines: {door: {source: cam-01, units: pixels, points: [[500, 1000], [500, 0]]}}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY source, track_id
    ORDER BY time, sequence
    MEASURES after.time AS crossed_at, after.x AS x, after.y AS y
    ONE ROW PER MATCH
    AFTER MATCH SKIP TO LAST after
    PATTERN (before after) WITHIN INTERVAL '5' SECOND
    DEFINE after AS crosses(PREV(after.x), PREV(after.y), after.x, after.y, 'door', 'any'))
""",
}
"""Rule files by what they find."""


def zone_rules(count: int, sides_px: tuple[float, float] = (60.0, 180.0)) -> list[str]:
    """So many rules of the first kind, each with a zone of its own.

    Args:
        count: How many.
        sides_px: The least and the greatest length of a zone's sides, px; the larger, the more tracks stay in it.
    """
    rng = np.random.default_rng(7)
    texts = []
    for number in range(count):
        x, y = rng.uniform(50, 980 - sides_px[1], 2)
        width, height = rng.uniform(*sides_px, 2)
        corners = [[x, y], [x + width, y + height / 4], [x + width * 0.8, y + height], [x + width / 5, y + height]]
        polygon = str([[round(float(value), 1) for value in corner] for corner in corners])
        texts.append(_ZONE_INTRUSION.replace("NAME", f"yard-{number:03}").replace("POLYGON", polygon))
    return texts


def rows(rule: str, keys: int, events: int, seed: int = 1) -> pa.Table:
    """So many events for a rule of `RULES`, of this many tracks or plates, in the order in which they arrive."""
    table = _MAKERS[rule](keys, events, np.random.default_rng(seed))
    times = table.column("time").cast(pa.int64()).to_numpy()
    rng = np.random.default_rng(seed + 1)
    delays = np.where(rng.random(events) < 0.1, rng.integers(0, LATENESS_US, events), 0)
    return table.take(pa.array(np.argsort(times + delays, kind="stable"))).combine_chunks()


def _track_points(keys: int, events: int, rng: np.random.Generator) -> pa.Table:
    index = np.arange(events)
    track, frame = index % keys, index // keys
    time_us = frame * _POINT_US + track * _POINT_US // keys
    period, phase = rng.uniform(60, 180, keys), rng.uniform(0, 2 * np.pi, keys)
    reach = rng.uniform(50, 450, (2, keys))
    angle = phase[track] + 2 * np.pi * time_us / 1e6 / period[track]
    x = SIZE_PX / 2 + reach[0][track] * np.cos(angle) + rng.normal(0, 1, events)
    y = SIZE_PX / 2 + reach[1][track] * np.sin(angle) + rng.normal(0, 1, events)
    more = {
        "track_id": pa.array(track + 1),
        "x": pa.array(x.astype(np.float32)),
        "y": pa.array(y.astype(np.float32)),
        "confidence": pa.array(np.ones(events, dtype=np.float32)),
    }
    return _table("track_point", time_us, pa.repeat(pa.scalar("cam-01"), events), index + 1, more)


def _plate_reads(keys: int, events: int, rng: np.random.Generator) -> pa.Table:
    time_us = np.sort(rng.integers(0, events * 100_000_000 // keys, events))
    gate = rng.integers(0, _GATES, events)
    names = pa.array([f"gate-{number}" for number in range(_GATES)])
    plates = pa.array([f"{number:07X}" for number in range(keys)])
    more = {"plate": plates.take(pa.array(rng.integers(0, keys, events)))}
    return _table("plate_read", time_us, names.take(pa.array(gate)), _numbered(gate), more)


def _numbered(streams: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each row its number within its stream, from 1."""
    order = np.argsort(streams, kind="stable")
    counts = np.bincount(streams, minlength=_GATES)
    numbers = np.empty(len(streams), dtype=np.int64)
    numbers[order] = np.arange(len(streams)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    return numbers


def _table(kind: str, time_us: NDArray[np.int64], source: Any, sequence: Any, more: dict[str, Any]) -> pa.Table:
    count = len(time_us)
    front = {
        "station": pa.repeat(pa.scalar(STATION), count),
        "source": source,
        "type": pa.repeat(pa.scalar(kind), count),
        "subject": pa.nulls(count, pa.string()),
        "sequence": pa.array(sequence),
        "time": pa.array(_START_US + time_us, pa.timestamp("us", "UTC")),
    }
    return pa.table({**front, **more})


_MAKERS: dict[str, Callable[[int, int, np.random.Generator], pa.Table]] = {
    "zone intrusion": _track_points,
    "A then B": _plate_reads,
    "line crossing": _track_points,
}
