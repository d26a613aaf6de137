"""Turns: a request that goes on where another ends waits until that one is through.

Contract: a station with two requests under way names each (`order`) and says of the second that it follows the
first. Requests of one event loop keep turns. The second takes no room before the first has come, so that it never
stands in its way; then it waits for the first however long that one waits for others, up to a bound. One whose
predecessor does not come in time, or with which too many of its station would wait, goes on without, and the log
refuses it where that matters. Names are a station's own and are forgotten after a while.
"""

import asyncio
from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum

from events import Station

COME_S = 2.0
"""How long a request waits for one that has not come."""
THROUGH_S = 25.0
"""How long a request waits for one that has come: less than its body is counted (`sync.central.room.PATIENCE_S`), and
than its station listens."""
WAITING_MAX = 4
"""Requests of a station that wait at a time."""
NAME_LENGTH_MAX = 64
_REMEMBERED = 16
"""Requests of a station that are remembered."""
_STATIONS_MAX = 10_000


class _Mark(Enum):
    """What happens to a request that others follow."""

    COME = "come"
    THROUGH = "through"


class Turns:
    """The requests with segments of all stations that have come, or are through.

    Args:
        come_s: How long to wait for one that has not come, in seconds.
        through_s: How long to wait for one that has come.
    """

    def __init__(self, come_s: float = COME_S, through_s: float = THROUGH_S) -> None:
        self._come_s = come_s
        self._through_s = through_s
        self._here: Counter[tuple[Station, str]] = Counter()
        self._through: OrderedDict[Station, OrderedDict[str, None]] = OrderedDict()
        self._waiting: Counter[Station] = Counter()
        self._noted: dict[tuple[_Mark, Station, str], set[asyncio.Event]] = {}

    @contextmanager
    def under_way(self, station: Station, order: str) -> Iterator[None]:
        """The station's request of that name is here while the block lasts, and through after it; empty: no name."""
        if not order:
            yield
            return
        self._here[station, order] += 1
        self._note(_Mark.COME, station, order)
        try:
            yield
        finally:
            self._here[station, order] -= 1
            self._here += Counter()  # forgets who is gone
            self.is_through(station, order)

    def is_through(self, station: Station, order: str) -> None:
        """Note that the station's request of that name is through."""
        if not order:
            return
        names = self._through.setdefault(station, OrderedDict())
        names[order] = None
        self._through.move_to_end(station)
        while len(names) > _REMEMBERED:
            names.popitem(last=False)
        while len(self._through) > _STATIONS_MAX:
            self._through.popitem(last=False)
        self._note(_Mark.THROUGH, station, order)

    async def wait_until_come(self, station: Station, follows: str) -> None:
        """Return when the station's request of that name has come, or is late; empty: at once."""
        if follows and not self._here[station, follows] and not self._was_through(station, follows):
            await self._wait(_Mark.COME, station, follows, self._come_s)

    async def wait_until_through(self, station: Station, follows: str) -> None:
        """Return when the station's request of that name is through or takes too long; at once if it is not here."""
        if self._here[station, follows] and not self._was_through(station, follows):
            await self._wait(_Mark.THROUGH, station, follows, self._through_s)

    def _was_through(self, station: Station, order: str) -> bool:
        return order in self._through.get(station, ())

    async def _wait(self, mark: _Mark, station: Station, order: str, seconds: float) -> None:
        if self._waiting[station] >= WAITING_MAX:
            return
        noted, others = asyncio.Event(), self._noted.setdefault((mark, station, order), set())
        others.add(noted)
        self._waiting[station] += 1
        try:
            with suppress(TimeoutError):
                await asyncio.wait_for(noted.wait(), seconds)
        finally:
            others.discard(noted)
            if not others:
                self._noted.pop((mark, station, order), None)
            self._waiting[station] -= 1
            self._waiting += Counter()  # forgets those of which none waits

    def _note(self, mark: _Mark, station: Station, order: str) -> None:
        for noted in self._noted.get((mark, station, order), ()):
            noted.set()
