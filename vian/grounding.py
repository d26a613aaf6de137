"""Track points on the ground: position, speed and how well both are known, as a table that queries may name.

Contract: nothing is stored. Each point is read through the calibration of its own source and station that was valid at
its time, or, where the camera had the same view, through one that the query names by its position in the log; so a
later, better calibration changes no event, and the same points can be read through both. A calibration is valid from
its own time until the camera is moved; of several that are valid the one that was said last counts. One that people
gave holds for what its view showed before, too: where none is valid, the first of them that was said of the same view
counts. Where there is none of these, metres are null; where a calibration says no uncertainty, the deviations are. The
view of PostgreSQL means the same.
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
Integers = NDArray[np.int64]
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

    @property
    def is_given(self) -> bool:
        """Whether people gave it: what tracks say of a camera has a covariance."""
        return self.covariance is None


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What the log says of a source's camera, each in the order in which it was said."""

    calibrations: list[Calibrated]
    moves_us: list[int]
    """when it was moved, ascending"""
    sizes: list[tuple[int, tuple[int, int]]]
    """width and height of its frames, each from a position of the log on"""


def track_ground(
    points: pa.Table, calibrations: pa.Table, videos: pa.Table, changes: pa.Table, position: int | None
) -> pa.Table:
    """The points with their place on the ground.

    Args:
        points: Rows of `track_point`.
        calibrations: Rows of `camera_calibrated`, of all times.
        videos: Rows of `video_added`, of all times: which frame sizes a source's points are of.
        changes: Rows of `scene_changed`, of all times: when cameras were moved.
        position: Of the calibration to use throughout its view; None: for each point the one valid at its time.
    """
    metres = np.full((len(_METRES), len(points)), np.nan)
    used = np.zeros(len(points), np.int64)
    known = _by_source(calibrations, videos, changes, position)
    for each, rows in _of_sources(points, known):
        own = points.take(pa.array(rows))
        through = _valid(each, _microseconds(own), is_named=position is not None)
        for number in np.unique(through[through >= 0]):
            at = np.flatnonzero(through == number)
            calibration = each.calibrations[number]
            metres[:, rows[at]] = _mapped(own.take(pa.array(at)), calibration, each.sizes)
            used[rows[at]] = calibration.position
    table = points.select(_POINT)
    for name, values in zip(_METRES, metres, strict=True):
        table = table.append_column(name, pa.array(values, from_pandas=True))
    return table.append_column("calibration_position", pa.array(used, mask=used == 0))


def _valid(known: Known, time_us: Integers, *, is_named: bool) -> Integers:
    """For each time the number of the calibration that counts, `(n,)`; -1 where there is none."""
    through = np.full(len(time_us), -1, np.int64)
    view = _views(known, time_us)
    said_of = _views(known, np.array([each.time_us for each in known.calibrations], np.int64))
    for number, each in enumerate(known.calibrations):
        through[(view == said_of[number]) & (is_named | (time_us >= each.time_us))] = number
    for number, each in enumerate(known.calibrations):
        if each.is_given:
            through[(view == said_of[number]) & (through < 0)] = number
    return through


def _views(known: Known, time_us: Integers) -> Integers:
    """How often the camera had been moved by these times: which of its views it had."""
    return np.searchsorted(np.array(known.moves_us, np.int64), time_us, "right")


def _of_sources(points: pa.Table, known: dict[Key, Known]) -> Iterator[tuple[Known, Integers]]:
    """What is known of each source that has a calibration, with its rows."""
    index = {key: at for at, key in enumerate(known)}
    keys = zip(points.column("station").to_pylist(), points.column("source").to_pylist(), strict=True)
    of = np.array([index.get(key, -1) for key in keys], np.int64)
    for key, at in index.items():
        if known[key].calibrations:
            yield known[key], np.flatnonzero(of == at)


def _mapped(points: pa.Table, calibration: Calibrated, sizes: list[tuple[int, tuple[int, int]]]) -> Floats:
    """The metres of these points, `(6, n)`."""
    wide, high = _scales(points, calibration.frame_size, sizes)
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


def _scales(points: pa.Table, to: tuple[int, int], sizes: list[tuple[int, tuple[int, int]]]) -> tuple[Floats, Floats]:
    """Pixels of the calibration for one of each point, across and down, `(n,)`; 1 where no video is known."""
    if not sizes:
        return np.ones(len(points)), np.ones(len(points))
    position = points.column("position").to_numpy()
    at = np.searchsorted([start for start, _ in sizes[1:]], position, "right")
    width, height = np.array([size for _, size in sizes], np.float64)[at].T
    return to[0] / width, to[1] / height


def _by_source(calibrations: pa.Table, videos: pa.Table, changes: pa.Table, position: int | None) -> dict[Key, Known]:
    """What is known of each source; of calibrations only those at the position, if it is named."""
    found: dict[Key, Known] = {}

    def of(row: dict[str, Any]) -> Known:
        return found.setdefault((row["station"], row["source"]), Known([], [], []))

    for row in _said(calibrations):
        if position is None or row["position"] == position:
            of(row).calibrations.append(_calibrated(row))
    for row in _said(videos):
        of(row).sizes.append((row["position"], (row["width"], row["height"])))
    for row in _said(changes):
        if row["cause"] == "moved":
            of(row).moves_us.append(microseconds(row["time"]))
    for each in found.values():
        each.moves_us.sort()
    return found


def _said(rows: pa.Table) -> list[dict[str, Any]]:
    """The rows in the order in which they were said."""
    ordered: list[dict[str, Any]] = rows.sort_by([("position", "ascending"), ("sequence", "ascending")]).to_pylist()
    return ordered


def _microseconds(points: pa.Table) -> Integers:
    return np.asarray(points.column("time").cast(pa.int64()).to_numpy())


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
