"""Connections that take turns, so that none of them grows cold while the others work.

Contract: a request goes over the connection that rested longest. A connection that is not used for some seconds is
closed, and a new one costs three ways there and back over a link on which a backlog queues: an alert that finds the
connections of the backlog busy would wait for these, where one that is kept in use is ready.
"""

import ssl
import threading
from collections import deque
from collections.abc import Callable, Iterator

import httpx

CONNECTIONS = 3
"""Two that carry a backlog, and one that is free for what is live."""
REST_S = 15.0
"""How long an unused connection is kept, in seconds: less than central keeps it, and than routers forget it."""


def take_turns(client: httpx.Client, verify: ssl.SSLContext, count: int = CONNECTIONS) -> None:
    """Let the client's direct connections take turns; those through a proxy stay as they are.

    Args:
        client: Has not been used yet.
        verify: What its servers' certificates are checked with.
        count: How many there are.
    """
    client._transport.close()
    # httpx asks the environment for proxies only where it makes the direct transport itself.
    client._transport = Rotation(
        lambda: httpx.HTTPTransport(verify=verify, limits=httpx.Limits(keepalive_expiry=REST_S)), count
    )


class Rotation(httpx.BaseTransport):
    """HTTP over several transports of one connection each.

    Args:
        make: Makes one of them.
        count: How many; a request waits while all are busy.
    """

    def __init__(self, make: Callable[[], httpx.BaseTransport], count: int = CONNECTIONS) -> None:
        self.transports = tuple(make() for _ in range(count))
        self._resting = deque(self.transports)
        self._is_free = threading.Condition()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """The answer; its connection rests when it is closed."""
        with self._is_free:
            self._is_free.wait_for(lambda: self._resting)
            transport = self._resting.popleft()
        try:
            response = transport.handle_request(request)
        except BaseException:
            self._rest(transport)
            raise
        assert isinstance(response.stream, httpx.SyncByteStream)
        response.stream = _Answer(response.stream, lambda: self._rest(transport))
        return response

    def close(self) -> None:
        """Close the connections."""
        for transport in self.transports:
            transport.close()

    def _rest(self, transport: httpx.BaseTransport) -> None:
        with self._is_free:
            self._resting.append(transport)
            self._is_free.notify()


class _Answer(httpx.SyncByteStream):
    """An answer's body that says once when it is closed."""

    def __init__(self, inner: httpx.SyncByteStream, closed: Callable[[], None]) -> None:
        self._inner = inner
        self._closed: Callable[[], None] | None = closed

    def __iter__(self) -> Iterator[bytes]:
        """Its bytes, piece by piece."""
        yield from self._inner

    def close(self) -> None:
        """Close it."""
        try:
            self._inner.close()
        finally:
            closed, self._closed = self._closed, None
            if closed is not None:
                closed()
