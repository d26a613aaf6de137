import hashlib
import json
import queue
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from typing import Any

import httpx
import pytest

from events import Header, Position, Segment, chain, encode, header_bytes
from events import batch_of as batch
from store import Log
from sync import Limits, Refusal
from sync.central.apply_v1 import apply
from sync.protocol.wire_v1 import Hello, SegmentsAnswer, StreamState, encode_record, encode_records
from tests.sync.conftest import (
    BRNO,
    NOON,
    OTHER_TOKEN,
    PRODUCER,
    TOKEN,
    Serve,
    append_points,
    central_app,
    points,
    stored,
    stream_of,
)


@pytest.fixture
def central(central_log: Log, serve: Serve) -> str:
    """Address of a central server over `central_log`, which knows no station but by its token."""
    return serve(central_app(central_log, enrolled=()))


@pytest.fixture
def post(central: str) -> Iterator[Callable[..., httpx.Response]]:
    """Posts a body to central, as station brno-2 unless told otherwise."""
    with httpx.Client(base_url=central) as client:

        def send(endpoint: str, body: bytes | Iterator[bytes], token: str | None = TOKEN) -> httpx.Response:
            headers = [] if token is None else [(b"authorization", f"Bearer {token}".encode("latin-1"))]
            return client.post(f"/sync/v1/{endpoint}", content=body, headers=headers)

        yield send


def segments_of(source: str = "gate", counts: tuple[int, ...] = (3, 2), station: str = "brno-2") -> list[Segment]:
    """A stream's first segments, as a station's log would hold them."""
    made: list[Segment] = []
    first, chain_hash = 1, bytes(32)
    for events in counts:
        draft = encode(stream_of(source, station), batch(points(first, events)), PRODUCER)
        header = Header(
            draft.stream,
            1,
            first,
            events,
            draft.schema_version,
            draft.time_min,
            draft.time_max,
            PRODUCER,  # type: ignore[arg-type]
        )
        chain_hash = chain(chain_hash, header, draft.payload_hash)
        made.append(Segment(header, draft.payload, draft.payload_hash, chain_hash, Position(0), NOON))
        first += events
    return made


def hello(station: str = "brno-2", *, source_station: str = "brno-2", **changed: object) -> bytes:
    state = StreamState(stream=f"{source_station}/gate/track_point", epoch=1, sequence=9, chain_hash="0" * 64)
    one = Hello(protocol=1, program="vian/0", station=station, epoch=1, time=NOON, streams=(state,))
    return json.dumps(json.loads(one.encoded()) | changed).encode()


def problem(response: httpx.Response, status: int) -> dict[str, str]:
    """The problem of an answer; each one says all four things."""
    assert response.status_code == status
    told: dict[str, str] = response.json()
    assert all(told[part] for part in ("code", "error", "got", "wanted", "next"))
    return told


