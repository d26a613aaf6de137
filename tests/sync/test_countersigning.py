"""Central countersigns what it holds; the station believes its signature only, and asks for nothing new twice."""

import threading
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from events import CheckpointCountersigned, CheckpointSigned, Position, StreamName, batch_of, decode, encode, events_of
from store import DiskNearlyFull, Log, Signer, StreamHead
from store.payloads import put_back, take_off
from store.room import Room
from sync import BadAnswer, Daemon, Plan, Refusal
from sync.keeping.countersigned import Held, countersigned_bytes, held_in, is_countersigned
from sync.keeping.countersigning import countersign
from sync.keeping.pruning import Pruner
from sync.protocol.reports import Pace
from sync.protocol.wire import CountersignRequest, Record, SegmentsAnswer
from sync.station.client import Link
from tests.store.tiered import seal_all
from tests.sync.conftest import (
    BRNO,
    CENTRAL_KEY,
    NOON,
    MakeDaemon,
    Serve,
    append_points,
    central_app,
    key_of,
    stream_of,
)

GIVEN = StreamName.of("brno-2", "sync", "checkpoint_countersigned")
ASKED = CountersignRequest(epoch=1, checkpoint_sequence=1).encoded()


def sign(log: Log) -> None:
    Signer(log, BRNO, lambda: key_of("brno-2"), lambda: NOON).sign()


def given(log: Log) -> list[CheckpointCountersigned]:
    return [event for s in log.read(GIVEN) for event in events_of(decode(s, log.catalogue))]  # type: ignore[misc]


def did(daemon: Daemon) -> list[str]:
    steps = []
    while not steps or steps[-1] != "nothing":
        step = daemon.step()
        assert step.error is None
        steps.append(step.did)
    return steps


@pytest.fixture
def make(make_daemon: MakeDaemon) -> MakeDaemon:
    def make_one(**more: Any) -> Daemon:
        return make_daemon(**({"central_key": CENTRAL_KEY.public} | more))

    return make_one


def test_a_checkpoint_that_central_holds_is_countersigned_once(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3, 2])
    sign(station_log)
    daemon = make()

    assert did(daemon).count("countersigned") == 1
    (event,) = given(station_log)
    assert is_countersigned(event, CENTRAL_KEY.public)
    assert (event.of_station, event.checkpoint_sequence) == ("brno-2", 1)
    assert {str(each.head.stream): each.head.sequence for each in held_in(event.held)} == {"brno-2/gate/track_point": 5}
    assert daemon.status().countersigned == 1


def test_who_catches_up_leaves_no_checkpoint_behind(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3] * 40)
    append_points(station_log, stream_of("yard"), [3] * 40)
    sign(station_log)
    daemon = make(
        plan=Plan.of({"entries": [{"stream": "*/log/*", "priority": 0}, {"stream": "*/*/*"}]}),
        pace=Pace(in_flight=2, request_bytes=1024, request_bytes_min=1024),
    )
    daemon.catch_up()

    assert {each.head.sequence for each in held_in(given(station_log)[-1].held)} == {120}
    assert len(held_in(given(station_log)[-1].held)) == 2


