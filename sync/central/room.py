"""Room: how many bytes of bodies central holds at once, of all stations together.

Contract: room is taken for the length of a block, before a body is read; who comes when it is full waits, and those
who wait are served in order. One station has at most a quarter of it, or one body: a hundred stations that send at
once take no more memory than a few, and one that never ends its bodies does not keep the others out. Of one event
loop.
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from events import Station

_STATIONS_SHARE = 4


class Room:
    """Room for so many bytes.

    Args:
        bytes_max: Bytes held at once; a single larger body goes alone.
    """

    def __init__(self, bytes_max: int) -> None:
        self._bytes_max = bytes_max
        self._taken: Counter[Station] = Counter()
        self._waiting: deque[tuple[Station, int, asyncio.Future[None]]] = deque()

    @asynccontextmanager
    async def taken(self, station: Station, size: int) -> AsyncIterator[None]:
        """Room for a body of the station's."""
        await self._take(station, size)
        try:
            yield
        finally:
            self._give_back(station, size)

    async def _take(self, station: Station, size: int) -> None:
        come = asyncio.get_running_loop().create_future()
        waiter = (station, size, come)
        self._waiting.append(waiter)
        self._let_in()
        try:
            await come
        except asyncio.CancelledError:
            if come.done() and not come.cancelled():
                self._give_back(station, size)  # it came with the cancellation
            else:
                self._waiting.remove(waiter)
                self._let_in()
            raise

    def _fits(self, station: Station, size: int) -> bool:
        own, total = self._taken[station], self._taken.total()
        return not total or (
            total + size <= self._bytes_max and (not own or own + size <= self._bytes_max // _STATIONS_SHARE)
        )

    def _give_back(self, station: Station, size: int) -> None:
        self._taken[station] -= size
        self._taken += Counter()  # forgets who has none
        self._let_in()

    def _let_in(self) -> None:
        """Let in who fits, in order; a station that has its share does not hold up those behind it."""
        held_up = deque[tuple[Station, int, asyncio.Future[None]]]()
        while self._waiting:
            station, size, come = waiter = self._waiting.popleft()
            if come.cancelled():
                continue
            if self._fits(station, size):
                self._taken[station] += size
                come.set_result(None)
            else:
                held_up.append(waiter)
                if self._taken.total() + size > self._bytes_max:
                    break
        held_up.extend(self._waiting)
        self._waiting = held_up
