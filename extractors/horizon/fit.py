"""The camera under which all tracks agree best, and with it the horizon and its covariance.

Maximum posterior over tilt, roll, focal length, usual size, a bias of all boxes, and usual pace, from the
evidence of box heights (`heights`) and of paces (`paces`), with an unknown of each track's own in each. The
covariance is a sandwich over tracks: it holds when what one track says is off as a whole, as for a blob
without its feet.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from extractors.horizon.camera import Floats, FrameSize, Line, horizon_of
from extractors.horizon.config import HorizonConfig
from extractors.horizon.evidence import DIFFERENCE, Belief, Part
from extractors.horizon.heights import Heights
from extractors.horizon.paces import Paces
from extractors.horizon.places import Places

SEEKING_STEPS = 7
"""Gauss-Newton steps from each start, after which the best one goes on."""
STEPS_MAX = 30
"""Further steps from there."""
SETTLED = 3e-4
"""A step this short in every parameter is the last."""
STEP_MAX = np.array([0.15, 0.15, 0.3, 0.5, 0.005, 0.5, 0.05])
"""Longest step in each parameter of the camera."""
VIEW = 3
"""Of the camera's parameters the first so many are what it sees: tilt, roll, focal length."""
CHANCE = float(chi2.ppf(0.95, VIEW))
"""Squared distance, in covariances, beyond which two estimates of a view contradict each other."""
LEVERAGE_MIN = 0.05
"""Share of its own information that a track is at least taken to lack; alone it cannot contradict itself."""
TRACKS_FEW = 3.0
"""Degrees of freedom below which the interval is not widened any more."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A camera and how well it is known."""

    camera: Floats
    """`tilt (rad), roll (rad), log of focal length (px), log of usual size (camera heights), bias of box
    heights (frame heights), log of usual pace (camera heights per s), depth of objects (their heights)`"""
    covariance: Floats
    """of them, `(7, 7)`"""
    line: Line
    line_covariance: Floats
    """of slope and offset, `(2, 2)`"""
    noise: float
    """typical error of a box's edge, share of its height"""
    aspect: float
    """height over width of most boxes"""
    cost: float
    """twice the negative log posterior, up to a constant"""
    track_weights: Floats
    """how much of each track is believed, 0 to 1"""

    def widened(self, factor: float) -> Self:
        """The fit with covariances this many times as large."""
        return replace(self, covariance=self.covariance * factor, line_covariance=self.line_covariance * factor)

    def as_sure_as(self, other: Self) -> Self:
        """The fit with the covariances of another, and what lies between the two as another deviation."""
        off = self.camera - other.camera
        line_off = np.array([self.line.slope - other.line.slope, self.line.offset - other.line.offset])
        return replace(
            self,
            covariance=other.covariance + np.outer(off, off),
            line_covariance=other.line_covariance + np.outer(line_off, line_off),
        )

    def deviation_at(self, x: float) -> float:
        """Standard deviation of the horizon's height at `x`, px."""
        at = np.array([x, 1.0])
        return float(np.sqrt(at @ self.line_covariance @ at))


def fitted(places: Places, size: FrameSize, config: HorizonConfig, starts: Iterable[tuple[float, float]]) -> Fit:
    """The best fit over all starts `(tilt, roll)`, rad."""
    problem = _Problem(places, size, config)
    found = [problem.descended(problem.start(tilt, roll), SEEKING_STEPS) for tilt, roll in starts]
    state = problem.descended(min(found, key=lambda state: state.cost), STEPS_MAX)
    fit = problem.judged(state)
    if not places.is_clear.all():
        fit = fit.as_sure_as(_again(places.clear(), state, size, config))
    halves = [_again(half, state, size, config) for half in places.halves()]
    return fit.widened(_contradiction(*halves)) if len(halves) == 2 else fit


def _again(part: Places, state: "_State", size: FrameSize, config: HorizonConfig) -> Fit:
    """The fit to a part of the places, from the camera that all of them gave."""
    problem = _Problem(part, size, config)
    return problem.judged(problem.descended(problem.beginning_at(state.camera), STEPS_MAX))


def _contradiction(one: Fit, other: Fit) -> float:
    """Squared distance of two fits' tilt, roll and focal length over the largest that chance explains; 1 at least.

    Source: the scale factor for results that contradict each other: Birge, Phys. Rev. 40 (1932) 207.
    """
    off = (one.camera - other.camera)[:VIEW]
    covariance = (one.covariance + other.covariance)[:VIEW, :VIEW]
    return max(float(off @ np.linalg.solve(covariance, off)) / CHANCE, 1.0)


@dataclass(frozen=True, slots=True)
class _State:
    camera: Floats
    heights: Belief
    paces: Belief
    cost: float = np.inf


@dataclass(frozen=True, slots=True)
class _Normal:
    heights: Part
    paces: Part
    prior: Floats
    prior_gradient: Floats
    track_weights: Floats

    @property
    def scores(self) -> Floats:
        return self.heights.scores + self.paces.scores

    @property
    def trends(self) -> Floats:
        return np.concatenate([self.heights.trends, self.paces.trends])

    @property
    def hessians(self) -> Floats:
        return self.heights.hessians + self.paces.hessians

    @property
    def hessian(self) -> Floats:
        return np.asarray(self.hessians.sum(axis=0) + self.prior)

    def step(self) -> Floats:
        gradient = self.scores.sum(axis=0) + self.prior_gradient
        return np.clip(np.linalg.solve(self.hessian, gradient), -STEP_MAX, STEP_MAX)


