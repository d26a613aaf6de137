"""A calibration from track points as they come: online beside motion, or over a log that already exists.

Contract: points in, in order of time; `camera_calibrated` out. What comes out depends on the points and horizons and
their order, and not on how they were cut into batches. Memory is bounded by the configuration. A scene that does not
decide the camera gets no event: too few upright tracks, boxes that no camera explains, or a wide covariance.

It looks at the tracks when there are a share more of them than before; `finish` looks once more.
"""

import json
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from events import CameraCalibrated, EventBatch, batch_of
from extractors.calibration.camera import Floats
from extractors.calibration.config import CalibrationConfig
from extractors.calibration.errors import NotDecided
from extractors.calibration.estimate import Boxes, Estimate, Horizon, estimate
from extractors.calibration.scale import PersonHeight, Scale

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TRACKS_HELD = 4
"""Tracks held, of those that may count: most never do."""

Row = tuple[float, float, float, float, float, float]
"""Middle, upper edge, lower edge and width of a box, px, its time, s, and 1: so that rows can be added up."""


@dataclass(slots=True)
class _Track:
    """Boxes of one track, each the mean of those seen while its foot went one step."""

    step: float
    rows: list[Row] = field(default_factory=list)
    last: tuple[float, float] | None = None
    sums: Row = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def add(self, row: Row, rows_max: int) -> bool:
        """Take one more box; whether that closed a step."""
        x, y1, y2, *_ = row
        is_closed = False
        if self.last is None:
            self.last = (x, y2)
        elif (x - self.last[0]) ** 2 + (y2 - self.last[1]) ** 2 > (self.step * (y2 - y1)) ** 2:
            count = self.sums[5]
            self.rows.append(tuple(value / count for value in self.sums))  # type: ignore[arg-type]  # as long as it was
            self.last, self.sums, is_closed = (x, y2), (0.0,) * 6, True
        if len(self.rows) > rows_max:
            self.rows, self.step = self.rows[::2], self.step * 2
        self.sums = tuple(a + b for a, b in zip(self.sums, row, strict=True))  # type: ignore[assignment]  # likewise
        return is_closed

    def is_upright(self, config: CalibrationConfig) -> bool:
        """Whether its boxes are like those of somebody upright, and enough."""
        if len(self.rows) < config.points_min:
            return False
        aspect = float(np.median([(y2 - y1) / width for _, y1, y2, width, _, _ in self.rows]))
        return config.aspect_min < aspect < config.aspect_max


