"""Motion from frames: what moved, where and when.

Contract: frames and gaps in, events out, the same bytes for the same frames and configuration, on any
number of threads. When the frames end with an error, all that was certain before it comes out first;
tracks that were open then have no end, because nobody saw it.

It knows neither source nor log: whoever calls it gives the events their stream.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import cv2
import numpy as np

from events import EventBatch, SceneChanged, batch_of
from extractors.errors import ExtractorError
from extractors.media import Frame, Gap, GapReason, Image
from extractors.motion import blobs
from extractors.motion.appearance import described
from extractors.motion.background import Background, Foreground
from extractors.motion.config import MotionConfig
from extractors.motion.covering import explained
from extractors.motion.detection import Detections, Detector
from extractors.motion.emission import Emission
from extractors.motion.grain import Grain
from extractors.motion.held import FOREGROUND, Mask
from extractors.motion.ignored import IgnoredArea
from extractors.motion.shake import Shake
from extractors.motion.sizes import LearntSizes
from extractors.motion.steadiness import Change, Steadiness, View
from extractors.motion.sway import Sway
from extractors.motion.tracks import EndReason, Observed, Tracks

DT_MAX_S = 1.0
"""A longer pause between two frames is bridged as if it had been so long."""


@dataclass(frozen=True, slots=True)
class Extraction:
    """What one interval of media time brought, and how far the work has come."""

    batches: tuple[EventBatch, ...]
    """events: points, ends of tracks, their looks, activity intervals, changes of the view, in this order; empty where
    nothing moved"""
    frames: int
    """frames worked on since the beginning"""
    time_us: int
    """media time of the last of them, µs"""
    gaps: tuple[Gap, ...]
    """gaps met within the interval"""


@dataclass(frozen=True, slots=True)
class Seen:
    """What was made of one frame, for who wants to look on; px of the analysed picture."""

    scale: float
    """pixels of the frame for one of the analysed picture"""
    foreground: Foreground
    blobs_xyxy: blobs.BoxesXyxy
    observed: Observed


@dataclass(frozen=True, slots=True)
class _Found:
    """What one picture has."""

    foreground: Foreground
    mask: Mask
    """where the objects' pixels are"""
    blobs_xyxy: blobs.BoxesXyxy
    objects: blobs.BoxesXyxy | Detections | None


_ANEW = "what is known of its horizon and of metres begins anew"

OnFrame = Callable[[Frame, Seen], None]


