"""From tracks to events, in order of time and in batches that depend on the media only.

Contract: a point is emitted `lag_s` after its picture, so that what became known in between can be
heeded: points of a track that was confirmed only then are included, and points where a track was merely
expected and never seen again are not. Points come in order of frame, then of track number. A track's end
follows its last point. Batches are cut where media time passes a whole number of `batch_s`.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from events import ActivityInterval, Appearance, EventBatch, TrackEnded, TrackPoint, batch_of, schema_of
from events.segment import microseconds
from extractors.motion.appearance import METHOD, packed
from extractors.motion.config import MotionConfig
from extractors.motion.tracks import Observed, Track

Row = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Picture:
    """What one picture showed, waiting for its emission; pixels of the video, not of the analysis."""

    frame: int
    time_us: int
    tracks: tuple[Track, ...]
    rows: npt.NDArray[np.float64]
    """`x y x1 y1 x2 y2 vx vy confidence`, `(n, 9)`"""
    area_share: float


@dataclass(slots=True)
class _Path:
    """What is known of a track's emitted points."""

    first_frame: int
    first_us: int
    first_xy: Row
    last_frame: int
    last_us: int
    last_xy: Row
    box_sum: Row
    """sum of the boxes `x1 y1 x2 y2`, `(4,)` px"""
    points: int = 1
    length_px: float = 0.0


@dataclass(slots=True)
class _Activity:
    """The open activity interval."""

    first_frame: int
    first_us: int
    last_frame: int
    last_us: int
    tracks_max: int
    area_share_max: float


