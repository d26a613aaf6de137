"""A station and central over real HTTP on loopback.

One uvicorn serves the session; each test's application hangs under a path of its own, as behind a
proxy. Each log is a database of its own.
"""

import random
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from typing import Any

import httpx
import pytest
import uvicorn
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fastapi import FastAPI

from events import Producer, Segment, Station, StreamName, TrackPoint, batch_of, encode, station_name
from store import Log, StationKey
from sync import Daemon, Grants, Limits, Pace, Plan, router, token_hash
from sync.central.access import Access
from sync.protocol.enrolment import new_secret
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import PATH
from sync.station.client import Central
from sync.station.client_v1 import CentralV1

BRNO = station_name("brno-2")
TOKEN = "a-token-of-brno-2-that-nobody-guesses"
OTHER_TOKEN = "a-token-of-oslo-1-that-nobody-guesses"
GRANTS = Grants({"brno-2": token_hash(TOKEN), "oslo-1": token_hash(OTHER_TOKEN)})
EVERYTHING = Plan.of({"entries": [{"stream": "*/*/*"}]})
NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)
PRODUCER = Producer("test", "1", bytes(32))

Serve = Callable[[Any], str]
MakeDaemon = Callable[..., Daemon]


def stream_of(source: str = "gate", station: str = "brno-2") -> StreamName:
    return StreamName.of(station, source, "track_point")


def append_points(log: Log, stream: StreamName, counts: list[int]) -> None:
    """Append a segment for each count, with so many points."""
    head = log.stream_head(stream).sequence
    for events in counts:
        log.append([encode(stream, batch_of(points(head, events)), PRODUCER)], [head])
        head += events


def points(first: int, events: int) -> list[TrackPoint]:
    box = {"x1": 1.0, "y1": 2.0, "x2": 3.0, "y2": 4.0, "vx": 0.5, "vy": 0.0, "confidence": 1.0}
    return [
        TrackPoint(time=NOON + timedelta(milliseconds=n), track_id=1 + n % 7, frame=n, x=float(n % 640), y=1.0, **box)
        for n in range(first, first + events)
    ]


def stored(log: Log, station: Station = BRNO) -> dict[str, list[tuple[Any, ...]]]:
    """All that a log holds of a station, in the order of streams, byte by byte, but for what is the log's own."""
    held: dict[str, list[tuple[Any, ...]]] = {}
    segments = log.read_all(stations=[station])
    for segment in sorted(segments, key=lambda each: (each.header.epoch, each.header.first_sequence)):
        held.setdefault(str(segment.stream), []).append(content(segment))
    return held


def content(segment: Segment) -> tuple[Any, ...]:
    return segment.header, segment.payload, segment.payload_hash, segment.chain_hash


def heads(log: Log, station: Station = BRNO) -> list[tuple[Any, ...]]:
    return [(h.stream, h.epoch, h.sequence, h.chain_hash) for h in log.streams() if h.stream.station == station]


class Faults(httpx.BaseTransport):
    """Real HTTP, with a fault of choice in each exchange; `next` names it, and is used up."""

    KINDS = (
        "cut before sending",
        "cut before the answer",
        "timeout after sending",
        "truncated request",
        "flipped byte",
        "flipped answer",
        "sent twice",
        "replayed",
        "status 500",
        "status 503",
        "page of a proxy",
        "truncated answer",
    )

    def __init__(self) -> None:
        self._http = httpx.HTTPTransport()
        self._sent: list[tuple[httpx.Request, bytes]] = []
        self.next: str | None = None
        self.where = 0.5
        self.exchanges: list[str] = []
        self.bodies: list[bytes] = []
        self.injected = 0

    def close(self) -> None:
        self._http.close()

    def deliver_again(self, where: float) -> None:
        """Let central have an old request once more, and the answer go nowhere."""
        if self._sent:
            self._exchange(*self._sent[int(where * (len(self._sent) - 1))])

    def forget(self) -> None:
        """Have no old requests."""
        self._sent.clear()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        fault, self.next = self.next, None
        self.injected += fault is not None
        body = request.read()
        self.exchanges.append(request.url.path.rsplit("/", 1)[-1])
        self.bodies.append(body)
        at = int(self.where * (len(body) - 1))
        if fault == "cut before sending":
            raise httpx.ConnectError("connection refused", request=request)
        if fault == "status 500":
            return httpx.Response(500, text="Internal Server Error")
        if fault == "status 503":
            return httpx.Response(503, html="<h1>Service Unavailable</h1>")
        if fault == "page of a proxy":
            return httpx.Response(200, html="<html>Please accept the terms of this network</html>")
        if fault == "truncated request":
            return self._exchange(request, body[:at])
        if fault == "flipped byte":
            return self._exchange(request, body[:at] + bytes([body[at] ^ 0x10]) + body[at + 1 :])
        if fault == "sent twice":
            self._exchange(request, body)
        if fault == "replayed":
            self.deliver_again(self.where)
        answer = self._exchange(request, body)
        self._sent.append((request, body))
        if fault == "cut before the answer":
            raise httpx.RemoteProtocolError("server disconnected without sending a response", request=request)
        if fault == "timeout after sending":
            raise httpx.ReadTimeout("timed out", request=request)
        if fault == "truncated answer":
            return httpx.Response(answer.status_code, content=answer.content[: int(self.where * len(answer.content))])
        if fault == "flipped answer":
            at = int(self.where * (len(answer.content) - 1))
            bit = 1 << self.injected % 7  # another one each time: the same damage twice is no accident
            damaged = answer.content[:at] + bytes([answer.content[at] ^ bit]) + answer.content[at + 1 :]
            return httpx.Response(answer.status_code, content=damaged)
        return answer

    def _exchange(self, request: httpx.Request, body: bytes) -> httpx.Response:
        headers = {k: v for k, v in request.headers.items() if k.lower() not in ("content-length", "transfer-encoding")}
        sent = httpx.Request("POST", request.url, headers=headers, content=body)
        response = self._http.handle_request(sent)
        content = response.read()
        response.close()
        return httpx.Response(response.status_code, headers=response.headers, content=content)


