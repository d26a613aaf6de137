"""The pattern engine in process, from Arrow batches in order of arrival to situations.

    python -m benchmarks.patterns [--quick] [--results FILE]

Events per CPU-second of this process, medians of several runs after one that warms up; wall clock beside it.
"""

import argparse
import gc
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa

from benchmarks.measuring import keep
from benchmarks.pattern_rows import RULES, rows, zone_rules
from events import load_catalogue
from patterns import BoundRule, RuleSetRun, bind, parse_rule
from patterns.processor import schemas

__all__ = ["RULES", "Measured", "main", "measured", "rows", "run_all"]

BATCH = 50_000
"""rows a push"""


@dataclass(frozen=True, slots=True)
class Measured:
    """What runs of one kind came to, medians."""

    what: str
    keys: int
    events: int
    matches: int
    events_per_cpu_s: float
    events_per_wall_s: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the rows, three runs")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/patterns.json"))
    options = parser.parse_args(arguments)
    found = []
    for each in run_all(is_quick=options.quick):
        print(
            f"{each.what:20} {each.keys:>9,} keys {each.events:>10,} events {each.matches:>7,} matches "
            f"{each.events_per_cpu_s / 1e6:7.2f} M/CPU-s {each.events_per_wall_s / 1e6:7.2f} M/s",
            flush=True,
        )
        found.append(each)
    keep(options.results, is_quick=options.quick, in_process=[asdict(each) for each in found])


def run_all(*, is_quick: bool) -> Iterator[Measured]:
    """Each rule at each number of keys, and many rules at once."""
    runs, events = (3, 300_000) if is_quick else (5, 3_000_000)
    for what, text in RULES.items():
        for keys in (100, 10_000, 1_000_000):
            yield measured(what, [bound(text)], rows(what, keys, events), keys, runs)
    many = [bound(text) for text in zone_rules(100)]
    table = rows("zone intrusion", 10_000, events)
    yield measured("one zone rule", many[:1], table, 10_000, runs)
    yield measured("100 zone rules", many, table, 10_000, runs)


def measured(what: str, bounds: Sequence[BoundRule], table: pa.Table, keys: int, runs: int) -> Measured:
    """The rules over the rows, several times."""
    batches = list(table.to_batches(max_chunksize=BATCH))
    costs = [timed(lambda: _matches(bounds, batches)) for _ in range(runs + 1)][1:]
    cpu_s, wall_s, matches = (statistics.median(side) for side in zip(*costs, strict=True))
    return Measured(what, keys, table.num_rows, int(matches), table.num_rows / cpu_s, table.num_rows / wall_s)


def timed(work: Callable[[], int]) -> tuple[float, float, int]:
    """CPU seconds of this process, seconds of the clock on the wall, and what the work returned."""
    gc.collect()
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return time.process_time() - cpu, time.perf_counter() - wall, result


def bound(text: str) -> BoundRule:
    """The rule of this file, bound to the catalogue."""
    return bind(parse_rule(text), schemas(load_catalogue()))


def _matches(bounds: Sequence[BoundRule], batches: Sequence[pa.RecordBatch]) -> int:
    group = RuleSetRun(bounds)
    steps = [group.push(batch) for batch in batches]
    steps.append(group.finish())
    if group.failures:
        raise RuntimeError(f"rules failed: {group.failures}")
    return sum(len(outcome.matches) for step in steps for outcome in step.values())


if __name__ == "__main__":
    main()
