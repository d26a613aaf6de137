"""Track points as columns, from wherever they come.

Contract: in order of time, then of track, as the motion extractor emits them.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Self

import numpy as np
import numpy.typing as npt

from events import EventBatch

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True, eq=False)
class TrackPoints:
    """Boxes of tracks in frames."""

    time_us: npt.NDArray[np.int64]
    """when, µs since 1970 (UTC), `(n,)`"""
    track_id: npt.NDArray[np.int64]
    """number of the track, `(n,)`"""
    frame: npt.NDArray[np.int64]
    """number of the frame, `(n,)`"""
    boxes_xyxy: npt.NDArray[np.float64]
    """`x1 y1 x2 y2`, px of the video's frame, `(n, 4)`"""
    confidence: npt.NDArray[np.float64]
    """0 (predicted) to 1 (seen), `(n,)`"""

    @classmethod
    def of(cls, batch: EventBatch) -> Self:
        """The columns of a batch of `track_point`."""
        column = batch.data.column
        return cls(
            time_us=column("time").cast("int64").to_numpy(),
            track_id=column("track_id").to_numpy(),
            frame=column("frame").to_numpy(),
            boxes_xyxy=np.stack([column(name).to_numpy() for name in ("x1", "y1", "x2", "y2")], axis=1).astype(float),
            confidence=column("confidence").to_numpy().astype(float),
        )

    def followed_by(self, later: Self) -> Self:
        """These points and then those."""
        return type(self)(
            np.concatenate([self.time_us, later.time_us]),
            np.concatenate([self.track_id, later.track_id]),
            np.concatenate([self.frame, later.frame]),
            np.concatenate([self.boxes_xyxy, later.boxes_xyxy]),
            np.concatenate([self.confidence, later.confidence]),
        )

    def __len__(self) -> int:
        return len(self.time_us)

    def __getitem__(self, kept: slice | npt.NDArray[np.bool_]) -> Self:
        return type(self)(
            self.time_us[kept], self.track_id[kept], self.frame[kept], self.boxes_xyxy[kept], self.confidence[kept]
        )
