"""A bad link: a TCP proxy on loopback that cuts, delays, doubles, truncates and garbles what passes, or falls silent.

It runs in a thread of its own. Of plain HTTP it sees each exchange and does one thing to it; of what
it cannot see into (TLS) it does the same to the bytes, at a random place. `weather` says how often
and what, and may be changed at any time; `counts` says what was done.
"""

import asyncio
import random
import socket
import struct
import threading
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, replace
from typing import Any, Self

CUT = "cut"
TRUNCATED = "truncated"
DELAYED = "delayed"
GARBLED = "garbled"
SILENT = "silent"
DOUBLED = "doubled"
REPLAYED = "replayed"
PAGE = "page"

OF_BYTES = (CUT, TRUNCATED, DELAYED, GARBLED, SILENT)
"""What happens to any stream of bytes."""
OF_EXCHANGES = (*OF_BYTES, DOUBLED, REPLAYED, PAGE)
"""What happens to exchanges of plain HTTP."""
CUTS = (CUT, TRUNCATED)
"""Ends of a connection in the middle of what it carried."""

_CHUNK = 65536
_KEPT = 20
"""Old requests that may come again."""
_PAGES = (
    (200, "<html>Please accept the terms of this network</html>"),
    (302, "<html>Moved</html>"),
    (407, "<html>Proxy authentication required</html>"),
    (502, "<html>Bad gateway</html>"),
    (503, "<html>Service unavailable</html>"),
)
_DEAD = struct.pack("ii", 1, 0)
"""SO_LINGER that ends a connection by a reset, as a link that is gone does."""


@dataclass(frozen=True, slots=True)
class Weather:
    """What the link does, and how often."""

    share: float = 0.0
    """Exchanges to which something happens; of bytes that it cannot see into, pieces of them."""
    kinds: tuple[str, ...] = OF_EXCHANGES
    delay_s: float = 0.02
    """Longest delay."""
    silent_s: float = 0.5
    """How long a connection stays open, with nothing more on it."""
    is_down: bool = False
    """Whether each connection is reset at once."""


CALM = Weather()


