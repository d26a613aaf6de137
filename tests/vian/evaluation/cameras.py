"""Walkers before a pinhole camera of known pose, as exact boxes."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vian.evaluation.boxes import Boxes
from vian.evaluation.lines import Horizon

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Pinhole:
    """Square pixels, principal point in the middle, ground z = 0, camera above the origin, looking north."""

    width: int = 640
    height: int = 480
    focal_px: float = 700.0
    pitch: float = 0.15
    roll: float = 0.0
    height_m: float = 5.0

    @property
    def camera_from_world(self) -> Floats:
        s, c = np.sin(self.pitch), np.cos(self.pitch)
        level = np.array([[1, 0, 0], [0, -s, -c], [0, c, -s]])  # x east, y down the picture, z along the view
        s, c = np.sin(self.roll), np.cos(self.roll)
        return np.asarray(np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ level)

    def pixels(self, points_m: Floats) -> Floats:
        """`(n, 2)` px of points `(n, 3)` m."""
        seen = (points_m - [0, 0, self.height_m]) @ self.camera_from_world.T
        return np.asarray(self.focal_px * seen[:, :2] / seen[:, 2:] + [self.width / 2, self.height / 2])

    @property
    def horizon(self) -> Horizon:
        """Where level directions vanish."""
        far = np.array([[-1e9, 1e10, self.height_m], [1e9, 1e10, self.height_m]])
        (x1, y1), (x2, y2) = self.pixels(far)
        slope = (y2 - y1) / (x2 - x1)
        return Horizon(float(slope), float(y1 - slope * x1))

    @property
    def homography(self) -> Floats:
        """From pixels to metres of the ground."""
        k = np.array([[self.focal_px, 0, self.width / 2], [0, self.focal_px, self.height / 2], [0, 0, 1]])
        r = self.camera_from_world
        inverse = np.linalg.inv(k @ np.column_stack([r[:, :2], -r @ [0, 0, self.height_m]]))
        foot = inverse @ np.append(self.pixels(np.array([[0.0, 15.0, 0.0]]))[0], 1)
        return np.asarray(inverse * np.sign(foot[2]))


def walkers(camera: Pinhole, rng: np.random.Generator, tracks: int = 12, frames: int = 40) -> tuple[Boxes, Floats]:
    """Boxes 10 cm to each side of upright walkers, and where they are, `(n, 2)` m."""
    rows, places = [], []
    for track in range(1, tracks + 1):
        start, way, tall = rng.uniform((-5, 12), (5, 40)), rng.normal(0, 1.2, 2), rng.uniform(1.6, 1.85)
        for frame in range(frames):
            at = start + way * frame / 10
            foot, head = camera.pixels(np.array([[*at, 0], [*at, tall]]))
            half = 0.2 * (foot[1] - head[1])
            rows.append((frame, track, foot[0] - half, head[1], foot[0] + half, foot[1]))
            places.append(at)
    found = np.array(rows)
    order = np.lexsort((found[:, 1], found[:, 0]))
    found, placed = found[order], np.array(places)[order]
    numbers = found[:, :2].astype(np.int64)
    boxes = Boxes(numbers[:, 0], numbers[:, 1], found[:, 2:], np.ones(len(found)), numbers[:, 0] * 100_000)
    return boxes, placed
