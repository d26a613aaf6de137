import hashlib
import json
import threading

import pytest

from events import Draft, StreamName, SyncPlanned, decode, events_of
from store import Log
from sync import (
    Daemon,
    Limits,
    Pace,
    Plan,
    PlanError,
    SegmentRefused,
)
from sync.station.bell import Bell
from sync.station.outbox import READERS_MAX
from tests.sync.conftest import (
    BRNO,
    EVERYTHING,
    NOON,
    PRODUCER,
    Faults,
    MakeDaemon,
    Serve,
    append_points,
    central_app,
    heads,
    stored,
    stream_of,
)

PLANNED = StreamName.of("brno-2", "sync", "sync_planned")


def steps(daemon: Daemon, count: int) -> list[str]:
    return [daemon.step().did for _ in range(count)]


def plans(log: Log) -> list[SyncPlanned]:
    return [event for s in log.read(PLANNED) for event in events_of(decode(s, log.catalogue))]  # type: ignore[misc]


def test_a_daemon_logs_its_plan_says_hello_sends_and_rests(station_log: Log, central_log: Log, daemon: Daemon) -> None:
    append_points(station_log, stream_of(), [3, 1, 5])

    assert steps(daemon, 5) == ["planned", "hello", "sent", "nothing", "nothing"]
    assert heads(central_log) == heads(station_log)
    assert stored(central_log) == stored(station_log)


def test_what_a_step_sent_is_counted(station_log: Log, daemon: Daemon) -> None:
    append_points(station_log, stream_of(), [3, 1, 5])
    steps(daemon, 2)

    step = daemon.step()

    assert (step.segments, step.events) == (4, 10)  # the plan's own event is one of them
    assert step.bytes > 0


def test_an_idle_daemon_sends_nothing(daemon: Daemon, faults: Faults) -> None:
    daemon.catch_up()
    exchanges = len(faults.exchanges)

    step = daemon.step()

    assert (step.did, step.sleep_s) == ("nothing", Pace().idle_s)
    assert len(faults.exchanges) == exchanges


