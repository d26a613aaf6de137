"""Central countersigns what it holds; the station believes its signature only, and asks for nothing new twice."""

import threading
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from events import CheckpointCountersigned, CheckpointSigned, StreamName, batch_of, decode, encode, events_of
from store import DiskNearlyFull, Log, Signer
from store.room import Room
from sync import BadAnswer, Daemon, Pace, Plan, Refusal
from sync.keeping.countersigning import countersign, heads_in, is_countersigned
from sync.keeping.pruning import Pruner
from sync.protocol.wire import CountersignRequest, Record, SegmentsAnswer
from sync.station.client import Link
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
    assert {str(head.stream): head.sequence for head in heads_in(event.held)} == {"brno-2/gate/track_point": 5}
    assert daemon.status().countersigned == 1


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
    assert [head.stream.source for head in heads_in(event.held)] == ["gate"]
    sign(station_log)
    did(daemon)
    assert did(daemon) == ["nothing"]


def test_what_is_held_from_a_time_on_only_is_not_countersigned(
    station_log: Log, central_log: Log, make: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [3, 3])
    sign(station_log)
    entries = [{"stream": "*/gate/*", "from": "2026-05-01T12:00:00.004Z"}, {"stream": "*/log/*"}]
    daemon = make(plan=Plan.of({"entries": entries}), now=lambda: NOON.replace(hour=13))
    daemon.catch_up()

    assert [(run.after, run.sequence) for run in central_log.runs(stream_of(), 1)] == [(3, 6)]
    assert given(station_log) == []


@pytest.mark.parametrize("change", ["station", "held", "statement_hash", "signature"])
def test_a_signature_is_over_all_that_the_event_says(change: str, station_log: Log, make: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    sign(station_log)
    make().catch_up()
    (event,) = given(station_log)
    changed = {
        "station": {"of_station": "oslo-1"},
        "held": {"held": event.held.replace(",3,", ",4,")},
        "statement_hash": {"statement_hash": "0" * 64},
        "signature": {"signature": bytes(64)},
    }[change]

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
    assert [(head.stream.source, head.sequence) for head in heads_in(signed.held)] == [("gate", 6)]


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

    def prune() -> list[bool]:
        pruner = Pruner(station_log, BRNO, timedelta(0), lambda event: is_countersigned(event, CENTRAL_KEY.public))
        while pruner.step(datetime.now(UTC) + timedelta(days=1)):
            pass
        return [each.has_payload for each in station_log.read(stream_of(), with_hollow=True)]

    not_now = Plan.of({"entries": [{"stream": "*/gate/*", "send": False}, {"stream": "*/*/*"}]})
    make(address=restored, plan=not_now).catch_up()
    assert prune() == [True, True]

    daemon = make(address=restored)
    daemon.catch_up()
    assert daemon.status().countersigned is not None
    assert prune() == [False, False]


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
    plan = Plan.of({"entries": [{"stream": "*/gate/*", "priority": "alerts"}, {"stream": "*/*/*"}]})
    append_points(station_log, stream_of(), [1])
    daemon = make(plan=plan, pace=Pace(1000, 1000, in_flight=2))
    assert segments_before_signing(daemon, station_log, lambda: append_points(station_log, stream_of(), [1])) < 100
