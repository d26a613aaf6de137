"""What is new before what is old, from a time on, capped, paused, replanned: the daemon over real HTTP and logs."""

from datetime import datetime, timedelta

import pytest

from events import Run
from store import Log, verify
from sync import Daemon, Limits, Pace, Plan
from sync.plans.planning import set_plan
from sync.protocol.reports import saved_status
from tests.sync.conftest import (
    BRNO,
    EVERYTHING,
    NOON,
    Faults,
    MakeDaemon,
    Serve,
    append_points,
    central_app,
    heads,
    stored,
    stream_of,
)

ALERTS = Plan.of({"entries": [{"stream": "*/gate/*", "priority": "alerts"}, {"stream": "*/*/*"}]})
SMALL = Pace(request_bytes=3000, request_bytes_min=3000)


class Steady:
    """Seconds that pass when a test says so."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds


def steps(daemon: Daemon, count: int) -> list[str]:
    return [daemon.step().did for _ in range(count)]


def runs_of(log: Log, source: str = "gate") -> list[tuple[int, int]]:
    return [(run.after, run.sequence) for run in log.runs(stream_of(source), 1)]


def test_an_alert_goes_before_the_backlog_of_its_own_stream_and_the_gap_is_filled(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [50] * 20)
    daemon = make_daemon(plan=ALERTS, pace=SMALL)
    steps(daemon, 4)
    before = runs_of(central_log)
    append_points(station_log, stream_of(), [1])

    daemon.step()

    assert runs_of(central_log) == [*before, (1000, 1001)]
    append_points(station_log, stream_of(), [2])
    daemon.step()
    assert runs_of(central_log)[-1] == (1000, 1003)
    daemon.catch_up()
    assert runs_of(central_log) == [(0, 1003)]
    assert heads(central_log) == heads(station_log)
    assert stored(central_log) == stored(station_log)
    assert verify(central_log).is_sound


def test_a_daemon_that_is_started_again_fills_the_gaps_that_it_left(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [50] * 20)
    daemon = make_daemon(plan=ALERTS, pace=SMALL)
    steps(daemon, 3)
    append_points(station_log, stream_of(), [1])
    daemon.step()

    make_daemon(plan=ALERTS).catch_up()

    assert runs_of(central_log) == [(0, 1001)]


def test_protocol_1_sends_the_same_in_order(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [50] * 20)
    daemon = make_daemon(plan=ALERTS, pace=SMALL, protocol=1)
    steps(daemon, 3)
    append_points(station_log, stream_of(), [1])

    daemon.step()

    assert len(runs_of(central_log)) == 1
    daemon.catch_up()
    assert stored(central_log) == stored(station_log)


def since(time: datetime) -> Plan:
    return Plan.of({"entries": [{"stream": "*/gate/*", "from": time.isoformat()}]})


def test_from_a_time_on_the_segment_that_holds_it_is_the_first_and_an_earlier_one_fills_in(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [10] * 6)  # a point each millisecond from noon on

    later = NOON + timedelta(seconds=9)
    make_daemon(plan=since(NOON + timedelta(milliseconds=35)), now=lambda: later).catch_up()
    assert runs_of(central_log) == [(30, 60)]
    make_daemon(plan=since(NOON + timedelta(milliseconds=12)), now=lambda: later).catch_up()
    assert runs_of(central_log) == [(10, 60)]
    make_daemon(plan=since(NOON + timedelta(milliseconds=50)), now=lambda: later).catch_up()
    assert runs_of(central_log) == [(10, 60)]
    make_daemon(plan=Plan.of({"entries": [{"stream": "*/gate/*"}]})).catch_up()
    assert runs_of(central_log) == [(0, 60)]
    assert verify(central_log).is_sound


def test_what_comes_after_a_time_that_nothing_had_reached_is_sent(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [10, 10])
    daemon = make_daemon(plan=since(NOON + timedelta(milliseconds=25)), now=lambda: NOON + timedelta(seconds=9))
    daemon.catch_up()
    assert runs_of(central_log) == []
    append_points(station_log, stream_of(), [3, 10])

    daemon.catch_up()

    assert runs_of(central_log) == [(23, 33)]


def test_a_new_plan_is_taken_up_by_a_daemon_that_runs_and_pause_and_resume(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    append_points(station_log, stream_of("gate"), [10] * 3)
    append_points(station_log, stream_of("yard"), [10] * 3)
    daemon = make_daemon(plan=Plan.of({"entries": [{"stream": "*/gate/*"}]}), pace=Pace(request_bytes=1))
    steps(daemon, 3)

    set_plan(station_log, BRNO, Plan.of({"paused": True, "entries": [{"stream": "*/yard/*"}]}), "", NOON)
    assert steps(daemon, 2) == ["nothing", "nothing"]
    assert (saved_status(station_log) or daemon.status()).state == "paused"
    set_plan(station_log, BRNO, Plan.of({"paused": False, "entries": [{"stream": "*/yard/*"}]}), "", NOON)
    daemon.catch_up()

    assert [(run[0], run[1]) for run in runs_of(central_log, "yard")] == [(0, 30)]
    assert runs_of(central_log, "gate") == [(0, 10)]  # one segment was sent before it was not wanted any more


def test_a_cap_holds_the_daemon_back_for_as_long_as_it_says(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    clock = Steady()
    append_points(station_log, stream_of(), [5000] * 3)
    plan = Plan.of({"entries": [{"stream": "*/gate/*", "rate": "8 kbit/s"}]})
    daemon = make_daemon(plan=plan, monotonic=clock)
    assert steps(daemon, 3) == ["planned", "hello", "sent"]

    waiting = daemon.step()

    assert waiting.did == "nothing"
    assert 1 < waiting.sleep_s <= Pace().idle_s
    clock.seconds += 600
    assert daemon.step().did == "sent"


def test_a_station_keeps_to_the_cap_of_central(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, serve: Serve
) -> None:
    clock = Steady()
    append_points(station_log, stream_of(), [5000] * 3)
    address = serve(central_app(central_log, limits=Limits(bits_per_s_max=8000)))
    daemon = make_daemon(address=address, monotonic=clock, plan=Plan.of({"entries": [{"stream": "*/gate/*"}]}))
    begun, size = clock.seconds, 0

    while (step := daemon.step()).did != "nothing" or daemon.status().streams[0].backlog:
        size += step.bytes
        clock.seconds += step.sleep_s

    assert central_log.stream_head(stream_of()).sequence == 15000
    largest = size / 3 * 1.5
    assert size - largest <= 1000 * (clock.seconds - begun) + 1000


def test_an_idle_daemon_says_hello_now_and_then_and_names_nothing(
    station_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    clock = Steady()
    for n in range(30):
        append_points(station_log, stream_of(f"cam-{n}"), [1])
    daemon = make_daemon(monotonic=clock)
    daemon.catch_up()
    faults.exchanges.clear()
    assert daemon.step().did == "nothing"
    clock.seconds += Pace().hello_s

    assert steps(daemon, 2) == ["hello", "nothing"]
    assert faults.exchanges == ["challenge", "hello"]
    assert len(faults.bodies[-1]) < 400


def test_a_central_that_went_back_is_noticed_by_an_idle_daemon(
    station_log: Log, make_log: type[Log], make_daemon: MakeDaemon, serve: Serve
) -> None:
    clock, before, after = Steady(), make_log(), make_log()
    app = central_app(before)
    append_points(station_log, stream_of(), [2, 2])
    daemon = make_daemon(address=serve(lambda *call: app(*call)), monotonic=clock)
    daemon.catch_up()
    app = central_app(after)
    clock.seconds += Pace().hello_s

    daemon.catch_up()

    assert stored(after) == stored(station_log)


@pytest.mark.parametrize("slots", [2, 3])
def test_several_requests_under_way_lose_and_double_nothing(
    slots: int, station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of("gate"), [20] * 40)
    append_points(station_log, stream_of("yard"), [20] * 5)
    pace = Pace(request_bytes=2000, request_bytes_min=2000, in_flight=slots, backoff_s=0.001)

    events = make_daemon(pace=pace).catch_up()

    assert events == 901
    assert stored(central_log) == stored(station_log)
    assert runs_of(central_log) == [(0, 800)]


@pytest.mark.parametrize("fault", ["cut before the answer", "status 503", "truncated answer", "cut before sending"])
def test_several_requests_under_way_outlive_faults(
    fault: str, station_log: Log, central_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    append_points(station_log, stream_of("gate"), [20] * 30)
    pace = Pace(request_bytes=2000, request_bytes_min=2000, in_flight=2, backoff_s=0.001, backoff_s_max=0.01)
    daemon, failed = make_daemon(pace=pace), 0
    for number in range(2000):
        if number % 20 == 5:
            faults.next = fault
        step = daemon.step()
        failed += step.error is not None
        assert step.did != "stopped"
        if step.did == "nothing":
            break

    assert failed
    assert stored(central_log) == stored(station_log)


def test_chores_are_done_when_nothing_live_waits(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    class Chore:
        left = 3

        def step(self, now: datetime) -> bool:
            assert now == NOON
            self.left -= 1
            return self.left > 0

    append_points(station_log, stream_of(), [5000] * 4)
    chore = Chore()
    daemon = make_daemon(chores=[chore], pace=Pace(request_bytes=1, request_bytes_min=1))

    did = steps(daemon, 9)

    assert chore.left == 0
    assert did.count("chore") == 3
    assert did.index("sent") < 5  # in turn with backlog
    daemon.catch_up()
    assert stored(central_log) == stored(station_log)


def test_two_daemons_see_each_other(station_log: Log, make_daemon: MakeDaemon) -> None:
    pair = [make_daemon(seed=n) for n in range(2)]
    for daemon in pair:
        daemon.catch_up()
    append_points(station_log, stream_of(), [1])
    for daemon in pair:
        daemon.catch_up()

    status = saved_status(station_log)
    assert status is not None
    assert status.other_daemons == 1


def test_who_catches_up_waits_for_the_rate(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [50] * 20)
    clock = [0.0]

    def pause(seconds: float) -> None:
        clock[0] += max(seconds, 0.001)  # the last of a debt may be less than the clock can tell

    capped = Plan.of({"rate": "1 kbit/s", "entries": [{"stream": "*/*/*", "order": "oldest"}]})
    daemon = make_daemon(plan=capped, monotonic=lambda: clock[0], pace=Pace(request_bytes=8192, request_bytes_min=8192))
    daemon.catch_up(pause)

    assert stored(central_log) == stored(station_log)
    assert clock[0] > 0


def test_a_run_is_what_the_log_says() -> None:
    assert Run(0, bytes(32), 1, bytes(32)).events == 1
    assert EVERYTHING.entries[0].order == "oldest"
