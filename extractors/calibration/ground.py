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
    east, north, east_rate, north_rate = _mapped(homography, x, y, vx, vy)
    speed = np.hypot(east_rate, north_rate)
    if camera is None or covariance is None:
        unknown = np.full_like(x, np.nan)
        return Ground(east, north, speed, unknown, unknown, unknown)
    foot, velocity = FOOT_SHARE * box_height, VELOCITY_SHARE * box_height
    by_noise = []
    for at, noise in enumerate((foot, foot, velocity, velocity)):
        ahead, behind = (
            [column + sign * noise / 2 if at == other else column for other, column in enumerate((x, y, vx, vy))]
            for sign in (1, -1)
        )
        by_noise.append(np.array(_mapped(homography, *ahead)) - np.array(_mapped(homography, *behind)))
    by_camera = _by_camera(camera, frame_size, lambda matrix: _mapped(matrix, x, y, vx, vy))
    carried = np.einsum("pvn,pq,qwn->vwn", by_camera, covariance, by_camera)
    total = carried + np.einsum("pvn,pwn->vwn", by_noise, by_noise)
    return Ground(
        east, north, speed, np.sqrt(total[0, 0]), np.sqrt(total[1, 1]), _of_length(total[2:, 2:], east_rate, north_rate)
    )


def _of_length(covariance: Floats, east: Floats, north: Floats) -> Floats:
    """Standard deviation of the vectors' lengths; where there is no direction, that of one component."""
    length = np.hypot(east, north)
    along = np.where(length > 0, [east, north], 1.0) / np.where(length > 0, length, np.sqrt(2))
    crossed = np.where(length > 0, 1.0, 0.0)
    own = along[0] ** 2 * covariance[0, 0] + along[1] ** 2 * covariance[1, 1]
    return np.asarray(np.sqrt(own + 2 * crossed * along[0] * along[1] * covariance[0, 1]))


def _mapped(homography: Floats, x: Floats, y: Floats, vx: Floats, vy: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """East and north, and the velocity in both directions; NaN above the horizon."""
    east, north, depth = (row[0] * x + row[1] * y + row[2] for row in homography)
    depth = np.where(depth > 0, depth, np.nan)
    east_rate, north_rate, depth_rate = (row[0] * vx + row[1] * vy for row in homography)
    east, north = east / depth, north / depth
    return east, north, (east_rate - east * depth_rate) / depth, (north_rate - north * depth_rate) / depth


def _by_camera(
    camera: tuple[float, float, float, float],
    frame_size: tuple[int, int],
    mapped: Callable[[Floats], tuple[Floats, Floats, Floats, Floats]],
) -> Floats:
    """Derivatives of the four values by the four numbers of the camera, `(4, 4, n)`."""
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
