"""The camera that the boxes of upright people speak for, with the uncertainty of that.

Maximum likelihood over camera (focal length, pitch, roll, height) and each track's own height. A person is a vertical
line over a point of the ground, projected exactly; a box shows the rows of its two ends and the column of its middle.
With roll the body's axis leans in the picture, so its foot lies beside the box's middle; this is part of the model. The
people's heights have a prior, the camera has a wide one, and a horizon that is known otherwise joins as an observation.

Does not decide whether the result is worth saying: `fold` does.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from extractors.calibration.camera import Camera, Floats
from extractors.calibration.config import CalibrationConfig
from extractors.calibration.errors import NotDecided
from extractors.calibration.scale import CameraHeight, KnownLength, PersonHeight, Scale

_LEAST = 1e-4
"""Smallest sine of an angle under the horizon, and smallest share of a height, that the model computes with: beyond
it a box does not fit at all."""
_ROUGH, _FINE = 1e-4, 1e-7
"""Relative change of cost and parameters at which the first round and the last one end."""
_ITERATIONS = 40
"""Most steps of a round; five to ten are usual."""
_TYPICAL = np.array([0.3, 0.1, 0.05, 0.1, 0.2, 0.04])
"""How far the parameters usually move."""
_STEPS = 3
"""Newton steps for the tracks' heights; the first brings them within noise."""


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes of upright tracks, all of shape `(n,)`.

    Attributes:
        track: Index of the track, 0 to tracks - 1.
        x: Middle, px.
        y1: Upper edge, px.
        y2: Lower edge, px.
        time_s: Seconds since any instant; ascending within a track.
    """

    track: NDArray[np.int64]
    x: Floats
    y1: Floats
    y2: Floats
    time_s: Floats

    @property
    def tracks(self) -> int:
        """How many tracks there are."""
        return int(self.track.max()) + 1 if len(self.track) else 0


@dataclass(frozen=True, slots=True)
class Horizon:
    """A horizon that is known otherwise: `y = slope x + offset`, and the covariance of the two, `(2, 2)`."""

    slope: float
    offset: float
    covariance: Floats


@dataclass(frozen=True, slots=True)
class Estimate:
    """A camera and how well it is known.

    Attributes:
        camera: The camera.
        covariance: Of (log focal length, pitch, roll, log height), `(4, 4)`; rad².
        tracks: Tracks that it rests on.
        rms_m: Root mean square of what is left of the boxes' heights, m of a person's height; robust.
        explained: Share of the boxes whose heights lie within three of the configured standard deviations.
    """

    camera: Camera
    covariance: Floats
    tracks: int
    rms_m: float
    explained: float

    @property
    def parameters(self) -> Floats:
        """Logarithm of focal length, pitch, roll, logarithm of height, `(4,)`: what `covariance` is of."""
        camera = self.camera
        return np.array([math.log(camera.focal_px), camera.pitch_rad, camera.roll_rad, math.log(camera.height_m)])

    @property
    def covariance_metric(self) -> Floats:
        """Of (focal length px, pitch rad, roll rad, height m), `(4, 4)`."""
        scale = np.array([self.camera.focal_px, 1.0, 1.0, self.camera.height_m])
        return self.covariance * np.outer(scale, scale)


def estimate(
    boxes: Boxes,
    frame_size: tuple[int, int],
    config: CalibrationConfig,
    scale: Scale,
    horizon: Horizon | None = None,
) -> Estimate:
    """The likeliest camera.

    Args:
        boxes: What was seen.
        frame_size: Width and height of the frame, px.
        config: The parameters.
        scale: Where metres come from.
        horizon: What is known of the horizon otherwise.

    Raises:
        NotDecided: There are too few tracks, or no camera explains them.

    Source: variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413. Covariance clustered by tracks:
    Liang and Zeger, Biometrika 73 (1986) 13, eq. 5.
    """
    if boxes.tracks < config.tracks_min:
        raise NotDecided(f"a calibration takes {config.tracks_min} upright tracks or more, got {boxes.tracks}")
    problem = _Problem(boxes, frame_size, config, scale, horizon)
    first = min((problem.refined(start, _ROUGH) for start in problem.starts()), key=lambda found: float(found[1]))
    # How noisy the boxes are follows from them; with it the priors get the say that is theirs.
    problem.scale_noise(first[0])
    theta, cost, jacobian, residuals = problem.refined(first[0], _FINE)
    if not math.isfinite(cost):
        raise NotDecided("no camera explains the tracks: their boxes lie on both sides of every horizon")
    covariance = _clustered(jacobian, residuals, problem.cluster, boxes.tracks)[:4, :4]
    return Estimate(problem.camera(theta), covariance, boxes.tracks, problem.rms_m(theta), problem.explained(theta))


class _Problem:
    """The residuals, each in standard deviations, as a function of six parameters.

    They are log f, pitch, roll, log H, and the logarithms of the mean speed and of the mean height of people.
    """

    def __init__(
        self,
        boxes: Boxes,
        frame_size: tuple[int, int],
        config: CalibrationConfig,
        scale: Scale,
        horizon: Horizon | None,
    ) -> None:
        self._config = config
        self._size = frame_size
        self._horizon = horizon
        self._scale = scale
        width, height = frame_size
        self._track = boxes.track
        self._tracks = boxes.tracks
        self._u = boxes.x - width / 2
        self._head = boxes.y1 - height / 2
        self._foot = boxes.y2 - height / 2
        self._nominal = self._deviation = np.hypot(config.noise_share * (boxes.y2 - boxes.y1), config.noise_px)
        self._person = (
            scale if isinstance(scale, PersonHeight) else PersonHeight(config.person_height_m, config.person_spread_m)
        )
        self._first, self._last = chords(boxes, config.chord_share)
        self._chord_track = self._track[self._first]
        self._duration_s = boxes.time_s[self._last] - boxes.time_s[self._first]
        self._walkers = np.unique(self._chord_track)
        priors = 6 + (2 if horizon is not None else 0)
        self.cluster = np.concatenate(
            [self._track, np.arange(self._tracks), self._chord_track, self._walkers, np.full(priors, -1)]
        )

    def camera(self, theta: Floats) -> Camera:
        log_focal, pitch, roll, log_height = (float(value) for value in theta[:4])
        return Camera(math.exp(log_focal), pitch, roll, math.exp(log_height), *self._size)

    def starts(self) -> list[Floats]:
        """The best two of a grid of cameras, each with the height that gives people of the mean height."""
        longer = max(self._size)
        usual = math.log(self._config.speed_mps), math.log(self._person.metres)
        grid = [
            np.array([math.log(focal * longer), pitch, roll, 0.0, *usual])
            for focal in (0.5, 0.8, 1.3, 2.0)
            for pitch in (0.1, 0.25, 0.4, 0.6, 0.85)
            for roll in (-0.15, 0.0, 0.15)
        ]
        for theta in grid:
            theta[3] = theta[5] - float(np.median(self._measured(theta)))
        costs = [float(np.sum(self.residuals(theta) ** 2)) for theta in grid]
        return [grid[at] for at in np.argsort(costs, kind="stable")[:2]]

    def refined(self, theta: Floats, tolerance: float) -> tuple[Floats, float, Floats, Floats]:
        """The optimum near a start: parameters, cost, Jacobian and residuals there."""
        low = np.array([math.log(0.1 * max(self._size)), -1.2, -1.2, -5.0, -5.0, -5.0])
        high = np.array([math.log(20.0 * max(self._size)), 1.4, 1.2, 7.0, 5.0, 5.0])
        found = least_squares(
            self.residuals,
            np.clip(theta, low + 1e-6, high - 1e-6),
            bounds=(low, high),
            ftol=tolerance,
            xtol=tolerance,
            x_scale=_TYPICAL,
            max_nfev=_ITERATIONS,
        )
        return found.x, float(found.cost), found.jac, found.fun

    def scale_noise(self, theta: Floats) -> None:
        """Take the boxes' noise from what is left of their heights, within limits.

        What is left of one box and of the next of the same track is alike; with correlation r, n such boxes say as
        much as n (1 - r) / (1 + r) that are independent (a first-order autoregression).
        """
        predicted, _ = self._predicted(theta, self._heights(theta))
        left = (self._foot - self._head - predicted) / self._deviation
        usual = np.clip(left, -3.0, 3.0)
        follows = self._track[1:] == self._track[:-1]
        square = float(np.mean(usual * usual))
        alike = float(np.mean((usual[1:] * usual[:-1])[follows])) / max(square, _LEAST * _LEAST) if follows.any() else 0
        alike = min(max(alike, 0.0), 0.9)
        size = 1.4826 * float(np.median(np.abs(left))) * math.sqrt((1 + alike) / (1 - alike))
        self._deviation = self._deviation * min(max(size, self._config.noise_least), 1.0 / self._config.noise_least)

    def residuals(self, theta: Floats) -> Floats:
        """Of boxes, of the tracks' heights, and of what is known beforehand."""
        heights = self._heights(theta)
        predicted, _ = self._predicted(theta, heights)
        # The foot's noise moves what is predicted with it: the distance to the curve counts, not that along one axis.
        nudged, _ = self._predicted(theta, heights, 1.0)
        slant = np.hypot(1.0, 1.0 - (nudged - predicted)) / math.sqrt(2)
        boxes = (self._foot - self._head - predicted) / (self._deviation * slant)
        people = (heights + theta[3] - theta[5]) / self._person.share
        own, walkers = self._speeds(theta)
        return np.concatenate([*map(self._tamed, (boxes, people, own, walkers)), self._beforehand(theta)])

    def _speeds(self, theta: Floats) -> tuple[Floats, Floats]:
        """How far each chord is off its track's mean speed, and each track's off the mean of all."""
        config = self._config
        east, north = self._ground(theta)
        first, last = self._first, self._last
        way = np.hypot(east[last] - east[first], north[last] - north[first])
        speed = np.log(np.maximum(way, _LEAST)) + theta[3] - np.log(self._duration_s)
        weight = np.ones_like(speed)
        pull = (config.speed_step_spread / config.speed_spread) ** 2
        for _ in range(_STEPS):
            sums = np.bincount(self._chord_track, weight * speed, self._tracks) + pull * theta[4]
            means = sums / (np.bincount(self._chord_track, weight, self._tracks) + pull)
            off = (speed - means[self._chord_track]) / config.speed_step_spread
            weight = 1 / (1 + (off / config.robust) ** 2)
        return off, (means[self._walkers] - theta[4]) / config.speed_spread

    def _ground(self, theta: Floats) -> tuple[Floats, Floats]:
        """East and north of each box's foot, in camera heights."""
        focal, sin_t, cos_t, _, _ = _parts(theta)
        u, row = self._levelled(theta, self._seen(theta))
        below = np.maximum(sin_t + row * cos_t / focal, _LEAST)
        return u / focal / below, (cos_t - row * sin_t / focal) / below

    def rms_m(self, theta: Floats) -> float:
        """What the boxes' heights deviate by from the tracks' own, m; robust (1.48 median of the absolute values)."""
        metres = np.exp(self._measured(theta) + theta[3])
        own = np.exp(self._heights(theta) + theta[3])[self._track]
        return 1.4826 * float(np.median(np.abs(metres - own)))

    def explained(self, theta: Floats) -> float:
        """Share of the boxes whose heights lie within three standard deviations."""
        predicted, _ = self._predicted(theta, self._heights(theta))
        return float(np.mean(np.abs(self._foot - self._head - predicted) < 3 * self._nominal))

    def _beforehand(self, theta: Floats) -> Floats:
        config = self._config
        log_focal = math.log(config.focal_share * max(self._size))
        known = [
            (theta[0] - log_focal) / config.focal_spread,
            (theta[1] - config.pitch_rad) / config.pitch_spread_rad,
            (theta[4] - math.log(config.speed_mps)) / config.speed_mean_spread,
            (theta[5] - math.log(self._person.metres)) / config.mean_share,
            theta[2] / config.roll_spread_rad,
        ]
        known.append(self._scale_residual(theta))
        if self._horizon is not None:
            slope, offset = self.camera(theta).horizon
            root = np.linalg.cholesky(self._horizon.covariance)
            given = np.array([slope - self._horizon.slope, offset - self._horizon.offset])
            known.extend(np.linalg.solve(root, given))
        return np.array(known, dtype=np.float64)

    def _scale_residual(self, theta: Floats) -> float:
        """What the scale says of the camera's height, besides the people's."""
        if isinstance(self._scale, CameraHeight):
            return float(theta[3] - math.log(self._scale.metres)) / self._scale.share
        if isinstance(self._scale, KnownLength):
            return self._scale.deviations(self.camera(theta))
        return 0.0

    def _tamed(self, residuals: Floats) -> Floats:
        """Residuals whose squares grow like the Cauchy loss, with signs: false tracks and cut boxes lose their say."""
        bend = self._config.robust
        return np.sign(residuals) * bend * np.sqrt(np.log1p((residuals / bend) ** 2))

    def _measured(self, theta: Floats) -> Floats:
        """Logarithm of each box's height on its ground point, of the camera's height."""
        share = self._seen(theta)
        return np.asarray(np.log(np.maximum(share / self._below(theta, share), _LEAST)))

    def _seen(self, theta: Floats) -> Floats:
        """Each person's height over the foot's depth along the view, as the box shows it."""
        focal, sin_t, cos_t, _, cos_r = _parts(theta)
        return (self._foot - self._head) / np.maximum(focal * cos_t * cos_r - self._head * sin_t, _LEAST * focal)

    def _levelled(self, theta: Floats, share: Floats) -> tuple[Floats, Floats]:
        """Column and row of each foot in a picture without roll, from the principal point, px."""
        focal, sin_t, cos_t, sin_r, cos_r = _parts(theta)
        # The box's middle is the mean of foot and head, u_head = (u + f share cos t sin r) / (1 - share sin t).
        shrink = 1 - share * sin_t
        u = (2 * self._u * shrink - focal * share * cos_t * sin_r) / (1 + shrink)
        return u * cos_r + self._foot * sin_r, self._foot * cos_r - u * sin_r

    def _below(self, theta: Floats, share: Floats) -> Floats:
        """One over the depth of each foot in camera heights: sin t + v cos t / f, v its row without roll."""
        focal, sin_t, cos_t, _, _ = _parts(theta)
        _, row = self._levelled(theta, share)
        return np.asarray(np.maximum(sin_t + row * cos_t / focal, _LEAST))

    def _heights(self, theta: Floats) -> Floats:
        """Logarithm of each track's height, of the camera's, that is likeliest for this camera, `(tracks,)`."""
        measured = self._measured(theta)
        at = theta[5] - theta[3]
        heights = _means(measured, np.ones_like(measured), self._track, self._tracks)
        for _ in range(_STEPS):
            predicted, slope = self._predicted(theta, heights)
            left = (self._foot - self._head - predicted) / self._deviation
            slope = slope / self._deviation
            weight = 1 / (1 + (left / self._config.robust) ** 2)
            away = (heights - at) / self._person.share
            pull = 1 / (1 + (away / self._config.robust) ** 2) / self._person.share
            gradient = np.bincount(self._track, weight * slope * left, self._tracks) - pull * away
            curvature = np.bincount(self._track, weight * slope * slope, self._tracks) + pull / self._person.share
            heights = heights + np.clip(gradient / curvature, -0.5, 0.5)
        return heights

    def _predicted(self, theta: Floats, heights: Floats, lower_px: float = 0.0) -> tuple[Floats, Floats]:
        """Height of each box, px, for tracks of these heights, and its derivative by their logarithm.

        `lower_px` is by how much lower the foot is taken to be than it was seen.
        """
        focal, sin_t, cos_t, _, cos_r = _parts(theta)
        below = self._below(theta, self._seen(theta)) + lower_px * cos_r * cos_t / focal
        share = np.exp(heights)[self._track] * below
        shrink = np.maximum(1 - share * sin_t, _LEAST)
        reach = focal * cos_t * cos_r - (self._foot + lower_px) * sin_t
        return reach * share / shrink, reach * share / (shrink * shrink)


