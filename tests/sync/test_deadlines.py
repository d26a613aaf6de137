"""A peer that hangs, or gives a byte now and then, ends by the deadline; turns are kept at central."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from time import monotonic

import httpx
import pytest

from events import station_name
from sync import CentralUnreachable
from sync.central.turns import Turns
from sync.protocol.wire import ChallengeRequest
from sync.station.client import Central
from sync.station.deadlines import bounded

BRNO = station_name("brno-2")
PATIENCE_S = 30.0


class Peer:
    """Listens, reads what comes, and says pieces of an answer as it is told."""

    def __init__(self, say: Callable[[socket.socket, threading.Event], None]) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        self.has_heard = threading.Event()
        self._over = threading.Event()
        self._say = say
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with suppress(OSError):
            connection, _ = self._listening.accept()
            with connection:
                connection.recv(65536)
                self.has_heard.set()
                self._say(connection, self._over)

    def close(self) -> None:
        self._over.set()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(PATIENCE_S)


def hang(_: socket.socket, over: threading.Event) -> None:
    over.wait(PATIENCE_S)


def trickle(connection: socket.socket, over: threading.Event) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: 1000000\r\n\r\n")
    while not over.wait(0.01):
        connection.sendall(b" ")


@pytest.fixture(params=[hang, trickle])
def peer(request: pytest.FixtureRequest) -> Iterator[Peer]:
    listening = Peer(request.param)
    yield listening
    listening.close()


def test_a_request_ends_by_its_deadline_however_its_bytes_come(peer: Peer) -> None:
    with httpx.Client(base_url=peer.address, timeout=PATIENCE_S) as client:
        bounded(client)
        central = Central(client, None, deadline_s=0.2)
        with pytest.raises(CentralUnreachable, match="gave no answer in time"):
            central._challenge(BRNO)


def test_a_request_in_another_thread_can_be_ended(peer: Peer) -> None:
    failures: list[Exception] = []

    def ask(central: Central) -> None:
        try:
            central._challenge(BRNO)
        except CentralUnreachable as error:
            failures.append(error)

    with httpx.Client(base_url=peer.address, timeout=PATIENCE_S) as client:
        bounds = bounded(client)
        thread = threading.Thread(target=ask, args=(Central(client, None),))
        begun = monotonic()
        thread.start()
        assert peer.has_heard.wait(PATIENCE_S)
        bounds.abort()
        thread.join(PATIENCE_S)

    assert len(failures) == 1
    assert monotonic() - begun < PATIENCE_S


def test_a_body_that_nobody_takes_ends_by_the_deadline() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        address = f"http://127.0.0.1:{listening.getsockname()[1]}"
        with httpx.Client(base_url=address, timeout=PATIENCE_S) as client:
            bounded(client)
            central = Central(client, None, deadline_s=0.2 - 20_000_000 / 1000)
            with pytest.raises(CentralUnreachable, match="gave no answer in time"):
                central._exchange.post("segments", bytes(20_000_000), {}, 1000)


def test_a_request_waits_for_the_one_that_it_follows() -> None:
    turns, order = Turns(PATIENCE_S, PATIENCE_S), list[str]()

    async def second() -> None:
        await turns.wait_until_come(BRNO, "a-1")
        order.append("second has room")
        await turns.wait_until_through(BRNO, "a-1")
        order.append("second")

    async def both() -> None:
        waiting = asyncio.create_task(second())
        await asyncio.sleep(0)
        order.append("first comes")
        with turns.under_way(BRNO, "a-1"):
            while len(order) < 2:
                await asyncio.sleep(0)
            order.append("first")
        await waiting
        await turns.wait_until_come(BRNO, "a-1")  # long through
        await turns.wait_until_through(BRNO, "a-1")
        assert not turns._noted
        assert not turns._here

    asyncio.run(both())
    assert order == ["first comes", "second has room", "first", "second"]


def test_a_request_waits_however_long_the_one_before_waits_for_others() -> None:
    turns, is_over = Turns(come_s=0.001, through_s=PATIENCE_S), list[bool]()

    async def scene() -> None:
        with turns.under_way(BRNO, "a-1"):
            waiting = asyncio.create_task(turns.wait_until_through(BRNO, "a-1"))
            await asyncio.sleep(0.05)
            is_over.append(waiting.done())
        await waiting

    asyncio.run(scene())
    assert is_over == [False]


def test_no_request_waits_for_ever() -> None:
    async def scene() -> None:
        turns = Turns(come_s=0.001, through_s=0.001)
        await turns.wait_until_come(BRNO, "")
        await turns.wait_until_come(BRNO, "never-sent")
        await turns.wait_until_through(BRNO, "never-sent")
        with turns.under_way(BRNO, "itself"):
            await turns.wait_until_come(BRNO, "itself")
            await turns.wait_until_through(BRNO, "itself")
        assert not turns._noted

    asyncio.run(asyncio.wait_for(scene(), PATIENCE_S / 2))


def test_who_gives_up_takes_no_turn_from_others_that_wait() -> None:
    turns = Turns(PATIENCE_S, PATIENCE_S)

    async def scene() -> None:
        with turns.under_way(BRNO, "a-1"):
            patient, gone = (asyncio.create_task(turns.wait_until_through(BRNO, "a-1")) for _ in range(2))
            await asyncio.sleep(0)
            gone.cancel()
            await asyncio.sleep(0)
        await asyncio.wait_for(patient, PATIENCE_S / 2)
        assert not turns._noted

    asyncio.run(scene())


def test_a_request_that_fails_is_through_as_well() -> None:
    turns = Turns(PATIENCE_S, PATIENCE_S)
    with suppress(ValueError), turns.under_way(BRNO, "a-1"):
        raise ValueError

    asyncio.run(asyncio.wait_for(turns.wait_until_come(BRNO, "a-1"), PATIENCE_S / 2))


def test_few_names_of_few_stations_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sync.central.turns._STATIONS_MAX", 2)
    turns = Turns()
    for station in ("a", "b", "c"):
        for number in range(100):
            with turns.under_way(station_name(station), str(number)):
                pass

    assert {name: len(names) for name, names in turns._through.items()} == {"b": 16, "c": 16}


def test_what_asks_for_a_challenge_is_small() -> None:
    assert len(ChallengeRequest(station=BRNO).encoded()) < 100
