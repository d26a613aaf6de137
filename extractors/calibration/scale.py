"""Where metres come from: the height of people, of the camera, or a length that somebody measured.

Each gives a standard deviation, so that it reaches the result.
"""

import math
from dataclasses import dataclass

import numpy as np

from extractors.calibration.camera import Camera

PIXEL_DEVIATION = 1.5
"""Standard deviation of an image point that a person marked, px."""


@dataclass(frozen=True, slots=True)
class PersonHeight:
    """The mean height of the people who pass, m, and the standard deviation of what is known of that, m."""

    metres: float
    deviation: float

    @property
    def share(self) -> float:
        """The standard deviation of the mean height's logarithm."""
        return self.deviation / self.metres

    @property
    def word(self) -> str:
        """What events call it."""
        return "person_height"


@dataclass(frozen=True, slots=True)
class CameraHeight:
    """The camera's height above the ground, m, and its standard deviation, m."""

    metres: float
    deviation: float

    @property
    def share(self) -> float:
        """The standard deviation of the height's logarithm."""
        return self.deviation / self.metres

    @property
    def word(self) -> str:
        """What events call it."""
        return "camera_height"


@dataclass(frozen=True, slots=True)
class KnownLength:
    """The distance of two points of the ground, m, and where they are in the picture, px."""

    xy: tuple[float, float]
    other_xy: tuple[float, float]
    metres: float

    @property
    def word(self) -> str:
        """What events call it."""
        return "length"

    def deviations(self, camera: Camera) -> float:
        """How far the camera's own length of it is off, as logarithm over its standard deviation; 100 if not seen."""
        ends = np.array([self.xy, self.other_xy])
        found = _length(camera, ends)
        if not found > 0:
            return 100.0
        moved = np.repeat(ends[None], 4, axis=0)
        moved[np.arange(4), np.arange(4) // 2, np.arange(4) % 2] += PIXEL_DEVIATION
        lengths = [_length(camera, each) for each in moved]
        if not min(lengths) > 0:
            return 100.0
        changes = [math.log(length / found) for length in lengths]
        deviation = math.sqrt(sum(change * change for change in changes))
        if not math.isfinite(deviation) or deviation <= 0:
            return 100.0
        return math.log(found / self.metres) / deviation


Scale = PersonHeight | CameraHeight | KnownLength


def _length(camera: Camera, ends: np.typing.NDArray[np.float64]) -> float:
    (east, north), (other_east, other_north) = camera.ground(ends)
    return math.hypot(other_east - east, other_north - north)
