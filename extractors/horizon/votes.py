"""What one track alone says: where its way meets the horizon.

An upright object's height in the picture is proportional to the distance of its foot from the horizon, so
the straight line through its foot points meets the horizon where its height would be nought: all lines
through corresponding points of the object at two times meet there.
"""

from dataclasses import dataclass

import numpy as np

from extractors.horizon.camera import Floats
from extractors.horizon.config import HorizonConfig


@dataclass(frozen=True, slots=True)
class Vote:
    """A point of the horizon, by one track."""

    x: float
    y: float
    deviation_px: float
    """standard deviation along the way"""
    direction: float
    """of the way in the picture, rad from the right, clockwise"""


def vote_of(rows: Floats, config: HorizonConfig) -> Vote | None:
    """The vote of a track's places `(n, 7)` (see `places.Path.rows`); None where its height does not change clearly."""
    if len(rows) < config.vote_places_min:
        return None
    feet_xy, heights = rows[:, 1:3], rows[:, 4]
    middle = feet_xy.mean(axis=0)
    along = np.linalg.svd(feet_xy - middle, full_matrices=False)[2][0]
    way = (feet_xy - middle) @ along
    spread = way @ way
    if spread <= 0:
        return None
    change = float(way @ heights / spread)
    misfits = heights - heights.mean() - change * way
    noise = max(misfits @ misfits / (len(rows) - 2), (config.noise_floor * heights.mean()) ** 2)
    if abs(change) < config.vote_significance * np.sqrt(noise / spread):
        return None
    away = -float(heights.mean()) / change
    deviation = np.sqrt(noise / len(rows) + away**2 * noise / spread) / abs(change)
    x, y = middle + away * along
    return Vote(float(x), float(y), float(deviation), float(np.arctan2(along[1], along[0])))
