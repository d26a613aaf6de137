"""A calibration from track points as they come: online beside motion, or over a log that already exists.

Contract: points in, in order of time; `camera_calibrated` out. What comes out depends on the points and horizons and
their order, and not on how they were cut into batches. Memory is bounded by the configuration. A scene that does not
decide the camera gets no event: its horizon is not decided, its camera is known too widely, or nothing gives metres.

The camera is the horizon's: a fold of its own finds it, or a horizon that runs anyway is shared, so that there is one
fit for both.
"""

import json
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from events import CameraCalibrated, EventBatch, batch_of
from extractors.calibration.camera import Floats
from extractors.calibration.config import CalibrationConfig
from extractors.calibration.errors import CalibrationError
from extractors.calibration.estimate import Estimate, Horizon, estimate
from extractors.calibration.scale import PersonHeight, Scale
from extractors.horizon import Estimate as HorizonFound
from extractors.horizon import FrameSize, TrackPoints
from extractors.horizon import Horizon as HorizonFold

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class CalibrationFold:
    """The camera of one source, from its track points and horizons."""

    def __init__(
        self,
        config: CalibrationConfig,
        frame_size: tuple[int, int],
        scale: Scale | None = None,
        *,
        shared: HorizonFold | None = None,
    ) -> None:
        """Begin with nothing.

        Args:
            config: The parameters.
            frame_size: Width and height of the frames, px.
            scale: Where metres come from; the mean height of people by default.
            shared: A horizon of the same tracks that runs anyway: who runs it gives it its points, ends it and lets it
                forget, and its estimates are taken here.
        """
        self._config = config
        self._size = frame_size
        self._scale = scale or PersonHeight(config.person_height_m, config.person_spread_m)
        self._tracks = shared or HorizonFold(FrameSize(*frame_size), config.camera)
        self._tracks.on_estimate = self._heed
        self._is_shared = shared is not None
        self._horizon: Horizon | None = None
        self._said: Estimate | None = None
        self._events: list[CameraCalibrated] = []
        self._reason = ""
        """why the newest estimate was not said"""

    def add(self, batch: EventBatch) -> None:
        """Take a batch of `track_point`; of a shared horizon it has taken them itself."""
        if not self._is_shared:
            self._tracks.take_in(batch)

    def add_points(
        self, time_us: NDArray[np.int64], track_id: NDArray[np.int64], boxes_xyxy: Floats, confidence: Floats
    ) -> None:
        """Take points as columns.

        Args:
            time_us: µs since 1970 (UTC), `(n,)`, ascending; points of one time are of one frame.
            track_id: Number of the track, `(n,)`.
            boxes_xyxy: `x1 y1 x2 y2`, px of the whole frame, `(n, 4)`.
            confidence: 0 (predicted) to 1 (seen), `(n,)`.
        """
        if not self._is_shared:
            self._tracks.add(TrackPoints(time_us, track_id, np.zeros_like(track_id), boxes_xyxy, confidence))

    def add_horizon(self, horizon: Horizon) -> None:
        """Take a horizon that is known otherwise, not from these very tracks; it stands in for those before it."""
        self._horizon = horizon

    def restart(self) -> None:
        """Forget all tracks and horizons: the camera was moved."""
        if not self._is_shared:
            self._tracks.forget()
        self._horizon = self._said = None

    def take(self) -> tuple[EventBatch, ...]:
        """The events since the last call."""
        if not self._is_shared:
            self._tracks.take()
        events, self._events = self._events, []
        return (batch_of(events),) if events else ()

    def finish(self) -> tuple[EventBatch, ...]:
        """Look once more at all that came, say what it comes to, and take."""
        if not self._is_shared:
            self._tracks.finish()
        return self.take()

    @property
    def said(self) -> Estimate | None:
        """The calibration that stands."""
        return self._said

    @property
    def reason(self) -> str:
        """Why the last look said nothing new; for people."""
        return self._tracks.reason or self._reason

    def _heed(self, time_us: int, found: HorizonFound, is_last: bool) -> None:
        """Say the camera of a horizon's estimate if it is worth saying; the last one in any case."""
        if found.doubt and self._horizon is None:
            self._reason = found.doubt
            return
        try:
            camera = estimate(found.fit, self._size, self._config, self._scale, self._horizon)
        except CalibrationError as error:
            self._reason = str(error)
            return
        except (np.linalg.LinAlgError, OverflowError) as error:
            self._reason = f"what is known of the camera contradicts its tracks: {error}"
            return
        self._reason = self._doubt(camera) or ("" if is_last else self._sameness(camera))
        if not self._reason:
            self._said = camera
            self._events.append(self._event(time_us, camera))

    def _doubt(self, found: Estimate) -> str:
        """Why the estimate is not good enough to be said; empty if it is."""
        config = self._config
        focal, *_, height = np.sqrt(np.diag(found.covariance))
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

    def _event(self, time_us: int, found: Estimate) -> CameraCalibrated:
        camera = found.camera
        return CameraCalibrated(
            time=_EPOCH + timedelta(microseconds=time_us),
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
