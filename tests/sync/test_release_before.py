"""The release before is understood: its recorded conversation can be had again, on either side."""

import json
import random
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress

import httpx
import pytest

from events import Draft, Segment
from store import Log
from sync import Daemon, Pace, Plan
from sync.protocol.wire_v1 import decode_records
from sync.station.client_v1 import CentralV1
from tests.sync.conftest import BRNO, NOON, TOKEN, central_app, start_http
from tests.sync.transcripts import Exchange, conversation

PLAN = Plan.of({"entries": [{"stream": "*/gate/*", "priority": "alerts"}, {"stream": "*/yard/*"}]})
EXCHANGES = conversation("v1")


def test_a_station_of_the_release_before_is_answered_as_it_was(central_log: Log) -> None:
    address, stop = start_http(central_app(central_log, enrolled=()))
    try:
        for exchange in EXCHANGES:
            answer = _exchanged(address, exchange.request)
            assert answer.status == exchange.status, exchange.name
            assert _said(answer) == _said(exchange), exchange.name
    finally:
        stop()
    sent = [s for e in EXCHANGES if "segments" in e.name and e.status == 200 for s in decode_records(e.request_body)]
    assert [s.chain_hash for s in central_log.read_all()] == [s.chain_hash for s in sent]


def test_central_of_the_release_before_hears_what_it_heard(station_log: Log, old_central: "OldCentral") -> None:
    _append(station_log, 1, 3)
    with httpx.Client(base_url=old_central.address) as client:
        daemon = _daemon(station_log, client, TOKEN)
        assert [daemon.step().did for _ in range(4)] == ["planned", "hello", "sent", "nothing"]
        _append(station_log, 3, 4)
        assert [daemon.step().did for _ in range(2)] == ["sent", "nothing"]
        _append(station_log, 4, 5)
        daemon = _daemon(station_log, client, TOKEN)
        assert [daemon.step().did for _ in range(4)] == ["planned", "hello", "sent", "nothing"]
    assert len(old_central.heard) == 5
    for heard, told in zip(old_central.heard, EXCHANGES, strict=False):
        assert _asked(heard) == _asked(told.request), told.name


@pytest.fixture
def old_central() -> Iterator["OldCentral"]:
    central = OldCentral()
    yield central
    central.close()


class OldCentral:
    """Says what central of the release before said, whatever it is told, and notes what it heard."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        self.heard: list[bytes] = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        told = iter(EXCHANGES)
        with suppress(OSError):  # the listening socket was shut: the test is over
            while True:
                with self._listening.accept()[0] as connection:
                    while request := _message(connection):
                        self.heard.append(request)
                        connection.sendall(next(told).response)

    def close(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(timeout=60)


def _append(log: Log, first: int, end: int) -> None:
    """Append what the recorded station had in its log: the segments that it sent, some of them at a time."""
    sent = [decode_records(e.request_body) for e in EXCHANGES if "segments" in e.name and e.status == 200]
    batches = {1: sent[0][:2], 2: sent[0][2:], 3: sent[1], 4: sent[2]}
    for number in range(first, end):
        log.append([_draft(segment) for segment in batches[number]])


def _draft(segment: Segment) -> Draft:
    header = segment.header
    times = header.time_min, header.time_max
    return Draft(
        header.stream,
        header.event_count,
        header.schema_version,
        *times,
        header.producer,
        segment.payload,
        segment.payload_hash,
    )


def _daemon(log: Log, client: httpx.Client, token: str) -> Daemon:
    return Daemon(
        log,
        BRNO,
        PLAN,
        CentralV1(client, token),
        now=lambda: NOON,
        random=random.Random(1).random,
        pace=Pace(backoff_s=0.001, backoff_s_max=0.01),
    )


def _exchanged(address: str, request: bytes) -> Exchange:
    url = httpx.URL(address)
    with socket.create_connection((url.host, url.port or 80)) as connection:
        connection.sendall(request)
        return Exchange("now", request, _message(connection))


def _message(connection: socket.socket) -> bytes:
    """One HTTP message; nothing if the other side is gone."""
    data = b""
    while b"\r\n\r\n" not in data:
        more = connection.recv(65536)
        if not more:
            return b""
        data += more
    head, _, body = data.partition(b"\r\n\r\n")
    length = next(int(line[15:]) for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:"))
    while len(body) < length:
        body += connection.recv(65536)
    return head + b"\r\n\r\n" + body


def _said(exchange: Exchange) -> dict[str, object]:
    """What an answer says, but for the program's version and the largest body, which may grow."""
    said = json.loads(exchange.response_body)
    for key in ("program", "body_bytes_max"):
        said.pop(key, None)
    return dict(said)


def _asked(request: bytes) -> object:
    """What a request says, but for what differs between two stations of the same history."""
    head, _, body = request.partition(b"\r\n\r\n")
    lines = [line for line in head.split(b"\r\n") if line.lower().startswith((b"post ", b"auth", b"content-type:"))]
    if body.startswith(b"{"):
        said = json.loads(body)
        said.pop("program")
        return lines, said
    records = decode_records(body)  # recorded_at is the log's own
    return lines, [(s.header, s.payload, s.payload_hash, s.chain_hash) for s in records]
