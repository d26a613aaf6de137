"""The horizon from track points, online and over a log alike.

Contract: points in order of time in, events out, the same bytes however the points are cut into batches:
an estimate is made where media time passes a whole number of `update_s` and enough is new, and at the end.
Memory and the time of an update are bounded by configuration. Says nothing where the data do not decide: too few
tracks, too wide an interval, a roll that is only the prior's, boxes that are no objects on a plane, a moving camera.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Final

import numpy as np

from events import EventBatch, HorizonEstimate, HorizonVote, SceneChanged, TrackPoint, batch_of
from extractors.horizon.camera import FrameSize
from extractors.horizon.config import HorizonConfig
from extractors.horizon.fit import Fit, fitted
from extractors.horizon.places import Path, is_whole, places_of
from extractors.horizon.points import TrackPoints
from extractors.horizon.stillness import Stillness
from extractors.horizon.votes import vote_of

STARTS: Final = tuple(
    (np.radians(tilt), np.radians(roll)) for tilt, roll in ((5, 0), (25, -12), (25, 0), (25, 12), (45, 0))
)
"""Tilt and roll, rad, from which the best camera is sought: no view is farther than a few steps from one of them."""
OTHER_VIEWS: Final = frozenset({"moved", "unknown"})
"""Causes of `scene_changed` after which tracks may be seen from elsewhere: what is found next rests on new ones."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A horizon, and whether the data decide it."""

    fit: Fit
    votes: int
    """tracks with a vote among those that it rests on"""
    doubt: str = ""
    """why they do not decide it, for people; empty if they do"""