class Proxy:
    """Stands between a station and central's port on loopback.

    Args:
        port: Central's.
        seed: Of what happens when; the same seed and the same exchanges give the same faults.
        is_opaque: Whether the bytes cannot be seen into, as with TLS.
        weather: What happens from the beginning.
    """

    def __init__(self, port: int, seed: int = 0, *, is_opaque: bool = False, weather: Weather = CALM) -> None:
        self.weather = weather
        self.counts: Counter[str] = Counter()
        self._to = port
        self._choose = random.Random(seed)
        self._handle = self._pass_bytes if is_opaque else self._pass_exchanges
        self._kept: list[bytes] = []
        self._open: set[asyncio.Task[None]] = set()
        self._changed = threading.Condition()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._server = self._call(asyncio.start_server(self._accept, "127.0.0.1", 0))
        self.port: int = self._server.sockets[0].getsockname()[1]

    def set(self, **changes: Any) -> None:
        """Change the weather in these respects."""
        self.weather = replace(self.weather, **changes)

    def cut_all(self) -> None:
        """Reset every connection that is open."""
        self._call(self._cut_all())

    def wait_for(self, is_so: Callable[[Counter[str]], bool], seconds: float = 60.0) -> None:
        """Return when the counts are so."""
        with self._changed:
            assert self._changed.wait_for(lambda: is_so(self.counts), seconds), f"never came to pass: {self.counts}"

    def close(self) -> None:
        """End it, and every connection through it."""
        self._call(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _call(self, action: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(action, self._loop).result(60)

    async def _close(self) -> None:
        self._server.close()
        await self._cut_all()

    async def _cut_all(self) -> None:
        tasks = list(self._open)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _count(self, kind: str) -> None:
        with self._changed:
            self.counts[kind] += 1
            self._changed.notify_all()

    def _fault(self) -> str | None:
        """What happens next; nothing, mostly."""
        return self._choose.choice(self.weather.kinds) if self._choose.random() < self.weather.share else None

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        near = _Side(reader, writer)
        task = asyncio.current_task()
        assert task is not None
        self._open.add(task)
        try:
            if self.weather.is_down:
                near.reset()
                return
            await self._handle(near)
        except (OSError, EOFError, asyncio.CancelledError):
            near.reset()
        finally:
            self._open.discard(task)
            near.end()

    # Plain HTTP.

    async def _pass_exchanges(self, near: "_Side") -> None:
        far: _Side | None = None
        try:
            while request := await near.message():
                fault = self._fault()
                if fault is not None:
                    self._count(fault)
                if far is None or far.is_over():
                    far = await self._far()
                await self._exchange(near, far, request, fault)
                self._kept = [*self._kept[-_KEPT + 1 :], request]
        finally:
            if far is not None:
                far.end()

    async def _exchange(self, near: "_Side", far: "_Side", request: bytes, fault: str | None) -> None:
        """One request and its answer, with one fault in either.

        Raises:
            OSError: The connection is at its end.
        """
        if fault == PAGE:
            return await near.send(_page(*self._choose.choice(_PAGES)))
        if fault == DOUBLED:
            await self._aside(request)
        elif fault == REPLAYED and self._kept:
            await self._aside(self._choose.choice(self._kept))
        is_there = self._choose.random() < 0.5
        await self._send(far, request, fault if is_there else None)
        answer = await far.message()
        if not answer:
            raise ConnectionResetError("central went away")
        return await self._send(near, answer, None if is_there else fault)

    async def _send(self, to: "_Side", data: bytes, fault: str | None) -> None:
        at = self._choose.randrange(len(data))
        if fault == GARBLED:
            data = data[:at] + bytes([data[at] ^ 1 << self._choose.randrange(8)]) + data[at + 1 :]
        if fault in (CUT, TRUNCATED, DELAYED, SILENT):
            await to.send(data[:at])
            await self._interrupt(to, fault)
            data = data[at:]
        await to.send(data)

    async def _interrupt(self, to: "_Side", fault: str) -> None:
        """Wait, or end the connection.

        Raises:
            OSError: It ended.
        """
        if fault == DELAYED:
            await asyncio.sleep(self._choose.uniform(0, self.weather.delay_s))
            return
        if fault == SILENT:
            await asyncio.sleep(self.weather.silent_s)
        if fault == CUT:
            to.reset()
        to.end()
        raise ConnectionResetError(fault)

    async def _aside(self, request: bytes) -> None:
        """Let central have a request on a connection of its own, and the answer go nowhere."""
        aside = await self._far()
        try:
            await aside.send(request)
            await aside.message()
        finally:
            aside.end()

    async def _far(self) -> "_Side":
        return _Side(*await asyncio.open_connection("127.0.0.1", self._to))

    # Bytes that it cannot see into.

    async def _pass_bytes(self, near: "_Side") -> None:
        far = await self._far()
        ways = [asyncio.ensure_future(self._pass(*way)) for way in ((near, far), (far, near))]
        try:
            done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in done:
                way.result()
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            far.end()

    async def _pass(self, from_: "_Side", to: "_Side") -> None:
        while data := await from_.reader.read(_CHUNK):
            fault = self._fault()
            if fault is not None:
                self._count(fault)
            await self._send(to, data, fault)


class _Side:
    """One of the proxy's two connections."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self._writer = reader, writer
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def is_over(self) -> bool:
        return self.reader.at_eof() or self._writer.is_closing()

    async def send(self, data: bytes) -> None:
        self._writer.write(data)
        await self._writer.drain()

    async def message(self) -> bytes:
        """A whole request or answer, as its Content-Length says; nothing if the other side is done.

        Raises:
            EOFError: The other side broke off in the middle.
        """
        try:
            head = await self.reader.readuntil(b"\r\n\r\n")
        except asyncio.IncompleteReadError as error:
            if error.partial:
                raise
            return b""
        lines = head.lower().split(b"\r\n")
        lengths = [int(line.split(b":")[1]) for line in lines if line.startswith(b"content-length:")]
        return head + (await self.reader.readexactly(lengths[0]) if lengths else b"")

    def reset(self) -> None:
        """End it without a word: what is under way is lost."""
        if not self._writer.is_closing():
            self._writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DEAD)
        self._writer.transport.abort()

    def end(self) -> None:
        self._writer.close()


def _page(status: int, text: str) -> bytes:
    head = f"HTTP/1.1 {status} From a proxy\r\nContent-Type: text/html\r\nContent-Length: {len(text)}\r\n\r\n"
    return (head + text).encode()
