"""Track points on the ground: position, speed and how well both are known, as a table that queries may name.

Contract: nothing is stored. Each point is read through the newest calibration of its own source and station that was
valid at its time, or through one that the query names by its position in the log; so a later, better calibration
changes no event, and the same points can be read through both. Where there is no calibration, metres are null; where a
calibration says no uncertainty, the deviations are.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from events.segment import microseconds
from extractors.calibration.ground import ground_of

_POINT = ("station", "source", "subject", "time", "sequence", "position", "track_id", "frame", "x", "y")
_METRES = ("ground_x", "ground_y", "ground_speed", "ground_x_deviation", "ground_y_deviation", "ground_speed_deviation")
"""m east, m north, m/s, and their standard deviations."""

Floats = NDArray[np.float64]
Key = tuple[str, str]
"""Station and source."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """One calibration of a source, from its time on."""

    time_us: int
    position: int
    homography: Floats
    camera: tuple[float, float, float, float] | None
    covariance: Floats | None
    frame_size: tuple[int, int]


def track_ground(points: pa.Table, calibrations: pa.Table, videos: pa.Table, position: int | None) -> pa.Table:
    """The points with their place on the ground.

    Args:
        points: Rows of `track_point`.
        calibrations: Rows of `camera_calibrated`, of all times.
        videos: Rows of `video_added`, of all times: which frame size the points of a source are of.
        position: Of the calibration to use throughout; None: for each point the one that was valid at its time.
    """
    known = _by_source(calibrations, position)
    sizes = {(row["station"], row["source"]): (row["width"], row["height"]) for row in _in_time(videos)}
    keys = list(zip(points.column("station").to_pylist(), points.column("source").to_pylist(), strict=True))
    time_us = points.column("time").cast(pa.int64()).to_numpy()
    metres = np.full((len(_METRES), len(points)), np.nan)
    used = np.zeros(len(points), np.int64)
    for rows, calibration, key in _uses(keys, time_us, known, position is not None):
        metres[:, rows] = _mapped(points.take(pa.array(rows)), calibration, sizes.get(key))
        used[rows] = calibration.position
    table = points.select(_POINT)
    for name, values in zip(_METRES, metres, strict=True):
        table = table.append_column(name, pa.array(values, from_pandas=True))
    return table.append_column("calibration_position", pa.array(used, mask=used == 0))


def _uses(
    keys: list[Key], time_us: NDArray[np.int64], known: dict[Key, list[Calibrated]], is_named: bool
) -> Iterator[tuple[NDArray[np.int64], Calibrated, Key]]:
    """Which rows are read through which calibration."""
    index = {key: at for at, key in enumerate(known)}
    of = np.array([index.get(key, -1) for key in keys], np.int64)
    for key, at in index.items():
        rows = np.flatnonzero(of == at)
        begins = np.array([each.time_us for each in known[key]])
        chosen = np.zeros(len(rows), np.int64) if is_named else np.searchsorted(begins, time_us[rows], "right") - 1
        for number in np.unique(chosen[chosen >= 0]):
            yield rows[chosen == number], known[key][number], key


def _mapped(points: pa.Table, calibration: Calibrated, frame_size: tuple[int, int] | None) -> Floats:
    """The metres of these points, `(6, n)`."""
    wide, high = 1.0, 1.0
    if frame_size is not None:
        wide, high = (to / of for to, of in zip(calibration.frame_size, frame_size, strict=True))
    x, y, vx, vy, y1, y2 = (
        points.column(name).to_numpy().astype(np.float64) for name in ("x", "y", "vx", "vy", "y1", "y2")
    )
    ground = ground_of(
        x * wide,
        y * high,
        vx * wide,
        vy * high,
        (y2 - y1) * high,
        calibration.homography,
        calibration.camera,
        calibration.covariance,
        calibration.frame_size,
    )
    return np.array(
        [
            *(ground.east, ground.north, ground.speed),
            *(ground.east_deviation, ground.north_deviation, ground.speed_deviation),
        ]
    )


def _by_source(calibrations: pa.Table, position: int | None) -> dict[Key, list[Calibrated]]:
    """Each source's calibrations in order of time; of a named position the last only."""
    found: dict[Key, list[Calibrated]] = {}
    for row in _in_time(calibrations):
        if position is None or row["position"] == position:
            each = found.setdefault((row["station"], row["source"]), [])
            each[:] = [*(each if position is None else ()), _calibrated(row)]
    return found


def _in_time(rows: pa.Table) -> list[dict[str, Any]]:
    order = [("time", "ascending"), ("position", "ascending"), ("sequence", "ascending")]
    ordered: list[dict[str, Any]] = rows.sort_by(order).to_pylist()
    return ordered


def _calibrated(row: dict[str, Any]) -> Calibrated:
    focal, pitch, roll, height = (row[name] for name in ("focal_px", "pitch_rad", "roll_rad", "height_m"))
    camera = None if None in (focal, pitch, roll, height) else (focal, pitch, roll, height)
    covariance = None if row["covariance"] is None else np.array(json.loads(row["covariance"]), np.float64)
    return Calibrated(
        time_us=microseconds(row["time"]),
        position=row["position"],
        homography=np.array(json.loads(row["homography"]), np.float64),
        camera=camera,
        covariance=covariance,
        frame_size=(row["width"], row["height"]),
    )
