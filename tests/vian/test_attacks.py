"""What a stranger, a thief or a bad network can send to central, over real HTTP and TLS: refused, noted, not stored."""

import hashlib
import json
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from events import CorruptSegment, Header, Position, Segment, StreamName, chain, encode, events_of, station_name
from events import decode as decode_events
from store import Log, StationKey
from sync.central.access import Access
from sync.central.refusals import Refusals
from sync.central.router import Limits, router
from sync.protocol.enrolment import Enrol, new_secret
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import FOLLOWS_HEADER, ORDER_HEADER, PATH, Hello, Record, encode_records
from tests.sync.test_losses import Disk
from tests.vian.samples import GATE, PRODUCER, START, points
from vian.api import bind, create_app, serving
from vian.clock import utc_now
from vian.tls import own_certificate, station_context

BRNO, OSLO, CENTRAL = (station_name(name) for name in ("brno", "oslo", "central"))
KEY, OSLO_KEY = (StationKey(Ed25519PrivateKey.generate()) for _ in range(2))
CENTRAL_KEY = StationKey(Ed25519PrivateKey.generate())


@dataclass(frozen=True, slots=True)
class Served:
    """A central server that listens, with all that its operator sees."""

    log: Log
    access: Access
    refusals: Refusals
    address: str
    certificate: str
    clients: list[httpx.Client] = field(default_factory=list)

    def http(self) -> httpx.Client:
        """A client that checks the certificate, closed with the server."""
        self.clients.append(
            httpx.Client(base_url=self.address, verify=station_context(self.certificate), timeout=30, trust_env=False)
        )
        return self.clients[-1]

    def close(self) -> None:
        for client in self.clients:
            client.close()

    def enrol(self, name: str, key: StationKey, operations: tuple[str, ...] = ("replicate",)) -> None:
        secret = new_secret()
        self.access.registry.invite(station_name(name), secret, operations, (), utc_now() + timedelta(hours=1))
        self.access.registry.enrol(name, secret, key.public, None)

    def recorded(self) -> list[tuple[str | None, str, str, int]]:
        """Which refusals central's log records, once the minute is over."""
        self.refusals.record(is_all=True)
        return [
            (event.claimed, event.endpoint, event.code, event.count)  # type: ignore[attr-defined]
            for segment in self.log.read_all(types=["request_refused"])
            for event in events_of(decode_events(segment, self.log.catalogue))
        ]

    @property
    def stored(self) -> int:
        """Segments of stations' own streams."""
        return sum(segment.stream.source != "sync" for segment in self.log.read_all())


class Client:
    """A station on the wire, which can say what no honest one says."""

    def __init__(self, central: Served, name: str = "brno", key: StationKey = KEY) -> None:
        self._central = central
        self._name = name
        self.signer = RequestSigner(key, name, central.access.key.id, PATH)
        self.http = central.http()

    def request(self, endpoint: str, body: bytes = b"") -> httpx.Request:
        """A request as an honest station signs it."""
        return next(self.signer.auth_flow(self.http.build_request("POST", f"{PATH}/{endpoint}", content=body)))

    def hello_request(self, *protocols: int) -> httpx.Request:
        challenge = self.http.post(f"{PATH}/challenge", content=json.dumps({"station": self._name})).json()
        self.signer.answer(challenge["challenge"])
        said = Hello(protocols=protocols or (2,), program="vian/0", station=self._name, epoch=1, time=START)
        return self.request("hello", said.encoded())

    def hello(self) -> None:
        answer = self.http.send(self.hello_request())
        assert answer.status_code == 200, answer.text
        self.signer.use(answer.json()["token"])

    def send(self, endpoint: str = "segments", body: bytes | None = None) -> httpx.Response:
        return self.http.send(self.request(endpoint, one_segment() if body is None else body))


def segment_of(stream: StreamName = GATE, count: int = 3, payload: bytes | None = None) -> Segment:
    """A stream's first segment; with a payload of choice its hashes are right all the same."""
    draft = encode(GATE, points(count), PRODUCER)
    header = Header(stream, 1, 1, count, draft.schema_version, draft.time_min, draft.time_max, PRODUCER)  # type: ignore[arg-type]
    data = draft.payload if payload is None else payload
    payload_hash = hashlib.sha256(data).digest()
    return Segment(header, data, payload_hash, chain(bytes(32), header, payload_hash), Position(0), START)


