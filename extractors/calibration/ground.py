"""Where points of the picture lie on the ground, how fast they move there, and how well both are known.

Contract: pure, over columns. Uncertainty is carried to first order: the camera's own covariance and the noise of the
foot in the picture add up. The camera's share is common to all points of one calibration: it does not average away.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, 5.2.1 (forward propagation of covariance).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from extractors.calibration.camera import Camera, Floats

FOOT_SHARE = 0.04
"""Standard deviation of a foot in the picture, of its box's height: a stride, and what shadows add."""
VELOCITY_SHARE = 0.08
"""Standard deviation of a velocity in the picture, box heights a second: of two feet half a second apart, filtered."""
_STEP = 1e-4
"""Step of the central differences, of focal length and height, and rad."""


@dataclass(frozen=True, slots=True)
class Ground:
    """Columns of shape `(n,)`; NaN where the point is not below the horizon, or where no covariance is known.

    Attributes:
        east: m.
        north: m.
        speed: m/s.
        east_deviation: Standard deviation, m.
        north_deviation: Standard deviation, m.
        speed_deviation: Standard deviation, m/s.
    """

    east: Floats
    north: Floats
    speed: Floats
    east_deviation: Floats
    north_deviation: Floats
    speed_deviation: Floats


def ground_of(
    x: Floats,
    y: Floats,
    vx: Floats,
    vy: Floats,
    box_height: Floats,
    homography: Floats,
    camera: tuple[float, float, float, float] | None,
    covariance: Floats | None,
    frame_size: tuple[int, int],
) -> Ground:
    """Ground positions and speeds of points with a velocity.

    Args:
        x: Column of the foot, px.
        y: Row of the foot, px.
        vx: Velocity, px/s.
        vy: Velocity, px/s.
        box_height: Height of the box, px: the noise of the foot is a share of it.
        homography: From pixels to metres, `(3, 3)`.
        camera: Focal length px, pitch rad, roll rad and height m; None where only the homography is known.
        covariance: Of these four, `(4, 4)`; None likewise: then no deviation is known.
        frame_size: Width and height, px.
    """
    values = _mapped(homography, x, y, vx, vy)
    if camera is None or covariance is None:
        unknown = np.full_like(x, np.nan)
        return Ground(*values, unknown, unknown, unknown)
    foot, velocity = FOOT_SHARE * box_height, VELOCITY_SHARE * box_height
    variances = [np.zeros_like(x) for _ in values]
    for at, noise in enumerate((foot, foot, velocity, velocity)):
        moved = [np.where(at == other, noise, 0.0) for other in range(4)]
        columns = zip((x, y, vx, vy), moved, strict=True)
        ahead = _mapped(homography, *(column + by / 2 for column, by in columns))
        columns = zip((x, y, vx, vy), moved, strict=True)
        behind = _mapped(homography, *(column - by / 2 for column, by in columns))
        variances = [total + (a - b) ** 2 for total, a, b in zip(variances, ahead, behind, strict=True)]
    jacobian = _by_camera(camera, frame_size, lambda matrix: _mapped(matrix, x, y, vx, vy))
    carried = np.einsum("pvn,pq,qvn->vn", jacobian, covariance, jacobian)
    deviations = [np.sqrt(own + common) for own, common in zip(variances, carried, strict=True)]
    return Ground(*values, *deviations)


def _mapped(homography: Floats, x: Floats, y: Floats, vx: Floats, vy: Floats) -> tuple[Floats, Floats, Floats]:
    """East, north and speed; NaN above the horizon."""
    east, north, depth = (row[0] * x + row[1] * y + row[2] for row in homography)
    depth = np.where(depth > 0, depth, np.nan)
    east_rate, north_rate, depth_rate = (row[0] * vx + row[1] * vy for row in homography)
    east, north = east / depth, north / depth
    speed = np.hypot(east_rate - east * depth_rate, north_rate - north * depth_rate) / depth
    return east, north, speed


def _by_camera(
    camera: tuple[float, float, float, float],
    frame_size: tuple[int, int],
    mapped: Callable[[Floats], tuple[Floats, Floats, Floats]],
) -> Floats:
    """Derivatives of the three values by the four numbers of the camera, `(4, 3, n)`."""
    steps = (_STEP * camera[0], _STEP, _STEP, _STEP * camera[3])
    rows = []
    for at, step in enumerate(steps):
        ahead, behind = (
            np.array(
                mapped(
                    _homography(tuple(v + sign * step * (at == other) for other, v in enumerate(camera)), frame_size)
                )
            )
            for sign in (1, -1)
        )
        rows.append((ahead - behind) / (2 * step))
    return np.array(rows)


def _homography(camera: tuple[float, ...], frame_size: tuple[int, int]) -> Floats:
    focal, pitch, roll, height = camera
    return Camera(focal, pitch, roll, height, *frame_size).homography