class CalibrationFold:
    """The camera of one source, from its track points and horizons."""

    def __init__(self, config: CalibrationConfig, frame_size: tuple[int, int], scale: Scale | None = None) -> None:
        self._config = config
        self._size = frame_size
        self._scale = scale or PersonHeight(config.person_height_m, config.person_spread_m)
        self._tracks: dict[int, _Track] = {}
        self._upright = 0
        self._due = config.tracks_min
        self._horizon: Horizon | None = None
        self._time_us = 0
        self._origin_us: int | None = None
        self._said: Estimate | None = None
        self._events: list[CameraCalibrated] = []
        self.reason = "no track has moved yet"
        """why the last look said nothing new; for people"""

    def add(self, batch: EventBatch) -> None:
        """Take a batch of `track_point`."""
        column = batch.data.column
        boxes = np.stack([column(name).to_numpy().astype(float) for name in ("x1", "y1", "x2", "y2")], axis=1)
        self.add_points(
            column("time").cast("int64").to_numpy(),
            column("track_id").to_numpy(),
            boxes,
            column("confidence").to_numpy().astype(float),
        )

    def add_points(
        self, time_us: NDArray[np.int64], track_id: NDArray[np.int64], boxes_xyxy: Floats, confidence: Floats
    ) -> None:
        """Take points as columns.

        Args:
            time_us: µs since 1970 (UTC), `(n,)`, ascending.
            track_id: Number of the track, `(n,)`.
            boxes_xyxy: `x1 y1 x2 y2`, px of the whole frame, `(n, 4)`.
            confidence: 0 (predicted) to 1 (seen), `(n,)`.
        """
        if not len(time_us):
            return
        if self._origin_us is None:
            self._origin_us = int(time_us[0])
        kept = self._whole(boxes_xyxy, confidence)
        x1, y1, x2, y2 = boxes_xyxy[kept].T
        seconds = (time_us[kept] - self._origin_us) / 1e6
        rows = zip(
            ((x1 + x2) / 2).tolist(), y1.tolist(), y2.tolist(), (x2 - x1).tolist(), seconds.tolist(), strict=True
        )
        for at_us, number, row in zip(time_us[kept].tolist(), track_id[kept].tolist(), rows, strict=True):
            self._time_us = at_us
            self._take_box(number, (*row, 1.0))
        self._time_us = int(time_us[-1])

    def add_horizon(self, horizon: Horizon) -> None:
        """Take a horizon that is known otherwise, not from these very tracks; it stands in for those before it."""
        self._horizon = horizon

    def restart(self) -> None:
        """Forget all tracks and horizons: the camera was moved."""
        self._tracks.clear()
        self._upright, self._due = 0, self._config.tracks_min
        self._horizon = self._said = None

    def take(self) -> tuple[EventBatch, ...]:
        """The events since the last call."""
        events, self._events = self._events, []
        return (batch_of(events),) if events else ()

    def finish(self) -> tuple[EventBatch, ...]:
        """Look once more at all that came, and take."""
        self._look()
        return self.take()

    @property
    def said(self) -> Estimate | None:
        """The calibration that stands."""
        return self._said

    def _whole(self, boxes_xyxy: Floats, confidence: Floats) -> NDArray[np.bool_]:
        """Which boxes were seen, and whole."""
        (width, height), edge = self._size, self._config.edge_share * self._size[1]
        x1, y1, x2, y2 = boxes_xyxy.T
        inside = (x1 > edge) & (y1 > edge) & (x2 < width - edge) & (y2 < height - edge) & (x2 > x1) & (y2 > y1)
        return np.asarray(inside & (confidence >= self._config.confidence_min))

    def _take_box(self, number: int, row: Row) -> None:
        track = self._tracks.get(number)
        if track is None:
            if len(self._tracks) >= _TRACKS_HELD * self._config.tracks_max:
                del self._tracks[next(iter(self._tracks))]
            track = self._tracks[number] = _Track(self._config.step_share)
        if not track.add(row, self._config.points_max) or len(track.rows) != self._config.points_min:
            return
        if track.step == self._config.step_share and track.is_upright(self._config):
            self._upright += 1
            if self._upright >= self._due:
                self._due = self._upright + max(self._config.growth_min, int(self._config.growth_share * self._upright))
                self._look()

    def _look(self) -> None:
        """Estimate, and say it if it is worth saying."""
        try:
            found = estimate(self._boxes(), self._size, self._config, self._scale, self._horizon)
        except NotDecided as error:
            self.reason = str(error)
            return
        self.reason = self._doubt(found) or self._sameness(found)
        if not self.reason:
            self._said = found
            self._events.append(self._event(found))

    def _boxes(self) -> Boxes:
        """The boxes of the newest tracks that count."""
        upright = [track.rows for track in self._tracks.values() if track.is_upright(self._config)]
        chosen = upright[-self._config.tracks_max :]
        table = np.array([row for rows in chosen for row in rows], np.float64).reshape(-1, 6)
        track = np.repeat(np.arange(len(chosen)), [len(rows) for rows in chosen])
        return Boxes(track, table[:, 0], table[:, 1], table[:, 2], table[:, 4])

    def _doubt(self, found: Estimate) -> str:
        """Why the estimate is not good enough to be said; empty if it is."""
        config = self._config
        focal, *_, height = np.sqrt(np.diag(found.covariance))
        if found.explained < config.explained_min:
            return (
                f"the likeliest camera explains {found.explained:.0%} of the boxes, wanted {config.explained_min:.0%}"
            )
        if focal > config.focal_error_max:
            return f"the focal length is known within {focal:.0%}, wanted {config.focal_error_max:.0%}"
        if height > config.height_error_max:
            return f"the camera's height is known within {height:.0%}, wanted {config.height_error_max:.0%}"
        return ""

    def _sameness(self, found: Estimate) -> str:
        """Why the estimate says nothing that was not said; empty if it does."""
        if self._said is None:
            return ""
        (_, new), (_, old) = np.linalg.slogdet(found.covariance), np.linalg.slogdet(self._said.covariance)
        change = found.parameters - self._said.parameters
        moved = float(np.sqrt(change @ np.linalg.solve(self._said.covariance, change)))
        if np.exp((new - old) / 8) <= self._config.firmer_share or moved >= self._config.moved_deviations:
            return ""
        return f"it is neither firmer nor elsewhere: moved by {moved:.1f} of the standard deviations said before"

    def _event(self, found: Estimate) -> CameraCalibrated:
        camera = found.camera
        return CameraCalibrated(
            time=_EPOCH + timedelta(microseconds=self._time_us),
            homography=json.dumps(camera.homography.tolist()),
            width=camera.width,
            height=camera.height,
            method="tracks",
            rms_m=found.rms_m,
            focal_px=camera.focal_px,
            pitch_rad=camera.pitch_rad,
            roll_rad=camera.roll_rad,
            height_m=camera.height_m,
            covariance=json.dumps(found.covariance_metric.tolist()),
            scale=self._scale.word,
        )
