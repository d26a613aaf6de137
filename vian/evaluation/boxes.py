"""Boxes with track numbers as columns: what truth, trackers and estimators have in common.

Contract: arrays of one length, in order of frame, then of track number; all finite, all boxes with an
area. Pixels: origin top-left, x right, y down.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from vian.errors import WrongUsage

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
FRAMES_MAX = 10_000_000
"""Numbers of frames beyond this are mistakes: some days of video."""
COORDINATE_MAX = 1e6
"""Coordinates beyond this are mistakes, px: products of four of them still have all digits."""


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Boxes of tracks, one a row."""

    frame: Ints
    """number of the frame, from 0, `(n,)`"""
    track_id: Ints
    """number of the track, `(n,)`; -1 where nobody said"""
    xyxy: Floats
    """`x1 y1 x2 y2`, `(n, 4)` px"""
    confidence: Floats
    """what the producer trusts it, 0 to 1 for most, `(n,)`"""
    time_us: Ints
    """time since the first frame, `(n,)` µs"""

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def feet_xy(self) -> Floats:
        """Middles of the lower edges, `(n, 2)` px."""
        return np.stack([(self.xyxy[:, 0] + self.xyxy[:, 2]) / 2, self.xyxy[:, 3]], axis=1)

    @property
    def heights(self) -> Floats:
        """Heights of the boxes, `(n,)` px."""
        return np.asarray(self.xyxy[:, 3] - self.xyxy[:, 1])

    def where(self, rows: npt.NDArray[Any]) -> "Boxes":
        """These rows alone."""
        return Boxes(self.frame[rows], self.track_id[rows], self.xyxy[rows], self.confidence[rows], self.time_us[rows])

    def by_track(self) -> Iterator["Boxes"]:
        """The boxes of one track after another, each in order of frame."""
        order = np.lexsort((self.frame, self.track_id))
        cuts = np.flatnonzero(np.diff(self.track_id[order])) + 1
        for rows in np.split(order, cuts):
            if len(rows):
                yield self.where(rows)

    def scaled(self, factor_x: float, factor_y: float) -> "Boxes":
        """The same boxes in pixels of a frame of another size."""
        factors = np.array([factor_x, factor_y, factor_x, factor_y])
        return Boxes(self.frame, self.track_id, self.xyxy * factors, self.confidence, self.time_us)


def boxes_of(
    name: object, frame: npt.ArrayLike, track_id: npt.ArrayLike, xyxy: Floats, confidence: Floats, time_us: Ints
) -> Boxes:
    """The columns as boxes in their order.

    Args:
        name: Where they come from, for errors.
        frame: Whole numbers from 0, `(n,)`.
        track_id: Whole numbers, `(n,)`.
        xyxy: `(n, 4)` px.
        confidence: `(n,)`.
        time_us: `(n,)` µs.

    Raises:
        WrongUsage: A number is not finite, a box has no area, or a track is twice in one frame.
    """
    frames, tracks = _whole(name, "frame", frame), _whole(name, "track", track_id)
    _check_boxes(name, frames, xyxy, confidence)
    order = np.lexsort((tracks, frames))
    boxes = Boxes(frames[order], tracks[order], xyxy[order], confidence[order], time_us[order])
    same = (np.diff(boxes.frame) == 0) & (np.diff(boxes.track_id) == 0) & (boxes.track_id[1:] >= 0)
    if same.any():
        at = int(np.flatnonzero(same)[0])
        raise WrongUsage(
            f"{name}: track {boxes.track_id[at]} has two boxes in frame {boxes.frame[at]}, wanted one. "
            "Next: keep one row a track and frame"
        )
    return boxes


def _whole(name: object, what: str, given: npt.ArrayLike) -> Ints:
    values = np.asarray(given, float)
    bad = np.flatnonzero(~np.isfinite(values) | (values != np.round(values)) | (np.abs(values) > 2**53))
    if len(bad):
        raise WrongUsage(
            f"{name}: row {bad[0] + 1} has the {what} {values[bad[0]]:g}, wanted a whole number. Next: mend that row"
        )
    return values.astype(np.int64)


def _check_boxes(name: object, frames: Ints, xyxy: Floats, confidence: Floats) -> None:
    if len(frames) and frames.min() < 0:
        raise WrongUsage(
            f"{name}: row {int(frames.argmin()) + 1} lies before the first frame. "
            "Next: count frames as the format says, MOTChallenge from 1"
        )
    if len(frames) and frames.max() > FRAMES_MAX:
        raise WrongUsage(
            f"{name}: row {int(frames.argmax()) + 1} is of frame {frames.max()}, wanted at most {FRAMES_MAX}. "
            "Next: mend that row"
        )
    bad = np.flatnonzero(~np.isfinite(xyxy).all(axis=1) | ~np.isfinite(confidence))
    if len(bad):
        raise WrongUsage(f"{name}: row {bad[0] + 1} has a number that is not finite. Next: mend or drop that row")
    bad = np.flatnonzero((np.abs(xyxy) > COORDINATE_MAX).any(axis=1))
    if len(bad):
        raise WrongUsage(
            f"{name}: row {bad[0] + 1} reaches {np.abs(xyxy[bad[0]]).max():g} px, wanted at most {COORDINATE_MAX:g}. "
            "Next: mend or drop that row"
        )
    sizes = xyxy[:, 2:] - xyxy[:, :2]
    bad = np.flatnonzero((sizes <= 0).any(axis=1))
    if len(bad):
        width, height = sizes[bad[0]]
        raise WrongUsage(
            f"{name}: row {bad[0] + 1} has a box of {width:g} x {height:g} px, wanted both above 0. "
            "Next: mend or drop that row"
        )
