"""A hundred stations against one central, beside one station with as much to send.

Contract: the stations' daemons are tasks of a few processes, each with connections and a right of its own; those of a
process share a log. Before the clock starts each has sent a little, so that its connections are open and it has
learnt how much goes into a request; then all begin at once, with as many segments of as many cameras each. Central is
`vian serve` with a log of its own.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.link import Link, fast_link, inside
from benchmarks.measuring import Figure, Row
from benchmarks.sync_drain import SEGMENT_EVENTS, backlog, tuned_log, wait_until
from benchmarks.sync_servers import Cost, Program, central_server, enrol, postgres_memory_bytes
from store import Log
from store.projector import NAME as PROJECTOR

STATIONS = 100
_PROCESSES = 2
_CAMERAS = 5
"""of each station"""
_WARMING_SEGMENTS = 40
"""that each station sends before"""
_MB = 2**20
_LOOK_SECONDS = 0.5


@dataclass(frozen=True, slots=True)
class _Run:
    """What one round came to."""

    events_per_s: float
    fairness: float
    """when the first station was done, of when the last was"""
    memory_bytes: int
    postgres_bytes: int
    """when all had come: to look at it takes long"""
    central: Cost
    stations_s: float
    """CPU seconds of the stations' programs"""


def many(folder: Path, rounds: int, segments: int) -> Iterator[Row | Figure]:
    """Throughput of a hundred stations beside one's; central's memory; fairness."""
    names = [f"station-{number:03}" for number in range(STATIONS)]
    with ExitStack() as stack:
        link = stack.enter_context(fast_link(whole_packets=True))
        central = stack.enter_context(tuned_log(folder / "central"))
        logs = [stack.enter_context(tuned_log(folder / log_name(number))) for number in range(_PROCESSES)]
        enrol(folder, ["alone", *names])
        server = stack.enter_context(central_server(link, folder))
        runs = list[tuple[_Run, _Run]]()
        for number in range(rounds + 1):
            one = _run(link, folder, (central, server), [(logs[0], ["alone"])], number, segments)
            groups = [(log, names[first::_PROCESSES]) for first, log in enumerate(logs)]
            runs.append((_run(link, folder, (central, server), groups, number, segments // STATIONS), one))
    runs = runs[1:]  # in the first one everything is new
    pairs = [(all_of_them.events_per_s, one.events_per_s) for all_of_them, one in runs]
    ours, reference = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratio = statistics.median(mine / other for mine, other in pairs)
    yield Row(f"{STATIONS} stations, one central, in all", "events/s", ours, reference, "one station", ratio, 1.0)
    crowds = [all_of_them for all_of_them, _ in runs]
    memory, postgres = (max(each) for each in zip(*((r.memory_bytes, r.postgres_bytes) for r in crowds), strict=True))
    yield Figure(f"memory of central, {STATIONS} stations", "MB", memory / _MB, 500.0, at_least=False)
    yield Figure("the same with its PostgreSQL", "MB", (memory + postgres) / _MB)
    fairness = statistics.median(each.fairness for each in crowds)
    yield Figure("time of the first station that was done, of the last one's", "", fairness)
    for what, cost_s in _COSTS.items():
        many_s, one_s = (statistics.median(cost_s(pair[side]) for pair in runs) for side in (0, 1))
        yield Row(f"{what}, {STATIONS} stations", "s", many_s, one_s, "one station", many_s / one_s, None)


Groups = Sequence[tuple[Log, Sequence[str]]]
"""The stations of each process, and the log that they share."""

_COSTS: dict[str, Callable[[_Run], float]] = {
    "CPU of central": lambda run: run.central.program_s,
    "CPU of central's PostgreSQL": lambda run: run.central.postgres_s,
    "CPU of the stations' programs": lambda run: run.stations_s,
}


def _run(link: Link, folder: Path, ends: tuple[Log, Program], groups: Groups, number: int, segments: int) -> _Run:
    """One round: so many segments of each station, all begun at once."""
    central, server = ends
    _fill(groups, 2 * number, _WARMING_SEGMENTS)
    stations = sum(len(names) for _, names in groups)
    with _ready(link, folder, groups) as (begin, cpu_s):
        _fill(groups, 2 * number + 1, segments)
        wait_until(lambda: central.checkpoint(PROJECTOR).position >= central.head())  # rows of what came before
        first, memory = central.head() + 1, _Memory(server)
        before, stations_before, began = server.cost(), cpu_s(), time.perf_counter()
        begin()
        wait_until(lambda: memory.is_looked_at() and central.head() >= first + stations * segments - 1, 0.02)
        seconds, cost, stations_s = time.perf_counter() - began, server.cost().since(before), cpu_s() - stations_before
    postgres_bytes = postgres_memory_bytes(folder / "central" / "pg")
    times = _times(central, first)
    events = stations * segments * SEGMENT_EVENTS
    fairness = min(times) / max(times)
    return _Run(events / seconds, fairness, memory.program, postgres_bytes, cost, stations_s)


def _fill(groups: Groups, number: int, segments: int) -> None:
    """Let so many segments wait at each station."""
    for log, names in groups:
        for name in names:
            log.append(backlog(number, segments, name, cameras=_CAMERAS))


class _Memory:
    """The most that central took whenever it was looked at."""

    def __init__(self, server: Program) -> None:
        self._server = server
        self._next = 0.0
        self.program = 0

    def is_looked_at(self) -> bool:
        """True; looks now and then."""
        if time.monotonic() > self._next:
            self.program = max(self.program, self._server.memory_bytes())
            self._next = time.monotonic() + _LOOK_SECONDS
        return True


def _times(central: Log, first: int) -> list[float]:
    """When each station's last segment came, in seconds from the first segment of all."""
    ends: dict[str, float] = {}
    began = None
    for segment in central.read_all(first, types=["track_point"]):
        at = segment.recorded_at.timestamp()
        began = at if began is None else began
        ends[segment.stream.station] = at - began
    return list(ends.values())


@contextmanager
def _ready(link: Link, folder: Path, groups: Groups) -> Iterator[tuple[Callable[[], None], Callable[[], float]]]:
    """The stations' daemons, ready to send; what lets them begin, and what tells their CPU seconds."""
    with ExitStack() as stack:
        processes = [
            stack.enter_context(_stations(link, folder, number, names)) for number, (_, names) in enumerate(groups)
        ]
        for process in processes:
            assert process.stdout is not None
            process.stdout.readline()
        yield lambda: _tell(processes), lambda: sum(map(_cpu_s, processes))
        _tell(processes)
        for process in processes:
            if process.wait():
                raise SystemExit(f"{process.args!r} ended with {process.returncode}")


@contextmanager
def _stations(link: Link, folder: Path, number: int, names: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "benchmarks.sync_stations", str(folder), log_name(number), *names]
    process = subprocess.Popen(inside(link.station, command), stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def log_name(number: int) -> str:
    """Folder of the log that the stations of that process share."""
    return f"station-{number}" if number else "station"


def _cpu_s(process: subprocess.Popen[bytes]) -> float:
    try:
        times = psutil.Process(process.pid).cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(times.user + times.system)


def _tell(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        assert process.stdin is not None
        process.stdin.write(b"go\n")
        process.stdin.flush()
