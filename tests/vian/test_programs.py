"""Whole programs, as a user runs them: processes, signals, pipes, HTTP over loopback, embedded servers."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from time import monotonic
from typing import Any

import httpx
import pytest

from store import Log, Subscription, open_log
from tests.conftest import MakeLog
from tests.vian.conftest import Run, command_line
from tests.vian.samples import GATE, START, append, heads, points
from tests.vian.test_rules import write_rule
from vian.demo.run import CENTRAL_DIR
from vian.extraction import Job, extract_motion, media_clock
from vian.stations import add_station

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

VIAN = (sys.executable, "-m", "vian")
SECONDS_MAX = 300.0
"""It ends what hangs, on a busy machine too."""
ROUNDS = int(os.environ.get("VIAN_KILL_ROUNDS", "1"))
"""Each kills a demo twice: at some moment, and at another while it goes on from there."""


@contextmanager
def running(*arguments: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A command in a process and a group of its own, which is gone when the block ends."""
    argv = [*VIAN, *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    # A suite that runs in the background of a shell ignores Ctrl-C, and so would its children.
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(argv, text=True, start_new_session=True, preexec_fn=heard, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def finished(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*VIAN, *map(str, arguments)], capture_output=True, text=True, timeout=SECONDS_MAX)


def line_of(stream: Any) -> str:
    """The next line of a process's output; the test's own timeout ends the wait."""
    line: str = stream.readline()
    assert line, "the process ended before it said anything"
    return line


# The demo: killed and interrupted at any moment.


class Stage:
    """Demos on one short clip, each in a folder of its own."""

    def __init__(self, folder: Path, clip: Path) -> None:
        self.folder = folder
        self.video = Path(shutil.copy(clip, folder / "crossing.mp4"))

    def arguments(self, name: str) -> list[object]:
        data_dir = self.folder / name
        return [
            "demo",
            "--video",
            self.video,
            "--data-dir",
            data_dir,
            "--report",
            self.folder / f"{name}.html",
            "--json",
        ]

    def streams(self, name: str) -> list[str]:
        """What `vian streams --json` says of both logs."""
        folders = [self.folder / name / part for part in (".", CENTRAL_DIR)]
        return [command_line("streams", "--json", "--data-dir", folder).out for folder in folders]

    def is_stopped(self, name: str) -> bool:
        """Whether neither embedded server runs any more."""
        return not list((self.folder / name).glob("**/postmaster.pid"))


@pytest.fixture(scope="module")
def stage(public_folder: Path, clip: Path) -> Iterator[Stage]:
    folder = public_folder / "demos"
    folder.mkdir()
    yield Stage(folder, clip)
    shutil.rmtree(folder)


class Undisturbed:
    """A demo that nothing disturbed: how long it took and what it left."""

    def __init__(self, stage: Stage) -> None:
        began = monotonic()
        done = finished(*stage.arguments("undisturbed"))
        self.seconds = monotonic() - began
        assert done.returncode == 0, done.stderr
        self.values: dict[str, Any] = json.loads(done.stdout)
        self._stage = stage

    @cached_property
    def streams(self) -> list[str]:
        """What `vian streams --json` says of both logs, asked in the first test that wants it."""
        return self._stage.streams("undisturbed")


@pytest.fixture(scope="module")
def undisturbed(stage: Stage) -> Undisturbed:
    return Undisturbed(stage)


def test_a_demo_leaves_two_sound_logs_and_no_server(stage: Stage, undisturbed: Undisturbed, run: Run) -> None:
    assert stage.is_stopped("undisturbed")
    assert undisturbed.values["sound"]
    station, central = undisturbed.streams
    own = [line for line in central.splitlines() if json.loads(line)["stream"].startswith("central/")]
    assert station.splitlines() == [line for line in central.splitlines() if line not in own]
    assert [json.loads(line)["stream"] for line in own] == ["central/sync/station_enrolled"]
    assert "demo/sync/sync_planned" in station
    data_dir = stage.folder / "undisturbed"
    assert run("verify", "--data-dir", data_dir).out.startswith(f"sound: {undisturbed.values['events']} events")
    asked = finished("psql", "--data-dir", data_dir, "--", "-Atc", "select count(*) from events")
    assert asked.stdout == f"{undisturbed.values['events']}\n"


@pytest.mark.parametrize("number", range(ROUNDS))
def test_a_demo_that_was_killed_ends_as_if_it_had_not(stage: Stage, undisturbed: Undisturbed, number: int) -> None:
    name = f"killed-{number}"
    shares = random.Random(number)
    for _ in range(2):
        moment = shares.uniform(0.1, 1.0) * undisturbed.seconds
        with running(*stage.arguments(name), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                process.wait(moment)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                assert process.wait() in (-signal.SIGKILL, 0)  # 0: it came to its end at that very moment
    assert_it_ends_as(undisturbed, stage, name)


def test_a_demo_that_was_interrupted_stops_its_servers_and_goes_on(stage: Stage, undisturbed: Undisturbed) -> None:
    name = "interrupted"
    with running(*stage.arguments(name)) as process:
        while "starting two PostgreSQL servers" not in line_of(process.stderr):
            pass
        try:
            process.wait(random.Random(1).uniform(0, 0.5) * undisturbed.seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the whole group
        _, told = process.communicate(timeout=SECONDS_MAX)
    assert process.returncode == 130, told
    assert "interrupted; what was stored stays, and the same command goes on" in told
    assert stage.is_stopped(name)
    assert_it_ends_as(undisturbed, stage, name)


def assert_it_ends_as(undisturbed: Undisturbed, stage: Stage, name: str) -> None:
    again = finished(*stage.arguments(name))
    assert again.returncode == 0, again.stderr
    assert stage.streams(name) == undisturbed.streams
    assert stage.is_stopped(name)
    values = json.loads(again.stdout)
    for key in ("frames", "events", "events_replicated", "situations", "bytes_per_event", "sound"):
        assert values[key] == undisturbed.values[key]
    shutil.rmtree(stage.folder / name)


def test_an_embedded_server_that_dies_in_the_middle_is_started_again(
    public_folder: Path, log: Log, clip: Path, decoded_once: None
) -> None:
    def kill_the_server(done: int, _: int | None) -> None:
        if done == 30:
            pid = int((public_folder / "dies" / "pg" / "postmaster.pid").read_text().split()[0])
            os.kill(pid, signal.SIGKILL)

    notes: list[str] = []
    job = Job(log=log, station="brno", source="gate", path=clip, started_at=START, stamp=media_clock)
    extract_motion(job)
    with open_log(data_dir=public_folder / "dies") as dying:
        values = {"on_progress": kill_the_server, "on_note": notes.append}
        extract_motion(Job(dying, "brno", "gate", clip, START, stamp=media_clock, **values))
        assert heads(dying) == heads(log)
    assert any(note.startswith("waiting: ") for note in notes)
    shutil.rmtree(public_folder / "dies")


# Pipes and signals.


def test_tail_follows_what_is_appended_until_it_is_interrupted(log: Log) -> None:
    append(log, points(3))
    with running("tail", "--follow", "-n", "1", "--json", "--dsn", log.dsn) as process:
        assert json.loads(line_of(process.stdout))["sequence"] == 3
        append(log, points(2, first_frame=3))
        assert [json.loads(line_of(process.stdout))["sequence"] for _ in range(2)] == [4, 5]
        process.send_signal(signal.SIGINT)
        out, told = process.communicate(timeout=SECONDS_MAX)
    assert (process.returncode, out) == (130, "")
    assert told.startswith("error: interrupted")


def test_a_service_is_ended_like_a_command_in_a_terminal(log: Log) -> None:
    append(log, points(1))
    with running("tail", "--follow", "--dsn", log.dsn) as process:
        line_of(process.stdout)
        process.terminate()
        assert process.wait(SECONDS_MAX) == 130


def test_a_reader_that_has_enough_is_no_error(log: Log) -> None:
    append(log, points(3000))
    with running("tail", "-n", "3000", "--dsn", log.dsn) as process:
        assert process.stdout is not None
        assert "track_point/1 " in process.stdout.readline()
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == ""
        assert process.wait(SECONDS_MAX) == 0


# Station and central.


@contextmanager
def server(role: str, log: Log, *options: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server with a port of its own; its process and its address."""
    with running("serve", "--role", role, "--dsn", log.dsn, "--json", *options, stderr=None) as process:
        said = json.loads(line_of(process.stdout))
        assert said["role"] == role
        yield process, said["address"]


@pytest.fixture
def token(tmp_path: Path) -> Path:
    """The token of station brno, which stands in `stations.toml`."""
    add_station(Path("stations.toml"), "brno", Path("brno.token"))
    return Path("brno.token")


def test_sync_replicates_to_a_central_server(make_log: MakeLog, token: Path) -> None:
    station, central = make_log(), make_log()
    append(station, points(500))
    with server("central", central, "--port", "0", "--stations-file", "stations.toml") as (process, address):
        done = finished("sync", "--once", "--dsn", station.dsn, "--station", "brno", "--central", address,
                        "--token-file", token, "--json")  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert heads(central) == heads(station)
        assert httpx.get(f"{address}/health").json()["position"] == central.head()
        process.terminate()
        assert process.wait(SECONDS_MAX) == 0


def test_a_station_that_serves_finds_situations_and_sends_them_when_central_is_there(
    make_log: MakeLog, token: Path, tmp_path: Path
) -> None:
    station, central = make_log(), make_log()
    rule = write_rule(tmp_path / "high.yaml")
    with server("central", central, "--port", "0", "--stations-file", "stations.toml") as (_, address):
        port = address.rsplit(":", 1)[1]
    options = ("--port", "0", "--station", "brno", "--rules", rule, "--central", address, "--token-file", token)
    with server("station", station, *options) as (process, _):
        append(station, points(2, x=9.0))
        append(station, points(1, first_frame=10, x=0.0))
        with Subscription(station, "tests", types=["situation_detected"]) as found:
            assert found.poll(timeout_s=SECONDS_MAX).segments
        with (
            server("central", central, "--port", port, "--stations-file", "stations.toml"),
            Subscription(central, "tests", types=["situation_detected"]) as arrived,
        ):
            (segment,) = arrived.poll(timeout_s=SECONDS_MAX).segments[:1]
            assert str(segment.stream) == str(GATE).replace("track_point", "situation_detected")
        process.terminate()
        assert process.wait(SECONDS_MAX) == 0