def test_signing_alone_leads_to_no_more_signatures(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    daemon = make()
    for _ in range(4):
        sign(station_log)
        did(daemon)
        did(make())  # nor does a restart

    signed = [
        event for s in station_log.read(StreamName.of("brno-2", "log", CheckpointSigned.type_name)) for event in [s]
    ]
    assert len(signed) < 4
    assert len(given(station_log)) <= 2  # the plan came behind the first checkpoint


def test_what_is_not_sent_is_not_countersigned_and_what_is_not_asked_again(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    append_points(station_log, stream_of("yard"), [3])
    sign(station_log)
    daemon = make(plan=Plan.of({"entries": [{"stream": "*/yard/*", "send": False}, {"stream": "*/*/*"}]}))

    assert did(daemon).count("countersigned") == 1
    (event,) = given(station_log)
    assert [each.head.stream.source for each in held_in(event.held)] == ["gate"]
    sign(station_log)
    did(daemon)
    assert did(daemon) == ["nothing"]


GATE_FROM_THE_SECOND = {"stream": "*/gate/*", "from": "2026-05-01T12:00:00.004Z"}
FROM_THE_SECOND = Plan.of({"entries": [GATE_FROM_THE_SECOND, {"stream": "*/log/*"}]})


def one_pm() -> datetime:
    return NOON.replace(hour=13)


def held_of(log: Log) -> list[tuple[str, int, int]]:
    return [(each.head.stream.source, each.after, each.head.sequence) for each in held_in(given(log)[-1].held)]


def prune(log: Log) -> list[bool]:
    pruner = Pruner(log, BRNO, timedelta(0), lambda event: is_countersigned(event, CENTRAL_KEY.public))
    while pruner.step(datetime.now(UTC) + timedelta(days=1)):
        pass
    return [each.has_payload for each in log.read(stream_of(), with_hollow=True)]


def test_what_is_held_from_a_time_on_is_countersigned_and_pruned_from_there(
    station_log: Log, central_log: Log, make: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3, 3])
    sign(station_log)
    daemon = make(plan=FROM_THE_SECOND, now=one_pm)
    daemon.catch_up()

    assert [(run.after, run.sequence) for run in central_log.runs(stream_of(), 1)] == [(3, 6)]
    (event,) = given(station_log)
    assert is_countersigned(event, CENTRAL_KEY.public)
    assert held_of(station_log) == [("gate", 3, 6)]
    assert prune(station_log) == [True, False]
    assert did(make(plan=FROM_THE_SECOND, now=one_pm))[-1:] == ["nothing"]
    assert len(given(station_log)) == 1, "nothing new, after a restart too"


def test_what_a_later_plan_fills_in_below_is_countersigned_too(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3, 3])
    sign(station_log)
    make(plan=FROM_THE_SECOND, now=one_pm).catch_up()
    make(now=one_pm).catch_up()
    make(now=one_pm).catch_up()  # a daemon looks once a second at most what is new to sign

    assert held_of(station_log) == [("gate", 0, 6)]
    assert prune(station_log) == [False, False]


def test_what_central_holds_without_payload_is_not_signed_and_asked_for_once(
    station_log: Log, central_log: Log, make: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3, 3, 3])
    payload = list(station_log.read(stream_of()))[1].payload
    take(station_log, 2)
    sign(station_log)
    daemon = make(monotonic=count(0.0, 2.0).__next__)
    assert [daemon.step().did for _ in range(40)].count("countersigned") == 1
    assert held_of(station_log) == [("gate", 6, 9)]

    with station_log.transaction() as transaction:
        put_back(transaction, Position(2), payload)  # as from a backup: now it is nowhere else
    assert prune(station_log) == [True, True, False]

    (hollow,) = [each for each in central_log.read(stream_of(), with_hollow=True) if not each.has_payload]
    with central_log.transaction() as transaction:
        put_back(transaction, hollow.position, payload)
    append_points(station_log, stream_of(), [3])
    sign(station_log)
    did(daemon)
    assert ("gate", 0, 12) in held_of(station_log)
    assert prune(station_log) == [False] * 4


@pytest.mark.parametrize("is_sealed", [False, True])
def test_what_came_without_payload_later_or_is_sealed_is_not_signed_either(
    station_log: Log, central_log: Log, make: MakeDaemon, tmp_path: Path, is_sealed: bool
) -> None:
    append_points(station_log, stream_of(), [3, 3])
    sign(station_log)
    daemon = make(monotonic=count(0.0, 2.0).__next__)
    if not is_sealed:
        did(daemon)
        assert held_of(station_log) == [("gate", 0, 6)]
    append_points(station_log, stream_of(), [3, 3])
    take(station_log, next(reversed(list(station_log.read(stream_of())))).position - 1)
    sign(station_log)
    if is_sealed:
        make(central_key=None).catch_up()
        seal_all(central_log, tmp_path, file_bytes=1_000_000)
    did(daemon)
    assert ("gate", 9, 12) in held_of(station_log)


def test_a_head_that_central_holds_without_payload_is_not_signed(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3, 3])
    append_points(station_log, stream_of("yard"), [3])
    take(station_log, 2)
    sign(station_log)
    daemon = make(monotonic=count(0.0, 2.0).__next__)
    assert [daemon.step().did for _ in range(40)].count("countersigned") == 1
    assert held_of(station_log) == [("yard", 0, 3)]


def take(log: Log, position: int) -> None:
    """Take a payload off a station's disk."""
    with log.transaction() as transaction:
        assert take_off(transaction, [position]).segments == 1


