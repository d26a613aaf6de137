"""Room: how many bytes of bodies central holds at once, of all stations together.

Contract: room is taken for the length of a block, before a body is read; who comes when it is full waits, and those
who wait are served in order. One station has at most a quarter of it, or one body: a hundred stations that send at
once take no more memory than a few. Small bodies need no room, so an alert waits for nobody. A body that takes long
is counted no longer: little of it comes, and it must not keep the others out. Of one event loop.
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from events import Station

SMALL_BYTES = 64 * 1024
"""Bodies up to here need no room; how many a station may send at once is bounded elsewhere."""
PATIENCE_S = 30.0
"""How long a body is counted."""
_STATIONS_SHARE = 4

_Waiter = tuple[Station, int, asyncio.Future[None]]


class Room:
    """Room for so many bytes.

    Args:
        bytes_max: Bytes held at once; a single larger body goes alone.
        patience_s: How long a body is counted, in seconds.
    """

    def __init__(self, bytes_max: int, patience_s: float = PATIENCE_S) -> None:
        self._bytes_max = bytes_max
        self._patience_s = patience_s
        self._taken: Counter[Station] = Counter()
        self._waiting: deque[_Waiter] = deque()

    @asynccontextmanager
    async def taken(self, station: Station, size: int) -> AsyncIterator[None]:
        """Room for a body of the station's."""
        if size <= SMALL_BYTES:
            yield
            return
        await self._take(station, size)
        share = [size]

        def give_back() -> None:
            if share:
                self._give_back(station, share.pop())

        late = asyncio.get_running_loop().call_later(self._patience_s, give_back)
        try:
            yield
        finally:
            late.cancel()
            give_back()

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
                with suppress(ValueError):  # it may be gone: those who let others in pass over who gave up
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
        """Let in who fits, in order; a station that has its share holds up itself, not those behind it."""
        held_up, stations = deque[_Waiter](), set[Station]()
        while self._waiting:
            station, size, come = waiter = self._waiting.popleft()
            if come.cancelled():
                continue
            if station not in stations and self._fits(station, size):
                self._taken[station] += size
                come.set_result(None)
                continue
            held_up.append(waiter)
            stations.add(station)
            if self._taken.total() + size > self._bytes_max:
                break
        held_up.extend(self._waiting)
        self._waiting = held_up
