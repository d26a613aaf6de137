"""The camera over its ground: pinhole, square pixels, principal point in the picture's middle, no distortion.

Pixels: origin top-left, x right, y down. Ground: metres, ENU, with the point below the camera as origin and north
along its view. The horizon is the line `y = slope x + offset` of the full frame.

Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, 8.6 (vanishing points and the horizon) and 8.7
(a plane and a vertical direction).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from extractors.calibration.errors import NotACamera

Floats = NDArray[np.float64]

_HORIZON_GAP = 1e-9
"""Below this sine of the angle under the horizon a pixel is on it: no ground is seen there."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Focal length and pose.

    Attributes:
        focal_px: Focal length, px.
        pitch_rad: How far the view points below the horizontal.
        roll_rad: How far the horizon is turned in the picture, clockwise: its slope is `tan(roll_rad)`.
        height_m: Height above the ground, m.
        width: Width of the frame, px.
        height: Height of the frame, px.
    """

    focal_px: float
    pitch_rad: float
    roll_rad: float
    height_m: float
    width: int
    height: int

    def __post_init__(self) -> None:
        """Check that it can be a camera that sees the ground."""
        values = (self.focal_px, self.pitch_rad, self.roll_rad, self.height_m)
        if not all(math.isfinite(value) for value in values) or self.focal_px <= 0 or self.height_m <= 0:
            raise NotACamera(f"a camera has a focal length and a height above 0 and finite angles, got {self}")
        if not abs(self.roll_rad) < math.pi / 2 or not abs(self.pitch_rad) < math.pi / 2:
            raise NotACamera(f"pitch and roll must lie within a right angle, got {self}")

    @property
    def horizon(self) -> tuple[float, float]:
        """Slope (px/px) and offset (px at x = 0) of the horizon."""
        slope = math.tan(self.roll_rad)
        at_middle = self.height / 2 - self.focal_px * math.tan(self.pitch_rad) / math.cos(self.roll_rad)
        return slope, at_middle - slope * self.width / 2

    @property
    def homography(self) -> Floats:
        """From pixels to the ground, `(3, 3)`: (X, Y, W) = H (x, y, 1), metres X/W, Y/W, W > 0 below the horizon."""
        f, sin_t, cos_t = self.focal_px, math.sin(self.pitch_rad), math.cos(self.pitch_rad)
        ground = np.array(
            [
                [self.height_m, 0.0, 0.0],
                [0.0, -self.height_m * sin_t, self.height_m * f * cos_t],
                [0.0, cos_t, f * sin_t],
            ]
        )
        return ground @ self._levelled

    @property
    def _levelled(self) -> Floats:
        """From pixels to those of a camera without roll whose origin is the principal point, `(3, 3)`."""
        sin_r, cos_r = math.sin(self.roll_rad), math.cos(self.roll_rad)
        x, y = self.width / 2, self.height / 2
        return np.array(
            [
                [cos_r, sin_r, -cos_r * x - sin_r * y],
                [-sin_r, cos_r, sin_r * x - cos_r * y],
                [0.0, 0.0, 1.0],
            ]
        )

    def project(self, points_enu: Floats) -> Floats:
        """Pixels `(n, 2)` of points `(n, 3)` in metres above the ground; NaN behind the camera."""
        sin_t, cos_t = math.sin(self.pitch_rad), math.cos(self.pitch_rad)
        east, north, up = points_enu[:, 0], points_enu[:, 1], points_enu[:, 2] - self.height_m
        depth = cos_t * north - sin_t * up
        seen = np.where(depth > 0, depth, np.nan)
        u = self.focal_px * east / seen
        v = -self.focal_px * (sin_t * north + cos_t * up) / seen
        sin_r, cos_r = math.sin(self.roll_rad), math.cos(self.roll_rad)
        return np.stack([cos_r * u - sin_r * v + self.width / 2, sin_r * u + cos_r * v + self.height / 2], axis=1)

    def ground(self, pixels_xy: Floats) -> Floats:
        """Metres `(n, 2)` east and north of pixels `(n, 2)` of the ground; NaN above the horizon."""
        mapped = np.column_stack([pixels_xy, np.ones(len(pixels_xy))]) @ self.homography.T
        depth = mapped[:, 2:]
        return mapped[:, :2] / np.where(depth > _HORIZON_GAP * self.focal_px, depth, np.nan)


def camera_of(
    horizon: tuple[float, float], vertical_xy: tuple[float, float], frame_size: tuple[int, int], height_m: float = 1.0
) -> Camera:
    """The camera with this horizon and vertical vanishing point.

    With p the principal point, n the foot of the perpendicular from p to the horizon and v the vertical vanishing
    point: (v - p) . (n - p) = -f².

    Args:
        horizon: Slope and offset.
        vertical_xy: Where the images of vertical lines meet, px; below the picture of a camera that looks down.
        frame_size: Width and height, px.
        height_m: Height above the ground.

    Raises:
        NotACamera: Horizon and vanishing point lie on the same side of the picture's middle, or one of them in it: the
            focal length does not follow.

    Source: Hartley and Zisserman, 8.8 (the calibrating conic), for a single pair of pole and polar.
    """
    (slope, offset), (width, height) = horizon, frame_size
    roll = math.atan(slope)
    down = np.array([-math.sin(roll), math.cos(roll)])
    to_horizon = (slope * width / 2 + offset - height / 2) * math.cos(roll)
    to_vertical = float(down @ (np.array(vertical_xy) - np.array([width, height]) / 2))
    squared = -to_horizon * to_vertical
    if not squared > 0:
        raise NotACamera(
            f"the horizon lies {to_horizon:.1f} px and the vertical vanishing point {to_vertical:.1f} px below the "
            "picture's middle: they must lie on two sides of it to fix a focal length. Next: give another camera whose "
            "view is tilted, or a focal length"
        )
    focal = math.sqrt(squared)
    return Camera(focal, math.atan2(-to_horizon, focal), roll, height_m, width, height)


def meeting_point(feet_xy: Floats, heads_xy: Floats) -> tuple[float, float]:
    """Where the lines through feet and heads `(n, 2)` meet: the vertical vanishing point of upright things, px.

    Minimises the distances of the point from the lines, weighted with the lines' lengths, in homogeneous coordinates.

    Raises:
        NotACamera: There are fewer than two lines, or they are parallel in the picture.

    Source: Hartley and Zisserman, 8.6.1, the linear estimate.
    """
    if len(feet_xy) < 2:
        raise NotACamera(f"a vanishing point takes two lines or more, got {len(feet_xy)}")
    middle = np.concatenate([feet_xy, heads_xy]).mean(axis=0)
    size = float(np.abs(np.concatenate([feet_xy, heads_xy]) - middle).max()) or 1.0
    ones = np.ones((len(feet_xy), 1))
    feet, heads = (np.hstack([(points - middle) / size, ones]) for points in (feet_xy, heads_xy))
    _, sizes, rows = np.linalg.svd(np.cross(feet, heads))
    x, y, w = rows[-1]
    if abs(w) < 1e-6 * np.hypot(x, y) or sizes[1] < 1e-9 * sizes[0]:
        raise NotACamera("the lines are parallel in the picture: their vanishing point lies at infinity")
    return float(x / w * size + middle[0]), float(y / w * size + middle[1])