class Horizon:
    """Folds track points into votes and estimates."""

    def __init__(self, size: FrameSize, config: HorizonConfig) -> None:
        self._size, self._config = size, config
        self._update_us = round(config.update_s * 1e6)
        self._open: dict[int, Path] = {}
        self._closed: list[Path] = []
        self._votes: list[HorizonVote] = []
        self._estimates: list[HorizonEstimate] = []
        self._stillness = Stillness(size, config)
        self._is_moving = False
        self._said: Fit | None = None
        self._due_us: int | None = None
        self._last_us = 0
        self._held: TrackPoints | None = None
        self._fresh = self._used = 0
        self.on_estimate: Callable[[int, Estimate, bool], None] | None = None
        """told each estimate, also in doubt or no news: its time (µs since 1970, UTC), and whether it is the last"""
        self.reason = "no track has moved yet"
        """why the last look found no line, for people; empty if it did"""
        self.frames = 0
        """frames with points that were taken in"""

    def add(self, points: TrackPoints) -> None:
        """Take in points, later than all before."""
        points = points if self._held is None else self._held.followed_by(points)
        starts = np.flatnonzero(np.diff(points.time_us, prepend=-1))
        for start, stop in pairwise(starts.tolist()):
            self._step(points[start:stop])
        # The last frame's points may go on in the next batch.
        self._held = points[int(starts[-1]) :] if len(starts) else None

    def take_in(self, batch: EventBatch) -> None:
        """Heed a batch of events of the source: track points, and that the view may be another; others say nothing."""
        if batch.type is TrackPoint:
            self.add(TrackPoints.of(batch))
        elif batch.type is SceneChanged and OTHER_VIEWS & set(batch.data.column("cause").to_pylist()):
            self.forget()

    def forget(self) -> None:
        """The camera was moved: what was seen before was seen from elsewhere."""
        self._open, self._closed, self._said, self._held = {}, [], None, None
        self._used = 0

    def finish(self) -> None:
        """No more points come: all tracks vote, and the last estimate is made."""
        self.flush()
        for number in list(self._open):
            self._close(number)
        self._estimate(is_last=True)

    def take(self) -> tuple[EventBatch, ...]:
        """What came out since the last call: votes, then estimates; empty where there is nothing to say."""
        batches = tuple(batch_of(events) for events in (self._votes, self._estimates) if events)
        self._votes, self._estimates = [], []
        return batches

    def estimate(self) -> Estimate | None:
        """The horizon by all whole frames that were taken in; None where they do not decide."""
        found = self._found()
        return None if found is None or found.doubt else found

    def flush(self) -> None:
        """The last frame is whole, too."""
        if self._held is not None:
            self._step(self._held)
            self._held = None

    def _step(self, frame: TrackPoints) -> None:
        """Take in the points of one frame."""
        self.frames += 1
        time_us = int(frame.time_us[0])
        self._heed_motion(time_us, frame)
        if self._due_us is None:
            self._due_us = (time_us // self._update_us + 1) * self._update_us
        if time_us >= self._due_us:
            if self._fresh >= self._config.fresh_share * self._used:
                self._estimate()
            self._due_us = (time_us // self._update_us + 1) * self._update_us
        self._last_us = time_us
        if not self._is_moving:
            self._collect(time_us, frame)
        self._close_gone(time_us)

    def _heed_motion(self, time_us: int, frame: TrackPoints) -> None:
        self._stillness.add(time_us, frame.track_id, frame.boxes_xyxy)
        is_moving = self._stillness.is_moving
        if is_moving and not self._is_moving:
            self.forget()
        self._is_moving = is_moving

    def _collect(self, time_us: int, frame: TrackPoints) -> None:
        whole = is_whole(frame.boxes_xyxy, frame.confidence, self._size, self._config)
        columns = (frame.track_id, frame.boxes_xyxy, frame.confidence)
        for number, (x1, y1, x2, y2), sure in zip(*(column[whole] for column in columns), strict=True):
            path = self._open.setdefault(int(number), Path(time_us))
            path.last_us = time_us
            self._fresh += path.add((time_us / 1e6, (x1 + x2) / 2, y2, x2 - x1, y2 - y1, sure), self._config)

    def _close_gone(self, time_us: int) -> None:
        gone_us = time_us - round(self._config.gone_s * 1e6)
        for number in [number for number, path in self._open.items() if path.last_us < gone_us]:
            self._close(number)

    def _close(self, number: int) -> None:
        path = self._open.pop(number)
        self._closed = [*self._closed[-self._config.tracks_max :], path]
        vote = vote_of(path.rows(), self._config)
        if vote is not None:
            self._votes.append(
                HorizonVote(
                    time=_time(self._last_us),
                    track_id=number,
                    x=vote.x,
                    y=vote.y,
                    deviation_px=vote.deviation_px,
                    direction_rad=vote.direction,
                    places=len(path.rows()),
                )
            )

    def _estimate(self, *, is_last: bool = False) -> None:
        """Say what the estimate is, if it is one and has moved or firmed up; the last one in any case."""
        found = self._found() if self._fresh else None
        self._fresh = 0
        if found is None:
            return
        if self.on_estimate is not None:
            self.on_estimate(self._last_us, found, is_last)
        if found.doubt or not (is_last or self._is_news(found.fit)):
            return
        fit, self._said = found.fit, found.fit
        (slope_variance, covariance), (_, offset_variance) = fit.line_covariance
        self._estimates.append(
            HorizonEstimate(
                time=_time(self._last_us),
                slope=fit.line.slope,
                offset_px=fit.line.offset,
                slope_variance=float(slope_variance),
                slope_offset_covariance=float(covariance),
                offset_variance=float(offset_variance),
                width=self._size.width,
                height=self._size.height,
                votes=found.votes,
            )
        )

    def _found(self) -> Estimate | None:
        """The likeliest horizon; None where there is too little, or no objects on a plane."""
        config = self._config
        paths = [*self._closed, *self._open.values()][-config.tracks_max :]
        votes = sum(vote_of(path.rows(), config) is not None for path in paths)
        if self._is_moving:
            self.reason = "all tracks move alike: the camera moves"
            return None
        if votes < config.tracks_min:
            self.reason = f"a horizon takes {config.tracks_min} tracks that come or go, got {votes}"
            return None
        places = places_of(paths, self._size, config)
        if (clear := places.clear().tracks) < config.tracks_min:
            self.reason = f"a horizon takes {config.tracks_min} tracks that are seen by themselves, got {clear}"
            return None
        self._used = sum(path.points for path in paths)
        fit = fitted(places, self._size, config, STARTS)
        if not fit.noise <= config.noise_max:
            self.reason = (
                f"the boxes' edges are off by {fit.noise:.0%} of their heights, wanted {config.noise_max:.0%}: "
                "these are no upright things on one plane"
            )
            return None
        self.reason = ""
        return Estimate(fit, votes, self._doubt(fit))

    def _doubt(self, fit: Fit) -> str:
        """Why the data do not decide the horizon; empty if they do."""
        config, (width, height) = self._config, (self._size.width, self._size.height)
        deviation = max(fit.deviation_at(x) for x in (0.0, width / 2, float(width)))
        wanted = config.deviation_share_max * height
        if not deviation <= wanted:
            return f"the horizon is known within {deviation:.0f} px, wanted {wanted:.0f} px"
        if not np.sqrt(fit.covariance[1, 1]) <= (1 - config.roll_learnt_min) * np.radians(config.roll_spread_deg):
            return "the tracks say little of the camera's roll: all move along one line"
        return ""

    def _is_news(self, fit: Fit) -> bool:
        if self._said is None:
            return True
        ends = (0.0, float(self._size.width))
        moved = max(abs(fit.line.y(x) - self._said.line.y(x)) / self._said.deviation_at(x) for x in ends)
        firmed = max(fit.deviation_at(x) / self._said.deviation_at(x) for x in ends)
        return moved > self._config.moved_deviations or firmed < self._config.firmed_share


def estimated(points: TrackPoints, size: FrameSize, config: HorizonConfig) -> Estimate | None:
    """The horizon by these points, in order of time; None where they do not decide."""
    horizon = Horizon(size, config.model_copy(update={"update_s": 1e9}))
    horizon.add(points)
    horizon.flush()
    return horizon.estimate()


def _time(time_us: int) -> datetime:
    return _EPOCH + timedelta(microseconds=time_us)
