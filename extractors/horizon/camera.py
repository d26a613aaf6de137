"""How high an upright object's box is in the picture of a tilted pinhole camera over a plane.

Frames: camera axes x right, y down, z forward; lengths in camera heights; square pixels, principal point in
the frame's middle. Many cameras at a time: where a camera's numbers are arrays, results have their shape, `(...)`,
before the points'. Exact for any tilt and roll, and in its limit of small tilt the proportion of box height
to the distance below the horizon (Hoiem, Efros and Hebert 2008, equation 7).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

DEPTH_MIN = 0.001
"""Smallest sine below the horizon at which a foot point is taken to stand; points above it go here smoothly."""

SHARE_MAX = 0.95
"""Largest share of the way to the camera's plane at which a head is taken to be."""


@dataclass(frozen=True, slots=True)
class FrameSize:
    """Width and height of the video's frames, px."""

    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Line:
    """The horizon `y = slope * x + offset`, px of the frame, y down."""

    slope: float
    offset: float

    def y(self, x: float) -> float:
        """Its height in the picture at `x`, px."""
        return self.slope * x + self.offset


def up(tilt: Floats, roll: Floats) -> Floats:
    """The direction away from the ground, unit vector in camera axes, `(3, ...)`; angles rad.

    Args:
        tilt: Of the view below the horizontal.
        roll: Of the horizon, clockwise in the picture.
    """
    return np.array([np.sin(roll) * np.cos(tilt), -np.cos(roll) * np.cos(tilt), -np.sin(tilt)])


def horizon_of(tilt: float, roll: float, focal: float, size: FrameSize) -> Line:
    """The line of the plane's points at infinity; focal length px."""
    slope = np.tan(roll)
    middle = size.height / 2 - focal * np.tan(tilt) / np.cos(roll)
    return Line(float(slope), float(middle - slope * size.width / 2))


def log_heights(camera: Floats, log_size: Floats, depth: Floats, foot_xy: Floats, size: FrameSize) -> Floats:
    """Logarithm of the box heights (px) of upright objects that stand at these points of the picture, `(..., n)`.

    A box is higher than the line from foot to head: its lower edge is at the foot that is nearest, its upper one where
    the head is farthest.

    Args:
        camera: `tilt (rad), roll (rad), log of the focal length (px)`.
        log_size: Logarithm of each object's height over the camera's, `(..., n)`.
        depth: How far the top of the head is behind the nearest foot, along the ground, of the object's height.
        foot_xy: Where the nearest foot is, px, `(..., n, 2)`.
        size: Of the frame.
    """
    tilt, roll, log_focal = camera
    focal, n = np.exp(log_focal), up(tilt, roll)
    x, y = _ray(foot_xy, focal, size)
    below = _softly_positive(-(n[0] * x + n[1] * y + n[2]))
    share = np.exp(log_size) * below
    away_x, away_y, away_z = x + below * n[0], y + below * n[1], 1 + below * n[2]
    leaning = depth / np.sqrt(away_x**2 + away_y**2 + away_z**2)
    head_y = y + share * (n[1] + leaning * away_y)  # of Q ~ r + share * (n + away), with r the ray to the foot
    head_z = np.maximum(1 + share * (n[2] + leaning * away_z), 1 - SHARE_MAX)
    return np.asarray(np.log(np.maximum(focal * (y - head_y / head_z), 1e-3)))


def feet_of(camera: Floats, middle_xy: Floats, height_px: Floats, size: FrameSize) -> Floats:
    """Where upright objects with these boxes stand, px, `(..., n, 2)`.

    Under a rolled camera bodies lean in the picture: the middle of a box is that of foot and head, not the foot.

    Args:
        camera: `tilt (rad), roll (rad), log of the focal length (px)`.
        middle_xy: Middles of the boxes' lower edges, px, `(n, 2)`.
        height_px: Heights of the boxes, px, `(n,)`.
        size: Of the frame.
    """
    tilt, roll, log_focal = camera
    focal, n = np.exp(log_focal), up(tilt, roll)
    middle, y = _ray(middle_xy, focal, size)
    head_y = y - height_px / focal
    share = height_px / focal / np.maximum(head_y * n[2] - n[1], DEPTH_MIN)  # the head is this part of n nearer
    nearer = np.maximum(1 + share * n[2], 1 - SHARE_MAX)
    x = (2 * middle * nearer - share * n[0]) / (1 + nearer)
    return np.stack(np.broadcast_arrays(x * focal + size.width / 2, middle_xy[:, 1]), axis=-1)


def ground_points(camera: Floats, foot_xy: Floats, size: FrameSize) -> Floats:
    """Where on the ground these points of the picture lie, right and ahead, camera heights, `(..., n, 2)`.

    Args:
        camera: `tilt (rad), roll (rad), log of the focal length (px)`.
        foot_xy: Points of the picture, px, `(..., n, 2)`.
        size: Of the frame.
    """
    tilt, roll, log_focal = camera
    focal, n = np.exp(log_focal), up(tilt, roll)
    x, y = _ray(foot_xy, focal, size)
    depth = _softly_positive(-(n[0] * x + n[1] * y + n[2]))
    cosine, sine = np.cos(roll), np.sin(roll)
    right = x * cosine + y * sine
    ahead = n[2] * (y * cosine - x * sine) + n[0] * sine - n[1] * cosine  # along up x right
    return np.stack([right / depth, ahead / depth], axis=-1)


def _ray(xy: Floats, focal: Floats, size: FrameSize) -> tuple[Floats, Floats]:
    """The rays to these points, x and y at z = 1."""
    return (xy[..., 0] - size.width / 2) / focal, (xy[..., 1] - size.height / 2) / focal


def _softly_positive(below: Floats) -> Floats:
    return np.asarray((below + np.sqrt(below**2 + DEPTH_MIN**2)) / 2)
