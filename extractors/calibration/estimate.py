"""A camera in metres: the horizon's camera, whose lengths are in camera heights, with one length that is known.

What is known besides the tracks (people's mean height, the camera's height, a length on the ground, a horizon) are
observations that join the horizon's fit; what they say of each other moves the camera, too.

Does not decide whether the result is worth saying: `fold` does.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from extractors.calibration.camera import Camera, Floats
from extractors.calibration.config import CalibrationConfig
from extractors.calibration.errors import NotDecided
from extractors.calibration.scale import CameraHeight, KnownLength, PersonHeight, Scale
from extractors.horizon import Fit

TILT, ROLL, FOCAL, SIZE, HEIGHT = 0, 1, 2, 3, 7
"""Places in the state: those of `Fit.camera`, and the logarithm of the camera's height (m) behind them."""
HEIGHT_UNKNOWN = 10.0
"""Standard deviation of the logarithm of a camera's height before anything is known of it."""
STEPS = 8
"""Gauss-Newton steps; the observations are nearly linear in the state, and two or three settle it."""
CONTRADICTION = 5.0
"""Standard deviations by which what is known may be off, tracks included, before one of it must be wrong."""
DIFFERENCE = 1e-6
"""Step of numeric derivatives, of order-one values."""


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
        rms_m: Root mean square of what is left of the boxes' heights, m of an object's height; robust.
    """

    camera: Camera
    covariance: Floats
    rms_m: float

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
    fit: Fit,
    frame_size: tuple[int, int],
    config: CalibrationConfig,
    scale: Scale,
    horizon: Horizon | None = None,
) -> Estimate:
    """The likeliest camera in metres.

    Args:
        fit: The camera in camera heights.
        frame_size: Width and height of the frame, px.
        config: The parameters.
        scale: Where metres come from.
        horizon: What is known of the horizon otherwise.

    Raises:
        NotDecided: Nothing gives metres, or what is known contradicts the tracks beyond all cameras.

    Source: a Gaussian's iterated update by observations: Bell and Cathey, IEEE Trans. Autom. Control 38 (1993) 294.
    """
    observed = list(_observations(fit, frame_size, config, scale, horizon))
    start, prior = _before(fit, config, scale)
    state, information = start.copy(), prior
    for _ in range(STEPS):
        residuals = np.concatenate([each(state) for each in observed])
        jacobian = np.stack(
            [
                (np.concatenate([each(state + DIFFERENCE * axis) for each in observed]) - residuals) / DIFFERENCE
                for axis in np.eye(len(state))
            ],
            axis=1,
        )
        information = prior + jacobian.T @ jacobian
        state = state - np.linalg.solve(information, jacobian.T @ residuals + prior @ (state - start))
    if not np.isfinite(state).all() or abs(state[TILT]) > math.pi / 2 or abs(state[ROLL]) > math.pi / 2:
        raise NotDecided("what is known of the camera contradicts its tracks: no camera explains both")
    residuals = np.concatenate([each(state) for each in observed])
    off = math.sqrt(residuals @ residuals + (state - start) @ prior @ (state - start))
    if not off <= CONTRADICTION:
        raise NotDecided(
            f"what was given of the camera contradicts its tracks by {off:.0f} standard deviations, wanted at most "
            f"{CONTRADICTION:g}: a height or length of another unit or place, perhaps"
        )
    places = np.ix_([FOCAL, TILT, ROLL, HEIGHT], [FOCAL, TILT, ROLL, HEIGHT])
    person_m = math.exp(state[SIZE] + state[HEIGHT])
    # A height is off by what its two edges are.
    return Estimate(
        _camera(state, frame_size),
        np.asarray(np.linalg.inv(information)[places], np.float64),
        math.sqrt(2) * fit.noise * person_m,
    )


Observation = Callable[[Floats], Floats]
"""Residuals of a state in standard deviations, `(k,)`."""


def _observations(
    fit: Fit, frame_size: tuple[int, int], config: CalibrationConfig, scale: Scale, horizon: Horizon | None
) -> list[Observation]:
    known: list[Observation] = []
    if config.aspect_min < fit.aspect < config.aspect_max:
        person = (
            scale if isinstance(scale, PersonHeight) else PersonHeight(config.person_height_m, config.person_spread_m)
        )
        share = math.hypot(person.share, config.box_share)
        known.append(lambda state: np.array([state[SIZE] + state[HEIGHT] - math.log(person.metres)]) / share)
    elif isinstance(scale, PersonHeight):
        raise NotDecided(
            f"the boxes are {fit.aspect:.1f} times as high as wide, wanted {config.aspect_min:g} to "
            f"{config.aspect_max:g}: these are no upright people, whose height gives metres"
        )
    if isinstance(scale, CameraHeight):
        known.append(lambda state: np.array([state[HEIGHT] - math.log(scale.metres)]) / scale.share)
    if isinstance(scale, KnownLength):
        known.append(lambda state: np.array([scale.deviations(_camera(state, frame_size))]))
    if horizon is not None:
        root = np.linalg.cholesky(horizon.covariance)
        given = np.array([horizon.slope, horizon.offset])
        known.append(lambda state: np.linalg.solve(root, np.array(_camera(state, frame_size).horizon) - given))
    return known


def _before(fit: Fit, config: CalibrationConfig, scale: Scale) -> tuple[Floats, Floats]:
    """State and information of it `(8, 8)` before what is known joins."""
    height_m = scale.metres if isinstance(scale, CameraHeight) else config.person_height_m / math.exp(fit.camera[SIZE])
    information = np.zeros((8, 8))
    information[:HEIGHT, :HEIGHT] = np.linalg.inv(fit.covariance)
    information[HEIGHT, HEIGHT] = 1 / HEIGHT_UNKNOWN**2
    return np.append(fit.camera, math.log(height_m)), information


def _camera(state: Floats, frame_size: tuple[int, int]) -> Camera:
    return Camera(math.exp(state[FOCAL]), float(state[TILT]), float(state[ROLL]), math.exp(state[HEIGHT]), *frame_size)
