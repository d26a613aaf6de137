"""Whatever happens between and at the two sides, in the end central holds what the station holds."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from store import Log, verify
from sync import Daemon, Pace, Step, SyncError
from tests.sync.conftest import (
    Faults,
    MakeDaemon,
    append_points,
    central_app,
    start_http,
    stored,
    stream_of,
)

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("fault", Faults.KINDS)
def test_each_fault_in_each_exchange_loses_and_doubles_nothing(
    fault: str, station_log: Log, central_log: Log, make_daemon: MakeDaemon, faults: Faults
) -> None:
    append_points(station_log, stream_of(), [20] * 8)
    daemon = make_daemon(pace=Pace(request_bytes=1500))
    number = 0
    while (step := daemon.step()).did != "nothing":
        assert step.did != "stopped"
        number += 1
        # Two faults, then two good steps: a request is hit, then the hello after it.
        faults.next, faults.where = fault if number % 4 < 2 else None, 0.37

    assert faults.injected >= 2
    assert stored(central_log) == stored(station_log)
    assert verify(central_log).is_sound


def test_two_daemons_of_one_station_do_no_harm(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [5] * 12)
    pair = [make_daemon(pace=Pace(request_bytes=600)) for _ in range(2)]

    for _ in range(20):
        for daemon in pair:
            assert daemon.step().error is None

    assert stored(central_log) == stored(station_log)


class Observed:
    """A daemon that runs in a thread; what it did can be waited for."""

    def __init__(self, daemon: Daemon) -> None:
        self.steps: list[Step] = []
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=daemon.run, args=(self._stop, self._told))

    def _told(self, step: Step) -> None:
        with self._changed:
            self.steps.append(step)
            self._changed.notify_all()

    def wait_for(self, is_seen: Callable[[list[Step]], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: is_seen(self.steps), timeout=60), "it did not come to pass"

    def __enter__(self) -> "Observed":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=60)
        assert not self._thread.is_alive()


def count(steps: list[Step], did: str) -> int:
    return sum(step.did == did for step in steps)


def test_a_running_daemon_wakes_when_the_log_grows(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [2])
    with Observed(make_daemon(pace=Pace(idle_s=3600))) as running:
        for round_ in range(1, 4):
            running.wait_for(lambda steps, n=round_: count(steps, "sent") >= n and steps[-1].did == "nothing")  # type: ignore[misc]
            append_points(station_log, stream_of(), [2])
        running.wait_for(lambda steps: count(steps, "sent") >= 4 and steps[-1].did == "nothing")
        idle = len(running.steps)

    assert idle < 30  # it slept, and did not look again and again
    assert stored(central_log) == stored(station_log)


def test_a_running_daemon_outlives_central(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [2])
    app = central_app(central_log)
    address, stop = start_http(app)
    port = int(address.rsplit(":", 1)[1])
    with Observed(make_daemon(address=address)) as running:
        running.wait_for(lambda steps: steps[-1:] != [] and steps[-1].did == "nothing")
        stop()
        append_points(station_log, stream_of(), [3])
        running.wait_for(lambda steps: count(steps, "failed") >= 3)
        assert all(isinstance(step.error, SyncError) for step in running.steps if step.did == "failed")
        _, stop = start_http(app, port)
        running.wait_for(lambda steps: steps[-1].did == "nothing")
        stop()

    assert stored(central_log) == stored(station_log)


def test_a_running_daemon_outlives_its_own_database(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [2])
    with Observed(make_daemon()) as running:
        running.wait_for(lambda steps: count(steps, "nothing") >= 1)
        with station_log.connection() as connection:
            connection.execute("reset role")
            connection.execute(
                "select pg_terminate_backend(pid, 10000) from pg_stat_activity "
                "where datname = current_database() and pid <> pg_backend_pid()"
            )
        before = len(running.steps)
        append_points(station_log, stream_of(), [3])
        running.wait_for(lambda steps: count(steps[before:], "sent") >= 1 and steps[-1].did == "nothing")

    assert stored(central_log) == stored(station_log)


@contextmanager
def process(module: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of the tests' own, killed at the end."""
    command = [sys.executable, "-m", module, *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


def read_line(running: subprocess.Popen[str]) -> str:
    assert running.stdout is not None
    return running.stdout.readline().strip()


@pytest.mark.slow
def test_central_killed_in_the_middle_and_started_again_gets_everything_once(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, stream_of(), [10] * 60)
    with process("tests.sync.central_process", central_log.dsn, "0") as first:
        port = read_line(first)
        pace = Pace(request_bytes=1000, backoff_s=0.01, backoff_s_max=0.05)
        with Observed(make_daemon(address=f"http://127.0.0.1:{port}", pace=pace)) as running:
            running.wait_for(lambda steps: count(steps, "sent") >= 5)
            first.kill()
            running.wait_for(lambda steps: count(steps, "failed") >= 1)
            assert central_log.stream_head(stream_of()).sequence < 600
            with process("tests.sync.central_process", central_log.dsn, port) as second:
                read_line(second)
                running.wait_for(lambda steps: steps[-1].did == "nothing")

    assert stored(central_log) == stored(station_log)
    assert verify(central_log).is_sound


@pytest.mark.slow
def test_a_station_killed_in_the_middle_and_started_again_sends_everything_once(
    station_log: Log, central_log: Log, central: str
) -> None:
    append_points(station_log, stream_of(), [10] * 60)
    sends = 5
    with process("tests.sync.station_process", station_log.dsn, central) as running:
        while sends:
            sends -= read_line(running) == "sent"
        running.kill()
    assert 0 < central_log.stream_head(stream_of()).sequence < 600
    with process("tests.sync.station_process", station_log.dsn, central) as running:
        while read_line(running) != "nothing":
            pass

    assert stored(central_log) == stored(station_log)
    assert verify(central_log).is_sound
