"""The tracks that are alive, and how they live on from picture to picture.

    tentative --seen often enough, and moved--> confirmed --not seen--> lost --seen--> confirmed
        |                                           |                     |
        +--not seen--> dropped, unheard of          +--left the frame--> ended <--not seen too long

A track has no number before it is confirmed. `Tracks.step` is one picture; it reads in order: predict,
decide, update, judge, begin. Nothing here knows events.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Literal

import numpy as np
import numpy.typing as npt

from extractors.motion import kalman
from extractors.motion.appearance import LOOKS, Descriptors, unlikeness
from extractors.motion.association import Decision, decide
from extractors.motion.blobs import BoxesXyxy, xywh, xyxy
from extractors.motion.config import MotionConfig
from extractors.motion.detection import Detections
from extractors.motion.matching import matched
from extractors.motion.sizes import SizeLearner

SHARED_WEIGHTS = np.array([3.0, 3.0, 8.0, 8.0])
"""How much less a box cut out of a shared blob says, of position and size."""
EDGE_PX = 2.0
"""A box that comes as near as this to the picture's edge touches it."""
CUT_WEIGHTS = np.array([1.0, 1.0, 0.3, 0.3])
"""The size of what enters or leaves the picture changes from one picture to the next: it is followed at once."""


EndReason = Literal["lost", "left_frame", "input_changed", "end_of_video"]


class Stage(Enum):
    """Where in its life a track is."""

    TENTATIVE = auto()
    CONFIRMED = auto()
    LOST = auto()
    ENDED = auto()


@dataclass(slots=True, eq=False)
class Track:
    """One track's life; its state is a row of the arrays in `Tracks`."""

    born_us: int
    born_xy: npt.NDArray[np.float64]
    last_seen_us: int
    last_seen_frame: int
    hits: int = 1
    stage: Stage = Stage.TENTATIVE
    track_id: int = 0
    """number, given at confirmation"""
    anchor_xy: npt.NDArray[np.float64] = field(init=False)
    """middle of the box where the track last came to rest, px"""
    anchor_us: int = field(init=False)
    stood_s: float = 0.0
    """how long it has been near its anchor, s"""
    sway: float = 0.0
    """share of it that may be swaying background, 0 to 1: the mean over its views while it is tentative"""
    is_ghost: bool = False
    seen_xywh: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    """the last measured box, `x y w h` px"""
    looks: npt.NDArray[np.float64] = field(default_factory=lambda: np.full(LOOKS, np.nan))
    """how it looks, the mean over its clear views; NaN before the first"""
    views: int = 0
    """number of these views"""
    is_at_edge: bool = False
    """whether the picture's edge cut it when it was last clearly seen"""
    end_reason: EndReason | None = None

    def __post_init__(self) -> None:
        self.anchor_xy, self.anchor_us = self.born_xy, self.born_us


@dataclass(frozen=True, slots=True)
class Observed:
    """All living tracks in one picture, in the order of their birth."""

    tracks: tuple[Track, ...]
    means: npt.NDArray[np.float64] = field(repr=False)
    """states `x y w h vx vy`, `(n, 6)` px, px/s"""
    confidence: npt.NDArray[np.float64] = field(repr=False)
    """how far each state rests on this picture, 0 to 1, `(n,)`"""
    ended: tuple[Track, ...]
    """tracks that ended with this picture; confirmed ones only"""

    @property
    def boxes_xyxy(self) -> BoxesXyxy:
        """The filtered boxes, `(n, 4)` px."""
        return xyxy(self.means[:, :4])


