"""Room for bodies at central: who waits, who does not, and that nothing is kept of what has gone."""

import asyncio
import time
from contextlib import AsyncExitStack

import httpx

from events import station_name
from store import Log
from sync.central.room import SMALL_BYTES, Room
from sync.protocol.wire import Record
from sync.station.client import Greeting
from tests.sync.conftest import BRNO, NOON, append_points, signed_link, stream_of

KB = 10 * SMALL_BYTES
A, B, C = map(station_name, ("a", "b", "c"))


async def _settled(*tasks: asyncio.Task[None]) -> list[bool]:
    for _ in range(5):
        await asyncio.sleep(0)
    return [task.done() for task in tasks]


def test_who_comes_when_it_is_full_waits_and_is_served_in_order() -> None:
    async def scene() -> None:
        room = Room(100 * KB)
        async with AsyncExitStack() as held:
            await held.enter_async_context(room.taken(A, 60 * KB))
            large = asyncio.create_task(room._take(B, 80 * KB))
            small = asyncio.create_task(room._take(C, 10 * KB))
            assert await _settled(large, small) == [False, False]
        assert await _settled(large, small) == [True, True]
        room._give_back(B, 80 * KB)
        room._give_back(C, 10 * KB)
        assert not room._taken
        assert not room._waiting

    asyncio.run(scene())


def test_a_station_has_a_quarter_or_one_body_and_does_not_hold_up_the_others() -> None:
    async def scene() -> None:
        room = Room(100 * KB)
        await room._take(A, 60 * KB)
        more = asyncio.create_task(room._take(A, 1 * KB))
        other = asyncio.create_task(room._take(B, 10 * KB))
        assert await _settled(more, other) == [False, True]
        room._give_back(A, 60 * KB)
        assert await _settled(more) == [True]

    asyncio.run(scene())


def test_a_body_larger_than_all_goes_alone() -> None:
    async def scene() -> None:
        room = Room(100 * KB)
        async with room.taken(A, 500 * KB):
            waiting = asyncio.create_task(room._take(B, 1 * KB))
            assert await _settled(waiting) == [False]
        assert await _settled(waiting) == [True]

    asyncio.run(scene())


def test_who_gives_up_waiting_leaves_nothing() -> None:
    async def scene() -> None:
        room = Room(100 * KB)
        async with room.taken(A, 100 * KB):
            gone = asyncio.create_task(room._take(B, 50 * KB))
            behind = asyncio.create_task(room._take(C, 50 * KB))
            await _settled(gone)
            gone.cancel()
            await _settled(gone)
        assert await _settled(gone, behind) == [True, True]
        room._give_back(C, 50 * KB)
        assert not room._taken

    asyncio.run(scene())


def test_a_small_body_needs_no_room() -> None:
    async def scene() -> None:
        room = Room(100 * KB)
        async with room.taken(A, 100 * KB), room.taken(A, SMALL_BYTES), room.taken(B, 1):
            assert room._taken == {A: 100 * KB}

    asyncio.run(scene())


def test_a_large_body_is_not_overtaken_for_ever_by_others_of_its_station() -> None:
    async def scene() -> None:
        room = Room(100 * KB)
        await room._take(A, 20 * KB)
        large = asyncio.create_task(room._take(A, 60 * KB))
        await _settled(large)
        later = asyncio.create_task(room._take(A, 2 * KB))
        other = asyncio.create_task(room._take(B, 10 * KB))
        assert await _settled(large, later, other) == [False, False, True]
        room._give_back(A, 20 * KB)
        assert await _settled(large, later) == [True, False]
        later.cancel()

    asyncio.run(scene())


def test_a_body_that_takes_long_keeps_nobody_out() -> None:
    async def scene() -> None:
        room = Room(100 * KB, patience_s=0.01)
        async with room.taken(A, 500 * KB):
            await asyncio.wait_for(room._take(B, 50 * KB), 30)
        assert room._taken == {B: 50 * KB}

    asyncio.run(scene())


def test_central_says_what_it_took_itself(central: str, station_log: Log) -> None:
    append_points(station_log, stream_of(), [3])
    (segment,) = station_log.read(stream_of())
    with httpx.Client(base_url=central) as client:
        link = signed_link(client)
        link.hello(Greeting(BRNO, 1, NOON, (), None, None))
        began = time.monotonic()
        answer = link.send([Record(segment, bytes(32), begins_run=False)])
        assert 0 < answer.took_s < time.monotonic() - began