def extract(
    frames: Iterable[Frame | Gap],
    config: MotionConfig,
    *,
    start_time: datetime,
    first_track_id: int = 1,
    detector: Detector | None = None,
    ignored: IgnoredArea | None = None,
    on_frame: OnFrame | None = None,
) -> Iterator[Extraction]:
    """Events of what moves in the frames, an interval of `batch_s` media time at a time.

    Args:
        frames: Frames in order of time, with the gaps between them.
        config: The parameters.
        start_time: Wall-clock time of the first frame (aware).
        first_track_id: Number of the first track.
        detector: Finds the objects in each picture; by default they are found by what moves.
        ignored: Where motion does not count.
        on_frame: Called after each frame with what was made of it.

    Raises:
        DetectorFailed: The detector stopped.
        VideoError: The frames ended with it. Everything certain before either was yielded.
    """
    motion = _Motion(config, start_time, first_track_id, detector, ignored)
    gaps: list[Gap] = []
    step_us = round(config.batch_s * 1e6)
    due_us = step_us
    try:
        for item in frames:
            if isinstance(item, Gap):
                gaps.append(item)
                motion.meet(item)
                # The next frame may be hours away, or of another size, which is said before its points.
                if item.reason in (GapReason.INTERRUPTED, GapReason.SIZE_CHANGED):
                    yield motion.taken(gaps)
                    gaps = []
                continue
            if item.time_us >= due_us:
                yield motion.taken(gaps)
                gaps = []
                due_us = (item.time_us // step_us + 1) * step_us
            seen = motion.step(item)
            if on_frame:
                on_frame(item, seen)
    except ExtractorError:
        motion.leave()
        yield motion.taken(gaps)
        raise
    motion.finish()
    yield motion.taken(gaps)


class _Motion:
    """The method, one frame at a time."""

    def __init__(
        self,
        config: MotionConfig,
        start_time: datetime,
        first_track_id: int,
        detector: Detector | None,
        ignored: IgnoredArea | None,
    ) -> None:
        # What a model calls an object is one before it moves.
        self._config = config if detector is None else config.model_copy(update={"confirm_path": 0.0})
        self._detector = detector
        self._start_time = start_time
        self._viewed: Frame | None = None
        self._steadiness: Steadiness | None = None
        self._changes: list[SceneChanged] = []
        self._gaps: list[Gap] = []
        self._emission = Emission(config, start_time)
        self._next_track_id = first_track_id
        self._ignored = ignored
        self._tracks: Tracks | None = None
        self._shape: tuple[int, ...] = ()
        self._sizes: LearntSizes | None = None
        self._last: Frame | None = None
        self._frames = 0

    def step(self, frame: Frame) -> Seen:
        """Find and follow what moves in one more frame."""
        dt_s = self._dt_s(frame)
        self._frames, self._last = self._frames + 1, frame
        factor = self._factor_of(frame.image)
        image = shrunk(frame.image, factor)
        view = self._view(frame, image, dt_s)
        if not view.is_kept:
            return unseen(image, factor)
        if self._tracks is None or frame.image.shape != self._shape:
            self._restart(frame)
        assert self._tracks is not None
        image = self._grain.smoothed(self._shake.undone(image, dt_s), dt_s)
        if self._grain.is_renewed:
            self._background = Background(self._config)
        found = self._moving(frame, image, dt_s) if self._detector is None else self._modelled(frame, image)
        trusted = None if view.is_doubtful else found.objects
        observed = self._tracks.step(trusted, frame.index, frame.time_us, dt_s)
        if self._detector is None:
            self._sway.learn(self._background.known, dt_s)
            self._tracks.weigh(lambda boxes_xyxy: self._sway.shares(image, found.mask, boxes_xyxy))
        self._tracks.look(lambda boxes_xyxy: described(image, found.mask, boxes_xyxy))
        self._emission.add(frame.index, frame.time_us, observed, self._factor * frame.scale, found.foreground.share)
        return Seen(self._factor, found.foreground, found.blobs_xyxy, observed)

    def _moving(self, frame: Frame, image: Image, dt_s: float) -> _Found:
        """What moves in the picture, which is the frame's, smaller."""
        assert self._tracks is not None
        standing = self._tracks.standing()
        foreground = self._background.foreground(image, dt_s, standing, self._grain.deviation)
        if self._ignored is not None:
            foreground = self._ignored.without(foreground)
        mask = blobs.cleaned(foreground.mask, self._config)
        boxes = blobs.boxes(mask, self._config)
        self._tracks.disown(foreground.ghosts)
        sizes = self._known_sizes()
        objects = None if foreground.is_light_change else self._objects(image, mask, boxes, sizes, dt_s)
        return _Found(foreground, mask, boxes, objects)

    def _modelled(self, frame: Frame, image: Image) -> _Found:
        """What the detector sees in the frame."""
        assert self._detector is not None
        seen = self._detector.detect(frame.image)
        if self._ignored is not None:
            seen = seen.where(self._ignored.is_watched(seen.boxes_xyxy, frame.image.shape[1], frame.image.shape[0]))
        boxes = seen.boxes_xyxy / self._factor
        mask = np.full(image.shape[:2], FOREGROUND, np.uint8)
        share = min(1.0, float(blobs.areas(boxes).sum()) / mask.size)
        objects = replace(seen, boxes_xyxy=boxes, looks=described(image, mask, boxes))
        return _Found(Foreground(mask, share, is_light_change=False), mask, boxes, objects)

    def _known_sizes(self) -> LearntSizes | None:
        """What is known of sizes in the picture."""
        assert self._tracks is not None
        if self._tracks.sizes.is_due:
            self._sizes = self._tracks.sizes.learnt()
        return self._sizes

    def _objects(
        self, image: Image, mask: Mask, found: blobs.BoxesXyxy, sizes: LearntSizes | None, dt_s: float
    ) -> blobs.BoxesXyxy | Detections:
        """Objects of the known size; blobs, as long as none is known."""
        assert self._tracks is not None
        if sizes is None:
            return found
        objects = explained(mask, found, self._tracks.expected_xyxy(dt_s), sizes)
        return found if objects is None else replace(objects, looks=described(image, mask, objects.boxes_xyxy))

    def _view(self, frame: Frame, image: Image, dt_s: float) -> View:
        """What is known of the view; when it is lost nothing seen before can be followed, which is recorded."""
        if self._viewed is not None and frame.image.shape != self._viewed.image.shape:
            self.leave()
        self._viewed, self._steadiness = frame, self._steadiness or Steadiness(self._config)
        view = self._steadiness.look(image, dt_s)
        if view.change is not None:
            self._stop("input_changed")
            self._changes.append(self._scene_changed(frame, view.change))
        told = _told(view)
        if told is not None:
            self._gaps.append(Gap(frame.index, *told))
        return view

    def _scene_changed(self, frame: Frame, change: Change) -> SceneChanged:
        factor = frame.image.shape[1] / shrunk(frame.image, self._factor_of(frame.image)).shape[1]
        dx, dy = (None, None) if change.shift_xy is None else (each * factor * frame.scale for each in change.shift_xy)
        time = self._start_time + timedelta(microseconds=frame.time_us)
        return SceneChanged(time=time, cause=change.cause, changed_share=change.share, dx=dx, dy=dy)

    def meet(self, gap: Gap) -> None:
        """Heed a gap: after a change of size or an interruption, nothing seen before can be followed."""
        if gap.reason in (GapReason.SIZE_CHANGED, GapReason.INTERRUPTED):
            self._stop("input_changed")

    def finish(self) -> None:
        """End what is open: the video is over."""
        self._stop("end_of_video")
        self.leave()

    def leave(self) -> None:
        """Nobody will look at this view again: one that was lost and is not there at last was another's."""
        change = self._steadiness.end() if self._steadiness is not None else None
        if change is not None:
            assert self._viewed is not None, "it has seen a view"
            self._changes.append(self._scene_changed(self._viewed, change))
            said = f"these pictures end while the camera shows another view: {_ANEW}"
            self._gaps.append(Gap(self._viewed.index, GapReason.CAMERA_MOVED, said))
        self._steadiness = None

    def taken(self, gaps: list[Gap]) -> Extraction:
        """What came out since the last call."""
        time_us = self._last.time_us if self._last else 0
        changes = (batch_of(self._changes),) if self._changes else ()
        said = sorted([*gaps, *self._gaps], key=lambda gap: gap.before_index)
        self._changes, self._gaps = [], []
        return Extraction((*self._emission.take(), *changes), self._frames, time_us, tuple(said))

    def _restart(self, frame: Frame) -> None:
        self._stop("input_changed")
        self._shape = frame.image.shape
        self._factor = self._factor_of(frame.image)
        height, width = shrunk(frame.image, self._factor).shape[:2]
        self._shake = Shake(self._config)
        self._grain = Grain(self._config)
        self._background = Background(self._config)
        self._sway = Sway(self._config)
        self._sizes = None
        self._tracks = Tracks(self._config, width, height, self._next_track_id)

    def _stop(self, reason: EndReason) -> None:
        if self._tracks is not None:
            self._emission.close(self._tracks.end_all(reason))
            self._next_track_id = self._tracks.next_track_id
            self._tracks = None

    def _factor_of(self, image: Image) -> float:
        """Pixels of the picture for one of the analysed picture."""
        return float(max(1.0, min(image.shape[:2]) / self._config.analysis_lines))

    def _dt_s(self, frame: Frame) -> float:
        since_us = frame.time_us - self._last.time_us if self._last else 0
        return min(since_us / 1e6, DT_MAX_S)


def _told(view: View) -> tuple[GapReason, str] | None:
    """What people are told of the view; None if there is no news."""
    if view.has_rested:
        said = "the camera rests: its view is learnt anew"
        return GapReason.CAMERA_RESTS, said if view.change is None else f"{said}; it is another view: {_ANEW}"
    if view.change is None:
        return None
    if view.is_kept:
        return GapReason.CAMERA_MOVED, f"the camera shows another view than before it was dark: {_ANEW}"
    said = f"the camera shows another view ({view.change.cause}): nothing is said of it until it rests"
    return GapReason.CAMERA_MOVED, said


def unseen(image: Image, factor: float) -> Seen:
    """What is made of a picture of a camera that does not rest: nothing."""
    foreground = Foreground(np.zeros(image.shape[:2], np.uint8), 0.0, is_light_change=False)
    nobody = Observed((), np.zeros((0, 6)), np.zeros(0), ())
    return Seen(factor, foreground, np.zeros((0, 4)), nobody)


def shrunk(image: Image, factor: float) -> Image:
    """The picture, smaller by a factor: means over a whole number of its pixels, then interpolated for the rest.

    Exact means over fractions of pixels take six times as long, more than anything else that is done to a picture
    but for the background model.
    """
    if factor == 1:
        return image
    height, width = image.shape[:2]
    whole = int(factor)
    if whole > 1:
        image = np.asarray(cv2.resize(image, (width // whole, height // whole), interpolation=cv2.INTER_AREA), np.uint8)
    size = (round(width / factor), round(height / factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)
