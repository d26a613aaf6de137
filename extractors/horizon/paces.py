"""Evidence of paces: who walks or drives keeps about the same pace on the ground, wherever in the picture.

It does not rest on the boxes' heights, so it holds where these are off by the same pixels near and far.
"""

import math

import numpy as np
import numpy.typing as npt

from extractors.horizon.camera import Floats, FrameSize, feet_of, ground_points
from extractors.horizon.config import HorizonConfig
from extractors.horizon.evidence import Evidence
from extractors.horizon.places import Places


class Paces(Evidence):
    """Misfit of a stretch from one place to a later one: its pace on the ground against its track's own."""

    def __init__(self, places: Places, tracks: int, size: FrameSize, config: HorizonConfig) -> None:
        self._places, self._size, self._turn = places, size, config.pace_turn
        self._from, self._to = _stretches(places, config.pace_stretch)
        self._log_s = np.log(places.time_s[self._to] - places.time_s[self._from])
        track = places.track[self._to]
        super().__init__(
            track,
            tracks,
            weight=config.pace_weight * np.minimum(places.likeness[self._from], places.likeness[self._to]),
            tail=config.pace_tail,
            noise_floor=config.pace_floor,
            own_spread=config.pace_spread,
            own_tail=config.object_tail,
            trends=config.pace_trend * (places.frame_xy[self._from] + places.frame_xy[self._to]) / 2,
        )

    def misfits(self, camera: Floats, own: Floats) -> Floats:
        """Misfits of the logarithm of the paces, camera heights per s."""
        log_pace = np.log(np.maximum(np.linalg.norm(self._ways(camera), axis=-1), 1e-9)) - self._log_s
        return np.asarray(log_pace - camera[5] - own[self._track])

    def trends(self, camera: Floats) -> Floats:
        """By place in the frame, and by direction on the ground."""
        way = self._ways(camera)
        twice = 2 * np.arctan2(way[:, 1], way[:, 0])
        turns = self._turn * np.stack([np.cos(twice), np.sin(twice)], axis=1)
        return np.hstack([super().trends(camera), turns])

    def usual_pace(self, camera: Floats) -> float:
        """Logarithm of the median pace under this camera, camera heights per s."""
        if not len(self._track):
            return 0.0
        off = self.misfits(camera, np.zeros(self._tracks))
        return float(camera[5] + np.median(off))

    def _ways(self, camera: Floats) -> Floats:
        """Each stretch on the ground, right and ahead of the camera, camera heights, `(..., n, 2)`."""
        feet_xy = feet_of(camera[:3], self._places.middle_xy, np.exp(self._places.log_height), self._size)
        ground = ground_points(camera[:3], feet_xy, self._size)
        return np.asarray(ground[..., self._to, :] - ground[..., self._from, :])


def _stretches(places: Places, share: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First and last place of each stretch of a track, `(n,)`: one begins where the one before ended.

    Args:
        places: In order of track, then of time.
        share: How far apart they are in the picture, box heights.
    """
    first, last, began = [], [], 0
    x, y = places.middle_xy.T.tolist()
    track, time_s, height = places.track.tolist(), places.time_s.tolist(), np.exp(places.log_height).tolist()
    for at in range(1, len(track)):
        if track[at] != track[began]:
            began = at
        elif math.hypot(x[at] - x[began], y[at] - y[began]) >= share * height[began] and time_s[at] > time_s[began]:
            first.append(began)
            last.append(at)
            began = at
    return np.array(first, np.int64), np.array(last, np.int64)