def segments_in_a_row() -> tuple[Segment, Segment]:
    """A stream's first two segments."""
    first = segment_of()
    header = replace(first.header, first_sequence=first.header.last_sequence + 1)  # type: ignore[arg-type]
    data, payload_hash = first.payload, first.payload_hash
    return first, Segment(header, data, payload_hash, chain(first.chain_hash, header, payload_hash), Position(0), START)


def one_segment(stream: StreamName = GATE, **given: Any) -> bytes:
    return encode_records([Record(segment_of(stream, **given), bytes(32))])


LIMITS = Limits(body_bytes_max=2_000_000, hello_bytes_max=100_000, idle_s_max=0.3)


@pytest.fixture
def central(log: Log, tmp_path: Path) -> Iterator[Served]:
    with central_at(log, tmp_path, CENTRAL_KEY) as served:
        served.enrol("brno", KEY)
        yield served
        served.close()


@contextmanager
def central_at(log: Log, folder: Path, key: StationKey, limits: Limits = LIMITS) -> Iterator[Served]:
    certificate = own_certificate(folder)
    access = Access(log, CENTRAL, key, now=utc_now)
    refusals = Refusals(log, CENTRAL, utc_now, lambda: 0.0)
    app = create_app(log)
    app.include_router(router(log, None, limits, access=access, note=refusals.note))
    with serving(app, bind("127.0.0.1", 0), certificate) as address:
        yield Served(log, access, refusals, address, certificate.certificate.read_text())


@pytest.fixture
def brno(central: Served) -> Client:
    client = Client(central)
    client.hello()
    return client


def told(response: httpx.Response, status: int) -> str:
    """The problem's code; each problem says all four things."""
    problem = response.json()
    assert response.status_code == status, problem
    assert all(problem[part] for part in ("error", "got", "wanted", "next"))
    return str(problem["code"])


def test_an_honest_station_is_heard(central: Served, brno: Client) -> None:
    answer = brno.send()
    assert (answer.status_code, answer.json()["stored"], central.stored) == (200, 1, 1)
    assert central.recorded() == []


def test_a_replayed_request_is_refused_here_and_at_another_central(
    central: Served, brno: Client, make_log: Callable[[], Log], tmp_path: Path
) -> None:
    request = brno.request("segments", one_segment())
    assert brno.http.send(request).status_code == 200
    assert told(brno.http.send(request), 401) == "replayed"
    hello = brno.hello_request()
    assert brno.http.send(hello).status_code == 200
    assert told(brno.http.send(hello), 401) == "stale_challenge"
    (tmp_path / "other").mkdir()
    with central_at(make_log(), tmp_path / "other", OSLO_KEY) as other:
        other.enrol("brno", KEY)
        elsewhere = Client(other)
        for again in (request, hello):
            sent = elsewhere.http.build_request("POST", again.url.path, content=again.content, headers=again.headers)
            assert told(elsewhere.http.send(sent), 401) == "other_central"
        other.close()
        assert other.recorded() == [("brno", "segments", "other_central", 1), ("brno", "hello", "other_central", 1)]
    assert central.recorded() == [("brno", "segments", "replayed", 1), ("brno", "hello", "stale_challenge", 1)]
    assert central.stored == 1


def test_numbers_may_come_in_another_order(central: Served, brno: Client) -> None:
    first, second = brno.request("segments", one_segment()), brno.request("segments", one_segment())
    assert [brno.http.send(each).status_code for each in (second, first)] == [200, 200]
    assert central.stored == 1


def test_another_body_under_a_good_signature_is_refused(central: Served, brno: Client) -> None:
    request = brno.request("segments", one_segment())
    other = bytearray(one_segment())
    other[-1] ^= 1
    sent = brno.http.build_request("POST", request.url.path, content=bytes(other), headers=request.headers)
    assert told(brno.http.send(sent), 400) == "other_body"
    assert (central.stored, central.recorded()) == (0, [("brno", "segments", "other_body", 1)])


def test_forged_signatures_are_refused_before_the_body_comes(central: Served, brno: Client) -> None:
    thief = Client(central, key=OSLO_KEY)
    thief.signer.use(brno.request("segments").headers["authorization"].removeprefix("Bearer "))
    assert told(thief.send(), 401) == "wrong_key"
    request = brno.request("segments", one_segment())
    request.headers["vian-number"] = "60"
    assert told(brno.http.send(request), 401) == "bad_signature"
    unsigned = brno.http.build_request("POST", f"{PATH}/segments", content=one_segment())
    assert told(brno.http.send(unsigned), 401) == "not_signed"
    # The head alone is enough for the answer: the body, which never comes, is not waited for.
    url = httpx.URL(central.address)
    with tls_connection(central) as connection:
        connection.sendall(
            f"POST {PATH}/segments HTTP/1.1\r\nHost: {url.host}\r\nContent-Length: 1000000\r\n\r\n".encode()
        )
        assert connection.recv(65536).startswith(b"HTTP/1.1 401 ")
    assert central.stored == 0
    assert {each[:3] for each in central.recorded()} == {
        ("brno", "segments", "wrong_key"),
        ("brno", "segments", "bad_signature"),
        (None, "segments", "not_signed"),
    }


