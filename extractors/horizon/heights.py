"""Evidence of box heights: objects of about one height, lower in the picture the nearer they are."""

import numpy as np

from extractors.horizon.camera import Floats, FrameSize, feet_of, log_heights
from extractors.horizon.config import HorizonConfig
from extractors.horizon.evidence import Evidence
from extractors.horizon.places import Places

HEIGHT_MIN = 0.1
"""Smallest height that is expected of a box, px."""
FOOT_STEP = 0.01
"""Step of the derivative by the foot point, px."""


class Heights(Evidence):
    """Misfit of a box: its height against that of an object of the usual height, and its track's deviation from it."""

    def __init__(self, places: Places, tracks: int, size: FrameSize, config: HorizonConfig) -> None:
        super().__init__(
            places.track,
            tracks,
            weight=places.likeness,
            tail=config.tail,
            noise_floor=config.noise_floor,
            own_spread=config.object_spread,
            own_tail=config.object_tail,
            trends=config.height_trend * places.frame_xy,
        )
        self._places, self._size = places, size
        self._height_px = np.exp(places.log_height)
        shared = config.shared_share
        pixels = (config.noise_lines * size.height / self._height_px / config.noise_usual) ** 2
        self._edge_variance = shared + (1 - shared) / places.points + pixels

    def misfits(self, camera: Floats, own: Floats) -> Floats:
        """Misfits of the logarithm of the heights, over their deviation for edges that are off by one height.

        The foot point is measured by the same edge as the height, so an edge that is off moves both: the
        deviation depends on the camera (Sampson 1982; Chojnacki et al. 2000, equation 8).
        """
        places, size = self._places, self._size
        log_size = camera[3] + own[places.track]
        bias_px = camera[4] * size.height

        def expected(feet_xy: Floats) -> Floats:
            heights = np.exp(log_heights(camera[:3], log_size, camera[6], feet_xy, size))
            return np.asarray(np.log(np.maximum(heights + bias_px, HEIGHT_MIN)))

        feet_xy = feet_of(camera[:3], places.middle_xy, self._height_px, size)
        here = expected(feet_xy)
        right, down = (
            (expected(feet_xy + step) - here) * self._height_px / FOOT_STEP
            for step in (np.array([FOOT_STEP, 0.0]), np.array([0.0, FOOT_STEP]))
        )
        spread = np.sqrt(self._edge_variance * (1 + (1 - down) ** 2 + right**2 / 2))
        return np.asarray((places.log_height - here) / spread)

    def usual_size(self, camera: Floats) -> float:
        """Logarithm of the size that the median place has under this camera."""
        sizes = np.full(len(self._height_px), camera[3])
        feet_xy = feet_of(camera[:3], self._places.middle_xy, self._height_px, self._size)
        off = self._places.log_height - log_heights(camera[:3], sizes, camera[6], feet_xy, self._size)
        return float(camera[3] + np.median(off))