def test_a_sealed_file_goes_when_what_lies_below_a_base_is_held_too(
    station_log: Log, make: MakeDaemon, tmp_path: Path
) -> None:
    append_points(station_log, stream_of(), [3, 30])
    seal_all(station_log, tmp_path, file_bytes=1_000_000)
    sign(station_log)
    make(plan=FROM_THE_SECOND, now=one_pm).catch_up()
    pruner = Pruner(station_log, BRNO, timedelta(0), lambda event: is_countersigned(event, CENTRAL_KEY.public))
    later = datetime.now(UTC) + timedelta(days=1)

    def pruned() -> list[bool]:
        while pruner.step(later):
            pass
        return [each.has_payload for each in station_log.read(stream_of(), with_hollow=True)]

    assert pruned() == [True, False]
    make(now=one_pm).catch_up()
    make(now=one_pm).catch_up()
    assert pruned() == [False, False]


def test_a_station_that_reads_no_bases_is_signed_what_central_holds_whole(
    station_log: Log, central_log: Log, make: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3, 3])
    append_points(station_log, stream_of("yard"), [3])
    sign(station_log)
    plan = Plan.of({"entries": [GATE_FROM_THE_SECOND, {"stream": "*/*/*"}]})
    make(plan=plan, now=one_pm, central_key=None).catch_up()

    whole = countersign(central_log, BRNO, ASKED, CENTRAL_KEY, NOON)
    assert [each.head.stream.source for each in held_in(whole.held)] == ["yard"]
    asked = CountersignRequest(epoch=1, checkpoint_sequence=1, reads_bases=True).encoded()
    both = countersign(central_log, BRNO, asked, CENTRAL_KEY, NOON)
    assert [(each.head.stream.source, each.after) for each in held_in(both.held)] == [("gate", 3), ("yard", 0)]


def test_what_is_signed_of_a_base_is_as_documented() -> None:
    head = StreamHead(stream_of(), 1, 6, b"h" * 32)
    said = countersigned_bytes("brno-2", 1, b"s" * 32, [Held(head, 3, b"a" * 32)], NOON, b"k" * 32)
    row = b"".join(
        [
            *(b"\0\6brno-2", b"\0\0\0\1", b"\0\4gate", b"\0\x0btrack_point", (6).to_bytes(8, "big"), b"h" * 32),
            *((3).to_bytes(8, "big"), b"a" * 32),
        ]
    )
    held = sha256(b"VIANHLD1\0\0\0\1" + row).digest()
    time = int(NOON.timestamp() * 1e6).to_bytes(8, "big")
    assert said == b"VIANCSG2\0\6brno-2" + (1).to_bytes(8, "big") + b"s" * 32 + held + time + b"k" * 32
    assert countersigned_bytes("brno-2", 1, b"s" * 32, [Held(head)], NOON, b"k" * 32).startswith(b"VIANCSG1")


