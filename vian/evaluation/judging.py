"""Estimators over scenes of known horizon, and what it comes to."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vian.evaluation.estimators import HorizonEstimator
from vian.evaluation.lines import Horizon, auc, error_of, is_covered, is_in_region
from vian.evaluation.scenes import Scene


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What one estimator said of one scene."""

    method: str
    scene: Scene
    estimate: Horizon | None
    error: float
    """image heights; infinite where it abstained"""

    @property
    def is_covered(self) -> bool | None:
        """Whether the interval holds the truth; None without one."""
        if self.estimate is None or self.estimate.covariance is None:
            return None
        return is_covered(self.estimate, self.scene.truth, self.scene.width)

    @property
    def is_in_region(self) -> bool | None:
        """Whether the region of slope and offset holds the truth; None without one."""
        if self.estimate is None or self.estimate.covariance is None:
            return None
        return is_in_region(self.estimate, self.scene.truth)


@dataclass(frozen=True, slots=True)
class Summary:
    """What one estimator came to over all scenes; an abstention counts as an error without bound."""

    method: str
    scenes: int
    abstained: int
    median: float
    """image heights"""
    percentile_75: float
    percentile_90: float
    auc: float
    coverage: float | None
    """share of intervals of the height in the middle of the image that hold the truth; None without intervals"""
    coverage_region: float | None
    """share of regions of slope and offset that hold it"""


def judged(scenes: Sequence[Scene], estimators: Iterable[HorizonEstimator]) -> Iterator[Judged]:
    """Each estimator on each scene."""
    for estimator in estimators:
        for scene in scenes:
            estimate = estimator.estimate(scene.boxes, scene.width, scene.height)
            yield Judged(estimator.name, scene, estimate, error_of(estimate, scene.truth, scene.width, scene.height))


def summaries(found: Sequence[Judged]) -> list[Summary]:
    """One a method, in their order."""
    methods = dict.fromkeys(each.method for each in found)
    return [_summary(method, [each for each in found if each.method == method]) for method in methods]


def _summary(method: str, found: Sequence[Judged]) -> Summary:
    errors = np.array([each.error for each in found])
    # Between a finite and an infinite error there is no number to interpolate: their mean is infinite.
    low, high = (np.quantile(errors, 0.5, method=side) for side in ("lower", "higher"))
    quartile, decile = (np.quantile(errors, q, method="higher") for q in (0.75, 0.9))
    return Summary(
        method=method,
        scenes=len(errors),
        abstained=int(np.isinf(errors).sum()),
        median=float((low + high) / 2),
        percentile_75=float(quartile),
        percentile_90=float(decile),
        auc=auc([float(each) for each in errors]),
        coverage=_share([each.is_covered for each in found]),
        coverage_region=_share([each.is_in_region for each in found]),
    )


def _share(said: Sequence[bool | None]) -> float | None:
    known = [each for each in said if each is not None]
    return float(np.mean(known)) if known else None