@contextmanager
def tls_connection(central: Served) -> Iterator[ssl.SSLSocket]:
    url = httpx.URL(central.address)
    with (
        socket.create_connection((url.host, url.port or 0), timeout=30) as plain,
        station_context(central.certificate).wrap_socket(plain, server_hostname=url.host) as connection,
    ):
        yield connection


def test_a_station_speaks_for_itself_alone(central: Served, brno: Client) -> None:
    central.enrol("oslo", OSLO_KEY)
    oslo = Client(central, "oslo", OSLO_KEY)
    oslo.hello()
    assert told(oslo.send(), 403) == "foreign_stream"
    brno.signer.use(oslo.request("segments").headers["authorization"].removeprefix("Bearer "))
    assert told(brno.send(), 401) == "no_session"
    own = one_segment(StreamName.of("oslo", "gate", "track_point"))
    mixed = own + one_segment()
    assert told(oslo.send(body=mixed), 403) == "foreign_stream"
    assert told(oslo.send(body=one_segment(StreamName.of("central", "sync", "track_point"))), 403) == "foreign_stream"
    assert central.stored == 0
    assert oslo.send(body=own).status_code == 200
    assert ("oslo", "segments", "foreign_stream", 3) in central.recorded()


def test_what_is_not_granted_is_not_done(central: Served) -> None:
    central.enrol("oslo", OSLO_KEY, operations=("find",))
    oslo = Client(central, "oslo", OSLO_KEY)
    oslo.hello()
    assert told(oslo.send(body=one_segment(StreamName.of("oslo", "gate", "track_point"))), 403) == "not_granted"
    assert (central.stored, central.recorded()) == (0, [("oslo", "segments", "not_granted", 1)])


def test_a_station_revoked_between_two_requests_is_out(central: Served, brno: Client) -> None:
    assert brno.send().status_code == 200
    central.access.registry.revoke("brno")
    assert told(brno.send(), 401) == "revoked"
    assert told(brno.http.send(brno.hello_request()), 401) == "revoked"
    assert central.stored == 1


def test_a_station_revoked_while_its_body_comes_stores_nothing(central: Served, brno: Client) -> None:
    with half_sent(central, brno) as (connection, rest):
        central.access.registry.revoke("brno")
        connection.sendall(rest)
        answer = connection.recv(65536)
    assert answer.startswith(b"HTTP/1.1 401 ")
    assert central.stored == 0
    assert central.recorded() == [("brno", "segments", "revoked", 1)]


@contextmanager
def half_sent(central: Served, client: Client) -> Iterator[tuple[ssl.SSLSocket, bytes]]:
    """A request that was let in, but for the last byte of its body."""
    request = client.request("segments", one_segment())
    head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
    with tls_connection(central) as connection:
        connection.sendall(f"POST {PATH}/segments HTTP/1.1\r\n{head}\r\n".encode() + request.content[:-1])
        wait_until_let_in(central)
        yield connection, request.content[-1:]


def wait_until_let_in(central: Served, number: int = 1) -> None:
    """Return when central has taken the number of a request: it was let in."""
    for _ in range(10_000):
        with central.log.connection() as watched:
            if watched.execute("select max(newest) from sync_tokens").fetchone() == (number,):
                return
    raise AssertionError(f"request {number} was not let in")


def test_a_station_does_not_fill_memory_with_requests(log: Log, tmp_path: Path) -> None:
    limits = replace(LIMITS, requests_max=1, idle_s_max=30)
    with central_at(log, tmp_path, CENTRAL_KEY, limits) as central:
        central.enrol("brno", KEY)
        brno = Client(central)
        brno.hello()
        with half_sent(central, brno) as (connection, rest):
            while (answer := brno.send()).status_code == 200:  # the number is taken just before the body is held
                pass
            assert told(answer, 429) == "too_many_requests"
            connection.sendall(rest)
            assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
        assert brno.send().status_code == 200
        central.close()


