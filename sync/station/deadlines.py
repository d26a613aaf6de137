"""Deadlines: a request is over after so many seconds, however slowly its bytes come.

Contract: an HTTP client's timeout is for one read or one write; a peer that sends a byte now and then, or takes
one, never meets it. On a client that is `bounded`, no read or write within `deadline` waits beyond it. `abort` ends
what is under way in other threads at once.
"""

import socket
import ssl
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic
from typing import Any
from weakref import WeakSet

import httpcore
import httpx

from sync.station.rotation import Rotation


class _Limit(threading.local):
    """Until when the thread's own request may last."""

    at: float | None = None


_limit = _Limit()


@contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Let no read and no write of this thread's requests last beyond so many seconds from now."""
    before, _limit.at = _limit.at, monotonic() + seconds
    try:
        yield
    finally:
        _limit.at = before


class Bounds:
    """What a client's connections are bounded by; made by `bounded`."""

    def __init__(self) -> None:
        self._streams: WeakSet[_Stream] = WeakSet()

    def abort(self) -> None:
        """End what is under way on the client, whichever thread waits for it: it fails as on a lost connection."""
        for stream in list(self._streams):
            stream.shut()

    def add(self, stream: "_Stream") -> "_Stream":
        """The stream, which `abort` ends from now on."""
        self._streams.add(stream)
        return stream


def bounded(client: httpx.Client) -> Bounds:
    """Bound the client's connections, proxies' included, and say by what."""
    bounds = Bounds()
    direct = client._transport
    transports = direct.transports if isinstance(direct, Rotation) else (direct,)
    for transport in (*transports, *client._mounts.values()):
        pool = getattr(transport, "_pool", None)
        if isinstance(pool, httpcore.ConnectionPool):
            # httpx has no way to give a network backend, httpcore has; both keep it under this name.
            pool._network_backend = _Backend(pool._network_backend, bounds)
    return bounds


class _Backend(httpcore.NetworkBackend):
    def __init__(self, inner: httpcore.NetworkBackend, bounds: Bounds) -> None:
        self._inner = inner
        self._bounds = bounds

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        left = _left(timeout, httpcore.ConnectTimeout)
        stream = self._inner.connect_tcp(host, port, left, local_address, socket_options)
        return self._bounds.add(_Stream(stream, self._bounds))

    def connect_unix_socket(
        self, path: str, timeout: float | None = None, socket_options: Iterable[Any] | None = None
    ) -> httpcore.NetworkStream:
        left = _left(timeout, httpcore.ConnectTimeout)
        stream = self._inner.connect_unix_socket(path, left, socket_options)
        return self._bounds.add(_Stream(stream, self._bounds))

    def sleep(self, seconds: float) -> None:
        self._inner.sleep(seconds)


class _Stream(httpcore.NetworkStream):
    def __init__(self, inner: httpcore.NetworkStream, bounds: Bounds) -> None:
        self._inner = inner
        self._bounds = bounds

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._inner.read(max_bytes, _left(timeout, httpcore.ReadTimeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        # In pieces, since each piece that the socket takes would begin the time anew.
        for at in range(0, len(buffer), _PIECE_BYTES) or (0,):
            self._inner.write(buffer[at : at + _PIECE_BYTES], _left(timeout, httpcore.WriteTimeout))

    def close(self) -> None:
        self._inner.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        left = _left(timeout, httpcore.ConnectTimeout)
        stream = self._inner.start_tls(ssl_context, server_hostname, left)
        return self._bounds.add(_Stream(stream, self._bounds))

    def get_extra_info(self, info: str) -> Any:
        return self._inner.get_extra_info(info)

    def shut(self) -> None:
        """End it, also under a read in another thread."""
        with suppress(OSError):
            self.get_extra_info("socket").shutdown(socket.SHUT_RDWR)


_PIECE_BYTES = 64 * 1024


def _left(timeout: float | None, error: type[Exception]) -> float | None:
    """Seconds that the next operation may take."""
    if _limit.at is None:
        return timeout
    left = _limit.at - monotonic()
    if left <= 0:
        raise error("the request took too long")
    return left if timeout is None else min(timeout, left)
