"""Repair from the other side: what may come back, what may not, and what the log says of it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import httpx
import psycopg
import pytest
from fastapi import FastAPI

from events import Draft, Segment, SegmentsRepaired, Station, StreamName, decode, events_of
from store import Log, verify
from store.payloads import take_off
from sync.central.access import Access
from sync.central.router import router
from sync.errors import CentralUnreachable, Refusal, Refused
from sync.keeping.repair import Repaired, Repairer, Wanted, damaged_payloads, hollow_payloads, records_for
from sync.plans.plan import Plan
from sync.protocol.wire import Range, decode_records
from sync.station.client import Central, Greeting
from sync.station.daemon import Daemon
from tests.store.samples import GATE, NOON, YARD, append, owner
from tests.sync.conftest import Serve
from tests.sync.test_access import CENTRAL_KEY, KEY, Sender, enrol

BRNO = Station("brno")
MAX = 1 << 26


@pytest.fixture
def station(make_log: Callable[[], Log]) -> Log:
    log = make_log()
    append(log, GATE, 3, 2, 4, 1)
    append(log, YARD, 2, 2)
    return log


@pytest.fixture
def central(make_log: Callable[[], Log], station: Log) -> Log:
    """Holds what the station sent."""
    log = make_log()
    copy(station, log)
    return log


def copy(source: Log, target: Log) -> None:
    for segment in source.read_all():
        header = segment.header
        draft = Draft(
            header.stream,
            header.event_count,
            header.schema_version,
            header.time_min,
            header.time_max,
            header.producer,
            segment.payload,
            segment.payload_hash,
        )
        target.append([draft], [header.first_sequence - 1], chain_hashes=[segment.chain_hash])


def fetching(central: Log) -> Callable[[Range], Sequence[Segment]]:
    def fetch(wanted: Range) -> list[Segment]:
        body = records_for(central, BRNO, wanted, bytes_max=MAX, segments_max=100)
        return [record.segment for record in decode_records(body)]

    return fetch


def repairer(station: Log, central: Log) -> Repairer:
    return Repairer(station, BRNO, fetching(central), "central", lambda: NOON)


@pytest.fixture
def tampering(station: Log) -> Iterator["psycopg.Connection[object]"]:
    """A connection past the log's guards."""
    with owner(station) as connection:
        connection.execute("set session_replication_role = replica")
        yield connection


def repairs(log: Log) -> list[tuple[str, int, int, int, str]]:
    segments = log.read_all(types=[SegmentsRepaired.type_name])
    events = [event for segment in segments for event in events_of(decode(segment, log.catalogue))]
    return [
        (each.stream, each.first_sequence, each.last_sequence, each.segments, each.origin)
        for each in events
        if isinstance(each, SegmentsRepaired)
    ]


def contents(log: Log) -> list[Segment]:
    return list(log.read_all(types=["track_point"]))


def all_done(done: Sequence[Repaired]) -> bool:
    return bool(done) and all(each.segments and each.failure is None for each in done)


