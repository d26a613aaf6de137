"""The tracker alone, on detections that somebody else made.

Contract: detections of pictures in order of time go in, points of tracks come out, held back and bridged as
the motion extractor's own (`extractors.motion.emission`). A detection is an object, so that a track needs
no way to be confirmed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from events import EventBatch, TrackPoint
from extractors.motion.config import MotionConfig
from extractors.motion.detection import Detections
from extractors.motion.emission import Emission
from extractors.motion.tracks import Tracks

_COLUMNS = ("frame", "track_id", "x1", "y1", "x2", "y2", "confidence")


@dataclass(frozen=True, slots=True, eq=False)
class DetectedFrame:
    """What was detected in one picture."""

    frame: int
    """number of the frame"""
    time_us: int
    """its time, µs; increases"""
    detections: Detections


def track_detections(
    frames: Iterable[DetectedFrame], config: MotionConfig, *, width: int, height: int
) -> npt.NDArray[np.float64]:
    """Points of the tracks, `frame track_id x1 y1 x2 y2 confidence`, `(n, 7)`, in order of frame and track.

    Args:
        frames: The pictures in order of time, those with no detection too.
        config: The parameters.
        width: Width of the pictures, px.
        height: Their height, px.
    """
    tracks = Tracks(config.model_copy(update={"confirm_path": 0.0}), width, height, first_track_id=1)
    emission = Emission(config, datetime(1970, 1, 1, tzinfo=UTC))
    last_us: int | None = None
    for item in frames:
        dt_s = 0.0 if last_us is None else (item.time_us - last_us) / 1e6
        observed = tracks.step(item.detections, item.frame, item.time_us, dt_s)
        emission.add(item.frame, item.time_us, observed, 1.0, 0.0)
        last_us = item.time_us
    emission.close(tracks.end_all("end_of_video"))
    return _rows(emission.take())


def _rows(batches: Iterable[EventBatch]) -> npt.NDArray[np.float64]:
    points = [batch.data for batch in batches if batch.type is TrackPoint]
    columns = [
        np.concatenate([np.asarray(b.column(name), float) for b in points] or [np.zeros(0)]) for name in _COLUMNS
    ]
    return np.stack(columns, axis=1)