def test_a_body_of_a_gigabyte_is_refused_early_and_memory_stays(central: Served, brno: Client) -> None:
    memory = psutil.Process().memory_info().rss
    sent = 0

    def pieces(count: int) -> Iterator[bytes]:
        nonlocal sent
        for _ in range(count):
            sent += 1_000_000
            yield bytes(1_000_000)

    chunked = brno.request("segments")
    del chunked.headers["content-length"]
    for headers in (
        {**chunked.headers, "transfer-encoding": "chunked"},
        {**chunked.headers, "content-length": "1000000000"},
    ):
        sent = 0
        request = httpx.Request("POST", f"{central.address}{PATH}/segments", content=pieces(1000), headers=headers)
        try:
            answer = brno.http.send(request)
        except httpx.TransportError:
            pass  # central hung up while we still talked, and its answer was lost with it
        else:
            assert told(answer, 411 if "transfer-encoding" in headers else 413) in ("no_length", "too_large")
        assert sent < 100_000_000
    assert psutil.Process().memory_info().rss - memory < 100_000_000
    assert central.stored == 0
    assert {each[2] for each in central.recorded()} == {"no_length", "too_large"}


def test_a_longer_body_than_declared_is_not_read(central: Served, brno: Client) -> None:
    request = brno.request("segments", one_segment())
    head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
    with tls_connection(central) as connection:
        body = request.content + b"GET / HTTP/1.1\r\n\r\n"
        connection.sendall(f"POST {PATH}/segments HTTP/1.1\r\n{head}\r\n".encode() + body)
        answer = connection.recv(65536)
    assert answer.startswith(b"HTTP/1.1 200 ")
    assert central.stored == 1


def test_a_request_of_a_long_name_is_refused(central: Served, brno: Client) -> None:
    for header in (ORDER_HEADER, FOLLOWS_HEADER):
        request = brno.request("segments", one_segment())
        request.headers[header] = "a" * 65
        assert told(brno.http.send(request), 400) == "long_name"
    assert central.stored == 0


