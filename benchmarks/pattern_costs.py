"""What rules cost beside events a second: DuckDB on the same rows, patterns that are hard, state, starting, reloading.

Parts of `python -m benchmarks.patterns`.
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa

from benchmarks.measuring import Row
from benchmarks.pattern_rows import RULES, rows, zone_rules
from events import load_catalogue
from patterns import BoundRule, PatternError, RuleSetRun, bind, parse_rule, query
from patterns.processor import schemas

BATCH = 50_000
"""rows a push"""
SMALL_BATCH = 2_500
_FIRST_MATCH = [sys.executable, "-m", "benchmarks.first_match"]

_CROSSINGS = """
SELECT track_id, time, x, y FROM (
  SELECT *, lag(x) OVER before AS x0, lag(y) OVER before AS y0 FROM (
    SELECT source, track_id, time, sequence, x::DOUBLE AS x, y::DOUBLE AS y FROM points)
  WINDOW before AS (PARTITION BY source, track_id ORDER BY time, sequence))
WHERE source = 'cam-01'
  AND ((500 - 500) * (y0 - 1000) - (0 - 1000) * (x0 - 500) >= 0)
   <> ((500 - 500) * (y - 1000) - (0 - 1000) * (x - 500) >= 0)
  AND least((x - x0) * (1000 - y0) - (y - y0) * (500 - x0), (x - x0) * (0 - y0) - (y - y0) * (500 - x0)) <= 0
  AND greatest((x - x0) * (1000 - y0) - (y - y0) * (500 - x0), (x - x0) * (0 - y0) - (y - y0) * (500 - x0)) >= 0
"""
"""Line crossing as window functions say it: the rule's arithmetic."""


@dataclass(frozen=True, slots=True)
class Worst:
    """A pattern that naive matchers take for ever with.

    Attributes:
        what: The pattern, and the rows.
        way: As a rule, or as a query.
        rows: How many rows.
        seconds: CPU seconds that they took.
        growth: How much longer than a quarter of the rows took, four times: 1 is linear.
        matches: How many matches there are.
        error: Why it was refused, if it was.
    """

    what: str
    way: str
    rows: int
    seconds: float
    growth: float
    matches: int
    error: str | None = None


@dataclass(frozen=True, slots=True)
class Costs:
    """Single figures, medians; CPU where it does not say otherwise."""

    checkpoint_partitions: int
    checkpoint_ms: float
    checkpoint_mb: float
    restore_ms: float
    start_cpu_s: float
    """a fresh process, kernel compiled before: from its begin to its first match"""
    start_wall_s: float
    first_start_cpu_s: float
    """the same on a machine where the kernel was never compiled"""
    compiling_cpu_s: float
    """compiling it, once for a machine and version"""
    reload_ms: float
    """one rule among 100, from its text to the end of the next step"""
    step_ms: float
    """2,500 rows, 20 rules"""
    step_p99_ms: float


def bound(text: str) -> BoundRule:
    """The rule of this file, bound to the catalogue."""
    return bind(parse_rule(text), schemas(load_catalogue()))


def cpu_s(work: Callable[[], object]) -> float:
    """CPU seconds of this process that the work takes."""
    began = time.process_time()
    work()
    return time.process_time() - began


def run(group: RuleSetRun, table: pa.Table) -> int:
    """All rows through the set to their end; how many situations it found, the end of each read."""
    steps = [group.push(batch) for batch in table.to_batches(max_chunksize=BATCH)]
    steps.append(group.finish())
    if group.failures:
        raise RuntimeError(f"rules failed: {group.failures}")
    ends = [match.last.sequence for step in steps for outcome in step.values() for match in outcome.matches]
    return len(ends)


# Beside DuckDB.


