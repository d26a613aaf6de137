"""Rules over the log: from stored segments to committed situations.

    python -m benchmarks.patterns_log [--quick] [--results FILE]

- catch-up: events per CPU-second of this process, from the log to the situations in it, each rule by itself;
- online: 25,000 events a second come in real time, 20 rules run; how long after the commit that lifts the
  watermark over what decided a situation this is committed, and how much of a core that takes;
- memory: of this process while an hour of event time goes by as fast as it can, for four minutes at most;
- reload: how long it takes that one rule among 100 is replaced, from the append that says so to the next step.
"""

import argparse
import statistics
import tempfile
import threading
import time
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.compute as pc

from benchmarks.measuring import keep
from benchmarks.pattern_rows import LATENESS_US, RULES, rows, zone_rules
from events import (
    Draft,
    EventBatch,
    PlateRead,
    Producer,
    StreamName,
    TrackPoint,
    decode,
    encode,
    events_of,
    schema_of,
)
from patterns import parse_rule
from patterns.engine.compiling import compile_kernel
from patterns.processor import Processor, ProcessorLimits, deploy
from store import Log, open_log

STATION = "brno"
PRODUCER = Producer("benchmark", "1", bytes(32))
CAMERAS = 10
SEGMENT = 10_000
"""events a segment where history is read"""
_WIDE_PX = (250.0, 450.0)
"""Sides of zones in which tracks stay for ten seconds: hundreds of situations in a minute."""
AT = datetime(2026, 1, 1, tzinfo=UTC)
_TYPES: dict[str, type[TrackPoint] | type[PlateRead]] = {"track_point": TrackPoint, "plate_read": PlateRead}


@dataclass(frozen=True, slots=True)
class CatchUp:
    """History read by one rule: medians."""

    rule: str
    keys: int
    events: int
    situations: int
    events_per_cpu_s: float
    events_per_wall_s: float


@dataclass(frozen=True, slots=True)
class Online:
    """Rules beside a stream of events in real time."""

    events_per_s: int
    rules: int
    seconds: float
    situations: int
    latency_p50_ms: float
    latency_p99_ms: float
    latency_max_ms: float
    cores: float
    """CPU seconds of the processor's thread, a second"""


@dataclass(frozen=True, slots=True)
class Memory:
    """An hour of event time as fast as it goes: this process's own memory after each quarter, MB."""

    events: int
    seconds: float
    """of event time"""
    quarters_mb: tuple[float, ...]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer keys, one run, a shorter hour")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/patterns_log.json"))
    options = parser.parse_args(arguments)
    quick = options.quick
    compile_kernel()
    found = []
    for each in caught_up(is_quick=quick):
        print(each, flush=True)
        found.append(each)
    live = online(seconds=25.0 if quick else 60.0)
    print(live, flush=True)
    hour = memory(seconds=400 if quick else 3600)
    print(hour, flush=True)
    reloads = reload_ms(runs=3 if quick else 7)
    print(f"reload of one rule among 100: {reloads:.1f} ms", flush=True)
    keep(
        options.results,
        is_quick=quick,
        catch_up=[asdict(each) for each in found],
        online=asdict(live),
        memory=asdict(hour),
        reload_ms=reloads,
    )


def caught_up(*, is_quick: bool) -> Iterator[CatchUp]:
    """Each rule over history; twenty seconds of 10,000 tracks are the least in which one can stay ten."""
    for name, text in RULES.items():
        for keys in (10_000,) if is_quick else (100, 10_000):
            yield _caught_up(name, text, keys, 2_000_000, 1 if is_quick else 5)


def _caught_up(name: str, text: str, keys: int, events: int, runs: int) -> CatchUp:
    rule, costs = parse_rule(text), []
    with tempfile.TemporaryDirectory() as folder, open_log(data_dir=Path(folder)) as log:
        _store(log, rows(name, keys, events), SEGMENT)
        for run in range(runs + 1):
            version = rule.model_copy(update={"version": run + 1})
            processor = Processor(log, STATION, [version])
            cpu, wall = time.process_time(), time.perf_counter()
            situations = processor.catch_up()
            costs.append((time.process_time() - cpu, time.perf_counter() - wall, situations))
            processor.close()
    cpu_s, wall_s, count = (statistics.median(side) for side in zip(*costs[1:], strict=True))
    return CatchUp(name, keys, events, int(count), events / cpu_s, events / wall_s)


def online(*, seconds: float, events_per_s: int = 25_000, rules: int = 20, step_s: float = 0.1) -> Online:
    """Rules beside a stream of events in real time; each step every camera appends its share."""
    texts = [text.replace("cam-01", _camera(number)) for number, text in enumerate(zone_rules(rules, _WIDE_PX))]
    per_camera = int(events_per_s * step_s) // CAMERAS
    steps = int(seconds / step_s)
    tables = [rows("zone intrusion", per_camera, per_camera * steps, seed) for seed in range(CAMERAS)]
    # Made ahead: in the world it is other processes that make them.
    arriving = [
        [_draft(_camera(n), table.slice(step * per_camera, per_camera), TrackPoint) for n, table in enumerate(tables)]
        for step in range(steps)
    ]
    with tempfile.TemporaryDirectory() as folder, open_log(data_dir=Path(folder)) as log:
        deploy(log, STATION, [parse_rule(text) for text in texts], {}, AT)
        processor = Processor(log, STATION)
        processor.catch_up()
        stop, cpu = threading.Event(), [0.0]

        def run() -> None:
            began = time.thread_time()
            while not stop.is_set():
                processor.step(0.2)
            cpu[0] = time.thread_time() - began

        thread = threading.Thread(target=run)
        thread.start()
        began = time.perf_counter()
        for step, drafts in enumerate(arriving):
            log.append(drafts)
            time.sleep(max(0.0, began + (step + 1) * step_s - time.perf_counter()))
        elapsed = time.perf_counter() - began
        stop.set()
        thread.join()
        processor.catch_up()
        latencies = np.array(_latencies(log)) * 1e3
        processor.close()
    p50, p99, most = (float(each) for each in np.percentile(latencies, [50, 99, 100]))
    return Online(events_per_s, rules, elapsed, len(latencies), p50, p99, most, cpu[0] / elapsed)