class Switchboard:
    """Hands each request to the application under the first part of its path."""

    def __init__(self) -> None:
        self.apps: dict[str, Any] = {}

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        _, name, *rest = scope["path"].split("/")
        path = "/" + "/".join(rest)
        await self.apps[name]({**scope, "path": path, "raw_path": path.encode()}, receive, send)


def start_http(app: Any, port: int = 0) -> tuple[str, Callable[[], None]]:
    """Serve the application from a thread; its address, and what stops it."""
    listening = socket.create_server(("127.0.0.1", port))
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # without it each answer waits 40 ms
    config = uvicorn.Config(app, log_config=None, lifespan="off", ws="none", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()

    def stop() -> None:
        server.should_exit = True
        thread.join()
        listening.close()

    return f"http://127.0.0.1:{listening.getsockname()[1]}", stop


@pytest.fixture(scope="session")
def switchboard() -> Iterator[tuple[str, Switchboard]]:
    board = Switchboard()
    address, stop = start_http(board)
    yield address, board
    stop()


@pytest.fixture
def serve(switchboard: tuple[str, Switchboard]) -> Serve:
    """Serves an application; returns its address."""
    address, board = switchboard

    def start(app: Any) -> str:
        name = f"t{len(board.apps)}"
        board.apps[name] = app
        return f"{address}/{name}"

    return start


def key_of(name: str) -> StationKey:
    """A station's key, the same in each process of a test."""
    return StationKey(Ed25519PrivateKey.from_private_bytes(sha256(name.encode()).digest()))


CENTRAL = station_name("central")
CENTRAL_KEY = key_of("central")


def central_app(
    log: Log, grants: Grants = GRANTS, limits: Limits | None = None, enrolled: Iterable[Station] = (BRNO,)
) -> FastAPI:
    """A central server that knows the stations of the grants in protocol 1, and those enrolled in protocol 2."""
    access = Access(log, CENTRAL, CENTRAL_KEY, now=real_now)
    for station in enrolled:
        if access.registry.station(station) is None:
            enrol(access, station)
    app = FastAPI()
    app.include_router(router(log, grants, limits, now=central_now, access=access))
    return app


def central_now() -> datetime:
    """Central's clock, which is ahead of the station's."""
    return NOON + timedelta(seconds=3)


def real_now() -> datetime:
    """The time, by which challenges and tokens end."""
    return datetime.now(UTC)


def enrol(access: Access, station: Station) -> None:
    """Take a station in, by its key."""
    secret = new_secret()
    access.registry.invite(station, secret, ("replicate",), (), real_now() + timedelta(hours=1))
    access.registry.enrol(station, secret, key_of(station).public, "192.0.2.7")


def signed_link(client: httpx.Client, station: Station = BRNO) -> Central:
    """Central as that station sees it in protocol 2."""
    return Central(client, RequestSigner(key_of(station), station, CENTRAL_KEY.id, PATH))


@pytest.fixture
def station_log(make_log: Callable[[], Log]) -> Log:
    return make_log()


@pytest.fixture
def central_log(make_log: Callable[[], Log]) -> Log:
    return make_log()


@pytest.fixture
def central(central_log: Log, serve: Serve) -> str:
    """Address of a central server over `central_log`."""
    return serve(central_app(central_log))


@pytest.fixture
def faults() -> Iterator[Faults]:
    transport = Faults()
    yield transport
    transport.close()


@pytest.fixture
def make_daemon(station_log: Log, faults: Faults, request: pytest.FixtureRequest) -> Iterator[MakeDaemon]:
    """Makes a daemon of station brno-2; `faults` lies between it and `central`, or what is at `address`."""
    clients: list[httpx.Client] = []

    def make(
        *,
        log: Log = station_log,
        plan: Plan = EVERYTHING,
        address: str | None = None,
        station: Station = BRNO,
        token: str = TOKEN,
        pace: Pace | None = None,
        protocol: int = 2,
        seed: int = 1,
        now: Callable[[], datetime] = lambda: NOON,
        **more: Any,
    ) -> Daemon:
        base_url = address or request.getfixturevalue("central")
        clients.append(httpx.Client(base_url=base_url, transport=faults))
        return Daemon(
            log,
            station,
            plan,
            CentralV1(clients[-1], token) if protocol == 1 else signed_link(clients[-1], station),
            now=now,
            random=random.Random(seed).random,
            pace=pace or Pace(backoff_s=0.001, backoff_s_max=0.01),
            **more,
        )

    yield make
    for client in clients:
        client.close()


@pytest.fixture
def daemon(make_daemon: MakeDaemon) -> Daemon:
    return make_daemon()
