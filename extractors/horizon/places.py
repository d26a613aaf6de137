"""Where along its way a track had what height: the median box of each place, folded from track points.

Contract: points come in order of time; the fold depends on their order and not on how it is cut into
batches. Memory is bounded by configuration. Boxes that are cut by the frame's edge, predicted, or too low
are left out.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from extractors.horizon.camera import Floats, FrameSize
from extractors.horizon.config import HorizonConfig

Row = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Places:
    """Median boxes of the places of several tracks."""

    track: npt.NDArray[np.int64]
    """index of the track, from 0, `(n,)`"""
    time_s: Floats
    """when the track was there, s, `(n,)`"""
    middle_xy: Floats
    """middle of the box's lower edge, px, `(n, 2)`; where it stands only without roll"""
    log_height: Floats
    """logarithm of the box's height in px, `(n,)`"""
    likeness: Floats
    """how much the box has the shape that most have, 0 to 1, `(n,)`"""
    points: Floats
    """track points that the place is made of, `(n,)`"""
    frame_xy: Floats
    """where in the frame that is, -0.5 to 0.5 on both axes, `(n, 2)`"""
    is_clear: npt.NDArray[np.bool_]
    """whether most of the boxes were measured, and not sized as expected, `(n,)`"""
    aspect: float
    """height over width that most have; 0 without places"""

    @property
    def tracks(self) -> int:
        """How many tracks there are."""
        return len(np.unique(self.track))

    def halves(self) -> Iterator["Places"]:
        """The tracks that ended first, and the others, as many; nothing of a single track."""
        tracks = np.unique(self.track)
        if len(tracks) > 1:
            is_late = self.track >= tracks[len(tracks) // 2]
            yield self._where(~is_late)
            yield self._where(is_late)

    def clear(self) -> "Places":
        """Those whose boxes were measured."""
        return self._where(self.is_clear)

    def _where(self, kept: npt.NDArray[np.bool_]) -> "Places":
        _, track = np.unique(self.track[kept], return_inverse=True)
        return replace(
            self,
            track=track,
            time_s=self.time_s[kept],
            middle_xy=self.middle_xy[kept],
            log_height=self.log_height[kept],
            likeness=self.likeness[kept],
            points=self.points[kept],
            frame_xy=self.frame_xy[kept],
            is_clear=self.is_clear[kept],
        )


@dataclass(slots=True)
class Path:
    """The places of one track."""

    last_us: int
    places: list[Row] = field(default_factory=list)
    """`time (s), x, y, width, height (px), confidence, points` of each closed place"""
    here: list[Row] = field(default_factory=list)
    """`time (s), x, y, width, height (px), confidence` of the points of the place that is open"""
    stride: float = 1.0
    """length of a place, in units of the configured one"""
    points: int = 0
    """how many were taken in and not left out"""

    def add(self, point: Row, config: HorizonConfig) -> bool:
        """Take in one box: `time (s), x, y, width, height (px), confidence`; False where it is left out."""
        _, x, y, *_ = point
        if self.here:
            _, x0, y0, _, height0, _ = self.here[0]
            if (x - x0) ** 2 + (y - y0) ** 2 > (config.stride * self.stride * height0) ** 2:
                self.places.append(_median(self.here))
                self.here = []
                self._thin(config)
        is_kept = len(self.here) < config.place_points_max
        if is_kept:
            self.here.append(point)
            self.points += 1
        return is_kept

    def rows(self) -> Floats:
        """All places, the open one included: `time (s), x, y, width, height (px), confidence, points`, `(n, 7)`."""
        return np.array([*self.places, _median(self.here)] if self.here else self.places).reshape(-1, 7)

    def _thin(self, config: HorizonConfig) -> None:
        if len(self.places) > config.track_places_max:
            self.places = self.places[::2]
            self.stride *= 2


def _median(points: list[Row]) -> Row:
    return (*map(float, np.median(np.array(points), axis=0)), float(len(points)))


def is_whole(boxes_xyxy: Floats, confidence: Floats, size: FrameSize, config: HorizonConfig) -> npt.NDArray[np.bool_]:
    """Which boxes show an object whole, `(n,)`: seen, high enough, and not cut by the frame.

    A box that reaches beyond the frame is whole: who gave it knew more than the picture shows.
    """
    border = config.border_share * size.height
    edges = np.array([0, 0, size.width, size.height])
    is_cut = (np.abs(boxes_xyxy - edges) < border).any(axis=1)
    widths, heights = (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]).T
    is_high = heights >= config.height_share_min * size.height
    return np.asarray(~is_cut & is_high & (widths > 0) & (confidence >= config.confidence_min))


def places_of(paths: Iterable[Path], size: FrameSize, config: HorizonConfig) -> Places:
    """The places of these tracks as columns, in order."""
    rows = [np.insert(path.rows(), 0, index, axis=1) for index, path in enumerate(paths)]
    table = np.concatenate(rows) if rows else np.zeros((0, 8))
    shapes = np.log(table[:, 5] / table[:, 4])
    usual = float(np.median(shapes)) if len(shapes) else -np.inf
    unlike = (shapes - usual) / config.shape_spread
    return Places(
        track=table[:, 0].astype(np.int64),
        time_s=table[:, 1],
        middle_xy=table[:, 2:4],
        log_height=np.log(table[:, 5]),
        likeness=1 / (1 + unlike**2) ** 2,
        points=table[:, 7],
        frame_xy=table[:, 2:4] / [size.width, size.height] - 0.5,
        is_clear=table[:, 6] >= config.clear_confidence,
        aspect=float(np.exp(usual)),
    )