def chords(boxes: Boxes, chord_share: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last box of each stretch that a track went, so long that noise is small beside it.

    A stretch ends where the foot is `chord_share` of the box's height away from where it began.
    """
    first: list[int] = []
    last: list[int] = []
    began = 0
    for at in range(1, len(boxes.track)):
        if boxes.track[at] != boxes.track[began]:
            began = at
            continue
        way = math.hypot(boxes.x[at] - boxes.x[began], boxes.y2[at] - boxes.y2[began])
        if way >= chord_share * (boxes.y2[began] - boxes.y1[began]) and boxes.time_s[at] > boxes.time_s[began]:
            first.append(began)
            last.append(at)
            began = at
    return np.array(first, np.int64), np.array(last, np.int64)


def _parts(theta: Floats) -> tuple[float, float, float, float, float]:
    """Focal length, and sine and cosine of pitch and roll."""
    return math.exp(theta[0]), math.sin(theta[1]), math.cos(theta[1]), math.sin(theta[2]), math.cos(theta[2])


def _means(values: Floats, weights: Floats, track: NDArray[np.int64], tracks: int) -> Floats:
    return np.asarray(np.bincount(track, weights * values, tracks) / np.bincount(track, weights, tracks))


def _clustered(jacobian: Floats, residuals: Floats, cluster: NDArray[np.int64], tracks: int) -> Floats:
    """Covariance of the parameters, clustered by tracks, and in no direction below what the noise model says."""
    information = jacobian.T @ jacobian
    model = np.linalg.pinv(information, hermitian=True)
    spread = np.zeros_like(information)
    for at in range(tracks):
        gradient = jacobian[cluster == at].T @ residuals[cluster == at]
        spread += np.outer(gradient, gradient)
    parameters = jacobian.shape[1]
    spread *= tracks / max(tracks - parameters, 1)
    known = jacobian[cluster < 0]
    spread += known.T @ known
    root = np.linalg.cholesky(model + 1e-15 * np.eye(parameters))
    sizes, axes = np.linalg.eigh(root.T @ spread @ root)
    turned = root @ axes
    return np.asarray((turned * np.maximum(sizes, 1.0)) @ turned.T)