@pytest.mark.parametrize("protocol, wanted", [(2, ["sent", "nothing"]), (1, ["hello", "sent", "nothing"])])
def test_a_new_stream_is_asked_for_where_hello_tells_of_named_streams_only(
    protocol: int, wanted: list[str], station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    daemon = make_daemon(protocol=protocol)
    daemon.catch_up()
    append_points(station_log, stream_of("yard"), [2])

    assert steps(daemon, len(wanted)) == wanted
    assert stored(central_log) == stored(station_log)


def test_a_plan_is_logged_once_for_each_change(station_log: Log, make_daemon: MakeDaemon) -> None:
    other = Plan.of({"entries": [{"stream": "*/*/track_point"}]})
    for plan in (EVERYTHING, EVERYTHING, other, other, EVERYTHING):
        make_daemon(plan=plan).step()

    assert [event.plan_hash for event in plans(station_log)] == [
        EVERYTHING.plan_hash.hex(),
        other.plan_hash.hex(),
        EVERYTHING.plan_hash.hex(),
    ]
    assert json.loads(plans(station_log)[0].plan) == {
        "entries": [{"from": "beginning", "priority": 30, "stream": "*/*/*"}]
    }


def test_a_plan_event_that_does_not_read_is_told_and_nothing_is_sent(station_log: Log, make_daemon: MakeDaemon) -> None:
    payload = b"of a newer ViAn"
    station_log.append([Draft(PLANNED, 1, 99, NOON, NOON, PRODUCER, payload, hashlib.sha256(payload).digest())])

    step = make_daemon().step()

    assert isinstance(step.error, PlanError)
    assert "does not read here" in str(step.error)
    assert station_log.stream_head(PLANNED).sequence == 1


def test_more_streams_than_a_hello_can_name_are_told(
    station_log: Log, make_daemon: MakeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    append_points(station_log, stream_of(), [1])
    monkeypatch.setattr("sync.station.standing.STREAMS_MAX", 1)

    with pytest.raises(PlanError, match=r"the plan names 2 streams of this station, at most 1 can be sent"):
        make_daemon().catch_up()


def test_the_bell_rings_for_what_came_since_the_log_was_looked_at(station_log: Log) -> None:
    bell, never = Bell(station_log, BRNO), threading.Event()
    looked_at = station_log.head()
    append_points(station_log, stream_of(), [1])
    assert bell.wait(looked_at, 3600, never), "nothing between looking and sleeping is missed"
    looked_at = station_log.head()
    assert not bell.wait(looked_at, 0, never)
    stop = threading.Event()
    stop.set()
    assert not bell.wait(looked_at, 3600, stop)
    bell.close()


def test_the_bell_of_a_log_that_is_away_does_not_hold_the_daemon_up(station_log: Log) -> None:
    bell, never = Bell(station_log, BRNO), threading.Event()
    station_log.close()
    assert not bell.wait(0, 3600, never)
    assert not bell.wait(0, 3600, never)
    bell.close()


def test_the_logged_address_of_central_has_no_password(station_log: Log, make_daemon: MakeDaemon) -> None:
    make_daemon(address="http://user:secret@central.example:8470/vian").step()

    assert plans(station_log)[0].central == "http://central.example:8470/vian"


def test_a_plan_that_another_daemon_logs_at_the_same_moment_is_looked_at_again(
    station_log: Log, make_daemon: MakeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, head = make_daemon(), station_log.stream_head(PLANNED)
    make_daemon(plan=Plan.of({"entries": [{"stream": "*/*/track_point"}]})).step()
    with monkeypatch.context() as patch:
        patch.setattr(station_log, "stream_head", lambda _: head)
        assert daemon.step().did == "planned"

    assert steps(daemon, 2) == ["planned", "hello"]
    assert [event.plan_hash for event in plans(station_log)][1:] == [EVERYTHING.plan_hash.hex()]


def test_a_plan_without_a_pattern_for_the_station_is_refused(make_daemon: MakeDaemon) -> None:
    with pytest.raises(PlanError, match=r"the plan names no stream of station brno-2"):
        make_daemon(plan=Plan.of({"entries": [{"stream": "oslo-1/*/*"}]}))


def test_streams_outside_the_plan_and_of_other_stations_stay(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of("gate"), [1])
    append_points(station_log, stream_of("yard"), [1])
    append_points(station_log, stream_of("gate", "oslo-1"), [1])

    make_daemon(plan=Plan.of({"entries": [{"stream": "*/gate/*"}]})).catch_up()

    assert list(stored(central_log)) == ["brno-2/gate/track_point"]


def test_the_smaller_priority_goes_first_and_requests_are_bounded(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of("a"), [50] * 6)
    append_points(station_log, stream_of("b"), [50] * 2)
    plan = Plan.of({"entries": [{"stream": "*/b/*", "priority": "alerts"}, {"stream": "*/a/*"}]})
    daemon = make_daemon(plan=plan, pace=Pace(request_bytes=3000))
    steps(daemon, 2)

    sent = [daemon.step() for _ in range(5)]

    assert all(step.bytes <= 3000 and step.segments for step in sent if step.did == "sent")
    order = [str(s.stream) for s in central_log.read_all(stations=[BRNO])]
    assert order == ["brno-2/b/track_point"] * 2 + ["brno-2/a/track_point"] * 6


def test_what_comes_in_a_better_lane_overtakes_a_backlog(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of("a"), [50] * 10)
    append_points(station_log, stream_of("b"), [1])
    plan = Plan.of({"entries": [{"stream": "*/b/*", "priority": "alerts"}, {"stream": "*/a/*"}]})
    daemon = make_daemon(plan=plan, pace=Pace(request_bytes=3000))
    steps(daemon, 4)
    append_points(station_log, stream_of("b"), [1])

    daemon.step()

    newest = [str(s.stream) for s in central_log.read_all()]
    assert newest.count("brno-2/b/track_point") == 2
    assert newest.count("brno-2/a/track_point") < 10
    daemon.catch_up()
    assert stored(central_log)["brno-2/a/track_point"] == stored(station_log)["brno-2/a/track_point"]


def test_streams_of_one_lane_take_turns(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    sources = [f"cam-{n}" for n in range(READERS_MAX + 2)]
    for source in sources:
        append_points(station_log, stream_of(source), [10, 10, 10])
    daemon = make_daemon(pace=Pace(request_bytes=1))
    steps(daemon, 2)
    while len(central_log.streams()) <= len(sources):
        daemon.step()

    assert {head.sequence for head in central_log.streams()} <= {1, 10}
    daemon.catch_up()
    assert stored(central_log) == stored(station_log)


def test_a_segment_larger_than_a_request_goes_alone(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [1, 200, 1])
    daemon = make_daemon(pace=Pace(request_bytes=400), plan=Plan.of({"entries": [{"stream": "*/gate/*"}]}))
    steps(daemon, 2)

    assert [daemon.step().segments for _ in range(3)] == [1, 1, 1]
    assert stored(central_log)["brno-2/gate/track_point"] == stored(station_log)["brno-2/gate/track_point"]


def test_a_segment_that_central_can_never_take_stops_its_stream_only(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, serve: Serve
) -> None:
    append_points(station_log, stream_of("big"), [500])
    append_points(station_log, stream_of("small"), [1])
    daemon = make_daemon(address=serve(central_app(central_log, limits=Limits(body_bytes_max=1000))))
    assert steps(daemon, 4) == ["planned", "hello", "doubted", "hello"]

    stopped = daemon.step()

    assert stopped.did == "stopped"
    assert isinstance(stopped.error, SegmentRefused)
    assert "central takes at most 1000" in str(stopped.error)
    daemon.catch_up()
    assert set(stored(central_log)) == {"brno-2/small/track_point", "brno-2/sync/sync_planned"}
    status = {s.stream.source: s for s in daemon.status().streams}
    assert "brno-2/big/track_point" in (status["big"].error or "")
    assert status["small"].error is None


def test_status_tells_here_central_and_backlog(station_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [4])
    daemon = make_daemon(plan=Plan.of({"entries": [{"stream": "*/gate/*", "priority": 7}]}))

    before = daemon.status()
    assert [(s.sequence, s.cursor, s.backlog, s.priority) for s in before.streams] == [(4, None, None, 7)]
    assert (before.last_contact, before.clock_offset_s) == (None, None)

    daemon.catch_up()
    append_points(station_log, stream_of(), [6])
    after = daemon.status()

    assert [(str(s.stream), s.sequence, s.cursor, s.backlog) for s in after.streams] == [
        ("brno-2/gate/track_point", 10, 4, 6)
    ]
    assert (after.station, after.last_contact, after.clock_offset_s) == (BRNO, NOON, 3.0)
