"""Two tracks that are near each other, frame by frame: `pair_distance`."""

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from events import EventType, PairDistance
from patterns.durations import microseconds
from patterns.engine.situations import nearest_time
from patterns.stages.frames import Frame, frames
from patterns.stages.settings import Pairs

STANDS_PX_S = 1e-3
"""A track slower than this stands still, and has no direction, px/s."""


class NearPairs:
    """Remembers when each pair was last told of, where it matters; `given_up` counts pairs beyond the limit."""

    def __init__(self, name: str, settings: Pairs) -> None:
        self.name = name
        self.settings = settings
        self.every_us = microseconds(settings.every)
        self.given_up = 0
        self._told: dict[tuple[str, int, int], int] = {}

    def take(self, rows: pa.Table, until_us: int) -> list[tuple[str, EventType]]:
        """What the rows, the next final ones in their total order, and the coming of this time lead to."""
        found = [(frame.source, event) for frame in frames(rows) for event in self._of_frame(frame)]
        if self._told:
            self._told = {pair: told for pair, told in self._told.items() if told + self.every_us > until_us}
        return found

    def reset(self) -> None:
        """The input has ended."""
        self._told.clear()

    def state(self) -> Any:
        """What `restore` takes."""
        return [self.given_up, [[*pair, told] for pair, told in self._told.items()]]

    def restore(self, saved: Any) -> None:
        """Goes on from what `state` gave."""
        self.given_up, told = saved
        self._told = {(source, a, b): at for source, a, b, at in told}

    def _of_frame(self, whole: Frame) -> list[EventType]:
        frame = whole.first(self.settings.tracks_most)
        pairs, distances = near_pairs(frame.xy, self.settings.radius_px)
        order = np.lexsort((pairs[:, 1], pairs[:, 0], distances))
        told: list[EventType] = []
        for at in order[: self.settings.pairs_most]:
            first, second = pairs[at]
            key = (frame.source, int(frame.tracks[first]), int(frame.tracks[second]))
            if self._is_due(key, frame.time_us):
                told.append(self._event(frame, first, second, float(distances[at])))
        self.given_up += max(0, len(order) - self.settings.pairs_most)
        return told

    def _is_due(self, key: tuple[str, int, int], time_us: int) -> bool:
        if self.every_us == 0:
            return True
        told = self._told.get(key)
        if told is not None and time_us < told + self.every_us:
            return False
        self._told[key] = time_us
        return True

    def _event(self, frame: Frame, first: int, second: int, distance: float) -> PairDistance:
        between = frame.xy[second] - frame.xy[first]
        velocity_a, velocity_b = frame.vxy[first], frame.vxy[second]
        closing = -float(between @ (velocity_b - velocity_a)) / distance if distance else 0.0
        speed_a, speed_b = (float(np.hypot(*velocity)) for velocity in (velocity_a, velocity_b))
        stands = min(speed_a, speed_b) < STANDS_PX_S
        cosine = None if stands else float(velocity_a @ velocity_b) / (speed_a * speed_b)
        track_a, track_b = int(frame.tracks[first]), int(frame.tracks[second])
        x, y = (frame.xy[first] + frame.xy[second]) / 2
        return PairDistance(
            time=nearest_time(frame.time_us), stage=self.name, pair=f"{track_a}+{track_b}", track_a=track_a,
            track_b=track_b, distance_px=distance, closing_px_s=closing, speed_a_px_s=speed_a, speed_b_px_s=speed_b,
            alignment=None if cosine is None else min(1.0, max(-1.0, cosine)), x=x, y=y,
        )  # fmt: skip


def near_pairs(xy: NDArray[np.float64], radius: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The pairs of points at most `radius` apart: indices, the lower first, shape (m, 2), and distances, shape (m,)."""
    if len(xy) < 2:
        return np.empty((0, 2), dtype=np.int64), np.empty(0)
    pairs = cKDTree(xy).query_pairs(radius, output_type="ndarray").astype(np.int64)
    distances = np.hypot(*(xy[pairs[:, 0]] - xy[pairs[:, 1]]).T)
    return pairs, distances
