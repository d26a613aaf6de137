"""How large an object is that stands at a place in the picture.

Objects of one kind that stand upright on a plane have a height in the picture that is about
`h = k (y - slope x - offset)`, with `(x, y)` the ground contact point and `y = slope x + offset` the
horizon. `SizeLearner` fits that to the boxes of confirmed tracks as they come, robustly, and says how sure it
is; `LearntSizes` is what the rest of the method asks.

It abstains where the tracks do not decide: few of them, sizes of several kinds, objects that are not
upright (vehicles come in too many lengths to be told apart by size), places far from all that was seen.

Sources: the relation: D. Hoiem et al., "Putting Objects in Perspective", CVPR 2006, equation 3, with roll.
The fit: P. J. Huber, "Robust Estimation of a Location Parameter", 1964, by reweighted least squares.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from extractors.motion.config import MotionConfig

Array = npt.NDArray[np.float64]

ROUNDS = 12
"""Rounds of reweighting; the fit stands still to a thousandth after eight."""
HUBER = 1.5
"""Residuals beyond so many deviations count less."""
INLIER = 3.0
"""Residuals within so many deviations belong to the kind."""
MAD_TO_DEVIATION = 1.4826
"""Standard deviation of a normal distribution, of its median absolute deviation."""
DEVIATION_FLOOR = 0.03
"""No fit claims a smaller relative deviation: boxes are not measured better."""

PRECISION = np.diag([1.0, 25.0, 0.0])
"""Of what the coefficients are beforehand: k about 0 to 1 px/px, and k slope within 0.2 px/px."""


@dataclass(frozen=True, slots=True, eq=False)
class Sizes:
    """Expected sizes of n objects, px of the analysed picture; NaN where nothing is known."""

    height: Array
    """`(n,)` px"""
    width: Array
    """`(n,)` px"""
    deviation: Array
    """relative standard deviation of the height: of the kind, and of what is known of it, `(n,)`"""


@dataclass(frozen=True, slots=True, eq=False)
class LearntSizes:
    """A fitted relation."""

    coefficients: Array
    """of `h = a y + b x + c`, `(3,)`: k, -k slope, -k offset"""
    covariance: Array
    """of the coefficients, `(3, 3)`"""
    aspect: float
    """width of an object, of its height"""
    spread: float
    """relative standard deviation of heights within the kind"""
    deviation_max: float
    """expectations less sure than this are not given"""

    def expected(self, feet_xy: Array) -> Sizes:
        """Sizes of upright objects with these ground contact points, `(n, 2)` px."""
        design = _design(feet_xy)
        height = design @ self.coefficients
        unsure = np.sqrt(np.einsum("ni,ij,nj->n", design, self.covariance, design))
        with np.errstate(divide="ignore", invalid="ignore"):
            deviation = np.hypot(self.spread, unsure / height)
            known = (height > 1) & (deviation <= self.deviation_max)
        height = np.where(known, height, np.nan)
        return Sizes(height, self.aspect * height, np.where(known, deviation, np.nan))


class SizeLearner:
    """Gathers boxes of tracks, and fits the relation anew now and then."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._samples: deque[tuple[int, Array]] = deque(maxlen=config.size_samples_max)
        self._last: dict[int, Array] = {}
        self._fresh = 0

    def add(self, track_id: int, box_xywh: Array) -> None:
        """Take in a clear view of a confirmed track, unless it is where the last one was.

        Args:
            track_id: Its number.
            box_xywh: The measured box, `x y w h` px.
        """
        last = self._last.get(track_id)
        if last is not None and np.hypot(*(box_xywh[:2] - last[:2])) < self._config.size_step * last[3]:
            return
        self._last[track_id] = box_xywh
        self._samples.append((track_id, box_xywh))
        self._fresh += 1

    def forget(self, track_id: int) -> None:
        """The track has ended; what it showed stays."""
        self._last.pop(track_id, None)

    @property
    def is_due(self) -> bool:
        """Whether so many views are new that a fit may say something else."""
        return self._fresh >= max(self._config.size_samples_min // 4, len(self._samples) // 8)

    def learnt(self) -> LearntSizes | None:
        """The relation, from the views so far; None where they do not decide."""
        self._fresh = 0
        config = self._config
        tracks = len({track_id for track_id, _ in self._samples})
        if tracks < config.size_tracks_min or len(self._samples) < config.size_samples_min:
            return None
        return fitted(np.array([box for _, box in self._samples]), tracks, config)


def fitted(boxes_xywh: Array, tracks: int, config: MotionConfig) -> LearntSizes | None:
    """The relation that the boxes follow; None where they follow none.

    Args:
        boxes_xywh: `x y w h` px, `(n, 4)`.
        tracks: From how many tracks they are: boxes of one track are wrong together.
        config: The parameters.
    """
    design, heights = _design(boxes_xywh[:, :2]), boxes_xywh[:, 3]
    coefficients = np.array([0.0, 0.0, float(np.median(heights))])
    deviation = 0.5
    weights = np.ones(len(heights))
    for _ in range(ROUNDS):
        expected = np.maximum(design @ coefficients, 1)
        residuals = heights / expected - 1
        deviation = max(DEVIATION_FLOOR, MAD_TO_DEVIATION * float(np.median(np.abs(residuals))))
        weights = np.minimum(1, HUBER * deviation / np.maximum(np.abs(residuals), 1e-9)) / expected**2
        coefficients = np.linalg.solve(*_normal(design, heights, weights, deviation**2 * PRECISION))
    residuals = heights / np.maximum(design @ coefficients, 1) - 1
    is_inlier = np.abs(residuals) <= INLIER * deviation
    aspect = float(np.median(boxes_xywh[is_inlier, 2] / heights[is_inlier])) if is_inlier.any() else np.inf
    if deviation > config.size_spread_max or is_inlier.mean() < config.size_share_min or aspect > config.aspect_max:
        return None
    normal, _ = _normal(design, heights, weights, deviation**2 * PRECISION)
    together = len(heights) / tracks
    covariance: Array = np.asarray(deviation**2 * together * np.linalg.inv(normal), np.float64)
    return LearntSizes(coefficients, covariance, aspect, deviation, config.size_deviation_max)


def _design(feet_xy: Array) -> Array:
    return np.stack([feet_xy[:, 1], feet_xy[:, 0], np.ones(len(feet_xy))], axis=1)


def _normal(design: Array, heights: Array, weights: Array, ridge: Array) -> tuple[Array, Array]:
    """Left and right side of the normal equations."""
    weighted = design * weights[:, None]
    return design.T @ weighted + ridge, weighted.T @ heights