class _Problem:
    """The evidence, the priors, and one step of the method."""

    def __init__(self, places: Places, size: FrameSize, config: HorizonConfig) -> None:
        self._size, self._config, self._aspect = size, config, places.aspect
        self._tracks = int(places.track.max()) + 1
        self._heights = Heights(places, self._tracks, size, config)
        self._paces = Paces(places, self._tracks, size, config)
        focal, usual_size, pace = config.focal_widths * size.width, config.size_median, config.pace_median
        tilt, tilt_spread, roll_spread = np.radians([config.tilt_deg, config.tilt_spread_deg, config.roll_spread_deg])
        self._prior_mean = np.array([tilt, 0.0, np.log(focal), np.log(usual_size), 0.0, np.log(pace), config.depth])
        spreads = [
            tilt_spread,
            roll_spread,
            config.focal_spread,
            config.size_spread,
            config.bias_lines,
            config.pace_usual_spread,
            config.depth_spread,
        ]
        self._prior = np.diag(1 / np.square(spreads))

    def start(self, tilt: float, roll: float) -> _State:
        """A state with this view, and the size and pace that the median place has under it."""
        camera = self._prior_mean.copy()
        camera[:2] = tilt, roll
        camera[3] = self._heights.usual_size(camera)
        camera[5] = self._paces.usual_pace(camera)
        return self.beginning_at(camera)

    def beginning_at(self, camera: Floats) -> _State:
        """A state with this camera, and tracks of which nothing is known."""
        nothing = np.zeros(self._tracks)
        return _State(camera, Belief(nothing, 0.1), Belief(nothing, 0.2))

    def descended(self, state: _State, steps_max: int) -> _State:
        """The state after steps until it settles."""
        for _ in range(steps_max):
            state, normal = self._normal(state)
            step = normal.step()
            state = _State(
                state.camera + step,
                Belief(state.heights.own + normal.heights.own_step(step), state.heights.noise),
                Belief(state.paces.own + normal.paces.own_step(step), state.paces.noise),
            )
            if np.all(np.abs(step) < SETTLED):
                break
        return _State(state.camera, state.heights, state.paces, self._cost(state))

    def judged(self, state: _State) -> Fit:
        """The state as a fit, with its covariance."""
        state, normal = self._normal(state, is_last=True)
        covariance = self._covariance(normal)
        jacobian = self._line_jacobian(state.camera)
        line_covariance = jacobian @ covariance @ jacobian.T
        line_covariance[1, 1] += (self._config.model_share * self._size.height) ** 2
        return Fit(
            camera=state.camera,
            covariance=covariance,
            line=self._line(state.camera),
            line_covariance=line_covariance,
            noise=state.heights.noise,
            aspect=self._aspect,
            cost=self._cost(state),
            track_weights=normal.track_weights * self._heights.own_weights(state.heights),
        )

    def _normal(self, state: _State, *, is_last: bool = False) -> tuple[_State, _Normal]:
        """The state with its noises adapted, and the normal equations there."""
        height_misfits = self._heights.misfits(state.camera, state.heights.own)
        pace_misfits = self._paces.misfits(state.camera, state.paces.own)
        heights = self._heights.settled(state.heights, height_misfits)
        paces = self._paces.settled(state.paces, pace_misfits)
        weights = np.exp(-self._heights.track_costs(heights, height_misfits) / self._config.track_misfit)
        normal = _Normal(
            self._heights.part(state.camera, heights, height_misfits, weights, is_last=is_last),
            self._paces.part(state.camera, paces, pace_misfits, weights, is_last=is_last),
            self._prior,
            -self._prior @ (state.camera - self._prior_mean),
            weights,
        )
        return _State(state.camera, heights, paces), normal

    def _covariance(self, normal: _Normal) -> Floats:
        """Of the camera: jackknife-like sandwich (Bell and McCaffrey 2002), widened for the few tracks there are."""
        inverse = np.linalg.inv(normal.hessian)
        count = len(inverse)
        left_out = (1 + LEVERAGE_MIN) * np.eye(count) - normal.hessians @ inverse
        scores = np.linalg.solve(left_out, normal.scores[:, :, None])[:, :, 0]
        trends = normal.trends
        meat = scores.T @ scores + trends.T @ trends + self._prior
        shares = np.einsum("ijk,kj->i", normal.hessians, inverse)
        freedom = max(shares.sum() ** 2 / (shares**2).sum() - 1, TRACKS_FEW)
        factor = student.ppf(0.975, freedom) / student.ppf(0.975, np.inf)
        return np.asarray(inverse @ meat @ inverse * factor**2)

    def _cost(self, state: _State) -> float:
        """Twice the negative log posterior; what a track can cost is bounded by its size."""
        limit = self._config.track_misfit
        costs = self._heights.track_costs(state.heights, self._heights.misfits(state.camera, state.heights.own))
        heights = self._heights.counts @ (limit * (1 - np.exp(-costs / limit)) + 2 * np.log(state.heights.noise))
        misfits = self._paces.misfits(state.camera, state.paces.own)
        costs = self._paces.track_costs(state.paces, misfits) + 2 * np.log(state.paces.noise)
        paces = self._config.pace_weight * self._paces.counts @ costs
        own = self._heights.own_costs(state.heights).sum() + self._paces.own_costs(state.paces).sum()
        off = state.camera - self._prior_mean
        return float(heights + paces + own + off @ self._prior @ off)

    def _line(self, camera: Floats) -> Line:
        return horizon_of(float(camera[0]), float(camera[1]), float(np.exp(camera[2])), self._size)

    def _line_jacobian(self, camera: Floats) -> Floats:
        """Derivatives of slope and offset by the camera, `(2, 7)`."""
        here = self._line(camera)
        moved = [self._line(camera + DIFFERENCE * axis) for axis in np.eye(len(camera))]
        return np.array([[line.slope - here.slope, line.offset - here.offset] for line in moved]).T / DIFFERENCE
