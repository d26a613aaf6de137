"""The reference of the pattern engine: Apache Flink 2.3 on the same rules and rows, bounded input, warmed up.

    python -m benchmarks.flink [--quick] [--results FILE]

Each rule runs as the script that `vian rules flink` prints, in its simplest form, over a CSV file in order of
arrival, on a local cluster with one slot. Events per CPU-second of the Java process, medians of five runs after
three that warm up, and without what a job costs that has no rows at all: planning and starting. `pass-through`
is what reading alone comes to. Needs `make flink`.
"""

import argparse
import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv

from benchmarks.measuring import keep
from benchmarks.pattern_rows import LATENESS_US, RULES, rows
from events import load_catalogue
from patterns import parse_rule
from patterns.flink import Options, translate
from patterns.processor import schemas

PYTHON = Path(".flink/bin/python")
KEYS = (100, 10_000)
_COLUMNS = {
    "track_point": {"source": "STRING", "sequence": "BIGINT", "track_id": "BIGINT", "x": "DOUBLE", "y": "DOUBLE"},
    "plate_read": {"source": "STRING", "sequence": "BIGINT", "plate": "STRING"},
}


@dataclass(frozen=True, slots=True)
class Measured:
    """What Flink's runs of one kind came to, medians."""

    what: str
    keys: int
    events: int
    matches: int
    events_per_cpu_s: float
    events_per_wall_s: float
    start_cpu_s: float
    """what a job without rows costs, left out of the rates"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a fifth of the rows, fewer keys and runs")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/flink.json"))
    options = parser.parse_args(arguments)
    if not PYTHON.exists():
        print(f"skipped: there is no {PYTHON}. Next: make flink")
        return
    found = []
    for each in run_all(is_quick=options.quick):
        print(
            f"{each.what:20} {each.keys:>9,} keys {each.events:>10,} events {each.matches:>7,} matches "
            f"{each.events_per_cpu_s / 1e3:8.1f} k/CPU-s {each.events_per_wall_s / 1e3:8.1f} k/s",
            flush=True,
        )
        found.append(each)
    keep(options.results, is_quick=options.quick, flink=[asdict(each) for each in found])


def run_all(*, is_quick: bool) -> Iterator[Measured]:
    """Each rule at each number of keys, and reading alone."""
    warm_up, runs, events = (1, 3, 100_000) if is_quick else (3, 5, 500_000)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        asked = [(what, keys) for what in RULES for keys in (KEYS[-1:] if is_quick else KEYS)]
        jobs = [job for what, keys in asked for job in _jobs(what, keys, events, folder)]
        costs = _costs({"warm_up": warm_up, "runs": runs, "jobs": jobs}, folder)
    for what, keys in asked:
        for shown, kind in ((what, "rule"), (f"{what}: pass-through", "pass-through")):
            ran, empty = costs[f"{what} {keys} {kind}"], costs[f"{what} {keys} {kind} empty"]
            cpu_s, wall_s = (_net(_median(ran, field), _median(empty, field)) for field in ("cpu_s", "wall_s"))
            matches = int(_median(ran, "rows"))
            yield Measured(shown, keys, events, matches, events / cpu_s, events / wall_s, _median(empty, "cpu_s"))


def _median(costs: Sequence[dict[str, float]], field: str) -> float:
    return statistics.median(each[field] for each in costs)


def _net(cost: float, start: float) -> float:
    """The cost without the start; on a noisy machine a short run may seem to cost less than none: then a tenth."""
    return max(cost - start, cost / 10)


def _jobs(what: str, keys: int, events: int, folder: Path) -> Iterator[dict[str, Any]]:
    rule = parse_rule(RULES[what])
    table = rows(what, keys, events)
    event_type = table.column("type")[0].as_py()
    script = translate(
        rule, schemas(load_catalogue()),
        options=Options(source_tables={event_type: "arrived"}, whole_milliseconds=True, one_station=True),
    )  # fmt: skip
    views = [statement for _, statement in script.statements]
    file = folder / f"{what} {keys}.csv"
    _write(table, event_type, file)
    empty = folder / "empty.csv"
    empty.write_text("")
    found = folder / "found"
    sinks = {"rule": f"'filesystem', 'path' = '{found}', 'format' = 'json'", "pass-through": "'blackhole'"}
    for kind, sink in sinks.items():
        read = "SELECT `sequence` FROM arrived" if kind == "pass-through" else _found(script.result)
        for name, path in ((kind, file), (f"{kind} empty", empty)):
            made = f"CREATE TABLE found (n BIGINT) WITH ('connector' = {sink})"
            yield {
                "name": f"{what} {keys} {name}",
                "statements": [_arrived(event_type, path), *views, made],
                "insert": f"INSERT INTO found {read}",
                "folder": str(found),
            }


def _found(result: str) -> str:
    return f"SELECT last_sequence FROM `{result}`"


def _arrived(event_type: str, path: Path) -> str:
    """The table of the events as they arrive; the watermark is the rules', less a millisecond for ties."""
    columns = ", ".join(f"`{name}` {kind}" for name, kind in _COLUMNS[event_type].items())
    late = f"INTERVAL '{LATENESS_US // 1_000_000}.001' SECOND(3)"
    return (
        f"CREATE TABLE arrived (time_ms BIGINT, {columns}, `time` AS TO_TIMESTAMP_LTZ(time_ms, 3), "
        f"rowtime AS TO_TIMESTAMP_LTZ(time_ms, 3), WATERMARK FOR rowtime AS rowtime - {late}) "
        f"WITH ('connector' = 'filesystem', 'path' = '{path}', 'format' = 'csv')"
    )


def _write(table: pa.Table, event_type: str, file: Path) -> None:
    time_ms = table.column("time").cast(pa.timestamp("ms", "UTC"), safe=False).cast(pa.int64())
    columns = {"time_ms": time_ms} | {name: table.column(name) for name in _COLUMNS[event_type]}
    pyarrow.csv.write_csv(pa.table(columns), file, pyarrow.csv.WriteOptions(include_header=False))


def _costs(asked: dict[str, Any], folder: Path) -> dict[str, list[dict[str, float]]]:
    """What each run cost, by the job's name."""
    (folder / "jobs.json").write_text(json.dumps(asked))
    # Flink's process must not see our folders: it imports modules by their top-level names.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    runner = Path(__file__).with_name("flink_runs.py")
    command = [str(PYTHON.absolute()), "-W", "ignore", str(runner.absolute()), str(folder / "jobs.json")]
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if ran.returncode:
        raise RuntimeError(f"Flink failed: {ran.stderr[-4000:]}")
    costs: dict[str, list[dict[str, float]]] = {}
    for line in ran.stdout.splitlines():
        if line.startswith("{"):
            said = json.loads(line)
            costs.setdefault(said.pop("name"), []).append(said)
    return costs


if __name__ == "__main__":
    main()
