"""Positions on the ground and speeds, against those of a published calibration.

Estimated and true positions are of two frames of reference: they are brought together by the rigid motion of the
plane that leaves the least squares, without scale, which is part of what is measured.

Source: S. Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", 1991,
equations 40 to 42 with c = 1.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vian.evaluation.boxes import Boxes, Ints

Floats = npt.NDArray[np.float64]
WALK_MIN_MPS = 0.4
"""Who is slower over the whole track stands: the share by which the speed is off says nothing, m/s."""
STEP_S = 1.0
"""Time over which a way is measured: shorter ones measure the boxes' noise, s."""
STEPS_MIN = 2
PERCENTILES = (50, 75, 90, 95)


@dataclass(frozen=True, slots=True)
class GroundScores:
    """How far positions and speeds are off."""

    positions: int
    tracks: int
    median_m: float
    percentiles_m: dict[int, float]
    unplaced: int
    """positions that the estimated calibration puts nowhere: at or above its horizon"""
    walkers: int
    speed_ratio: float
    """median over walkers of estimated over true speed"""
    speed_error: float
    """median over walkers of how much their speed is off, as a share"""
    speed_within: float
    """share of walkers whose speed is off by at most 15 %"""


def mapped(homography: Floats, pixels_xy: Floats) -> Floats:
    """Where the pixels lie on the ground, `(n, 2)` m; NaN where W <= 0, at the horizon and above."""
    xyw = np.column_stack([pixels_xy, np.ones(len(pixels_xy))]) @ homography.T
    w = np.where(xyw[:, 2] > 0, xyw[:, 2], np.nan)
    return np.asarray(xyw[:, :2] / w[:, None])


def rigid(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Rotation `(2, 2)` and shift `(2,)` that bring `source` nearest to `target`, both `(n, 2)`."""
    middle_s, middle_t = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - middle_t).T @ (source - middle_s))
    rotation = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, middle_t - rotation @ middle_s


def ground_scores(tracks: Boxes, estimated: Floats, truth: Floats) -> GroundScores | None:
    """Scores of estimated positions; None where fewer than two can be compared.

    Args:
        tracks: The true tracks, which say whose position each row is.
        estimated: Where the row is by the calibration under test, `(n, 2)` m; NaN where it is nowhere.
        truth: Where it is by the published one, `(n, 2)` m.
    """
    is_placed = np.isfinite(estimated).all(axis=1) & np.isfinite(truth).all(axis=1)
    if is_placed.sum() < 2:
        return None
    rotation, shift = rigid(estimated[is_placed], truth[is_placed])
    moved = estimated @ rotation.T + shift
    off = np.hypot(*(moved - truth)[is_placed].T)
    ratios = np.array(list(_speed_ratios(tracks, estimated, truth)))
    wrong = np.abs(ratios - 1) if len(ratios) else np.array([np.nan])
    return GroundScores(
        positions=int(is_placed.sum()),
        tracks=len(np.unique(tracks.track_id[is_placed])),
        median_m=float(np.median(off)),
        percentiles_m={p: float(np.percentile(off, p)) for p in PERCENTILES},
        unplaced=int((~is_placed).sum()),
        walkers=len(ratios),
        speed_ratio=float(np.median(ratios)) if len(ratios) else float("nan"),
        speed_error=float(np.median(wrong)),
        speed_within=float(np.mean(wrong <= 0.15)),
    )


def _speed_ratios(tracks: Boxes, estimated: Floats, truth: Floats) -> Iterator[float]:
    """Estimated over true speed of each walker, both over the same steps."""
    for number in np.unique(tracks.track_id):
        rows = np.flatnonzero(tracks.track_id == number)
        begins, ends = _steps(tracks.time_us[rows])
        ways = [
            np.hypot(*(each[rows[ends]] - each[rows[begins]]).T) if len(begins) else np.zeros(0)
            for each in (estimated, truth)
        ]
        is_known = np.isfinite(ways[0]) & np.isfinite(ways[1])
        seconds = (tracks.time_us[rows[ends]] - tracks.time_us[rows[begins]])[is_known].sum() / 1e6
        walked = ways[1][is_known].sum()
        if is_known.sum() >= STEPS_MIN and walked >= WALK_MIN_MPS * seconds:
            yield float(ways[0][is_known].sum() / walked)


def _steps(times_us: Ints) -> tuple[Ints, Ints]:
    """First and last rows of steps of `STEP_S`, one after another."""
    begins, ends, begin = [], [], 0
    for row, time_us in enumerate(times_us):
        if time_us - times_us[begin] >= STEP_S * 1e6:
            begins.append(begin)
            ends.append(row)
            begin = row
    return np.array(begins, np.int64), np.array(ends, np.int64)
