import hashlib
import re
from typing import Any

import httpx
import psycopg
import pytest
from fastapi import FastAPI, Request, Response

from events import Draft
from store import Log, LogUnavailable
from sync import (
    BadAnswer,
    CentralFailed,
    CentralUnreachable,
    Daemon,
    Damaged,
    HeadsDisagree,
    NotAuthorised,
    Pace,
    ProtocolMismatch,
    Refused,
    SegmentRefused,
    SessionOver,
    Step,
)
from sync.runs import end_of
from sync.station.client import Central
from sync.station.client_v1 import CentralV1
from sync.station.outbox import check_history
from tests.sync.conftest import (
    BRNO,
    EVERYTHING,
    NOON,
    OTHER_TOKEN,
    PRODUCER,
    Faults,
    MakeDaemon,
    Serve,
    append_points,
    central_app,
    stored,
    stream_of,
)


def steps(daemon: Daemon, count: int) -> list[str]:
    return [daemon.step().did for _ in range(count)]


def test_a_wrong_token_is_told_with_the_next_command_and_tried_again_slowly(make_daemon: MakeDaemon) -> None:
    daemon = make_daemon(protocol=1, token="not-the-token-of-anybody", pace=Pace(backoff_s=1, backoff_s_max=60))
    daemon.step()

    step = daemon.step()

    assert isinstance(step.error, NotAuthorised)
    assert "the token is not granted here" in str(step.error)
    assert "Next: vian station add" in str(step.error)
    assert step.sleep_s <= 1  # the link may have garbled this one
    assert [daemon.step().sleep_s >= 30 for _ in range(3)] == [True] * 3
    with pytest.raises(NotAuthorised):
        daemon.catch_up()


