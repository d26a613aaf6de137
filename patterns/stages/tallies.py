"""How many events there were in each window of time, empty windows too: `tally`."""

from typing import Any

import numpy as np
import pyarrow as pa

from events import EventType, Tally
from patterns.binding.rows import TIME
from patterns.durations import microseconds
from patterns.engine.situations import nearest_time
from patterns.stages.settings import Windows


class WindowCounts:
    """Remembers, for each source and key, its counts of the window that is open, and how many were empty before.

    `given_up` counts events of keys beyond the limit.
    """

    def __init__(self, name: str, settings: Windows) -> None:
        self.name = name
        self.settings = settings
        self.window_us = microseconds(settings.window)
        self.given_up = 0
        self._window: int | None = None
        self._counts: dict[tuple[str, str], list[int]] = {}
        self._keys: dict[str, int] = {}

    def take(self, rows: pa.Table, until_us: int) -> list[tuple[str, EventType]]:
        """What the rows, the next final ones in their total order, and the coming of this time lead to."""
        found: list[tuple[str, EventType]] = []
        if rows.num_rows:
            windows = np.asarray(rows.column(TIME)) // self.window_us
            sources = rows.column("source").to_pylist()
            keys = rows.column(self.settings.by).to_pylist() if self.settings.by else [""] * rows.num_rows
            starts = np.flatnonzero(np.diff(windows, prepend=windows[0] - 1))
            for begin, end in zip(starts.tolist(), [*starts[1:].tolist(), rows.num_rows], strict=True):
                found += self._closed(int(windows[begin]))
                for at in range(begin, end):
                    self._count(sources[at], keys[at])
        return found + self._closed(until_us // self.window_us)

    def reset(self) -> None:
        """The input has ended; windows that were open then are not told of."""
        self._window = None
        self._counts.clear()
        self._keys.clear()

    def state(self) -> Any:
        """What `restore` takes."""
        return [self.given_up, self._window, [[*key, *counts] for key, counts in self._counts.items()]]

    def restore(self, saved: Any) -> None:
        """Goes on from what `state` gave."""
        self.given_up, self._window, counts = saved
        self._counts = {(source, key): [events, empty] for source, key, events, empty in counts}
        self._keys = {}
        for source, _ in self._counts:
            self._keys[source] = self._keys.get(source, 0) + 1

    def _count(self, source: str, key: str | None) -> None:
        counts = self._counts.get((source, key or ""))
        if counts is None:
            if self._keys.get(source, 0) >= self.settings.keys_most:
                self.given_up += 1
                return
            self._keys[source] = self._keys.get(source, 0) + 1
            counts = self._counts[source, key or ""] = [0, 0]
        counts[0] += 1

    def _closed(self, window: int) -> list[tuple[str, EventType]]:
        """The windows before this one, which is the one that is open now."""
        found: list[tuple[str, EventType]] = []
        while self._window is not None and self._window < window and self._counts:
            for source, key in sorted(self._counts):
                found += self._told(source, key)
            self._window += 1
        self._window = window if self._window is None else max(window, self._window)
        return found

    def _told(self, source: str, key: str) -> list[tuple[str, EventType]]:
        counts = self._counts[source, key]
        events, empty = counts
        if not events and empty >= self.settings.empty_most:
            del self._counts[source, key]
            self._keys[source] -= 1
            return []
        counts[:] = [0, 0 if events else empty + 1]
        assert self._window is not None, "a window is open"
        began_us = self._window * self.window_us
        event = Tally(
            time=nearest_time(began_us + self.window_us), stage=self.name, key=key, began_at=nearest_time(began_us),
            window_s=self.window_us / 1e6, events=events,
        )  # fmt: skip
        return [(source, event)]
