"""What the tracks of a camera say of it while they are made: its horizon and its calibration.

Contract: batches of one source in, as motion gives them; votes, estimates and calibrations out, the same however often
it is run. Horizon and calibration come from one fit where both are looked for. Where the view or the frame's size
changes, both begin anew.

A calibration is said where it beats the one that stands: after a pause of the camera or in another video few tracks are
known again, and what many tracks said before is better as long as the two agree.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from events import CameraCalibrated, EventBatch, SceneChanged, TrackPoint, batch_of, events_of
from extractors.calibration import VERSION, CalibrationConfig, CalibrationFold, KnownLength, Scale
from extractors.horizon import OTHER_VIEWS, FrameSize, Horizon, HorizonConfig
from extractors.horizon import VERSION as HORIZON_VERSION

AGREEMENT_DEVIATIONS = 3.7
"""All four numbers of two calibrations of one camera differ by less, in standard deviations of their differences, in
999 of 1,000 cases (normal distribution, Bonferroni); those of a camera that was turned differ by far more."""


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """How the camera is found from its tracks."""

    horizon: HorizonConfig | None = field(default_factory=HorizonConfig.of_blobs)
    """None: no horizon is looked for"""
    calibration: CalibrationConfig | None = field(default_factory=CalibrationConfig)
    """None: no calibration is looked for"""
    scale: Scale | None = None
    """where metres come from; None: the mean height of people, as the configuration has it"""

    @property
    def description(self) -> dict[str, Any]:
        """What is said of it in the log: extractors' versions and configurations, and where metres come from."""
        said: dict[str, Any] = {}
        if self.horizon is not None:
            said["horizon"] = {"version": HORIZON_VERSION, "configuration": self.horizon.config_hash.hex()}
        if self.calibration is not None:
            said["calibration"] = {"version": VERSION, "configuration": self.calibration.config_hash.hex()}
            if self.scale is not None:
                said["scale"] = {"from": self.scale.word} | asdict(self.scale)
        return said


@dataclass(frozen=True, slots=True)
class Resized:
    """From this frame on, frames have another size."""

    frame: int
    time_us: int
    """since the first frame, µs"""
    size: FrameSize


class CameraFolds:
    """The horizon and the calibration of one source, from what motion says."""

    def __init__(self, size: FrameSize, config: CameraConfig, standing: CameraCalibrated | None = None) -> None:
        """Build folds that have seen nothing.

        Args:
            size: Of the frames, and of the one in which a known length was marked.
            config: What to look for.
            standing: The source's calibration that holds so far; the first of these must beat it.
        """
        self._marked_size, self._config, self._standing = size, config, standing
        self._last: CameraCalibrated | None = None
        self._begin(size)

    def add(self, batches: Iterable[EventBatch], resized: Sequence[Resized] = ()) -> tuple[EventBatch, ...]:
        """What follows from one interval's batches, within which frames may have come to other sizes."""
        said: list[EventBatch] = []
        waiting = list(resized)
        for batch in batches:
            if batch.type is TrackPoint:
                for change in waiting:
                    at = int(np.searchsorted(batch.data.column("frame").to_numpy(), change.frame))
                    self._take_in(batch.slice(0, at))
                    said += self.resize(change.size)
                    batch = batch.slice(at)
                waiting = []
            self._take_in(batch)
        for change in waiting:
            said += self.resize(change.size)
        return (*said, *self._said(self._calibration.take() if self._calibration is not None else ()))

    def resize(self, size: FrameSize) -> tuple[EventBatch, ...]:
        """What the frames so far come to; those that follow have this size."""
        said = self.finish()
        self._standing = self._last or self._standing
        self._last = None
        self._begin(size)
        return said

    def finish(self) -> tuple[EventBatch, ...]:
        """What all that came in comes to: no more follows."""
        if self._horizon is not None:
            self._horizon.finish()
        return self._said(self._calibration.finish() if self._calibration is not None else ())

    @property
    def reason(self) -> str:
        """Why there is no newer calibration; for people."""
        return self._calibration.reason if self._calibration is not None else "no calibration is looked for"

    def _begin(self, size: FrameSize) -> None:
        config, self.size = self._config, size
        self._horizon = Horizon(size, config.horizon) if config.horizon else None
        self._calibration = (
            CalibrationFold(config.calibration, (size.width, size.height), self._scale(size), shared=self._horizon)
            if config.calibration
            else None
        )

    def _scale(self, size: FrameSize) -> Scale | None:
        """Where metres come from; a known length was marked in a frame of the size at the beginning."""
        scale, marked = self._config.scale, self._marked_size
        if not isinstance(scale, KnownLength):
            return scale
        wide, high = size.width / marked.width, size.height / marked.height
        ends = [(x * wide, y * high) for x, y in (scale.xy, scale.other_xy)]
        return replace(scale, xy=ends[0], other_xy=ends[1])

    def _take_in(self, batch: EventBatch) -> None:
        if batch.type is SceneChanged:
            self._heed(set(batch.data.column("cause").to_pylist()))
        elif batch.type is TrackPoint and len(batch):
            if self._horizon is not None:
                self._horizon.take_in(batch)
            if self._calibration is not None:
                self._calibration.add(batch)

    def _heed(self, causes: set[str]) -> None:
        """Begin anew where the view may be another; where the camera was moved, nothing stands any more."""
        if not causes & OTHER_VIEWS:
            return
        self._standing, self._last = self._last or self._standing, None
        if "moved" in causes:
            self._standing = None
        if self._horizon is not None:
            self._horizon.forget()
        if self._calibration is not None:
            self._calibration.restart()
            if "moved" in causes:
                self._calibration.take()  # what was found of the view before would be said behind the move

    def _said(self, calibrations: tuple[EventBatch, ...]) -> tuple[EventBatch, ...]:
        """What the horizon has said since the last call, and the calibrations that beat the one that stands."""
        better = []
        for event in (event for batch in calibrations for event in events_of(batch)):
            assert isinstance(event, CameraCalibrated), "it says nothing else"
            if self._last is not None or self._standing is None or is_better(event, self._standing):
                self._last = event
                better.append(event)
        votes = self._horizon.take() if self._horizon is not None else ()
        return (*votes, *([batch_of(better)] if better else []))


def is_better(new: CameraCalibrated, standing: CameraCalibrated) -> bool:
    """Whether the new calibration is surer than the one that stands, or contradicts it; of one by hand it is neither.

    Each number is looked at by itself: a covariance from a few tracks claims too much of what they say together.
    """
    if standing.covariance is None:
        return False
    numbers, deviations = _numbers(new, new.width)
    others, other_deviations = _numbers(standing, new.width)
    is_surer = np.log(deviations).sum() < np.log(other_deviations).sum()
    distance = np.abs(numbers - others) / np.hypot(deviations, other_deviations)
    return bool(is_surer or distance.max() > AGREEMENT_DEVIATIONS)


def _numbers(event: CameraCalibrated, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Focal length in px of a frame of this width, pitch, roll and height, and their standard deviations, `(4,)`."""
    assert event.covariance is not None, "the caller has looked"
    units = np.array([width / event.width, 1.0, 1.0, 1.0])
    numbers = np.array([event.focal_px, event.pitch_rad, event.roll_rad, event.height_m], np.float64)
    return numbers * units, np.sqrt(np.diag(json.loads(event.covariance))) * units