@pytest.mark.parametrize("change", ["station", "held", "base", "statement_hash", "signature"])
def test_a_signature_is_over_all_that_the_event_says(change: str, station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    sign(station_log)
    make().catch_up()
    (event,) = given(station_log)
    changes: dict[str, dict[str, Any]] = {
        "station": {"of_station": "oslo-1"},
        "held": {"held": event.held.replace(",3,", ",4,")},
        "base": {"held": event.held.replace("]]", f',1,"{"00" * 32}"]]')},
        "statement_hash": {"statement_hash": "0" * 64},
        "signature": {"signature": bytes(64)},
    }
    changed = changes[change]

    assert is_countersigned(event, CENTRAL_KEY.public)
    assert not is_countersigned(event.model_copy(update=changed), CENTRAL_KEY.public)
    assert not is_countersigned(event, key_of("oslo-1").public)
    assert not is_countersigned(event.model_copy(update={"held": "[1]"}), CENTRAL_KEY.public)


def test_another_key_is_not_believed(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    sign(station_log)

    with pytest.raises(BadAnswer, match=r"is not that of its key .* Next: .* vian station enrol"):
        make(central_key=key_of("oslo-1").public).catch_up()
    assert given(station_log) == []


def test_without_central_key_nothing_is_asked(station_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    sign(station_log)

    assert "countersigned" not in did(make_daemon())


def test_what_central_does_not_hold_it_does_not_sign(station_log: Log, central_log: Log, make: MakeDaemon) -> None:
    with pytest.raises(Refusal) as raised:
        countersign(central_log, BRNO, ASKED, CENTRAL_KEY, NOON)
    assert (raised.value.code, raised.value.status) == ("not_held", 409)
    with pytest.raises(Refusal) as raised:
        countersign(central_log, BRNO, b"{}", CENTRAL_KEY, NOON)
    assert raised.value.code == "bad_request"

    append_points(station_log, stream_of(), [3, 3])
    sign(station_log)
    append_points(station_log, stream_of(), [2])
    make(central_key=None).catch_up()
    signed = countersign(central_log, BRNO, ASKED, CENTRAL_KEY, NOON)
    assert [(each.head.stream.source, each.head.sequence) for each in held_in(signed.held)] == [("gate", 6)]


def test_a_checkpoint_that_its_station_did_not_sign_is_refused(
    station_log: Log, central_log: Log, make: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3])
    sign(station_log)
    (segment,) = station_log.read(StreamName.of("brno-2", "log", CheckpointSigned.type_name))
    (event,) = events_of(decode(segment, station_log.catalogue))

    forged = event.model_copy(update={"signature": bytes(64)})
    draft = encode(segment.stream, batch_of([forged]), segment.header.producer)
    central_log.append([draft])

    with pytest.raises(Refusal) as raised:
        countersign(central_log, BRNO, ASKED, CENTRAL_KEY, NOON)
    assert raised.value.code == "bad_checkpoint"


def test_what_a_central_that_was_restored_lost_is_not_pruned_before_it_holds_it_again(
    station_log: Log, make: MakeDaemon, make_log: Callable[[], Log], serve: Serve
) -> None:
    append_points(station_log, stream_of(), [3, 2])
    sign(station_log)
    make().catch_up()
    restored = serve(central_app(make_log()))

    not_now = Plan.of({"entries": [{"stream": "*/gate/*", "send": False}, {"stream": "*/*/*"}]})
    make(address=restored, plan=not_now).catch_up()
    assert prune(station_log) == [True, True]

    daemon = make(address=restored)
    daemon.catch_up()
    assert daemon.status().countersigned is not None
    assert prune(station_log) == [False, False]


def test_what_leads_to_room_is_recorded_on_a_full_disk(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    station_log.room = Room(station_log._fetched, Path("/"), lambda _: 0)
    station_log.room.bytes_min = 1

    with pytest.raises(DiskNearlyFull):
        append_points(station_log, stream_of(), [3])
    sign(station_log)
    assert did(make()).count("countersigned") == 1
    assert len(given(station_log)) == 1


class Saturated:
    """A link on which a request with segments is answered once the next one is under way, or after a while."""

    def __init__(self, inner: Link) -> None:
        self._inner = inner
        self._sent = 0
        self._begun = threading.Condition()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def send(self, records: Sequence[Record], order: str = "", follows: str = "") -> SegmentsAnswer:
        answer = self._inner.send(records, order, follows)
        with self._begun:
            self._sent += 1
            mine = self._sent
            self._begun.notify_all()
            self._begun.wait_for(lambda: self._sent > mine, 0.5)
        return answer


def segments_before_signing(daemon: Daemon, log: Log, on_step: Callable[[], None] = lambda: None) -> int:
    """How many segments were sent between a checkpoint, made once all is under way, and its countersignature."""
    daemon._central = daemon._flights._link = Saturated(daemon._central)
    while daemon.step().did != "sent":
        on_step()
    sign(log)
    segments = 0
    while (step := daemon.step()).did != "countersigned":
        assert step.error is None
        assert step.did != "nothing"
        segments += step.segments
        on_step()
    return segments


def test_a_saturated_link_does_not_keep_central_from_signing(station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [10] * 100)
    append_points(station_log, stream_of("yard"), [1])
    alerts = [{"stream": each, "priority": "alerts"} for each in ("*/log/*", "*/yard/*")]
    daemon = make(
        plan=Plan.of({"entries": [*alerts, {"stream": "*/*/*", "order": "live"}]}), pace=Pace(1000, 1000, in_flight=2)
    )
    assert segments_before_signing(daemon, station_log) < 10
    assert daemon.status().countersigned == 1


def test_live_work_without_end_does_not_keep_central_from_signing(station_log: Log, make: MakeDaemon) -> None:
    alerts = [{"stream": each, "priority": "alerts"} for each in ("*/gate/*", "*/log/*")]
    plan = Plan.of({"entries": [*alerts, {"stream": "*/*/*"}]})
    append_points(station_log, stream_of(), [1])
    clock = count(0.0, 0.5)  # it looks at most once a second, and how much is sent meanwhile is the machine's matter
    daemon = make(plan=plan, pace=Pace(1000, 1000, in_flight=2), monotonic=clock.__next__)
    assert segments_before_signing(daemon, station_log, lambda: append_points(station_log, stream_of(), [1])) < 100
