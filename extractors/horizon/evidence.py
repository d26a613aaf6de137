"""One kind of evidence on the camera: misfits of many tracks, each with an unknown of its own.

A robust, reweighted Gauss-Newton step: misfits are Student's t with a scale that is estimated, tracks that
do not fit as a whole lose their weight (Dennis and Welsch 1978), and each track's own unknown is eliminated
exactly (Schur complement), so that a step costs time linear in the misfits.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from extractors.horizon.camera import Floats

DIFFERENCE = 1e-5
"""Step of numeric derivatives; the models are smooth and their values of order one."""

CURVATURE_MIN = 0.2
"""Below this share of the weights' Hessian most misfits are outliers, and no interval would hold."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What this evidence holds of its own besides the camera."""

    own: Floats
    """each track's unknown, `(tracks,)`"""
    noise: float
    """scale of the misfits"""


@dataclass(frozen=True, slots=True)
class Part:
    """This evidence's part of the normal equations, with the tracks' own unknowns eliminated."""

    scores: Floats
    """each track's part of the gradient, `(tracks, c)`"""
    hessians: Floats
    """each track's part of the Hessian, `(tracks, c, c)`"""
    trends: Floats
    """what the gradient would be by a misfit that grows by its usual trend over the frame, `(trends, c)`"""
    coupling: Floats
    own_hessian: Floats
    own_gradient: Floats

    def own_step(self, step: Floats) -> Floats:
        """The step of each track's unknown that goes with a step of the camera."""
        return np.asarray((self.own_gradient - self.coupling @ step) / self.own_hessian)