class Tracks:
    """The tracks of one source."""

    def __init__(self, config: MotionConfig, width: int, height: int, first_track_id: int) -> None:
        self._config = config
        self._size = np.array([width, height], float)
        self._next_id = first_track_id
        self._noise = kalman.Noise(config.position_noise, config.size_noise, config.acceleration, config.size_drift)
        self._sizes = SizeLearner(config)
        self._clear: list[Track] = []
        self._alive: list[Track] = []
        self._means = np.zeros((0, 6))
        self._covariances = np.zeros((0, 6, 6))

    @property
    def next_track_id(self) -> int:
        """The number that the next confirmed track gets."""
        return self._next_id

    @property
    def sizes(self) -> SizeLearner:
        """What the tracks have shown of their sizes."""
        return self._sizes

    def expected_xyxy(self, dt_s: float) -> BoxesXyxy:
        """Where the confirmed tracks are expected `dt_s` from the last picture, `(n, 4)` px."""
        is_known = [track.track_id > 0 for track in self._alive]
        means = self._means[is_known]
        return xyxy(means[:, :4] + dt_s * np.pad(means[:, 4:], ((0, 0), (0, 2))))

    def standing(self) -> dict[int, BoxesXyxy]:
        """Boxes `(4,)` of the confirmed tracks that stand still and may go on standing."""
        boxes = self._clipped(xyxy(self._means[:, :4]))
        return {
            track.track_id: box
            for track, box in zip(self._alive, boxes, strict=True)
            if track.track_id
            and self._config.stand_after_s <= track.stood_s <= self._config.stand_max_s
            and np.all(box[2:] > box[:2])
        }

    def disown(self, ghosts: frozenset[int]) -> None:
        """End these tracks at the next step: there is nothing where they stand."""
        for track in self._alive:
            if track.track_id in ghosts:
                track.is_ghost = True

    def step(self, found: BoxesXyxy | Detections | None, frame: int, time_us: int, dt_s: float) -> Observed:
        """The tracks after one more picture.

        Args:
            found: What was found in it: blobs `(m, 4)` px, which may hold several objects or parts of one, or
                detections, each one object; None when it says nothing.
            frame: Its number.
            time_us: Its time, µs.
            dt_s: Time since the one before, s.
        """
        self._means, self._covariances = kalman.predict(self._means, self._covariances, dt_s, self._noise)
        decision = self._matched(found, time_us) if isinstance(found, Detections) else self._decided(found)
        confidence = self._updated(decision, time_us)
        self._judge(confidence > 0, frame, time_us, dt_s, is_blind=found is None)
        ended, is_alive = self._bury()
        begun = self._begin(decision.free_xyxy, frame, time_us)
        confidence = np.concatenate([confidence[is_alive], np.ones(begun)])
        return Observed(tuple(self._alive), self._means, confidence, ended)

    def look(self, view: Callable[[BoxesXyxy], Descriptors]) -> None:
        """Let the tracks that are clearly seen in this picture take in how they look.

        Args:
            view: Gives the descriptors of boxes in the picture.
        """
        clear = [track for track in self._clear if track.stage is not Stage.ENDED]
        if not clear:
            return
        looks = view(xyxy(np.array([track.seen_xywh for track in clear])))
        for track, here in zip(clear, looks, strict=True):
            if np.isnan(here).any():
                continue
            track.views += 1
            rate = max(1 / track.views, self._config.looks_rate)
            track.looks = here if track.views == 1 else track.looks + rate * (here - track.looks)

    def weigh(self, shares: Callable[[BoxesXyxy], npt.NDArray[np.float64]]) -> None:
        """Let the tentative tracks take in how far this picture may show the background where they are.

        Args:
            shares: Gives the share of the foreground in boxes that may be swaying background.
        """
        tentative = [track for track in self._alive if track.stage is Stage.TENTATIVE]
        if not tentative:
            return
        found = shares(xyxy(np.array([track.seen_xywh for track in tentative])))
        for track, share in zip(tentative, found.tolist(), strict=True):
            track.sway += (share - track.sway) / track.hits

    def end_all(self, reason: EndReason) -> tuple[Track, ...]:
        """End every track; the confirmed ones are returned."""
        for track in self._alive:
            self._end(track, reason)
        ended, _ = self._bury()
        return ended

    def _matched(self, found: Detections, time_us: int) -> Decision:
        costs = kalman.distances(self._means, self._covariances, xywh(found.boxes_xyxy), self._noise, found.doubts)
        is_confirmed = np.array([track.stage is not Stage.TENTATIVE for track in self._alive], bool)
        is_at_edge = np.array([track.is_at_edge for track in self._alive], bool)
        last_xywh = np.array([track.seen_xywh for track in self._alive]).reshape(-1, 4)
        missed_s = np.array([(time_us - track.last_seen_us) / 1e6 for track in self._alive])
        reach = (self._config.reach_size + self._config.reach_speed * missed_s) * kalman.scale_of(last_xywh)
        offsets = last_xywh[:, None, :2] - xywh(found.boxes_xyxy)[None, :, :2]
        away = np.hypot(offsets[..., 0], offsets[..., 1]) / reach[:, None]
        looks = np.array([track.looks for track in self._alive]).reshape(-1, LOOKS)
        unlike = unlikeness(looks, found.looks)
        expected_xyxy = xyxy(self._means[:, :4])
        return matched(
            expected_xyxy, xyxy(last_xywh), is_confirmed, is_at_edge, found, costs, away, unlike, self._config
        )

    def _decided(self, blobs: BoxesXyxy | None) -> Decision:
        blobs_xyxy = np.zeros((0, 4)) if blobs is None else blobs
        costs = kalman.distances(self._means, self._covariances, xywh(blobs_xyxy), self._noise)
        is_confirmed = np.array([track.stage is not Stage.TENTATIVE for track in self._alive], bool)
        expected_xyxy = xyxy(self._means[:, :4])
        is_settled = is_confirmed & ~self._is_cut(expected_xyxy)
        return decide(expected_xyxy, is_confirmed, is_settled, blobs_xyxy, costs, self._config.gate)

    def _updated(self, decision: Decision, time_us: int) -> npt.NDArray[np.float64]:
        """Take the measurements in; how far each track rests on its own."""
        seen = np.flatnonzero(~np.isnan(decision.measured_xyxy[:, 0]))
        measured = decision.measured_xyxy[seen]
        shared = decision.is_shared[seen]
        if decision.doubts is None:
            weights = np.where(shared[:, None], SHARED_WEIGHTS, 1.0)
        else:
            weights = np.repeat(decision.doubts[seen, None], 4, axis=1)
        weights[self._is_cut(measured) & ~shared] = CUT_WEIGHTS
        r = kalman.measurement_noise(self._means[seen], self._noise, weights)
        self._means[seen], self._covariances[seen] = kalman.update(
            self._means[seen], self._covariances[seen], xywh(measured), r
        )
        self._remember(seen, xywh(measured), time_us)
        is_cut = self._is_cut(measured)
        for row, is_at_edge in zip(seen[~shared], is_cut[~shared].tolist(), strict=True):
            self._alive[row].is_at_edge = is_at_edge
        is_clear = ~shared & ~is_cut
        self._clear = [self._alive[row] for row in seen[is_clear]]
        self._learn()
        confidence = np.zeros(len(self._alive))
        confidence[seen] = np.where(shared, 0.5, 1.0)
        return confidence

    def _learn(self) -> None:
        for track in self._clear:
            if track.stage is Stage.CONFIRMED:
                self._sizes.add(track.track_id, track.seen_xywh)

    def _remember(self, seen: npt.NDArray[np.intp], measured_xywh: npt.NDArray[np.float64], time_us: int) -> None:
        """Note where tracks were seen; what comes back after a while gets the speed that brought it there.

        Source: observation-centric re-update of J. Cao et al., "Observation-Centric SORT", CVPR 2023, section
        4.1, with a straight virtual path.
        """
        for row, box in zip(seen, measured_xywh, strict=True):
            track = self._alive[row]
            away_s = (time_us - track.last_seen_us) / 1e6
            if track.stage is Stage.LOST and away_s > self._config.forget_s:
                self._means[row, 4:] = (box[:2] - track.seen_xywh[:2]) / away_s
            track.seen_xywh = box

    def _judge(self, is_seen: npt.NDArray[np.bool_], frame: int, time_us: int, dt_s: float, *, is_blind: bool) -> None:
        scales = kalman.scale_of(self._means)
        for track, mean, scale, seen in zip(self._alive, self._means, scales, is_seen, strict=True):
            if track.is_ghost:
                self._end(track, "lost")
            elif seen:
                track.hits += 1
                track.last_seen_us, track.last_seen_frame = time_us, frame
                self._judge_seen(track, mean, scale, time_us)
            elif is_blind:
                track.last_seen_us += round(dt_s * 1e6)  # nobody can be seen now, so nobody ages
            else:
                self._judge_missed(track, mean, time_us)
            self._judge_standing(track, mean, scale, time_us)

    def _judge_seen(self, track: Track, mean: npt.NDArray[np.float64], scale: float, time_us: int) -> None:
        if track.stage is Stage.LOST:
            track.stage = Stage.CONFIRMED
        config = self._config
        is_old = time_us - track.born_us >= config.confirm_s * 1e6 and track.hits >= config.confirm_hits
        has_moved = np.hypot(*(_middle(mean) - track.born_xy)) >= config.confirm_path * scale
        if track.stage is Stage.TENTATIVE and is_old and has_moved and track.sway <= config.sway_max:
            track.stage = Stage.CONFIRMED
            track.track_id, self._next_id = self._next_id, self._next_id + 1

    def _judge_missed(self, track: Track, mean: npt.NDArray[np.float64], time_us: int) -> None:
        missed_s = (time_us - track.last_seen_us) / 1e6
        if track.stage is Stage.TENTATIVE:
            if missed_s > self._config.forget_s:
                self._end(track, "lost")
            return
        track.stage = Stage.LOST
        is_outside = bool(np.any((_middle(mean) < 0) | (_middle(mean) > self._size)))
        if is_outside or missed_s > self._config.lost_s:
            self._end(track, "left_frame" if is_outside or self._is_cut(xyxy(mean[None, :4]))[0] else "lost")

    def _judge_standing(self, track: Track, mean: npt.NDArray[np.float64], scale: float, time_us: int) -> None:
        here = _middle(mean)
        if np.hypot(*(here - track.anchor_xy)) > self._config.stand_radius * scale:
            track.anchor_xy, track.anchor_us = here, time_us
        track.stood_s = (time_us - track.anchor_us) / 1e6

    def _end(self, track: Track, reason: EndReason) -> None:
        track.stage, track.end_reason = Stage.ENDED, reason

    def _bury(self) -> tuple[tuple[Track, ...], npt.NDArray[np.bool_]]:
        """Forget the ended tracks; those among them that had a number, and which are still alive."""
        is_alive = np.array([track.stage is not Stage.ENDED for track in self._alive], bool)
        ended = tuple(t for t in self._alive if t.stage is Stage.ENDED and t.track_id)
        for track in ended:
            self._sizes.forget(track.track_id)
        self._alive = [track for track in self._alive if track.stage is not Stage.ENDED]
        self._means, self._covariances = self._means[is_alive], self._covariances[is_alive]
        return ended, is_alive

    def _begin(self, blobs_xyxy: BoxesXyxy, frame: int, time_us: int) -> int:
        means, covariances = kalman.born(xywh(blobs_xyxy), self._noise)
        self._alive += [Track(time_us, _middle(mean), time_us, frame, seen_xywh=mean[:4].copy()) for mean in means]
        self._means = np.concatenate([self._means, means])
        self._covariances = np.concatenate([self._covariances, covariances])
        return len(means)

    def _is_cut(self, boxes_xyxy: BoxesXyxy) -> npt.NDArray[np.bool_]:
        """Which boxes touch the picture's edge, `(n,)`."""
        low, high = boxes_xyxy[:, :2] <= EDGE_PX, boxes_xyxy[:, 2:] >= self._size - EDGE_PX
        return np.asarray(np.any(low | high, axis=1))

    def _clipped(self, boxes_xyxy: BoxesXyxy) -> BoxesXyxy:
        return np.clip(boxes_xyxy, 0, np.tile(self._size, 2))


def _middle(mean: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Middle of the box, `(2,)` px."""
    return np.array([mean[0], mean[1] - mean[3] / 2])
