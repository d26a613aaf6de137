"""Turns: a request that goes on where another ends waits until that one is through.

Contract: a station with two requests under way names each (`order`) and says of the second that it follows the
first. Requests of one event loop keep turns; one whose predecessor does not come through in time, or with which too
many of its station would wait, goes on without, and the log refuses it where that matters. Names are a station's own
and are forgotten after a while.
"""

import asyncio
from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from events import Station

WAIT_S = 2.0
WAITING_MAX = 4
"""Requests of a station that wait at a time: each holds a body in memory."""
NAME_LENGTH_MAX = 64
_REMEMBERED = 16
"""Requests of a station that are remembered."""
_STATIONS_MAX = 10_000


class Turns:
    """The requests with segments of all stations that are through."""

    def __init__(self, wait_s: float = WAIT_S) -> None:
        self._wait_s = wait_s
        self._through: OrderedDict[Station, OrderedDict[str, None]] = OrderedDict()
        self._waiting: Counter[Station] = Counter()
        self._noted: dict[tuple[Station, str], set[asyncio.Event]] = {}

    async def wait_for(self, station: Station, follows: str) -> None:
        """Return when the station's request of that name is through or too late; empty: at once."""
        if not follows or follows in self._through.get(station, ()) or self._waiting[station] >= WAITING_MAX:
            return
        noted, others = asyncio.Event(), self._noted.setdefault((station, follows), set())
        others.add(noted)
        self._waiting[station] += 1
        try:
            with suppress(TimeoutError):
                await asyncio.wait_for(noted.wait(), self._wait_s)
        finally:
            others.discard(noted)
            if not others:
                self._noted.pop((station, follows), None)
            self._waiting[station] -= 1
            self._waiting += Counter()  # forgets those of which none waits

    @contextmanager
    def named(self, station: Station, order: str) -> Iterator[None]:
        """Note, when the block ends, that the station's request of that name is through; empty: it has none."""
        try:
            yield
        finally:
            if order:
                self._note(station, order)

    def _note(self, station: Station, order: str) -> None:
        names = self._through.setdefault(station, OrderedDict())
        names[order] = None
        self._through.move_to_end(station)
        while len(names) > _REMEMBERED:
            names.popitem(last=False)
        while len(self._through) > _STATIONS_MAX:
            self._through.popitem(last=False)
        for noted in self._noted.get((station, order), ()):
            noted.set()