class Evidence(ABC):
    """Misfits of tracks under a camera."""

    def __init__(
        self,
        track: npt.NDArray[np.int64],
        tracks: int,
        *,
        weight: Floats,
        tail: float,
        noise_floor: float,
        own_spread: float,
        own_tail: float,
        trends: Floats,
    ) -> None:
        """Set the statistics.

        Args:
            track: Which track each misfit is of, `(n,)`.
            tracks: How many tracks there are.
            weight: How much each misfit counts, 0 to 1, `(n,)`.
            tail: Degrees of freedom of the misfits.
            noise_floor: Smallest scale that is believed.
            own_spread: Scale of the tracks' own unknowns about nought.
            own_tail: Their degrees of freedom.
            trends: What all misfits may have in common by where they are in the frame, one standard deviation of each
                trend, `(n, trends)`.
        """
        self._track, self._tracks, self._weight = track, tracks, weight
        self._tail, self._noise_floor = tail, noise_floor
        self._own_spread, self._own_tail, self._trends = own_spread, own_tail, trends
        self._members = csr_array((np.ones(len(track)), (track, np.arange(len(track)))), shape=(tracks, len(track)))
        self.counts = np.bincount(track, minlength=tracks)

    @abstractmethod
    def misfits(self, camera: Floats, own: Floats) -> Floats:
        """How far each observation is off, `(..., n)`; smooth in the camera and in its track's unknown.

        Args:
            camera: Its numbers, `(c,)`, or those of many cameras, `(c, ..., 1)`.
            own: The unknown of each track, `(tracks,)`.
        """

    def trends(self, camera: Floats) -> Floats:
        """One standard deviation of what all misfits may have in common, each trend by itself, `(n, trends)`."""
        return self._trends

    def settled(self, belief: Belief, misfits: Floats) -> Belief:
        """The belief with its noise adapted: one step of maximum likelihood (Lange, Little and Taylor 1989)."""
        if not len(misfits):
            return belief
        ratio = (misfits / belief.noise) ** 2
        share = np.average((self._tail + 1) / (self._tail + ratio) * ratio, weights=self._weight)
        return Belief(belief.own, float(np.clip(belief.noise * np.sqrt(share), self._noise_floor, 1.0)))

    def track_costs(self, belief: Belief, misfits: Floats) -> Floats:
        """Mean cost of each track's misfits, `(tracks,)`; about 2 where they fit."""
        costs = (self._tail + 1) * np.log1p((misfits / belief.noise) ** 2 / self._tail)
        return self._sums(costs) / np.maximum(self.counts, 1)

    def own_costs(self, belief: Belief) -> Floats:
        """Cost of each track's own unknown, `(tracks,)`."""
        return (self._own_tail + 1) * np.log1p((belief.own / self._own_spread) ** 2 / self._own_tail)

    def own_weights(self, belief: Belief) -> Floats:
        """How usual each track's own unknown is, 0 to 1, `(tracks,)`."""
        return self._own_tail / (self._own_tail + (belief.own / self._own_spread) ** 2)

    def part(
        self, camera: Floats, belief: Belief, misfits: Floats, track_weights: Floats, *, is_last: bool = False
    ) -> Part:
        """Normal equations at this camera.

        With `is_last` the Hessian is the mean one of the robust costs instead of their weights', which is larger: for
        Student's t by (v + 3) / (v + 1). Steps need the one, intervals the other (Huber 1981, section 7.6).
        """
        jacobian = self._jacobian(camera, belief.own, misfits)
        by_own = (misfits - self.misfits(camera, belief.own + DIFFERENCE)) / DIFFERENCE
        weights = self._weight * track_weights[self._track] * self._robust_weights(belief, misfits)
        own_weights = self.own_weights(belief) * (self._own_tail + 1) / self._own_tail / self._own_spread**2
        own_gradient = self._sums(weights * by_own * misfits) - own_weights * belief.own
        gradients = self._sums((weights * misfits)[:, None] * jacobian)
        if is_last:
            weights = weights * _curvature(weights, misfits / belief.noise, self._tail)
            own_weights = own_weights * _curvature(own_weights, belief.own / self._own_spread, self._own_tail)
        own_hessian = self._sums(weights * by_own**2) + own_weights
        coupling = self._sums((weights * by_own)[:, None] * jacobian)
        scores = gradients - coupling * (own_gradient / own_hessian)[:, None]
        size = len(camera)
        products = (weights[:, None, None] * jacobian[:, :, None] * jacobian[:, None, :]).reshape(-1, size * size)
        hessians = self._sums(products).reshape(-1, size, size)
        hessians -= coupling[:, :, None] * coupling[:, None, :] / own_hessian[:, None, None]
        common = self.trends(camera)
        trends = (weights[:, None] * common).T @ jacobian
        trends -= (self._sums((weights * by_own)[:, None] * common) / own_hessian[:, None]).T @ coupling
        return Part(scores, hessians, trends, coupling, own_hessian, own_gradient)

    def _robust_weights(self, belief: Belief, misfits: Floats) -> Floats:
        """Second derivative of each misfit's cost where it is nought, less where it is large, `(n,)`."""
        return np.asarray((self._tail + 1) / (self._tail + (misfits / belief.noise) ** 2) / belief.noise**2)

    def _jacobian(self, camera: Floats, own: Floats, misfits: Floats) -> Floats:
        """Derivatives of the misfits by the camera, negative, `(n, c)`."""
        moved = camera[:, None] + DIFFERENCE * np.eye(len(camera))
        return np.asarray((misfits - self.misfits(moved[:, :, None], own)).T / DIFFERENCE)

    def _sums(self, values: Floats) -> Floats:
        """Each track's sum of its misfits' values, `(tracks,)`, or of each column of them, `(tracks, columns)`."""
        return np.asarray(self._members @ values, np.float64)


def _curvature(weights: Floats, ratios: Floats, tail: float) -> float:
    """Mean second derivative of Student's cost over the mean weight, 0 to 1."""
    if not len(ratios) or not weights.sum() > 0:
        return 1.0
    share = np.average((tail - ratios**2) / (tail + ratios**2), weights=weights)
    return float(max(share, CURVATURE_MIN))
