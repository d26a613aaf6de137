"""What an append and a catch-up cost as the log grows, and how much memory they take.

    python -m benchmarks.growth [--quick] [--folder DIR] [--results FILE] [--plot FILE]

The log is filled to each size; there a fixed number of events is appended and read back, several times.
What is quoted is the median cost an event. A log that knows its length must not pay for it.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

from benchmarks.measuring import keep
from benchmarks.points import PRODUCER, points, stream
from events import decode, encode
from store import Log, SharedAppender, open_log

_PROBES = 7
_PROBE_SEGMENTS = 40
_PROBE_EVENTS = 1000
_FILL_EVENTS = 10_000


@dataclass(frozen=True, slots=True)
class Point:
    """Costs at one length of the log."""

    events: int
    append_us: float
    """an event appended, 1,000 a segment and commit, µs"""
    read_us: float
    """an event caught up with, from PostgreSQL to Arrow, µs"""
    memory_mb: float
    """this process's own memory, MB"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, keep and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="up to a million events")
    parser.add_argument("--folder", type=Path, help="where the database lives, on a real disk")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/growth.json"))
    parser.add_argument("--plot", type=Path, help="draw the costs into this SVG file")
    options = parser.parse_args(arguments)
    sizes = [10_000, 100_000, 1_000_000, *([] if options.quick else [10_000_000, 50_000_000])]
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        Path(folder).chmod(0o755)
        with open_log(data_dir=Path(folder) / "log") as log:
            found = [_at(log, size) for size in sizes]
    keep(options.results, is_quick=options.quick, points=[asdict(each) for each in found])
    if options.plot:
        _draw(found, options.plot)


def _at(log: Log, size: int) -> Point:
    _fill(log, size)
    appends, reads = [], []
    for _ in range(_PROBES):
        first = log.head() + 1
        began = time.perf_counter()
        for number in range(_PROBE_SEGMENTS):
            log.append([encode(stream(number), points(_PROBE_EVENTS, number % 20), PRODUCER)])
        appended = time.perf_counter()
        events = sum(len(decode(segment, log.catalogue)) for segment in log.read_all(first))
        reads.append((time.perf_counter() - appended) / events * 1e6)
        appends.append((appended - began) / events * 1e6)
    memory = psutil.Process().memory_info().rss / 2**20
    point = Point(size, statistics.median(appends), statistics.median(reads), memory)
    print(
        f"{size:>12,} events: append {point.append_us:.2f} µs, read {point.read_us:.3f} µs an event, {memory:.0f} MB",
        flush=True,
    )
    return point


def _fill(log: Log, size: int) -> None:
    missing = size - sum(head.sequence for head in log.streams())
    with SharedAppender(log) as appender:
        for number in range(max(0, missing // _FILL_EVENTS)):
            appender.submit(stream(number), points(_FILL_EVENTS, number % 20), PRODUCER)


def _draw(found: Sequence[Point], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    cost, memory = figure.subplots(1, 2)
    sizes = [point.events for point in found]
    cost.loglog(sizes, [point.append_us for point in found], marker="o", label="append, 1,000 a commit")
    cost.loglog(sizes, [point.read_us for point in found], marker="s", label="catch-up read")
    cost.set(xlabel="events in the log", ylabel="µs an event", ylim=(0.01, 10), title="cost an event")
    cost.legend(frameon=False)
    memory.semilogx(sizes, [point.memory_mb for point in found], marker="o")
    memory.set(xlabel="events in the log", ylabel="MB", ylim=(0, 400), title="memory of the process")
    for each in (cost, memory):
        each.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
