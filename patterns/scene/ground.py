"""From pixels to the ground: what a calibration says of points and speeds in the ground plane.

Pixels have their origin at the top left, x to the right and y down; the ground has metres to the
east and to the north. A homography holds for points of the ground plane only: it is right for the
ground contact point of a track, and for nothing above it.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
GroundValue = Literal["x", "y", "speed"]


@dataclass(frozen=True, slots=True)
class Calibration:
    """The homography of one source.

    Attributes:
        matrix: Row by row; (X, Y, W) = matrix (x, y, 1), X/W m to the east, Y/W m to the north, W > 0
            on the near side of the horizon.
        frame_size: Width and height in pixels of the frame that the pixels are of.
    """

    matrix: Matrix
    frame_size: tuple[int, int]

    def __post_init__(self) -> None:
        """Checks that the matrix is one that can be turned round."""
        array = np.asarray(self.matrix, dtype=np.float64)
        if array.shape != (3, 3) or not np.isfinite(array).all():
            raise ValueError(f"a homography is 3 rows of 3 finite numbers, got shape {array.shape}")
        if abs(np.linalg.det(array / np.abs(array).max(initial=1e-300))) < 1e-15:
            raise ValueError("a homography must not be singular: it maps the whole picture to a line")

    def ground(self, x: Points, y: Points, frame_size: tuple[int, int] | None) -> tuple[Points, Points]:
        """Metres to the east and north of these pixels; NaN for pixels above the horizon.

        `frame_size` is that of the frame that the pixels are of; None: that of the calibration.
        """
        east, north, depth = self._mapped(*self._scaled(x, y, frame_size))
        seen = np.where(depth > 0, depth, np.nan)
        return east / seen, north / seen

    def speed(self, point: tuple[Points, Points], velocity: tuple[Points, Points],
              frame_size: tuple[int, int] | None) -> Points:  # fmt: skip
        """Speed on the ground, m/s, of a point (px) that moves with this velocity (px/s); NaN above the horizon.

        The derivative of X/W and Y/W along the velocity: (X' - X/W W') / W, and likewise for Y.
        """
        x, y = self._scaled(*point, frame_size)
        vx, vy = self._scaled(*velocity, frame_size)
        east, north, depth = self._mapped(x, y)
        seen = np.where(depth > 0, depth, np.nan)
        (a, b, _), (d, e, _), (g, h, _) = self.matrix
        depth_rate = g * vx + h * vy
        east_mps = (a * vx + b * vy - east / seen * depth_rate) / seen
        north_mps = (d * vx + e * vy - north / seen * depth_rate) / seen
        return np.sqrt(east_mps * east_mps + north_mps * north_mps)

    def _mapped(self, x: Points, y: Points) -> tuple[Points, Points, Points]:
        (a, b, c), (d, e, f), (g, h, i) = self.matrix
        return a * x + b * y + c, d * x + e * y + f, g * x + h * y + i

    def _scaled(self, x: Points, y: Points, frame_size: tuple[int, int] | None) -> tuple[Points, Points]:
        """Pixels of a frame of this size as pixels of the calibration's frame."""
        if frame_size is None or frame_size == self.frame_size:
            return x, y
        (width, height), (to_width, to_height) = frame_size, self.frame_size
        return x * (to_width / width), y * (to_height / height)
