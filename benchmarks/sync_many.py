"""A hundred stations against one central, beside one station with as much to send.

Contract: the stations' daemons are tasks of one process, each with connections and a right of its own; their logs
share a database. All begin at once, with as many segments each. Central is `vian serve` with a log of its own.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.link import Link, fast_link, inside
from benchmarks.measuring import Figure, Row
from benchmarks.sync_drain import SEGMENT_EVENTS, backlog, tuned_log, wait_until
from benchmarks.sync_servers import Program, central_server, enrol, postgres_memory_bytes
from store import Log

STATIONS = 100
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


def many(folder: Path, rounds: int, segments: int) -> Iterator[Row | Figure]:
    """Throughput of a hundred stations beside one's; central's memory; fairness."""
    names = [f"station-{number:03}" for number in range(STATIONS)]
    with ExitStack() as stack:
        link = stack.enter_context(fast_link(whole_packets=True))
        station, central = (stack.enter_context(tuned_log(folder / name)) for name in ("station", "central"))
        enrol(folder, ["alone", *names])
        server = stack.enter_context(central_server(link, folder))
        runs = []
        for number in range(rounds):
            one = _run(link, folder, (station, central, server), ["alone"], number, segments)
            runs.append((_run(link, folder, (station, central, server), names, number, segments // STATIONS), one))
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


def _run(
    link: Link, folder: Path, ends: tuple[Log, Log, Program], names: Sequence[str], number: int, segments: int
) -> _Run:
    """One round: so many segments of each station, all begun at once."""
    station, central, server = ends
    for name in names:
        station.append(backlog(number, segments, name))
    with _ready(link, folder, names) as begin:
        first, memory = central.head() + 1, _Memory(server, folder / "central" / "pg")
        began = time.perf_counter()
        begin()
        wait_until(lambda: memory.is_looked_at() and central.head() >= first + len(names) * segments - 1)
        seconds = time.perf_counter() - began
    times = _times(central, first)
    events = len(names) * segments * SEGMENT_EVENTS
    return _Run(events / seconds, min(times) / max(times), memory.program, memory.postgres)


class _Memory:
    """The most that central took whenever it was looked at."""

    def __init__(self, server: Program, pgdata: Path) -> None:
        self._server, self._pgdata = server, pgdata
        self._next = 0.0
        self.program, self.postgres = 0, 0

    def is_looked_at(self) -> bool:
        """True; looks now and then."""
        if time.monotonic() > self._next:
            self.program = max(self.program, self._server.memory_bytes())
            self.postgres = max(self.postgres, postgres_memory_bytes(self._pgdata))
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
def _ready(link: Link, folder: Path, names: Sequence[str]) -> Iterator[Callable[[], None]]:
    """The stations' daemons, ready to send; what lets them begin."""
    command = inside(link.station, [sys.executable, "-m", "benchmarks.sync_stations", str(folder), *names])
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdout.readline()
    try:
        yield lambda: _tell(process)
        if process.wait():
            raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    finally:
        process.kill()


def _tell(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin is not None
    process.stdin.write(b"go\n")
    process.stdin.flush()
