"""Boxes from a video or from detections, by the motion extractor and its tracker."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from events import EventBatch, TrackPoint
from extractors import video
from extractors.media import Frame, Gap, Image, VideoInfo
from extractors.motion import DetectedFrame, Detections, MotionConfig, extract, track_detections
from vian.evaluation.boxes import Boxes

START = datetime(1970, 1, 1, tzinfo=UTC)
"""Times are counted from the first frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """What the motion extractor made of a video."""

    info: VideoInfo
    boxes: Boxes
    picture: Image
    """the frame in the middle, as far as the container's count can be trusted"""


def watched(path: Path, config: MotionConfig | None = None) -> Watched:
    """The tracks of a video.

    Raises:
        VideoError: It cannot be read.
    """
    info = video.probe(path)
    kept: list[Image] = []
    frames = _keeping(video.frames(path), (info.frames_expected or 1) // 2, kept)
    steps = extract(frames, config or MotionConfig(), start_time=START)
    boxes = boxes_of_points(batch for step in steps for batch in step.batches)
    return Watched(info, boxes, kept[-1])


def boxes_of_points(batches: Iterable[EventBatch]) -> Boxes:
    """The boxes of the track points among the events."""
    points = [batch.data for batch in batches if batch.type is TrackPoint]

    def column(name: str) -> npt.NDArray[Any]:
        return np.concatenate([np.asarray(each.column(name)) for each in points] or [np.zeros(0)])

    return Boxes(
        frame=column("frame").astype(np.int64),
        track_id=column("track_id").astype(np.int64),
        xyxy=np.stack([column(name).astype(float) for name in ("x1", "y1", "x2", "y2")], axis=1),
        confidence=column("confidence").astype(float),
        time_us=column("time").astype("datetime64[us]").astype(np.int64),
    )


def _keeping(frames: Iterable[Frame | Gap], wanted: int, kept: list[Image]) -> Iterator[Frame | Gap]:
    """The frames, of which the first and then the wanted one are kept."""
    for frame in frames:
        if isinstance(frame, Frame) and (not kept or frame.index == wanted):
            kept[:] = [frame.image]
        yield frame


def tracked(detections: Boxes, width: int, height: int, config: MotionConfig | None = None) -> Boxes:
    """Tracks of given detections, by the tracker of the motion extractor alone.

    Args:
        detections: Boxes, whose track numbers do not count.
        width: Width of the frames, px.
        height: Their height, px.
        config: The parameters.
    """
    step_us = _step_us(detections)
    frames = (
        DetectedFrame(number, round(number * step_us), Detections.clear(here.xyxy, here.confidence))
        for number in range(int(detections.frame.max(initial=-1)) + 1)
        for here in (detections.where(detections.frame == number),)
    )
    rows = track_detections(frames, config or MotionConfig(), width=width, height=height)
    times_us = np.round(rows[:, 0] * step_us).astype(np.int64)
    return Boxes(rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2:6], rows[:, 6], times_us)


def _step_us(boxes: Boxes) -> float:
    """Time between two frames, µs."""
    last = int(boxes.frame.max(initial=0))
    return float(boxes.time_us[boxes.frame == last].max(initial=0) / last) if last else 0.0
