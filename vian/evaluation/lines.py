"""Horizons as lines, and how far an estimated one is from the true one.

A horizon is `y = slope x + offset` in pixels of the whole frame, origin top-left, y down; its covariance
is that of (slope, offset).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, norm

Floats = npt.NDArray[np.float64]
AUC_MAX = 0.25
"""Error at which the curve of `auc` ends, image heights."""
INTERVAL = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Horizon:
    """A horizon, true or estimated."""

    slope: float
    """px/px"""
    offset: float
    """y at x = 0, px"""
    covariance: Floats | None = None
    """of (slope, offset), `(2, 2)`; None where nobody said"""

    def at(self, x: npt.ArrayLike) -> Floats:
        """Its y at x, px."""
        return np.asarray(self.slope * np.asarray(x, float) + self.offset)

    def sd_at(self, x: npt.ArrayLike) -> Floats:
        """Standard deviation of its y at x, px."""
        assert self.covariance is not None, "an interval needs a covariance"
        basis = np.stack([np.asarray(x, float), np.ones_like(x, float)])
        return np.asarray(np.sqrt(np.einsum("i...,ij,j...->...", basis, self.covariance, basis)))

    def reach_at(self, x: npt.ArrayLike) -> Floats:
        """How far its 95 % interval reaches to either side at x, px."""
        return np.asarray(norm.ppf((1 + INTERVAL) / 2) * self.sd_at(x))

    def scaled(self, factor_x: float, factor_y: float) -> "Horizon":
        """The same horizon in pixels of a frame of another size."""
        factors = np.array([factor_y / factor_x, factor_y])
        covariance = None if self.covariance is None else self.covariance * np.outer(factors, factors)
        return Horizon(self.slope * factors[0], self.offset * factors[1], covariance)


def error_of(estimated: Horizon | None, truth: Horizon, width: int, height: int) -> float:
    """Largest vertical distance of the two within the image, over its height; infinite for no estimate."""
    if estimated is None:
        return float("inf")
    ends = np.array([0.0, width - 1.0])  # the distance of two lines is largest at an end
    return float(np.abs(estimated.at(ends) - truth.at(ends)).max() / height)


def auc(errors: Sequence[float], error_max: float = AUC_MAX) -> float:
    """Area under the share of scenes with at most so large an error, from 0 to `error_max`, over its largest.

    >>> auc([0.0, 0.125, float("inf")])
    0.5
    """
    return float(np.mean(np.clip(1 - np.asarray(errors) / error_max, 0, 1)))


def is_covered(estimated: Horizon, truth: Horizon, width: int) -> bool:
    """Whether the 95 % interval of the horizon's height in the middle of the image holds the true one."""
    middle = (width - 1) / 2
    return bool(abs(estimated.at(middle) - truth.at(middle)) <= estimated.reach_at(middle))


def is_in_region(estimated: Horizon, truth: Horizon) -> bool:
    """Whether the 95 % region of (slope, offset) holds the true line."""
    assert estimated.covariance is not None, "a region needs a covariance"
    off = np.array([estimated.slope - truth.slope, estimated.offset - truth.offset])
    return bool(off @ np.linalg.solve(estimated.covariance, off) <= chi2.ppf(INTERVAL, 2))