DAMAGES = {
    "payload": "update segments set payload = set_byte(payload, 5, get_byte(payload, 5) # 1) where position in (1, 6)",
    "payload hash": "update segments set payload_hash = sha256('x') where position = 2",
    "both payload and its hash": "update segments set payload = 'x', payload_hash = sha256('x') where position = 2",
    "event count": "update segments set event_count = 9 where position = 1",
    "times": "update segments set time_min = time_min - interval '1 day' where position = 3",
    "a time that no log can hold": "update segments set time_max = 'infinity' where position = 3",
    "producer": "update segments set producer = 'someone' where position = 4",
    "first sequence": "update segments set first_sequence = 77 where position = 2",
    "chain hash": "update segments set chain_hash = sha256('x') where position = 2",
    "the newest": "update segments set chain_hash = sha256('x'), producer = 'x' where position = 4",
    "neighbours": "update segments set producer = 'x' where position in (2, 3, 4)",
    "all of a stream": "update segments set event_count = 7, schema_version = 5 where position <= 4",
    "two streams": "update segments set producer = 'x', payload = 'y' where position in (2, 6)",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_was_damaged_is_again_what_it_was(
    station: Log, central: Log, tampering: "psycopg.Connection[object]", damage: str
) -> None:
    before = contents(station)
    tampering.execute(DAMAGES[damage])  # type: ignore[call-overload]  # statements of this file
    assert not verify(station).is_sound
    done = list(repairer(station, central).repair_all())
    assert verify(station).is_sound, done
    assert contents(station) == before
    assert sum(each.segments for each in done) == sum(segments for *_, segments, _ in repairs(station))


def test_a_payload_that_was_pruned_comes_back_when_it_is_wanted(station: Log, central: Log) -> None:
    before = contents(station)
    with station.transaction() as transaction:
        take_off(transaction, [1, 2, 3])
    wanted = list(hollow_payloads(station, GATE, 4, 5))
    assert [(each.first_sequence, each.last_sequence) for each in wanted] == [(4, 5)]
    assert all_done([repairer(station, central).repair(each) for each in wanted])
    assert contents(station) == [each for each in before if each.position not in (1, 3)]
    assert repairs(station) == [(str(GATE), 4, 5, 1, "central")]


def test_what_the_other_side_forged_is_refused(station: Log, central: Log, make_log: Callable[[], Log]) -> None:
    forger = make_log()
    append(forger, GATE, 3, 2, 3, 2)  # ends elsewhere from the third segment on
    with station.transaction() as transaction:
        take_off(transaction, [3])
    (damage,) = hollow_payloads(station, GATE, 6, 9)
    done = repairer(station, forger).repair(damage)
    assert done.segments == 0
    assert "was not put back" in str(done.failure)
    assert repairs(station) == []


def test_a_header_that_the_neighbours_do_not_demand_is_refused(
    station: Log, make_log: Callable[[], Log], tampering: "psycopg.Connection[object]"
) -> None:
    forger = make_log()
    append(forger, GATE, 3, 2, 5)
    tampering.execute("update segments set event_count = 5 where position = 3")
    done = list(repairer(station, forger).repair_all())
    assert [each.segments for each in done] == [0]
    assert "its neighbours' hashes say otherwise" in str(done[0].failure)
    assert not verify(station).is_sound


def test_what_the_other_side_lacks_and_a_link_that_is_down_leave_it_as_it_is(station: Log, central: Log) -> None:
    append(station, GATE, 1)
    with station.transaction() as transaction:
        take_off(transaction, [station.head()])
    (damage,) = hollow_payloads(station, GATE, 11, 11)
    lacking = Repairer(station, BRNO, lambda _: [], "central", lambda: NOON).repair(damage)
    assert lacking.failure == "central does not hold brno/gate/track_point from sequence 11 with its payload"

    def unreachable(_: Range) -> list[Segment]:
        raise CentralUnreachable("central cannot be reached")

    away = Repairer(station, BRNO, unreachable, "central", lambda: NOON).repair(damage)
    assert (away.segments, away.failure) == (0, "central cannot be reached")


def test_central_is_repaired_from_the_station_by_the_same_means(station: Log, central: Log) -> None:
    with owner(central) as connection:
        connection.execute("set session_replication_role = replica")
        connection.execute("update segments set payload = 'x' where position = 2")
    done = list(Repairer(central, Station("praha"), fetching(station), "brno", lambda: NOON).repair_all())
    assert all_done(done)
    assert [each.payload for each in contents(central)] == [each.payload for each in contents(station)]
    assert repairs(central) == [(str(GATE), 4, 5, 1, "brno")]


def test_a_station_reads_back_its_own_streams_only_and_is_told_what_is_not_held(central: Log) -> None:
    def asked(stream: str, first: int = 1) -> None:
        wanted = Range(stream=stream, epoch=1, first_sequence=first, last_sequence=first + 3)
        records_for(central, BRNO, wanted, bytes_max=MAX, segments_max=100)

    for stream, first, code in (("praha/gate/track_point", 1, "foreign_stream"), (str(GATE), 99, "not_held")):
        with pytest.raises(Refusal) as caught:
            asked(stream, first)
        assert caught.value.code == code


def test_an_answer_is_bounded_and_holds_one_segment_at_least(central: Log) -> None:
    wanted = Range(stream=str(GATE), epoch=1, first_sequence=2, last_sequence=9)

    def firsts(bytes_max: int, segments_max: int) -> list[int]:
        body = records_for(central, BRNO, wanted, bytes_max=bytes_max, segments_max=segments_max)
        return [record.segment.header.first_sequence for record in decode_records(body)]

    assert firsts(MAX, 100) == [1, 4, 6]
    assert firsts(1, 100) == [1]
    assert firsts(MAX, 2) == [1, 4]
    body = records_for(central, BRNO, wanted, bytes_max=MAX, segments_max=9)
    assert [each.previous for each in decode_records(body)] == [
        bytes(32),
        *(each.chain_hash for each in list(central.read(GATE))[:2]),
    ]


def test_a_stream_by_any_other_name_is_not_taken(station: Log, central: Log) -> None:
    def swapped(wanted: Range) -> list[Segment]:
        other = Range(stream=str(StreamName.parse(str(YARD))), epoch=1, first_sequence=1, last_sequence=2)
        return list(fetching(central)(other))

    with station.transaction() as transaction:
        take_off(transaction, [1])
    (damage,) = hollow_payloads(station, GATE, 1, 3)
    assert Repairer(station, BRNO, swapped, "central", lambda: NOON).repair(damage).segments == 0


def test_what_a_log_wants_back_is_asked_until_it_was_put_back(station: Log, central: Log) -> None:
    praha = Station("praha")
    with owner(central) as connection:
        connection.execute("set session_replication_role = replica")
        connection.execute("update segments set payload = 'x' where position in (2, 6)")
    wanted = Wanted(central)
    for _ in range(2):
        wanted.ask(list(damaged_payloads(central)))
    asked = [each.wanted() for each in wanted.of(BRNO)]
    assert [(each.stream, each.first_sequence, each.last_sequence) for each in asked] == [
        (str(GATE), 4, 5),
        (str(YARD), 3, 4),
    ]
    assert wanted.of(praha) == []
    forged = [replace(each, payload=b"y") for each in fetching(station)(asked[1])]
    assert wanted.take(praha, BRNO, forged, lambda: NOON) == 0
    assert wanted.take(praha, BRNO, fetching(station)(asked[0]), lambda: NOON) == 1
    assert [each.stream for each in wanted.of(BRNO)] == [YARD]
    assert wanted.take(praha, BRNO, fetching(station)(asked[1]), lambda: NOON) == 1
    assert wanted.of(BRNO) == []
    assert verify(central, station="praha").is_sound
    assert repairs(central) == [(str(GATE), 4, 5, 1, "brno"), (str(YARD), 3, 4, 1, "brno")]


@pytest.fixture
def link(central: Log, serve: Serve) -> Iterator[Central]:
    """Central over HTTP, as the enrolled station brno sees it."""
    app = FastAPI()
    access = Access(central, Station("praha"), CENTRAL_KEY, now=lambda: NOON)
    app.include_router(router(central, None, access=access, now=lambda: NOON))
    enrol(access, BRNO, KEY)
    with httpx.Client(base_url=serve(app)) as client:
        yield Central(client, Sender(access, "brno").signer)


def greeting(station: Log) -> Greeting:
    return Greeting(BRNO, station.epoch, NOON, station.streams(), None, None)


def damage_central(central: Log) -> None:
    with owner(central) as connection:
        connection.execute("set session_replication_role = replica")
        connection.execute("update segments set payload = 'x' where position in (2, 6)")
    Wanted(central).ask(list(damaged_payloads(central)))


def test_over_http_an_enrolled_station_reads_back_its_own_segments(
    station: Log, link: Central, tampering: "psycopg.Connection[object]"
) -> None:
    link.hello(greeting(station))
    before = contents(station)
    tampering.execute("update segments set event_count = 9, payload = 'x' where position = 2")
    done = list(Repairer(station, BRNO, link.read, "central", lambda: NOON).repair_all())
    assert all_done(done)
    assert contents(station) == before
    with pytest.raises(Refused, match="a station reads back its own streams only"):
        link.read(Range(stream="plzen/gate/track_point", epoch=1, first_sequence=1, last_sequence=2))


def test_over_http_it_sends_again_what_central_wants_back(station: Log, central: Log, link: Central) -> None:
    damage_central(central)
    for wanted in link.hello(greeting(station)).wanted:
        body = records_for(station, BRNO, wanted, bytes_max=MAX, segments_max=10)
        assert link.repair(body).repaired == 1
    assert link.hello(greeting(station)).wanted == ()
    with pytest.raises(Refused, match="the body does not hold segments"):
        link.repair(b"nothing")
    assert verify(central, station="praha").is_sound


def test_a_daemon_does_so_by_itself(station: Log, central: Log, link: Central) -> None:
    damage_central(central)
    plan = Plan.of({"entries": [{"stream": "*/*/track_point"}]})
    daemon = Daemon(station, BRNO, plan, link, now=lambda: NOON, random=lambda: 0.5)
    did = []
    while "nothing" not in did:
        did.append(daemon.step().did)
    assert did.count("repaired") == 2
    assert verify(central, station="praha").is_sound
    assert [each.payload for each in contents(central)] == [each.payload for each in contents(station)]


def test_what_its_station_lost_too_is_asked_once(station: Log, central: Log, link: Central) -> None:
    for log in (station, central):
        with log.transaction() as transaction:
            take_off(transaction, [1])
    damage_central(central)
    Wanted(central).ask(list(hollow_payloads(central, GATE, 1, 3)))
    plan = Plan.of({"entries": [{"stream": "*/*/track_point"}]})
    done = []
    for _ in range(2):
        daemon = Daemon(station, BRNO, plan, link, now=lambda: NOON, random=lambda: 0.5)
        did = []
        while "nothing" not in did:
            did.append(daemon.step().did)
        done.append(did.count("repaired"))
    assert done == [3, 0]
    assert Wanted(central).of(BRNO) == []


def test_where_too_much_is_wanted_the_rest_is_named(central: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sync.keeping.repair.WANTED_MAX", 2)
    with central.transaction() as transaction:
        take_off(transaction, [1, 2, 3, 4])
    wanted = Wanted(central)
    first, second, *_ = gone = list(hollow_payloads(central, GATE, 1, 99))
    assert wanted.ask([second]) == []
    assert wanted.ask([*gone]) == gone[2:]
    assert wanted.of(BRNO) == [second, first]