def test_hello_tells_the_cursor_of_each_stream(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    assert post("hello", hello()).json()["cursors"] == [
        {"stream": "brno-2/gate/track_point", "epoch": 1, "sequence": 0, "chain_hash": "0" * 64}
    ]

    append_points(central_log, stream_of(), [4])
    answer = post("hello", hello()).json()

    chain_hash = central_log.stream_head(stream_of()).chain_hash.hex()
    assert answer["cursors"] == [
        {"stream": "brno-2/gate/track_point", "epoch": 1, "sequence": 4, "chain_hash": chain_hash}
    ]
    assert (answer["protocol"], answer["station"], answer["time"]) == (1, "brno-2", "2026-05-01T12:00:03Z")


def test_segments_are_stored_as_they_came_and_only_once(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    sent = segments_of()

    first, again = post("segments", encode_records(sent)), post("segments", encode_records(sent))

    cursor = {
        "stream": "brno-2/gate/track_point",
        "epoch": 1,
        "sequence": 5,
        "chain_hash": sent[-1].chain_hash.hex(),
    }
    assert first.json() == {"cursors": [cursor], "stored": 2, "duplicates": 0}
    assert again.json() == {"cursors": [cursor], "stored": 0, "duplicates": 2}
    assert stored(central_log) == {
        "brno-2/gate/track_point": [(s.header, s.payload, s.payload_hash, s.chain_hash) for s in sent]
    }


def test_a_body_that_begins_with_known_segments_is_taken_on(
    central_log: Log, post: Callable[..., httpx.Response]
) -> None:
    one, two = segments_of()
    post("segments", encode_record(one))

    answer = post("segments", encode_records([one, two]))

    assert (answer.json()["stored"], answer.json()["duplicates"]) == (1, 1)
    assert central_log.stream_head(stream_of()).sequence == 5


def test_an_old_duplicate_is_answered_with_the_newest_cursor(
    central_log: Log, post: Callable[..., httpx.Response]
) -> None:
    one, two = segments_of()
    post("segments", encode_records([one, two]))

    assert post("segments", encode_record(one)).json()["cursors"][0]["sequence"] == 5


def test_epochs_are_streams_of_their_own(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    (one,) = segments_of(counts=(3,))
    header = replace(one.header, epoch=2)
    later = replace(one, header=header, chain_hash=chain(bytes(32), header, one.payload_hash))

    assert post("segments", encode_records([one, later])).status_code == 200
    assert [(h.epoch, h.sequence) for h in central_log.streams()] == [(1, 3), (2, 3)]


def test_without_a_granted_token_nothing_is_read(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    for token in (None, "wrong", TOKEN + "x", TOKEN[:-1], TOKEN.upper(), "t\u00f6ken", "Bearer " + TOKEN):
        for endpoint in ("hello", "segments"):
            response = post(endpoint, encode_records(segments_of()), token)
            told = problem(response, 401)
            assert (told["code"], response.headers["www-authenticate"]) == ("wrong_token", "Bearer")
            assert "vian station add" in told["next"]
    assert central_log.head() == 0


def test_a_token_of_another_kind_is_refused(central: str) -> None:
    response = httpx.post(f"{central}/sync/v1/hello", content=hello(), auth=("brno-2", TOKEN))

    assert problem(response, 401)["got"] == "no bearer token"


def test_a_station_cannot_be_another(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    assert problem(post("hello", hello("oslo-1")), 403)["code"] == "foreign_station"
    assert problem(post("hello", hello(source_station="oslo-1")), 403)["code"] == "foreign_stream"

    told = problem(post("segments", encode_records(segments_of(station="oslo-1"))), 403)

    assert (told["code"], told["got"]) == ("foreign_stream", "stream oslo-1/gate/track_point")
    mixed = [*segments_of(), *segments_of(station="oslo-1")]
    assert problem(post("segments", encode_records(mixed)), 403)["code"] == "foreign_stream"
    assert central_log.head() == 0
    assert post("segments", encode_records(segments_of(station="oslo-1")), OTHER_TOKEN).status_code == 200


def test_a_gap_is_refused_with_the_cursor(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    one, two, three = segments_of(counts=(3, 2, 4))
    post("segments", encode_record(one))

    told = problem(post("segments", encode_record(three)), 409)

    assert (told["code"], told["got"], told["wanted"]) == ("gap", "sequence 6", "sequence 4")
    assert told["cursors"] == [
        {"stream": "brno-2/gate/track_point", "epoch": 1, "sequence": 3, "chain_hash": one.chain_hash.hex()}
    ]
    assert (told["stream"], told["epoch"], told["first_sequence"]) == ("brno-2/gate/track_point", 1, 6)
    assert problem(post("segments", encode_records([three, two])), 409)["code"] == "gap"
    assert central_log.stream_head(stream_of()).sequence == 3


def test_other_bytes_in_a_place_are_refused_with_both_hashes(
    central_log: Log, post: Callable[..., httpx.Response]
) -> None:
    (one,) = segments_of(counts=(3,))
    post("segments", encode_record(one))
    other = encode(stream_of(), batch(points(77, 3)), PRODUCER)
    header = replace(one.header, time_min=other.time_min, time_max=other.time_max)
    chain_hash = chain(bytes(32), header, other.payload_hash)
    sent = Segment(header, other.payload, other.payload_hash, chain_hash, Position(0), NOON)

    told = problem(post("segments", encode_record(sent)), 409)

    assert told["code"] == "other_bytes"
    assert other.payload_hash.hex() in told["got"]
    assert one.payload_hash.hex() in told["wanted"]
    assert told["cursors"][0]["chain_hash"] == one.chain_hash.hex()  # type: ignore[index]
    assert len(stored(central_log)["brno-2/gate/track_point"]) == 1


def test_a_segment_of_another_history_is_refused(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    one, two = segments_of()
    post("segments", encode_record(one))
    forged = replace(two, chain_hash=chain(bytes(32), two.header, two.payload_hash))

    told = problem(post("segments", encode_record(forged)), 409)

    assert (told["code"], told["first_sequence"]) == ("other_history", 4)
    assert central_log.stream_head(stream_of()).sequence == 3


def test_one_bad_segment_refuses_its_whole_body(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    one, two = segments_of()

    told = problem(post("segments", encode_records([one, replace(two, payload=b"other bytes")])), 422)

    assert told["code"] == "bad_payload"
    assert hashlib.sha256(b"other bytes").hexdigest() in told["got"]
    assert central_log.head() == 0


LIES: list[Callable[[Header], Header]] = [
    lambda header: replace(header, event_count=4),
    lambda header: replace(header, time_min=header.time_min - timedelta(microseconds=1)),
    lambda header: replace(header, time_max=header.time_max + timedelta(microseconds=1)),
]


@pytest.mark.parametrize("before", [(), (2,)], ids=["at the beginning", "later"])
def test_a_header_that_lies_is_refused(
    before: tuple[int, ...], central_log: Log, post: Callable[..., httpx.Response]
) -> None:
    *first, last = segments_of(counts=(*before, 3))
    previous = first[-1].chain_hash if first else bytes(32)
    for lie in LIES:
        header = lie(last.header)
        liar = replace(last, header=header, chain_hash=chain(previous, header, last.payload_hash))
        damaged = replace(liar, chain_hash=last.chain_hash)

        # The chain tells a lie of the station's from a byte that flipped on the way.
        assert problem(post("segments", encode_records([*first, liar])), 422)["code"] == "false_header"
        assert problem(post("segments", encode_records([*first, damaged])), 422)["code"] == "bad_header"
    assert central_log.head() == 0


def test_a_payload_that_is_no_events_is_refused(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    (one,) = segments_of(counts=(3,))
    for payload in (b"", b"not zstd", b"\x28\xb5\x2f\xfd" + bytes(8)):
        payload_hash = hashlib.sha256(payload).digest()
        chained = chain(bytes(32), one.header, payload_hash)
        sent = replace(one, payload=payload, payload_hash=payload_hash, chain_hash=chained)
        assert problem(post("segments", encode_record(sent)), 422)["code"] == "false_header"
    assert central_log.head() == 0


@pytest.mark.parametrize(
    "body, words",
    [(b"", "got 0 bytes"), (b"<html>", "breaks off"), (bytes(4096), "must begin with b'VIANREC1'")],
)
def test_garbage_is_refused(body: bytes, words: str, central_log: Log, post: Callable[..., httpx.Response]) -> None:
    told = problem(post("segments", body), 400)

    assert told["code"] == "bad_body"
    assert words in told["got"]
    assert problem(post("hello", body), 400)["code"] == "bad_hello"
    assert central_log.head() == 0


def test_another_protocol_version_is_told_which_one_is_spoken(post: Callable[..., httpx.Response]) -> None:
    told = problem(post("hello", hello(protocol=2, more=True)), 400)

    assert (told["code"], told["wanted"]) == ("protocol_version", "version 1")
    assert "pip install --upgrade vian" in told["next"]


@pytest.fixture
def narrow(central_log: Log, serve: Serve) -> str:
    limits = Limits(body_bytes_max=10_000, segments_max=3, hello_bytes_max=1000, idle_s_max=0.05)
    return serve(central_app(central_log, limits=limits, enrolled=()))


@pytest.mark.parametrize("endpoint, limit", [("segments", 10_000), ("hello", 1000)])
def test_a_body_is_cut_off_at_the_limit_while_it_comes_in(endpoint: str, limit: int, narrow: str) -> None:
    taken = 0

    def endless() -> Iterator[bytes]:
        nonlocal taken
        while True:
            taken += 1000
            yield bytes(1000)

    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.Client() as client:
        declared = client.post(f"{narrow}/sync/v1/{endpoint}", content=bytes(limit + 1), headers=headers)
        try:
            undeclared = client.post(f"{narrow}/sync/v1/{endpoint}", content=endless(), headers=headers)
        except httpx.TransportError:
            undeclared = None  # central hung up while we still talked, and its answer was lost with it

    told = problem(declared, 413)
    assert (told["code"], told["wanted"]) == ("too_large", f"at most {limit} bytes")
    assert declared.headers["connection"] == "close"
    assert undeclared is None or undeclared.status_code == 413
    assert taken < 100_000_000


def test_too_many_segments_are_refused(narrow: str, central_log: Log) -> None:
    headers = {"Authorization": f"Bearer {TOKEN}"}
    body = encode_records(segments_of(counts=(1, 1, 1, 1)))

    response = httpx.post(f"{narrow}/sync/v1/segments", content=body, headers=headers)

    assert "at most 3 records" in problem(response, 400)["got"]
    assert central_log.head() == 0


def test_a_body_that_stops_coming_is_given_up(narrow: str) -> None:
    url = httpx.URL(narrow)
    with socket.create_connection((url.host, url.port)) as connection:
        connection.sendall(
            f"POST {url.path}/sync/v1/segments HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\n"
            "Content-Length: 5000\r\n\r\nVIANREC1".encode()
        )
        answer = b"".join(iter(lambda: connection.recv(65536), b""))  # to the end: central hangs up

    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b'"code":"slow_body"' in answer


def test_a_connection_lost_in_the_body_stores_nothing_and_ends_the_request(central_log: Log, serve: Serve) -> None:
    app, statuses = central_app(central_log, enrolled=()), queue.Queue[int]()

    async def watched(scope: Any, receive: Any, send: Any) -> None:
        async def note(message: Any) -> None:
            if message["type"] == "http.response.start":
                statuses.put(message["status"])
            await send(message)

        await app(scope, receive, note)

    url = httpx.URL(serve(watched))
    body = encode_records(segments_of())
    with socket.create_connection((url.host, url.port)) as connection:
        head = f"POST {url.path}/sync/v1/segments HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\n"
        connection.sendall(head.encode() + f"Content-Length: {len(body)}\r\n\r\n".encode() + body[:-1])

    assert statuses.get(timeout=60) == 400
    assert central_log.head() == 0


def test_a_refusal_reads_as_a_sentence(central_log: Log) -> None:
    with pytest.raises(Refusal, match=r"does not hold segments: got a body .* got 0 bytes, wanted .*\. Next: send it"):
        apply(central_log, BRNO, b"", body_bytes_max=10, segments_max=10)


def test_a_database_that_is_away_is_told_as_such(central_log: Log, post: Callable[..., httpx.Response]) -> None:
    central_log.close()

    for response in (post("hello", hello()), post("segments", encode_records(segments_of()))):
        assert problem(response, 503)["code"] == "log_unavailable"
        assert response.headers["retry-after"] == "5"


def test_what_is_acknowledged_has_been_committed(central_log: Log) -> None:
    body = encode_records(segments_of())

    answer = apply(central_log, BRNO, body, body_bytes_max=10**6, segments_max=10)

    assert isinstance(answer, SegmentsAnswer)
    with central_log.connection() as another:
        assert another.execute("select count(*) from segments").fetchone() == (2,)


def test_what_a_header_says_is_what_travels() -> None:
    (one,) = segments_of(counts=(3,))

    assert header_bytes(one.header) in encode_record(one)