def beside_duckdb(*, events: int, rounds: int) -> Row:
    """Line crossing by the rule and by window functions, in turns, rows a CPU-second.

    Raises:
        RuntimeError: They do not find equally many.
    """
    table, rule = rows("line crossing", 10_000, events), bound(RULES["line crossing"])
    found: dict[str, int] = {}

    def ours() -> None:
        found["ours"] = run(RuleSetRun([rule]), table)

    def theirs() -> None:
        with duckdb.connect() as opened:
            opened.register("points", table)
            found["theirs"] = opened.execute(_CROSSINGS).to_arrow_table().num_rows

    pairs = [(events / cpu_s(ours), events / cpu_s(theirs)) for _ in range(rounds + 1)][1:]
    if found["ours"] != found["theirs"]:
        raise RuntimeError(f"the rule found {found['ours']} crossings, the window functions {found['theirs']}")
    medians = [statistics.median(side) for side in zip(*pairs, strict=True)]
    ratio = statistics.median(mine / other for mine, other in pairs)
    what = "line crossing, 10,000 keys, a CPU-second"
    return Row(what, "events/s", medians[0], medians[1], "DuckDB, window functions", ratio, 1.0)


# Hard patterns.

_HARD: dict[str, tuple[str, str, str]] = {
    "(A|B)*? C, no row is a C": ("(A | B)*? C", "A AS A.letter = 'a', B AS B.letter = 'b', C AS C.letter = 'c'", "ab"),
    "A+ B+, every row is both": ("A+ B+", "A AS A.letter = 'a', B AS B.letter = 'a'", "a"),
    "((A+)+)+ B, no row is a B": ("((A+)+)+ B", "A AS A.letter = 'a', B AS B.letter = 'b'", "a"),
    "PERMUTE of 8": (
        f"PERMUTE({', '.join('ABCDEFGH')})",
        ", ".join(f"{name} AS {name}.letter = '{name.lower()}'" for name in "ABCDEFGH"),
        "hgfedcba",
    ),
}
_AS_QUERY = """SELECT * FROM letters MATCH_RECOGNIZE (
  ORDER BY time, sequence MEASURES MATCH_NUMBER() AS n
  ONE ROW PER MATCH AFTER MATCH SKIP PAST LAST ROW PATTERN (PATTERN_) DEFINE DEFINE_)"""
_AS_RULE = """rule: hard
version: 1
severity: info
title: hard
match: |
  SELECT * FROM letters MATCH_RECOGNIZE (
    PARTITION BY source ORDER BY time, sequence
    MEASURES MATCH_NUMBER() AS n
    ONE ROW PER MATCH AFTER MATCH SKIP PAST LAST ROW PATTERN (PATTERN_) DEFINE DEFINE_)
"""


