"""The pattern engine in process, from Arrow batches in order of arrival to situations.

    python -m benchmarks.patterns [--quick] [--flink] [--results FILE]

- rules: events per CPU-second of this process, medians of several runs after one that warms up; wall clock
  beside it. Of each situation its end is read, which is all that Flink's job writes;
- line crossing by the rule and by DuckDB's window functions, in turns;
- hard patterns: how long, and how that grows with the rows;
- single figures: state, starting, reloading, small steps.

With `--flink` Flink runs the same rows in the same run, see `benchmarks.flink`; that takes a quarter of an hour more.
"""

import argparse
import gc
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa

from benchmarks import flink
from benchmarks.measuring import keep
from benchmarks.pattern_costs import beside_duckdb, bound, costs, run, worst_cases
from benchmarks.pattern_rows import RULES, rows, zone_rules
from patterns import BoundRule, RuleSetRun
from patterns.engine.compiling import compile_kernel

__all__ = ["RULES", "Measured", "main", "measured", "rows", "run_all"]


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
    parser.add_argument("--flink", action="store_true", help="Flink on the same rows, in the same run")
    options = parser.parse_args(arguments)
    quick = options.quick
    compile_kernel()
    found = []
    for each in run_all(is_quick=quick):
        print(
            f"{each.what:20} {each.keys:>9,} keys {each.events:>10,} events {each.matches:>7,} matches "
            f"{each.events_per_cpu_s / 1e6:7.2f} M/CPU-s {each.events_per_wall_s / 1e6:7.2f} M/s",
            flush=True,
        )
        found.append(each)
    one, many = found[-2:]
    print(f"100 zone rules cost {one.events_per_cpu_s / many.events_per_cpu_s:.1f} times what one costs")
    duckdb = beside_duckdb(events=300_000 if quick else 3_000_000, rounds=3 if quick else 5)
    print(f"{duckdb.what}: {duckdb.ours:,.0f}, {duckdb.reference_name} {duckdb.reference:,.0f}: {duckdb.ratio:.2f}")
    hard = []
    for worst in worst_cases(count=100_000 if quick else 1_000_000):
        print(
            f"{worst.what}, as a {worst.way}, {worst.rows:,} rows: {worst.error or ''}{worst.seconds:.2f} s, "
            f"growth {worst.growth:.2f}, {worst.matches:,} matches",
            flush=True,
        )
        hard.append(worst)
    single = costs(is_quick=quick)
    print(json.dumps(asdict(single), indent=1))
    keep(
        options.results,
        is_quick=quick,
        in_process=[asdict(each) for each in found],
        duckdb=duckdb.plain(),
        worst_cases=[asdict(each) for each in hard],
        costs=asdict(single),
    )
    if options.flink:
        flink.main(["--quick"] if quick else [])


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
    took = [timed(lambda: run(RuleSetRun(bounds), table)) for _ in range(runs + 1)][1:]
    cpu_s, wall_s, matches = (statistics.median(side) for side in zip(*took, strict=True))
    return Measured(what, keys, table.num_rows, int(matches), table.num_rows / cpu_s, table.num_rows / wall_s)


def timed(work: Callable[[], int]) -> tuple[float, float, int]:
    """CPU seconds of this process, seconds of the clock on the wall, and what the work returned."""
    gc.collect()
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return time.process_time() - cpu, time.perf_counter() - wall, result


if __name__ == "__main__":
    main()