def test_the_second_request_is_stored_behind_the_first_though_it_comes_before(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sync.central.room.SMALL_BYTES", 0)
    first, second = segments_in_a_row()
    bodies = encode_records([Record(first, bytes(32))]), encode_records([Record(second, first.chain_hash)])
    with central_at(log, tmp_path, CENTRAL_KEY, replace(LIMITS, bodies_bytes_max=1)) as central:  # a body at a time
        central.enrol("brno", KEY)
        brno = Client(central)
        brno.hello()
        one, other = (brno.request("segments", body) for body in bodies)
        one.headers[ORDER_HEADER] = other.headers[FOLLOWS_HEADER] = "a-1"
        with ThreadPoolExecutor(1) as thread:
            later = thread.submit(central.http().send, other)
            wait_until_let_in(central, 2)
            assert brno.http.send(one).status_code == 200
            assert later.result().status_code == 200
        assert central.stored == 2
        central.close()


def test_a_slow_body_is_given_up(central: Served, brno: Client) -> None:
    request = brno.request("segments", one_segment())
    head = "".join(f"{name}: {value}\r\n" for name, value in request.headers.items())
    with tls_connection(central) as connection:
        connection.sendall(f"POST {PATH}/segments HTTP/1.1\r\n{head}\r\n".encode() + request.content[:5])
        assert connection.recv(65536).startswith(b"HTTP/1.1 408 ")
    assert central.recorded() == [("brno", "segments", "slow_body", 1)]


def test_huge_headers_are_refused(central: Served, brno: Client) -> None:
    request = brno.request("segments", one_segment())
    request.headers["x"] = "y" * 200_000
    try:
        answer = brno.http.send(request)
    except httpx.TransportError:
        pass
    else:
        assert answer.status_code in (400, 431)
    assert central.stored == 0


def test_payloads_that_unpack_to_gigabytes_are_refused_unopened(central: Served, brno: Client) -> None:
    bomb = zstd_frame(declared=8 * 2**30)
    assert told(brno.send(body=one_segment(payload=bomb)), 422) == "false_header"
    unknown = StreamName.of("brno", "gate", "starship_seen")
    assert told(brno.send(body=one_segment(unknown, payload=bomb)), 422) == "false_header"
    silent = zstd_frame(declared=None, blocks=4000)  # says nothing of its size, and unpacks to 500 MiB
    assert told(brno.send(body=one_segment(payload=silent)), 422) == "false_header"
    assert central.stored == 0


def test_many_payloads_that_unpack_to_much_each_are_refused_together(central: Served, brno: Client) -> None:
    honest_looking = zstd_frame(declared=60 * 2**20)
    records = b"".join(
        one_segment(StreamName.of("brno", f"cam-{number}", "track_point"), payload=honest_looking)
        for number in range(20)
    )
    assert told(brno.send(body=records), 413) == "too_much_unpacked"
    assert (central.stored, central.recorded()) == (0, [("brno", "segments", "too_much_unpacked", 1)])


def zstd_frame(declared: int | None, blocks: int = 1) -> bytes:
    """A Zstandard frame of blocks that each repeat a byte 128 KiB long; its head may declare a size (RFC 8878)."""
    # A window of 128 KiB and no size; or a single segment with its size in 8 bytes.
    head = bytes([0x00, 0x38]) if declared is None else bytes([0xE0]) + declared.to_bytes(8, "little")
    size = 128 * 1024
    repeated = b"".join(
        ((size << 3) | (1 << 1) | (number == blocks - 1)).to_bytes(3, "little") + b"\0" for number in range(blocks)
    )
    return b"\x28\xb5\x2f\xfd" + head + repeated


def test_codes_are_not_guessed(central: Served) -> None:
    client = Client(central, "oslo", OSLO_KEY)
    body = Enrol(secret=new_secret().hex(), public_key=OSLO_KEY.public.hex()).encoded()
    codes = [told(client.send("enrol", body), status) for status in [403] * 10 + [429]]
    assert codes == ["unknown_code"] * 10 + ["too_many_attempts"]
    assert central.access.registry.station("oslo") is None
    assert central.recorded() == [("oslo", "enrol", "unknown_code", 10), ("oslo", "enrol", "too_many_attempts", 1)]


def test_a_flood_of_challenges_costs_no_rows(central: Served) -> None:
    client = Client(central, "nobody", OSLO_KEY)
    for _ in range(50):
        assert client.http.post(f"{PATH}/challenge", content=b'{"station": "nobody"}').status_code == 200
    with central.log.connection() as connection:
        assert connection.execute("select count(*) from sync_tokens").fetchone() == (0,)
    assert told(client.http.post(f"{PATH}/challenge", content=b"<html>"), 400) == "bad_message"
    assert told(client.http.post(f"{PATH}/challenge", content=b" " * 5000), 413) == "too_large"


def test_a_hello_over_an_old_challenge_of_a_central_that_was_started_again_is_refused_once_answered(
    central: Served, brno: Client
) -> None:
    old = brno.hello_request()
    brno.hello()
    assert told(brno.http.send(old), 401) == "stale_challenge"


def test_a_station_from_the_future_is_told_what_is_spoken_here(central: Served, brno: Client) -> None:
    answer = brno.http.send(brno.hello_request(3, 99))
    assert told(answer, 400) == "protocol_version"
    assert answer.json()["wanted"] == "version 2"
    assert brno.http.send(brno.hello_request(2, 3)).json()["protocol"] == 2


def test_while_the_database_is_away_nothing_is_let_in(central: Served, brno: Client) -> None:
    central.log.close()
    assert told(brno.send(), 503) == "log_unavailable"
    assert central.refusals.counts() == {("segments", "log_unavailable"): 1}


def test_while_the_disk_is_nearly_full_nothing_is_stored_and_then_it_goes_on(central: Served, brno: Client) -> None:
    disk = Disk(central.log)
    disk.free_mib = 10
    answer = brno.send()
    assert told(answer, 503) == "disk_nearly_full"
    assert answer.json()["next"] == "make room on central's disk"
    assert central.stored == 0
    disk.free_mib = 1000
    assert brno.send().status_code == 200


def test_requests_of_many_threads_are_each_let_in_once(central: Served, brno: Client) -> None:
    requests = [brno.request("segments", one_segment()) for _ in range(8)]
    statuses: list[int] = []

    def send(request: httpx.Request) -> None:
        with central.http() as client:
            again = httpx.Request("POST", request.url, content=request.content, headers=request.headers)
            statuses.append(client.send(again).status_code)

    threads = [threading.Thread(target=send, args=(each,)) for each in [*requests, *requests]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [200] * 8 + [401] * 8
    assert central.stored == 1


def test_the_bombs_of_these_tests_are_what_they_say() -> None:
    from events import Catalogue

    for frame in (zstd_frame(declared=8 * 2**30), zstd_frame(declared=None, blocks=4000)):
        with pytest.raises(CorruptSegment):
            decode_events(replace(segment_of(), payload=frame), Catalogue.shipped(), as_stored=True)
