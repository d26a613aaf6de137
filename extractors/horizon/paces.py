"""Evidence of paces: who walks or drives keeps about the same pace on the ground, wherever in the picture.

It does not rest on the boxes' heights, so it holds where these are off by the same pixels near and far.
"""

import numpy as np

from extractors.horizon.camera import Floats, FrameSize, feet_of, ground_points
from extractors.horizon.config import HorizonConfig
from extractors.horizon.evidence import Evidence
from extractors.horizon.places import Places


class Paces(Evidence):
    """Misfit of a step from one place to the next: its pace on the ground against its track's own."""

    def __init__(self, places: Places, tracks: int, size: FrameSize, config: HorizonConfig) -> None:
        apart_s = np.diff(places.time_s)
        is_step = (np.diff(places.track) == 0) & (apart_s > 0)
        self._places, self._from, self._to = places, np.flatnonzero(is_step), np.flatnonzero(is_step) + 1
        self._log_s, self._size = np.log(apart_s[is_step]), size
        track = places.track[1:][is_step]
        super().__init__(
            track,
            tracks,
            weight=config.pace_weight * np.minimum(places.likeness[1:], places.likeness[:-1])[is_step],
            tail=config.pace_tail,
            noise_floor=config.pace_floor,
            own_spread=config.pace_spread,
            own_tail=config.object_tail,
        )

    def misfits(self, camera: Floats, own: Floats) -> Floats:
        """Misfits of the logarithm of the paces, camera heights per s."""
        feet_xy = feet_of(camera[:3], self._places.middle_xy, np.exp(self._places.log_height), self._size)
        ground = ground_points(camera[:3], feet_xy, self._size)
        way = ground[self._to] - ground[self._from]
        log_pace = np.log(np.maximum(np.hypot(*way.T), 1e-9)) - self._log_s
        return np.asarray(log_pace - camera[5] - own[self._track])

    def usual_pace(self, camera: Floats) -> float:
        """Logarithm of the median pace under this camera, camera heights per s."""
        if not len(self._track):
            return 0.0
        off = self.misfits(camera, np.zeros(self._tracks))
        return float(camera[5] + np.median(off))
