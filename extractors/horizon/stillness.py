"""Whether the camera stands still, by how the boxes move.

When the camera turns, everything moves alike. Objects on a plane do not: those farther away move less in
the picture, and they have aims of their own. Folded a frame at a time; memory is bounded by the window.
"""

from collections import deque

import numpy as np
import numpy.typing as npt

from extractors.horizon.camera import Floats, FrameSize
from extractors.horizon.config import HorizonConfig


class Stillness:
    """Counts frames in which everything moves alike."""

    def __init__(self, size: FrameSize, config: HorizonConfig) -> None:
        self._speed_min = config.moving_speed_min * size.height
        self._config = config
        self._last: dict[int, tuple[int, float, float]] = {}
        self._frames: deque[tuple[int, bool]] = deque()

    def add(self, time_us: int, track_id: npt.NDArray[np.int64], boxes_xyxy: Floats) -> None:
        """Take in the tracks of one frame."""
        middles = (boxes_xyxy[:, :2] + boxes_xyxy[:, 2:]) / 2
        now = {int(n): (time_us, float(x), float(y)) for n, (x, y) in zip(track_id, middles, strict=True)}
        moved = [
            (
                (x - self._last[n][1]) / (at - self._last[n][0]) * 1e6,
                (y - self._last[n][2]) / (at - self._last[n][0]) * 1e6,
            )
            for n, (at, x, y) in now.items()
            if n in self._last and at > self._last[n][0]
        ]
        self._last = now
        if len(moved) >= self._config.moving_tracks_min:
            self._frames.append((time_us, self._is_common(np.array(moved))))
        while self._frames and self._frames[0][0] < time_us - self._config.moving_window_s * 1e6:
            self._frames.popleft()

    @property
    def is_moving(self) -> bool:
        """Whether the camera moves, as far as the last seconds show."""
        if not self._frames or self._frames[-1][0] - self._frames[0][0] < self._config.moving_window_s * 0.5e6:
            return False
        return sum(is_common for _, is_common in self._frames) >= self._config.moving_share_min * len(self._frames)

    def _is_common(self, velocities: Floats) -> bool:
        mean = velocities.mean(axis=0)
        speed = float(np.hypot(*mean))
        spread = float(np.sqrt(((velocities - mean) ** 2).sum(axis=1).mean()))
        return speed > self._speed_min and spread < self._config.moving_spread_max * speed
