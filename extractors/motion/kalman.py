"""A constant-velocity Kalman filter over many boxes at once.

State of one box, px and px/s: `x y w h vx vy`, with `(x, y)` the middle of the lower edge (the ground
contact point), `w h` the size. Measurement: `x y w h`. All noise scales with the object's own size
`sqrt(w h)`, so that near and far objects are treated alike.

Pure functions of arrays, n boxes in one call: means `(n, 6)`, covariances `(n, 6, 6)`.

Source: R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", 1960; the white-noise
acceleration model is Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, section 6.2.2, equations 6.2.2-4 and 6.2.2-12.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MEASURED = 4
"""The first components of the state are measured."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations, in units of the object's size."""

    position: float
    size: float
    acceleration: float
    size_drift: float
    speed_at_birth: float = 3.0
    """speed of an object seen for the first time, object sizes per s"""


def scale_of(means: Array) -> Array:
    """Size of each object, the root of its box's area, `(n,)` px; at least 1."""
    return np.asarray(np.sqrt(np.maximum(means[:, 2], 1) * np.maximum(means[:, 3], 1)))


def born(measured: Array, noise: Noise) -> tuple[Array, Array]:
    """Means and covariances of objects seen for the first time.

    Args:
        measured: `x y w h`, `(n, 4)` px.
        noise: The noise.
    """
    means = np.concatenate([measured, np.zeros((len(measured), 2))], axis=1)
    scale = scale_of(means)[:, None]
    deviations = scale * np.array([noise.position] * 2 + [noise.size] * 2 + [noise.speed_at_birth] * 2)
    return means, _diagonal(deviations**2)


def predict(means: Array, covariances: Array, dt_s: float, noise: Noise) -> tuple[Array, Array]:
    """Means and covariances `dt_s` later: x = F x, P = F P F' + Q."""
    transition = np.eye(6)
    transition[0, 4] = transition[1, 5] = dt_s
    q = np.zeros((6, 6))
    q[[0, 1], [0, 1]] = noise.acceleration**2 * dt_s**3 / 3
    q[[0, 1, 4, 5], [4, 5, 0, 1]] = noise.acceleration**2 * dt_s**2 / 2
    q[[4, 5], [4, 5]] = noise.acceleration**2 * dt_s
    q[[2, 3], [2, 3]] = noise.size_drift**2 * dt_s
    scale = scale_of(means)[:, None, None]
    return means @ transition.T, transition @ covariances @ transition.T + scale**2 * q


def measurement_noise(means: Array, noise: Noise, weights: Array) -> Array:
    """Covariances R of measurements, `(n, 4, 4)`.

    Args:
        means: The predicted states.
        noise: The noise.
        weights: Factor on each deviation, `(n, 4)`: 1 for a clear view, more for a doubtful one.
    """
    deviations = scale_of(means)[:, None] * np.array([noise.position] * 2 + [noise.size] * 2) * weights
    return _diagonal(deviations**2)


def update(means: Array, covariances: Array, measured: Array, r: Array) -> tuple[Array, Array]:
    """Means and covariances after a measurement: K = P H' S⁻¹, x = x + K (z - H x), P = (I - K H) P.

    Args:
        means: Predicted states `(n, 6)`.
        covariances: Their covariances `(n, 6, 6)`.
        measured: `x y w h`, `(n, 4)` px.
        r: Covariances of the measurements `(n, 4, 4)`.
    """
    innovation = measured - means[:, :MEASURED]
    s = covariances[:, :MEASURED, :MEASURED] + r
    gain = np.linalg.solve(s, covariances[:, :MEASURED, :]).transpose(0, 2, 1)
    updated = means + (gain @ innovation[:, :, None])[:, :, 0]
    rest = covariances - gain @ covariances[:, :MEASURED, :]
    return updated, (rest + rest.transpose(0, 2, 1)) / 2


def distances(means: Array, covariances: Array, measured: Array, noise: Noise, doubts: Array | None = None) -> Array:
    """Squared Mahalanobis distances of positions `(n, m)`, between n predictions and m measurements.

    Args:
        means: Predicted states `(n, 6)`.
        covariances: Their covariances `(n, 6, 6)`.
        measured: `x y w h`, `(m, 4)` px.
        noise: The noise.
        doubts: Factor on each measurement's deviations, `(m,)`; 1 by default.
    """
    factors = np.ones(len(measured)) if doubts is None else doubts
    r = (scale_of(means)[:, None] * noise.position * factors[None, :]) ** 2
    s = covariances[:, None, :2, :2] + r[:, :, None, None] * np.eye(2)
    offset = measured[None, :, :2] - means[:, None, :2]
    return np.asarray(np.einsum("nmi,nmij,nmj->nm", offset, np.linalg.inv(s), offset))


def _diagonal(variances: Array) -> Array:
    return variances[:, :, None] * np.eye(variances.shape[1])
