"""Runs of the motion extractor, their events as plain arrays, and how they score against the truth."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from events import ActivityInterval, EventBatch, TrackEnded, TrackPoint, events_of
from extractors.media import Frame, Gap
from extractors.motion import Extraction, MotionConfig, extract
from vian.evaluation.boxes import Boxes
from vian.evaluation.scoring import Scores, scores

START = datetime(2026, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Run:
    extractions: list[Extraction]

    @property
    def batches(self) -> list[EventBatch]:
        return [batch for extraction in self.extractions for batch in extraction.batches]

    def column(self, name: str) -> npt.NDArray[Any]:
        parts = [np.asarray(b.data.column(name)) for b in self.batches if b.type is TrackPoint]
        return np.concatenate(parts) if parts else np.zeros(0)

    @property
    def rows(self) -> npt.NDArray[np.float64]:
        """`frame track_id x1 y1 x2 y2` of each point, `(n, 6)`."""
        names = ("frame", "track_id", "x1", "y1", "x2", "y2")
        return np.stack([self.column(name).astype(float) for name in names], axis=1)

    @property
    def ends(self) -> list[TrackEnded]:
        return [e for batch in self.batches for e in events_of(batch) if isinstance(e, TrackEnded)]

    @property
    def intervals(self) -> list[ActivityInterval]:
        return [e for batch in self.batches for e in events_of(batch) if isinstance(e, ActivityInterval)]

    @property
    def bytes(self) -> bytes:
        """All events as they would be stored."""
        return b"".join(batch.data.serialize().to_pybytes() for batch in self.batches)


def run(frames: Iterable[Frame | Gap], config: MotionConfig | None = None, **settings: Any) -> Run:
    return Run(list(extract(frames, config or MotionConfig(), start_time=START, **settings)))


def scored(truth: npt.NDArray[np.float64], found: npt.NDArray[np.float64]) -> Scores:
    """Scores of rows `frame track_id x1 y1 x2 y2` against such rows of the truth."""
    return scores(_boxes(truth), _boxes(found))


def _boxes(rows: npt.NDArray[np.float64]) -> Boxes:
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    frame, track_id = rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64)
    return Boxes(frame, track_id, rows[:, 2:6], np.ones(len(rows)), 100_000 * frame)
