"""How many tracks are in each zone, whenever that changes: `occupancy`."""

from typing import Any

import pyarrow as pa

from events import EventType, Occupancy
from patterns.durations import microseconds
from patterns.engine.situations import nearest_time
from patterns.errors import FrameSizeUnknown
from patterns.scene.geometry import FrameSize, in_polygon
from patterns.stages.frames import Frame, frames
from patterns.stages.settings import Zones


class ZoneCounts:
    """Remembers, for each zone, which tracks are in it and when each was last seen there."""

    def __init__(self, name: str, settings: Zones, frame_sizes: dict[str, FrameSize]) -> None:
        self.name = name
        self.settings = settings
        self.frame_sizes = frame_sizes
        self.gone_after_us = microseconds(settings.gone_after)
        self.given_up = 0
        self._inside: dict[str, dict[int, int]] = {zone: {} for zone in settings.zones}
        self._polygons: dict[tuple[str, FrameSize | None], Any] = {}

    def take(self, rows: pa.Table, until_us: int) -> list[tuple[str, EventType]]:
        """What the rows, the next final ones in their total order, and the coming of this time lead to."""
        found: list[tuple[str, EventType]] = []
        for frame in frames(rows):
            found += self._gone(frame.time_us)
            found += self._of_frame(frame)
        return found + self._gone(until_us)

    def reset(self) -> None:
        """The input has ended."""
        for tracks in self._inside.values():
            tracks.clear()

    def state(self) -> Any:
        """What `restore` takes."""
        return {zone: list(tracks.items()) for zone, tracks in self._inside.items()}

    def restore(self, saved: Any) -> None:
        """Goes on from what `state` gave."""
        self._inside = {zone: dict(tracks) for zone, tracks in saved.items()}

    def _of_frame(self, frame: Frame) -> list[tuple[str, EventType]]:
        found: list[tuple[str, EventType]] = []
        for name, zone in self.settings.zones.items():
            if zone.source != frame.source or not len(frame.tracks):
                continue
            is_in = in_polygon(self._polygon(name), frame.xy[:, 0], frame.xy[:, 1])
            tracks = self._inside[name]
            before = len(tracks)
            for track, inside in zip(frame.tracks.tolist(), is_in.tolist(), strict=True):
                if inside:
                    tracks[track] = frame.time_us
                else:
                    tracks.pop(track, None)
            found += self._change(name, before, frame.time_us)
        return found

    def _gone(self, until_us: int) -> list[tuple[str, EventType]]:
        """The changes by tracks that have not been seen for too long, before this time."""
        due = sorted(
            (seen + self.gone_after_us, at, zone, track)
            for at, (zone, tracks) in enumerate(self._inside.items())
            for track, seen in tracks.items()
            if seen + self.gone_after_us < until_us
        )
        found: list[tuple[str, EventType]] = []
        while due:
            due_us, _, zone, _ = due[0]
            together = [track for when, _, name, track in due if (when, name) == (due_us, zone)]
            before = len(self._inside[zone])
            for track in together:
                del self._inside[zone][track]
            found += self._change(zone, before, due_us)
            due = due[len(together) :]
        return found

    def _change(self, zone: str, before: int, time_us: int) -> list[tuple[str, EventType]]:
        now = len(self._inside[zone])
        if now == before:
            return []
        event = Occupancy(time=nearest_time(time_us), stage=self.name, zone=zone, tracks=now, tracks_before=before)
        return [(self.settings.zones[zone].source, event)]

    def _polygon(self, name: str) -> Any:
        zone = self.settings.zones[name]
        size = None if zone.units == "pixels" else self.frame_sizes.get(zone.source)
        if size is None and zone.units != "pixels":
            raise FrameSizeUnknown(name, zone.source)
        if (name, size) not in self._polygons:
            self._polygons[name, size] = zone.polygon_px(size)
        return self._polygons[name, size]
