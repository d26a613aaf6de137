"""Tracks that are together and stay so: `group_seen`.

In each frame, tracks nearer than the radius are neighbours, and what neighbours connect is a component. A
component continues the group with which it shares the most members, if these are half or more of the group's;
of two groups it continues the older one. A group is told of once it has persisted, whenever its members change,
every so often while they do not, and when it has dissolved.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from events import EventType, GroupSeen
from patterns.durations import microseconds
from patterns.engine.situations import nearest_time
from patterns.stages.frames import Frame, frames
from patterns.stages.pairs import near_pairs
from patterns.stages.settings import Groups


@dataclass(slots=True)
class _Group:
    """What is remembered of one group.

    Attributes:
        began_us: From when it has been together.
        seen_us: When it was last seen.
        members: Its tracks, ascending.
        place: Mean of its points and distance to the furthest, px.
        number: Its number once it was told of; 0 before.
        told_us: When it was last told of.
        told_members: Its members then.
    """

    began_us: int
    seen_us: int
    members: list[int]
    place: tuple[float, float, float]
    number: int = 0
    told_us: int = 0
    told_members: list[int] | None = None


class StandingGroups:
    """Remembers each source's groups, and how many were told of."""

    def __init__(self, name: str, settings: Groups) -> None:
        self.name = name
        self.settings = settings
        self.persists_us, self.every_us, self.gone_after_us = (
            microseconds(each) for each in (settings.persists, settings.every, settings.gone_after)
        )
        self.given_up = 0
        self._groups: dict[str, list[_Group]] = {}
        self._numbers: dict[str, int] = {}

    def take(self, rows: pa.Table, until_us: int) -> list[tuple[str, EventType]]:
        """What the rows, the next final ones in their total order, and the coming of this time lead to."""
        found: list[tuple[str, EventType]] = []
        for frame in frames(rows):
            found += self._dissolved(frame.time_us)
            found += [(frame.source, event) for event in self._of_frame(frame)]
        return found + self._dissolved(until_us)

    def reset(self) -> None:
        """The input has ended; numbers go on."""
        self._groups.clear()

    def state(self) -> Any:
        """What `restore` takes."""
        groups = {source: [asdict(group) for group in groups] for source, groups in self._groups.items()}
        return {"groups": groups, "numbers": self._numbers}

    def restore(self, saved: Any) -> None:
        """Goes on from what `state` gave."""
        self._numbers = dict(saved["numbers"])
        self._groups = {
            source: [_Group(**(group | {"place": tuple(group["place"])})) for group in groups]
            for source, groups in saved["groups"].items()
        }

    def _of_frame(self, whole: Frame) -> list[EventType]:
        frame = whole.first(self.settings.tracks_most)
        self.given_up += len(whole.tracks) - len(frame.tracks)
        found: list[EventType] = []
        free = self._groups.setdefault(frame.source, [])[:]
        for members in _components(frame, self.settings):
            tracks = frame.tracks[members].tolist()
            group = _continued(free, tracks)
            if group is None:
                group = _Group(frame.time_us, frame.time_us, tracks, (0.0, 0.0, 0.0))
                self._groups[frame.source].append(group)
            else:
                free.remove(group)
            middle = frame.xy[members].mean(axis=0)
            radius = float(np.hypot(*(frame.xy[members] - middle).T).max())
            group.seen_us, group.members, group.place = frame.time_us, tracks, (*middle.tolist(), radius)
            if self._is_due(group):
                found.append(self._told(frame.source, group))
        return found

    def _is_due(self, group: _Group) -> bool:
        if group.number == 0:
            return group.seen_us - group.began_us >= self.persists_us
        return group.members != group.told_members or group.seen_us - group.told_us >= self.every_us

    def _told(self, source: str, group: _Group) -> GroupSeen:
        if group.number == 0:
            group.number = self._numbers[source] = self._numbers.get(source, 0) + 1
        group.told_us, group.told_members = group.seen_us, group.members
        return self._event(group, group.seen_us, group.members)

    def _dissolved(self, until_us: int) -> list[tuple[str, EventType]]:
        """The ends of groups that have not been seen for too long, before this time."""
        over = sorted(
            (group.seen_us + self.gone_after_us, source, group.number, at)
            for source, groups in self._groups.items()
            for at, group in enumerate(groups)
            if group.seen_us + self.gone_after_us < until_us
        )
        found: list[tuple[str, EventType]] = []
        for due_us, source, number, at in over:
            if number:
                found.append((source, self._event(self._groups[source][at], due_us, [])))
        for source in {source for _, source, _, _ in over}:
            self._groups[source] = [
                group for group in self._groups[source] if group.seen_us + self.gone_after_us >= until_us
            ]
        return found

    def _event(self, group: _Group, time_us: int, members: list[int]) -> GroupSeen:
        x, y, radius = group.place
        return GroupSeen(
            time=nearest_time(time_us), stage=self.name, group_id=group.number, members=len(members),
            tracks="+".join(map(str, members)), began_at=nearest_time(group.began_us), x=x, y=y, radius_px=radius,
        )  # fmt: skip


def _components(frame: Frame, settings: Groups) -> list[list[int]]:
    """The components that are large enough, as indices of points, by their lowest track number."""
    pairs, _ = near_pairs(frame.xy, settings.radius_px)
    if not len(pairs):
        return []
    count = len(frame.tracks)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    parts: dict[int, list[int]] = {}
    for point, label in enumerate(labels.tolist()):
        parts.setdefault(label, []).append(point)
    return [part for part in parts.values() if len(part) >= settings.members_least]


def _continued(groups: list[_Group], tracks: list[int]) -> _Group | None:
    """Which of the groups, the oldest first, these tracks go on with."""
    shared = [(len(set(group.members) & set(tracks)), group) for group in groups]
    able = [(count, group) for count, group in shared if count and 2 * count >= len(group.members)]
    return max(able, key=lambda pair: pair[0])[1] if able else None