def worst_cases(*, count: int) -> Iterator[Worst]:
    """Each hard pattern, as a rule and as a query."""
    for what, (pattern, define, letters) in _HARD.items():
        for way, find in (("rule", _by_rule), ("query", _by_query)):
            costs = []
            try:
                for size in (count // 4, count):
                    table, began = _letters(letters, size), time.process_time()
                    matches = find(pattern, define, table)
                    costs.append(time.process_time() - began)
            except PatternError as error:
                said = str(error).splitlines()[0]
                yield Worst(what, way, count, time.process_time() - began, 0.0, 0, said)
                continue
            yield Worst(what, way, count, costs[1], costs[1] / costs[0] / 4, matches)


def _by_rule(pattern: str, define: str, table: pa.Table) -> int:
    text = _AS_RULE.replace("PATTERN_", pattern).replace("DEFINE_", define).replace("MATCH_NUMBER()", "LAST(time)")
    return run(RuleSetRun([bind(parse_rule(text), {"letters": table.schema})], is_strict=True), table)


def _by_query(pattern: str, define: str, table: pa.Table) -> int:
    found = query(_AS_QUERY.replace("PATTERN_", pattern).replace("DEFINE_", define), {"letters": table})
    return int(found.num_rows)


def _letters(letters: str, count: int) -> pa.Table:
    """One partition of rows, a second apart, whose letters are these again and again."""
    constant = {name: pa.repeat(pa.scalar(name), count) for name in ("station", "source")}
    repeated = pa.array(list(letters)).take(pa.array(np.arange(count) % len(letters)))
    return pa.table(
        {
            **constant,
            "type": pa.repeat(pa.scalar("letters"), count),
            "sequence": pa.array(np.arange(1, count + 1)),
            "time": pa.array(np.arange(count) * 1_000_000, pa.timestamp("us", "UTC")),
            "letter": repeated,
        }
    )


# State, starting, reloading.


def costs(*, is_quick: bool) -> Costs:
    """The single figures."""
    runs, partitions = (3, 13_000) if is_quick else (7, 130_000)
    checkpoint_s, restore_s, size = _checkpoint(partitions, runs)
    starts = [_started(_FIRST_MATCH) for _ in range(runs)]
    first, compiling = _first_ever()
    steps = _steps(200 if is_quick else 1_000)
    return Costs(
        checkpoint_partitions=partitions,
        checkpoint_ms=checkpoint_s * 1e3,
        checkpoint_mb=size / 1e6,
        restore_ms=restore_s * 1e3,
        start_cpu_s=statistics.median(cpu for cpu, _ in starts),
        start_wall_s=statistics.median(wall for _, wall in starts),
        first_start_cpu_s=first,
        compiling_cpu_s=compiling,
        reload_ms=_reload_s(runs) * 1e3,
        step_ms=statistics.median(steps) * 1e3,
        step_p99_ms=float(np.percentile(steps, 99)) * 1e3,
    )


def _checkpoint(partitions: int, runs: int) -> tuple[float, float, int]:
    """CPU seconds to save and to restore a rule with so many partial matches, each in its partition; bytes."""
    rule = bound(RULES["zone intrusion"])
    group = RuleSetRun([rule])
    outside = rows("zone intrusion", partitions, partitions)
    for second, (x, y) in enumerate(((10.0, 10.0), (760.0, 500.0), (760.0, 500.0), (760.0, 500.0))):
        group.push(_moved(outside, second, x, y))
    group.push(_moved(outside.slice(0, 1), 7, 760.0, 500.0))
    if group.partial_matches("yard-dwell") < partitions:
        raise RuntimeError(f"wanted {partitions} partial matches, got {group.partial_matches('yard-dwell')}")
    saving = [cpu_s(lambda: group.state("yard-dwell")) for _ in range(runs)]
    state = group.state("yard-dwell")
    restoring = [cpu_s(lambda: RuleSetRun().add(rule, state)) for _ in range(runs)]
    return statistics.median(saving), statistics.median(restoring), len(state)


def _moved(table: pa.Table, seconds: int, x: float, y: float) -> pa.Table:
    """A row for each track, all at one place and one time."""
    count = table.num_rows
    start = table.column("time")[0].value
    new = {
        "time": pa.array(np.full(count, start + seconds * 1_000_000), pa.timestamp("us", "UTC")),
        "sequence": pa.array(np.arange(count) + seconds * 10_000_000 + 1),
        "x": pa.array(np.full(count, x, dtype=np.float32)),
        "y": pa.array(np.full(count, y, dtype=np.float32)),
    }
    for name, column in new.items():
        table = table.set_column(table.schema.get_field_index(name), name, column)
    return table


def _started(command: list[str], environment: dict[str, str] | None = None) -> tuple[float, float]:
    """CPU seconds and seconds of the clock on the wall of a process, from its begin to its end."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, env={**os.environ, **(environment or {})})
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def _first_ever() -> tuple[float, float]:
    """CPU seconds to the first match where nothing was compiled before, and to compile."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {"NUMBA_CACHE_DIR": str(Path(folder))}
        first, _ = _started(_FIRST_MATCH, environment)
        compiling, _ = _started([sys.executable, "-m", "patterns.engine.compiling"], environment)
    return first, compiling


def _reload_s(runs: int) -> float:
    texts = zone_rules(100)
    group = RuleSetRun([bound(text) for text in texts])
    parts = rows("zone intrusion", 10_000, 500_000).to_batches(max_chunksize=SMALL_BATCH)
    for part in parts[: len(parts) // 2]:
        group.push(part)
    took = []
    for number, part in enumerate(parts[-runs:]):
        group.push(parts[len(parts) // 2 + number])
        name, began = f"yard-{number:03}", time.process_time()
        group.remove(name)
        group.add(bound(texts[number].replace("version: 1", "version: 2")))
        group.push(part)
        took.append(time.process_time() - began)
    return statistics.median(took)


def _steps(count: int) -> list[float]:
    """CPU seconds of steps of few rows."""
    group = RuleSetRun([bound(text) for text in zone_rules(20)])
    parts = rows("zone intrusion", 1_000, SMALL_BATCH * count).to_batches(max_chunksize=SMALL_BATCH)
    took = []
    for part in parts:
        began = time.process_time()
        group.push(part)
        took.append(time.process_time() - began)
    return took[count // 10 :]
