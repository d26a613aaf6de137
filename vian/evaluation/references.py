"""Two plain ways to the horizon, which the estimator of `extractors.horizon` is measured beside.

Both take a box's lower middle for the foot, its height for the object's, and each track for a rigid upright object.
They are references: no robust start, no abstention beyond too little data.
"""

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from vian.evaluation.boxes import Boxes
from vian.evaluation.lines import Horizon

Floats = npt.NDArray[np.float64]
POINTS_A_TRACK = 12
"""Boxes of a track that are paired with each other, spread over its length."""
GROWTH_MIN = 0.15
"""Pairs whose heights differ less say nothing of where their lines meet, of the larger height: twice what a noisy box's
height is off, 5 to 8 %."""
TRACKS_MIN, BOXES_MIN = 2, 10
ROUNDS = 20
"""Of reweighting."""


class VoteLine:
    """Method A: each pair of a track's boxes votes for a point of the horizon; a robust line through the votes."""

    name = "A"

    def estimate(self, boxes: Boxes, width: int, height: int) -> Horizon | None:
        """The line, without a covariance; None where there are no votes."""
        votes, weights = _votes(boxes)
        if len(votes) < TRACKS_MIN:
            return None
        # Votes near each other in x do not fix a slope: a weak pull to the level, half a picture's height at its edge.
        x = (votes[:, 0] - width / 2) / width
        slope, level = _robust_line(x, votes[:, 1] / height, weights)
        slope = slope * height / width
        return Horizon(float(slope), float(level * height - slope * width / 2))


class SizeRelation:
    """Method B: `h = k (y - a x - c)` with one k a track, by least squares that bound what one box says."""

    name = "B"

    def estimate(self, boxes: Boxes, width: int, height: int) -> Horizon | None:
        """The line and its covariance; None where there are too few boxes or they do not fix it."""
        tracks = [track for track in boxes.by_track() if len(track) >= BOXES_MIN]
        if len(tracks) < TRACKS_MIN:
            return None
        scale = np.array([height / width, height])

        def residuals(line: Floats) -> Floats:
            return np.concatenate([_unexplained(track, line * scale, width) for track in tracks])

        fits = [
            least_squares(residuals, [0.0, level], loss="soft_l1", f_scale=0.1, max_nfev=100)
            for level in (-1.0, -0.3, 0.1)
        ]
        fit = min(fits, key=lambda each: each.cost)
        information = fit.jac.T @ fit.jac
        if not fit.success or np.linalg.cond(information) > 1e12:
            return None
        spread = (fit.fun**2).sum() / max(1, len(fit.fun) - 2 - len(tracks))
        slope, level = fit.x * scale
        # Level is at the middle of the picture, offset at its left edge.
        to_line = np.array([[1.0, 0.0], [-width / 2, 1.0]]) * scale
        covariance = to_line @ np.linalg.inv(information) @ to_line.T * spread
        return Horizon(float(slope), float(level - slope * width / 2), covariance)


def _votes(boxes: Boxes) -> tuple[Floats, Floats]:
    """Points `(n, 2)` px where lines through feet and heads of one object at two times meet, and their weights."""
    votes, weights = [np.zeros((0, 2))], [np.zeros(0)]
    for track in boxes.by_track():
        some = np.unique(np.linspace(0, len(track) - 1, POINTS_A_TRACK).round().astype(int))
        i, j = (some[each] for each in np.triu_indices(len(some), 1))
        feet, h = track.feet_xy, track.heights
        growth = (h[i] - h[j]) / np.maximum(h[i], h[j])
        i, j, growth = (each[np.abs(growth) >= GROWTH_MIN] for each in (i, j, growth))
        # p = foot1 + h1 / (h1 - h2) (foot2 - foot1)
        votes.append(feet[i] + (h[i] / (h[i] - h[j]))[:, None] * (feet[j] - feet[i]))
        weights.append(growth**2)
    return np.concatenate(votes), np.concatenate(weights)


def _robust_line(x: Floats, y: Floats, weights: Floats) -> tuple[float, float]:
    """Slope and level of the line that leaves the least weighted sum of absolute distances, by reweighting."""
    basis = np.stack([x, np.ones_like(x)], axis=1)
    line = np.array([0.0, np.median(y)])
    for _ in range(ROUNDS):
        w = weights / np.maximum(np.abs(y - basis @ line), 1e-3)
        normal = basis.T @ (w[:, None] * basis) + np.diag([1e-3 * w.sum(), 0.0])
        line = np.linalg.solve(normal, basis.T @ (w * y))
    return float(line[0]), float(line[1])


def _unexplained(track: Boxes, line: Floats, width: int) -> Floats:
    """What of the heights the relation leaves, as shares of them, with the k that leaves least."""
    feet, h = track.feet_xy, track.heights
    depth = (feet[:, 1] - line[0] * (feet[:, 0] - width / 2) - line[1]) / h
    k = depth.sum() / max(float((depth**2).sum()), 1e-12)
    return np.asarray(1 - k * depth)
