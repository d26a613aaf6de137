"""Sizes of upright people before a calibrated camera: what `extractors.motion.sizes` learns, from geometry instead.

A person is an upright rectangle over the ground contact point, projected exactly; so this holds for cameras that look
down steeply, where the learnt linear relation does not. Nothing is known above the horizon.
"""

from dataclasses import dataclass

import numpy as np

from extractors.calibration import Camera
from extractors.motion.sizes import Array, SizePrior, Sizes

WIDTH_SHARE = 0.4
"""Width of a walking person, of the height: shoulders and swinging arms from the front, a stride from the side."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedSizes:
    """Sizes that a camera gives, px of its frame."""

    camera: Camera
    person_height_m: float = 1.70
    """mean height of those who pass, m"""
    deviation: float = 0.07
    """relative standard deviation of a height: of adults (0.05), and of their mean at this place (0.04)"""

    def expected(self, feet_xy: Array) -> Sizes:
        """Sizes of upright people with these ground contact points, `(n, 2)` px; NaN above the horizon."""
        ground = self.camera.ground(feet_xy)
        half_m = WIDTH_SHARE * self.person_height_m / 2
        corners = np.stack(
            [
                self.camera.project(np.column_stack([ground[:, 0] + east_m, ground[:, 1], np.full(len(ground), up_m)]))
                for east_m in (-half_m, half_m)
                for up_m in (0.0, self.person_height_m)
            ]
        )
        feet, heads = (corners[0] + corners[2]) / 2, (corners[1] + corners[3]) / 2
        height = feet[:, 1] - heads[:, 1]
        width = corners[:, :, 0].max(axis=0) - corners[:, :, 0].min(axis=0)
        is_known = height > 1
        height, width = (np.where(is_known, size, np.nan) for size in (height, width))
        return Sizes(height, width, np.where(is_known, self.deviation, np.nan))


@dataclass(frozen=True, slots=True, eq=False)
class ShrunkSizes:
    """Sizes in px of a smaller picture."""

    sizes: SizePrior
    factor: float
    """px of the frame for one of the picture"""

    def expected(self, feet_xy: Array) -> Sizes:
        """Sizes of upright objects with these ground contact points, `(n, 2)` px of the picture."""
        known = self.sizes.expected(feet_xy * self.factor)
        return Sizes(known.height / self.factor, known.width / self.factor, known.deviation)