def test_one_garbled_request_costs_an_ordinary_pause(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    append_points(station_log, stream_of(), [2])
    daemon = make_daemon(pace=Pace(backoff_s=1, backoff_s_max=60))
    garble_signatures(faults, {1, 3})
    pauses = [step.sleep_s for step in iter(daemon.step, Step("nothing", Pace().idle_s)) if step.error is not None]
    assert len(pauses) == 2
    assert max(pauses) <= 2
    assert stored(central_log) == stored(station_log)


def garble_signatures(faults: Faults, numbers: set[int]) -> None:
    """Let these of the signed requests that follow come to central with another signature."""
    exchange, count = faults._exchange, iter(range(1, 1000))

    def garbling(request: httpx.Request, body: bytes) -> httpx.Response:
        if "signature" in request.headers and next(count) in numbers:
            request.headers["signature"] = "vian-sync=:" + "A" * 86 + "==:"
        return exchange(request, body)

    faults._exchange = garbling  # type: ignore[method-assign]


def test_the_token_of_another_station_is_refused(central_log: Log, make_daemon: MakeDaemon) -> None:
    daemon = make_daemon(protocol=1, token=OTHER_TOKEN)

    with pytest.raises(NotAuthorised, match=r"got station brno-2, wanted station oslo-1"):
        daemon.catch_up()
    assert stored(central_log) == {}


def test_central_unreachable_is_reported_and_waited_for_longer_each_time(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    append_points(station_log, stream_of(), [2])
    daemon = make_daemon(pace=Pace(backoff_s=1, backoff_s_max=8))
    daemon.step()

    pauses = []
    for _ in range(6):
        faults.next = "cut before sending"
        step = daemon.step()
        assert isinstance(step.error, CentralUnreachable)
        pauses.append(step.sleep_s)

    assert pauses[0] <= 1
    assert pauses[0] < pauses[2] < pauses[4] <= 8
    assert "connection refused" in (daemon.status().last_error or "")
    assert daemon.status().failures == 6
    assert daemon.catch_up() == 3
    assert (daemon.status().last_error, daemon.status().failures) == (None, 0)
    assert stored(central_log) == stored(station_log)


def test_nobody_listening_is_reported(make_daemon: MakeDaemon) -> None:
    with pytest.raises(CentralUnreachable, match=r"central at http://127.0.0.1:1 cannot be reached"):
        make_daemon(address="http://127.0.0.1:1").catch_up()


def test_a_page_of_a_proxy_is_told_as_such(daemon: Daemon, faults: Faults) -> None:
    daemon.step()
    faults.next = "page of a proxy"

    step = daemon.step()

    assert isinstance(step.error, BadAnswer)
    assert "is not ViAn's central" in str(step.error)
    assert "curl" in str(step.error)


@pytest.mark.parametrize(
    "answer, error, words",
    [
        (Response("<h1>Bad Gateway</h1>", 502), CentralFailed, "Bad Gateway"),
        (Response("", 307, {"location": "https://login.example/"}), BadAnswer, "https://login.example/"),
        (Response("<h1>Request Entity Too Large</h1>", 413), BadAnswer, "client_max_body_size"),
        (Response("Basic realm", 401), NotAuthorised, "Authorization header"),
        (Response('{"detail":"Not Found"}', 404), BadAnswer, "Not Found"),
        (Response("x" * 5_000_000, 200), BadAnswer, "more than 65536 bytes"),
        (Response("\x1b[2Jevil\r\n" + "y" * 900, 400), BadAnswer, "?[2Jevil yyy"),
        (
            Response('{"code":"protocol_version","error":"e","got":"g","wanted":"w","next":"upgrade"}', 400),
            ProtocolMismatch,
            "This station speaks version 2",
        ),
    ],
)
def test_what_is_not_centrals_answer_is_named(
    answer: Response, error: type[Exception], words: str, make_daemon: MakeDaemon, serve: Serve
) -> None:
    app = FastAPI()
    app.post("/sync/v2/challenge")(lambda: answer)
    daemon = make_daemon(address=serve(app))
    daemon.step()

    step = daemon.step()

    assert type(step.error) is error
    assert words in str(step.error)
    assert str(step.error).isprintable()


def test_a_hello_without_all_cursors_is_no_answer(make_daemon: MakeDaemon, serve: Serve) -> None:
    app = FastAPI()
    answer = {
        "protocol": 1,
        "program": "vian/9",
        "station": "brno-2",
        "time": "2026-05-01T12:00:00Z",
        "cursors": [],
        "body_bytes_max": 1000,
        "segments_max": 10,
    }
    app.post("/sync/v1/hello")(lambda: answer)

    with pytest.raises(BadAnswer, match=r"no cursor for brno-2/sync/sync_planned"):
        make_daemon(address=serve(app), protocol=1).catch_up()


def test_another_version_in_an_answer_of_protocol_1_is_told(make_daemon: MakeDaemon, serve: Serve) -> None:
    app = FastAPI()
    app.post("/sync/v1/hello")(lambda: Response('{"protocol": 9, "new": "shape"}', 200))

    with pytest.raises(ProtocolMismatch, match="version 1 is spoken here, got version 9"):
        make_daemon(address=serve(app), protocol=1).catch_up()


@pytest.mark.parametrize("answer", ['{"cursors":[],"stored":1,"duplicates":0}', '{"stored":1}'])
def test_an_acknowledgement_without_a_cursor_is_doubted(
    answer: str, central_log: Log, make_daemon: MakeDaemon, serve: Serve
) -> None:
    app = FastAPI()
    app.post("/sync/v2/segments")(lambda: Response(answer, 200, media_type="application/json"))
    app.mount("/", central_app(central_log))
    daemon = make_daemon(address=serve(app))
    steps(daemon, 2)

    assert isinstance(daemon.step().error, BadAnswer)
    assert daemon.step().did == "hello"  # what central holds is in doubt


def test_a_refusal_is_followed_by_a_hello(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    append_points(station_log, stream_of(), [2])
    daemon = make_daemon(protocol=1)
    steps(daemon, 2)
    faults.next, faults.where = "truncated request", 0.9

    refused = daemon.step()

    assert isinstance(refused.error, Refused)
    assert refused.error.code == "bad_body"
    assert "breaks off" in str(refused.error)
    assert steps(daemon, 3) == ["hello", "sent", "nothing"]
    assert stored(central_log) == stored(station_log)


@pytest.mark.parametrize("protocol", [2, 1])
def test_central_set_back_to_an_older_backup_gets_all_again(
    protocol: int, station_log: Log, make_log: type[Log], make_daemon: MakeDaemon, serve: Serve
) -> None:
    before, after = make_log(), make_log()
    app = FastAPI()
    app.mount("/", central_app(before))
    append_points(station_log, stream_of(), [2, 2])
    daemon = make_daemon(address=serve(app), protocol=protocol)
    daemon.catch_up()
    app.router.routes.clear()
    app.mount("/", central_app(after))
    append_points(station_log, stream_of(), [2])

    step = daemon.step()

    # The session was central's that is no more; in protocol 1 it is the gap that tells.
    assert type(step.error) is (SessionOver if protocol == 2 else Refused)
    daemon.catch_up()
    assert stored(after) == stored(station_log)


def test_a_station_with_another_history_is_stopped_with_both_hashes(
    station_log: Log, central_log: Log, make_log: type[Log], make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3])
    append_points(station_log, stream_of("yard"), [3])
    make_daemon().catch_up()
    before = stored(central_log)
    re_imaged = make_log()
    append_points(re_imaged, stream_of(), [1, 2])
    append_points(re_imaged, stream_of("yard"), [3])
    daemon = make_daemon(log=re_imaged)
    assert steps(daemon, 4) == ["planned", "hello", "doubted", "hello"]

    step = daemon.step()

    assert step.did == "stopped"
    assert isinstance(step.error, HeadsDisagree)
    for part in ("brno-2/gate/track_point", "sequence 3", "then vian station new-epoch"):
        assert part in str(step.error)
    assert re_imaged.stream_head(stream_of()).chain_hash.hex() in str(step.error)
    assert station_log.stream_head(stream_of()).chain_hash.hex() in str(step.error)
    assert daemon.catch_up() == 0  # yard is the same on both; the plan's stream too
    assert stored(central_log) == before


@pytest.mark.parametrize(
    "counts, here",
    [([2], "no segment ends there"), ([2, 2], "no segment ends there"), ([1, 2, 1], "the chain hash here is")],
)
def test_another_history_is_found_wherever_central_stands(
    counts: list[int],
    here: str,
    station_log: Log,
    central_log: Log,
    make_log: type[Log],
    make_daemon: MakeDaemon,
) -> None:
    append_points(station_log, stream_of(), [3])
    make_daemon().catch_up()
    re_imaged = make_log()
    append_points(re_imaged, stream_of(), counts)

    with pytest.raises(HeadsDisagree, match=here) as raised:
        make_daemon(log=re_imaged).catch_up()
    assert raised.value.sequence == 3
    there = end_of(central_log.runs(stream_of(), epoch=1))
    with pytest.raises(HeadsDisagree, match=here):
        check_history(re_imaged, re_imaged.stream_head(stream_of()), there)
    check_history(station_log, station_log.stream_head(stream_of()), there)


@pytest.mark.parametrize(
    "said, damaged",
    [(rb'"chain_hash":"....', b'"chain_hash":"dead'), (rb'"body_bytes_max":\d+', b'"body_bytes_max":1')],
)
def test_an_answer_that_was_damaged_on_its_way_stops_no_stream(
    said: bytes, damaged: bytes, station_log: Log, central_log: Log, make_daemon: MakeDaemon, serve: Serve
) -> None:
    append_points(station_log, stream_of(), [3])
    make_daemon().catch_up()
    append_points(station_log, stream_of(), [4])
    app, answers = central_app(central_log), list[bytes]()

    @app.middleware("http")
    async def damage_the_first(request: Request, call_next: Any) -> Response:
        answer = await call_next(request)
        body = b"".join([piece async for piece in answer.body_iterator])
        answers.extend([body] if request.url.path.endswith("/hello") else [])
        return Response(re.sub(said, damaged, body) if len(answers) == 1 else body, answer.status_code)

    daemon = make_daemon(address=serve(app))

    assert "doubted" in [step.did for step in iter(daemon.step, Step("nothing", Pace().idle_s))]
    assert stored(central_log) == stored(station_log)


def test_other_streams_go_on_when_one_is_stopped(
    station_log: Log, central_log: Log, make_log: type[Log], make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3])
    make_daemon().catch_up()
    re_imaged = make_log()
    append_points(re_imaged, stream_of(), [1, 2, 7])
    append_points(re_imaged, stream_of("yard"), [5])
    daemon = make_daemon(log=re_imaged)

    with pytest.raises(HeadsDisagree):
        daemon.catch_up()
    daemon.catch_up()

    assert stored(central_log)["brno-2/yard/track_point"] == stored(re_imaged)["brno-2/yard/track_point"]
    status = {s.stream.source: s for s in daemon.status().streams}
    assert [(each.cursor, each.backlog) for each in (status["gate"], status["yard"])] == [(None, None), (5, 0)]
    assert "is stopped" in (daemon.status().last_error or "")


DAMAGES = {
    "update segments set payload = set_byte(payload, 9, get_byte(payload, 9) # 1) where first_sequence = 4": "hash",
    "update segments set producer_version = '2' where first_sequence = 4": "its header was changed",
    "update segments set first_sequence = 5 where first_sequence = 4": "must begin at 4",
    "update segments set time_min = time_max + interval '1 s' where first_sequence = 4": "time_min",
}


@pytest.mark.parametrize("damage, words", DAMAGES.items(), ids=["payload", "header", "sequence", "impossible header"])
def test_a_damaged_segment_stops_its_stream_before_it_travels(
    damage: str, words: str, station_log: Log, central_log: Log, daemon: Daemon
) -> None:
    append_points(station_log, stream_of(), [3, 3])
    append_points(station_log, stream_of("yard"), [3])
    yard = stored(station_log)["brno-2/yard/track_point"]
    with psycopg.connect(station_log.dsn) as connection:
        connection.execute("set session_replication_role = replica")  # the owner's slip: past the trigger
        connection.execute(damage + " and stream_id = (select id from streams where source = 'gate')")

    with pytest.raises(Damaged, match=words) as raised:
        daemon.catch_up()

    assert "Next: vian verify" in str(raised.value)
    daemon.catch_up()
    assert stored(central_log)["brno-2/yard/track_point"] == yard
    assert "brno-2/gate/track_point" not in stored(central_log)


def test_a_segment_whose_header_lies_stops_its_stream_only(station_log: Log, central_log: Log, daemon: Daemon) -> None:
    append_points(station_log, stream_of(), [3])
    append_points(station_log, stream_of("yard"), [3])
    (true,) = station_log.read(stream_of())
    header = true.header
    liar = Draft(
        stream_of("liar"),
        99,
        header.schema_version,
        header.time_min,
        header.time_max,
        PRODUCER,
        true.payload,
        true.payload_hash,
    )
    station_log.append([liar])
    steps(daemon, 2)

    step = daemon.step()

    assert isinstance(step.error, Refused)
    assert step.error.code == "false_header"
    daemon.catch_up()
    assert set(stored(central_log)) == {
        "brno-2/gate/track_point",
        "brno-2/yard/track_point",
        "brno-2/sync/sync_planned",
    }
    assert "99 events" in str({s.stream.source: s.error for s in daemon.status().streams}["liar"])


def test_the_stations_database_away_is_reported_and_survived(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    append_points(station_log, stream_of(), [3])
    daemon = make_daemon()
    steps(daemon, 2)

    def away() -> None:
        raise LogUnavailable("the database is away")

    with monkeypatch.context() as patch:
        patch.setattr(station_log, "head", away)
        assert isinstance(daemon.step().error, LogUnavailable)
        patch.setattr(station_log, "revive", away)
        assert isinstance(daemon.step().error, LogUnavailable)

    assert steps(daemon, 3) == ["hello", "sent", "nothing"]
    assert stored(central_log) == stored(station_log)


def test_central_without_its_database_is_reported(central_log: Log, daemon: Daemon) -> None:
    daemon.step()
    central_log.close()

    step = daemon.step()

    assert isinstance(step.error, CentralFailed)
    assert "central's database is away" in str(step.error)


def test_a_header_newer_than_this_program_is_carried_all_the_same(
    station_log: Log, central_log: Log, daemon: Daemon
) -> None:
    append_points(station_log, stream_of(), [3])
    (known,) = station_log.read(stream_of())
    header = known.header
    newer = Draft(
        stream_of(),
        4,
        77,
        header.time_min,
        header.time_max,
        PRODUCER,
        b"of the future",
        hashlib.sha256(b"of the future").digest(),
    )
    station_log.append([newer], [3])

    daemon.catch_up()

    assert stored(central_log) == stored(station_log)


def test_a_client_that_times_out_is_reported(station_log: Log, make_daemon: MakeDaemon, faults: Faults) -> None:
    daemon = make_daemon()
    daemon.step()
    faults.next = "timeout after sending"

    step = daemon.step()

    assert isinstance(step.error, CentralUnreachable)
    assert "gave no answer in time" in str(step.error)


def test_an_address_without_a_scheme_is_reported(station_log: Log, make_daemon: MakeDaemon) -> None:
    with httpx.Client(base_url="central.example") as client:
        daemon = Daemon(
            station_log, BRNO, EVERYTHING, CentralV1(client, "sixteen-letters-x"), now=lambda: NOON, random=lambda: 0.5
        )
        with pytest.raises(CentralUnreachable, match=r"http://"):
            daemon.catch_up()


def test_a_stream_that_stops_in_a_request_leaves_the_others_of_it_to_be_sent(
    station_log: Log, central_log: Log, daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    for source in ("gate", "yard"):
        append_points(station_log, stream_of(source), [2])
    send = Central.send

    def sent(self: Central, records: Any, order: str = "", follows: str = "") -> Any:
        if any(record.segment.stream.source == "yard" for record in records):
            raise SegmentRefused(stream_of("yard"), 1, 1, "it will not do")
        return send(self, records, order, follows)

    monkeypatch.setattr(Central, "send", sent)
    dones = [step.did for step in iter(daemon.step, Step("nothing", Pace().idle_s)) if step.did != "countersigned"]

    assert dones.count("stopped") == 1
    assert central_log.stream_head(stream_of("gate")).sequence == 2
    assert central_log.stream_head(stream_of("yard")).sequence == 0