def memory(*, seconds: int, events_per_s: int = 2_500, seconds_most: float = 240.0) -> Memory:
    """An hour of event time, appended and read in turn: four times the same quarter, each behind the one before."""
    began, quarter_s = time.perf_counter(), seconds // 4
    table = rows("zone intrusion", events_per_s // 10, quarter_s * events_per_s)
    process, quarters, events = psutil.Process(), [], 0
    with tempfile.TemporaryDirectory() as folder, open_log(data_dir=Path(folder)) as log:
        deploy(log, STATION, [parse_rule(text) for text in zone_rules(20, _WIDE_PX)], {}, AT)
        processor = Processor(log, STATION, limits=ProcessorLimits(save_every_events=500_000))
        for quarter in range(4):
            for part in _later(table, quarter * quarter_s).to_batches(max_chunksize=SEGMENT):
                if time.perf_counter() - began < seconds_most:
                    log.append([_draft("cam-01", pa.table(part), TrackPoint)])
                    processor.step()
                    events += part.num_rows
            quarters.append(round(process.memory_info().rss / 2**20, 1))
        processor.close()
    return Memory(events, events / events_per_s, tuple(quarters))


def _later(table: pa.Table, seconds: int) -> pa.Table:
    """The rows, so much later."""
    times = pc.add(table.column("time"), pa.scalar(timedelta(seconds=seconds), pa.duration("us")))
    return table.set_column(table.schema.get_field_index("time"), "time", times)


def reload_ms(*, runs: int, rules: int = 100) -> float:
    """From the append that says that one rule among many is replaced to the step that has taken it in, ms."""
    texts = zone_rules(rules)
    with tempfile.TemporaryDirectory() as folder, open_log(data_dir=Path(folder)) as log:
        deploy(log, STATION, [parse_rule(text) for text in texts], {}, AT)
        processor = Processor(log, STATION)
        log.append([_draft("cam-01", rows("zone intrusion", 1_000, 10_000), TrackPoint)])
        processor.catch_up()
        costs = []
        for run in range(runs):
            rule = parse_rule(texts[0]).model_copy(update={"version": run + 2})
            deploy(log, STATION, [rule], {}, AT, open_matches="dropped")
            began = time.perf_counter()
            processor.step()
            processor.step()
            costs.append((time.perf_counter() - began) * 1e3)
            if (rule.rule, run + 2) not in {service.key for service, _ in processor.rules}:
                raise RuntimeError("the new version does not run")
        processor.close()
    return statistics.median(costs)


def _latencies(log: Log) -> list[float]:
    """For each situation the seconds from the commit that lifted the watermark over what decided it."""
    lateness = timedelta(microseconds=LATENESS_US)
    lifted: dict[str, list[tuple[datetime, datetime]]] = {}
    for segment in log.read_all(types=["track_point"]):
        known = lifted.setdefault(str(segment.stream.source), [])
        newest = max(segment.header.time_max, known[-1][0] if known else segment.header.time_max)
        known.append((newest, segment.recorded_at))
    times = {source: [newest for newest, _ in each] for source, each in lifted.items()}
    found = []
    for segment in log.read_all(types=["situation_detected"]):
        for event in events_of(decode(segment, log.catalogue)):
            at = [_first_after(times[source], event.time + lateness) for source in lifted]
            if all(index is not None for index in at):
                commits = [lifted[source][index or 0][1] for source, index in zip(lifted, at, strict=True)]
                found.append((segment.recorded_at - max(commits)).total_seconds())
    return found


def _first_after(times: Sequence[datetime], bound: datetime) -> int | None:
    """Index of the first time beyond the bound, among times that do not go back."""
    index = bisect_right(times, bound)
    return index if index < len(times) else None


def _camera(number: int) -> str:
    return f"cam-{number % CAMERAS + 1:02}"


def _store(log: Log, table: pa.Table, size: int) -> None:
    """Append the rows in the order of arrival, a segment for each source in each slice."""
    kind = _TYPES[table.column("type")[0].as_py()]
    for start in range(0, table.num_rows, size):
        part = table.slice(start, size)
        drafts = []
        for source in sorted(set(part.column("source").to_pylist())):
            own = part.filter(pc.equal(part.column("source"), source))
            drafts.append(_draft(source, own, kind))
        log.append(drafts)


def _draft(source: str, table: pa.Table, kind: type[TrackPoint] | type[PlateRead]) -> Draft:
    """The rows as a segment of the source; columns that rules do not read hold zeros."""
    count = table.num_rows
    columns = []
    for field in schema_of(kind):
        if field.name in table.column_names:
            columns.append(table.column(field.name).cast(field.type).combine_chunks())
        elif field.nullable:
            columns.append(pa.nulls(count, field.type))
        else:
            columns.append(pa.repeat(pa.scalar(0).cast(field.type), count))
    data = pa.RecordBatch.from_arrays(columns, schema=schema_of(kind))
    return encode(StreamName.of(STATION, source, kind.type_name), EventBatch(kind, data), PRODUCER)


if __name__ == "__main__":
    main()