class Emission:
    """Holds back what is not yet certain, and turns the rest into batches."""

    def __init__(self, config: MotionConfig, start_time: datetime) -> None:
        self._config = config
        self._start_time = start_time
        self._held: deque[_Picture] = deque()
        self._points: list[tuple[int, int, int, Row]] = []  # time, track number, frame, row
        self._paths: dict[int, _Path] = {}
        self._seen: dict[int, tuple[int, Row]] = {}  # time and row of the last emitted point that was seen
        self._ended: list[Track] = []
        self._ends: list[TrackEnded] = []
        self._looks: list[Appearance] = []
        self._activity: _Activity | None = None
        self._intervals: list[ActivityInterval] = []

    def add(self, frame: int, time_us: int, observed: Observed, scale: float, area_share: float) -> None:
        """Take in one picture, and release what is old enough.

        Args:
            frame: Its number.
            time_us: Its time, µs.
            observed: The tracks in it, px of the analysed picture.
            scale: Pixels of the video for one of the analysed picture.
            area_share: Share of the picture in motion.
        """
        boxes = observed.boxes_xyxy
        pixels = np.concatenate([observed.means[:, :2], boxes, observed.means[:, 4:]], axis=1) * scale
        rows = np.concatenate([pixels, observed.confidence[:, None]], axis=1)
        self._held.append(_Picture(frame, time_us, observed.tracks, rows, area_share))
        self._ended += observed.ended
        self._release(time_us - round(self._config.lag_s * 1e6))

    def close(self, ended: Iterable[Track]) -> None:
        """Release everything: no more pictures come, or of another kind; these tracks ended with it."""
        self._ended += ended
        if self._held:
            self._release(self._held[-1].time_us)
        self._close_activity()

    def take(self) -> tuple[EventBatch, ...]:
        """The batches of what was released since the last call: points, ends, looks, intervals."""
        batches = []
        if self._points:
            batches.append(self._point_batch())
        if self._ends:
            batches.append(batch_of(self._ends))
        if self._looks:
            batches.append(batch_of(self._looks))
        if self._intervals:
            batches.append(batch_of(self._intervals))
        self._points, self._ends, self._looks, self._intervals = [], [], [], []
        return tuple(batches)

    def _release(self, until_us: int) -> None:
        while self._held and self._held[0].time_us <= until_us:
            self._emit(self._held.popleft())
        oldest_us = self._held[0].time_us if self._held else until_us + 1
        for track in [t for t in self._ended if t.last_seen_us < oldest_us]:
            self._ended.remove(track)
            self._end(track)

    def _emit(self, picture: _Picture) -> None:
        known = [
            (track.track_id, self._bridged(track, picture, row))
            for track, row in zip(picture.tracks, picture.rows, strict=True)
            if track.track_id and track.last_seen_frame >= picture.frame
        ]
        for track_id, row in sorted(known, key=lambda pair: pair[0]):
            if row[-1] > 0:
                self._seen[track_id] = picture.time_us, row
            self._points.append((picture.time_us, track_id, picture.frame, row))
            self._extend(track_id, picture, row)
        self._note_activity(picture, len(known))

    def _bridged(self, track: Track, picture: _Picture, row: Row) -> Row:
        """The row; where nothing was seen, on the straight way between what was seen before and what is next."""
        before = self._seen.get(track.track_id)
        if row[-1] > 0 or before is None:
            return row
        after = self._next_seen(track)
        if after is None:
            return row
        share = (picture.time_us - before[0]) / (after[0] - before[0])
        bridged = before[1] + share * (after[1] - before[1])
        bridged[-1] = 0
        return bridged

    def _next_seen(self, track: Track) -> tuple[int, Row] | None:
        """Time and row of the first waiting picture in which the track is seen."""
        for picture in self._held:
            for other, row in zip(picture.tracks, picture.rows, strict=True):
                if other is track and row[-1] > 0:
                    return picture.time_us, row
        return None

    def _extend(self, track_id: int, picture: _Picture, row: Row) -> None:
        xy, box = row[:2], row[2:6]
        path = self._paths.get(track_id)
        if path is None:
            self._paths[track_id] = _Path(picture.frame, picture.time_us, xy, picture.frame, picture.time_us, xy, box)
            return
        path.length_px += float(np.hypot(*(xy - path.last_xy)))
        path.last_frame, path.last_us, path.last_xy = picture.frame, picture.time_us, xy
        path.box_sum = path.box_sum + box
        path.points += 1

    def _end(self, track: Track) -> None:
        path = self._paths.pop(track.track_id)
        self._seen.pop(track.track_id, None)
        assert track.end_reason is not None
        x1, y1, x2, y2 = path.box_sum / path.points
        self._note_looks(track, path)
        self._ends.append(
            TrackEnded(
                time=self._time(path.last_us),
                track_id=track.track_id,
                began_at=self._time(path.first_us),
                first_frame=path.first_frame,
                last_frame=path.last_frame,
                points=path.points,
                path_px=path.length_px,
                x_entry=path.first_xy[0],
                y_entry=path.first_xy[1],
                x_exit=path.last_xy[0],
                y_exit=path.last_xy[1],
                reason=track.end_reason,
                displacement_px=float(np.hypot(*(path.last_xy - path.first_xy))),
                duration_s=(path.last_us - path.first_us) / 1e6,
                x1_mean=x1,
                y1_mean=y1,
                x2_mean=x2,
                y2_mean=y2,
            )
        )

    def _note_looks(self, track: Track, path: _Path) -> None:
        if track.views:
            self._looks.append(
                Appearance(
                    time=self._time(path.last_us),
                    track_id=track.track_id,
                    method=METHOD,
                    descriptor=packed(track.looks),
                    views=track.views,
                )
            )

    def _note_activity(self, picture: _Picture, tracks: int) -> None:
        now = self._activity
        if now and picture.time_us - now.last_us > self._config.activity_gap_s * 1e6:
            self._close_activity()
            now = None
        if not tracks:
            return
        if now is None:
            self._activity = _Activity(
                picture.frame, picture.time_us, picture.frame, picture.time_us, tracks, picture.area_share
            )
            return
        now.last_frame, now.last_us = picture.frame, picture.time_us
        now.tracks_max = max(now.tracks_max, tracks)
        now.area_share_max = max(now.area_share_max, picture.area_share)

    def _close_activity(self) -> None:
        now, self._activity = self._activity, None
        if now:
            self._intervals.append(
                ActivityInterval(
                    time=self._time(now.first_us),
                    ended_at=self._time(now.last_us),
                    first_frame=now.first_frame,
                    last_frame=now.last_frame,
                    tracks_max=now.tracks_max,
                    area_share_max=now.area_share_max,
                )
            )

    def _point_batch(self) -> EventBatch:
        schema = schema_of(TrackPoint)
        times, track_ids, frames, rows = zip(*self._points, strict=True)
        start_us = microseconds(self._start_time)
        names = ("x", "y", "x1", "y1", "x2", "y2", "vx", "vy", "confidence")
        columns: dict[str, npt.NDArray[np.generic]] = {
            "time": np.array(times, np.int64) + start_us,
            "track_id": np.array(track_ids, np.int64),
            "frame": np.array(frames, np.int64),
            **dict(zip(names, np.array(rows, np.float32).T, strict=True)),
        }
        arrays = [pa.array(columns[field.name]).cast(field.type) for field in schema]
        return EventBatch(TrackPoint, pa.RecordBatch.from_arrays(arrays, schema=schema))

    def _time(self, time_us: int) -> datetime:
        return self._start_time + timedelta(microseconds=time_us)
