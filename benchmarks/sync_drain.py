"""A backlog that drains as fast as it can: from the station's log to central's, beside the usual ways.

Contract: the backlog becomes durable at the station in one commit while the daemon waits; what is timed is from then
until central's log has all of it, durably. In the same round the same events go as rows through PostgreSQL's logical
replication, and the same segments into two more logs by their own append: in the groups in which central took
them, and one by one.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import psycopg
import pyarrow as pa

from benchmarks.link import Link, Traffic, fast_link
from benchmarks.measuring import Figure, Row
from benchmarks.points import CAMERAS, PRODUCER, points, row_batch, whole_row_batch
from benchmarks.sync_reference import LogicalReplication, Replicated, logical_replication
from benchmarks.sync_servers import STATION, Cost, Program, central_server, enrol, station_daemon
from events import Draft, EventBatch, Segment, StreamName, encode
from store import Log, open_log
from store.projector import NAME as PROJECTOR

SEGMENT_EVENTS = 1000
_LOOK_SECONDS = 0.005
_REPLICATION = "logical replication"
_COSTS: dict[str, Callable[["Round"], float]] = {
    "CPU of both ends": lambda each: each.station.total_s + each.central.total_s,
    "CPU of the daemon and its log": lambda each: each.station.total_s,
    "CPU of central and its log": lambda each: each.central.total_s,
}


@dataclass(frozen=True, slots=True)
class Round:
    """What one round came to."""

    events: int
    seconds: float
    rows_s: float
    """until central had written rows of it, too, which it does when it has stored what comes"""
    station: Cost
    central: Cost
    traffic: Traffic
    segments_a_commit: float
    replication: Replicated
    """durable at the subscriber at each commit, as central is"""
    lazy_replication: Replicated
    """durable at the end, as a subscription is by default"""
    grouped_s: float
    single_s: float


Rows = Callable[[EventBatch, int, int], pa.RecordBatch]
"""Makes the rows that replicate, of a segment's events."""


class Bench:
    """Everything of one link: logs, both programs, and the reference."""

    def __init__(self, stack: ExitStack, link: Link, folder: Path, rows: Rows = row_batch) -> None:
        self._link = link
        self._rows = rows
        names = ("station", "central", "grouped", "single")
        self._station, self._central, *self._local = (stack.enter_context(tuned_log(folder / name)) for name in names)
        self._replication: LogicalReplication = stack.enter_context(
            logical_replication(link, folder, rows(points(1, 0), 0, 1).schema)
        )
        enrol(folder)
        self._server: Program = stack.enter_context(central_server(link, folder))
        self._daemon: Program = stack.enter_context(station_daemon(link, folder))

    def round(self, number: int, segments: int) -> Round:
        """Drain a backlog of so many segments, and the same by the other ways."""
        drafts = backlog(number, segments)
        crossed, before = self._link.traffic(), (self._daemon.cost(), self._server.cost())
        first = self._central.head() + 1
        seconds = self._drain(drafts)
        after, traffic = (self._daemon.cost(), self._server.cost()), self._link.traffic().since(crossed)
        began = time.perf_counter()
        wait_until(lambda: self._central.checkpoint(PROJECTOR).position >= self._central.head())
        rows_s = seconds + time.perf_counter() - began
        taken = list(self._central.read_all(first, types=["track_point"]))
        groups = [list(group) for _, group in groupby(taken, key=lambda each: each.recorded_at)]
        return Round(
            segments * SEGMENT_EVENTS,
            seconds,
            rows_s,
            after[0].since(before[0]),
            after[1].since(before[1]),
            traffic,
            segments / len(groups),
            self._replicated(segments, is_each_synchronous=True),
            self._replicated(segments, is_each_synchronous=False),
            _appended(self._local[0], groups),
            _appended(self._local[1], [[each] for each in taken]),
        )

    def _drain(self, drafts: Sequence[Draft]) -> float:
        wait_until(lambda: 0 < self._station.head() <= self._central.head())  # what sync itself records is there
        end = self._central.head() + len(drafts)
        self._station.append(drafts)
        began = time.perf_counter()
        wait_until(lambda: self._central.head() >= end)
        return time.perf_counter() - began

    def _replicated(self, segments: int, *, is_each_synchronous: bool) -> Replicated:
        rows = [self._rows(points(SEGMENT_EVENTS, seed % CAMERAS), seed, 1) for seed in range(segments)]
        self._replication.fill(rows, is_each_synchronous=is_each_synchronous)
        return self._replication.drain()


def drained(folder: Path, rounds: int, segments: int) -> Iterator[Row | Figure]:
    """Events a second end to end, and what they cost."""
    with ExitStack() as stack:
        link = stack.enter_context(fast_link(whole_packets=True))
        bench = Bench(stack, link, folder)
        found = [bench.round(number, segments) for number in range(rounds + 1)][1:]
    rates = [(each.events / each.seconds, each) for each in found]

    def beside(name: str, reference: Callable[[Round], float], target: float | None) -> Row:
        pairs = [(rate, each.events / reference(each)) for rate, each in rates]
        return _row("durable end to end, 1,000 a segment", "events/s", pairs, name, target)

    yield beside(_REPLICATION, lambda each: each.replication.seconds, 4.0)
    yield beside(f"{_REPLICATION}, durable at its end", lambda each: each.lazy_replication.seconds, None)
    with_rows = [(each.events / each.rows_s, each.events / each.replication.seconds) for each in found]
    yield _row("the same, and rows of it at central", "events/s", with_rows, _REPLICATION, None)
    yield beside("the log's own append, same groups", lambda each: each.grouped_s, 0.5)
    yield beside("the log's own append, one by one", lambda each: each.single_s, 0.5)
    for what, cpu_s in _COSTS.items():
        costs = [(1e6 * cpu_s(each) / each.events, 1e6 * each.replication.cpu_s / each.events) for each in found]
        yield _row(f"{what}, a million events", "s", costs, f"{_REPLICATION}, both ends", None)
    groups = [(each.segments_a_commit, 1.0) for each in found]
    yield _row("segments a commit at central", "segments", groups, f"{_REPLICATION}, of as many rows", None)


def crossed(folder: Path, rounds: int, segments: int) -> Iterator[Row | Figure]:
    """Bytes on the wire an event, each packet with its headers; beside rows of all that a segment says, and slim ones.

    A slim row has only source and sequence beside the fields: at central it could not be told whose it is.
    """
    yield _crossed(folder / "whole", rounds, segments, whole_row_batch, _REPLICATION, 1 / 6)
    yield _crossed(folder / "slim", rounds, segments, row_batch, f"{_REPLICATION}, rows without station", None)


def _crossed(folder: Path, rounds: int, segments: int, rows: Rows, name: str, target: float | None) -> Row:
    folder.mkdir(mode=0o755)
    with ExitStack() as stack:
        link = stack.enter_context(fast_link())
        bench = Bench(stack, link, folder, rows)
        found = [bench.round(number, segments) for number in range(rounds + 1)][1:]
    pairs = [(each.traffic.both / each.events, each.replication.traffic.both / each.events) for each in found]
    return _row("bytes on the wire an event, 1,000 a segment", "bytes", pairs, name, target, at_least=False)


def _row(
    what: str,
    unit: str,
    pairs: Sequence[tuple[float, float]],
    name: str,
    target: float | None,
    *,
    at_least: bool = True,
) -> Row:
    ours, theirs = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratio = statistics.median(mine / other for mine, other in pairs)
    return Row(what, unit, ours, theirs, name, ratio, target, at_least)


def backlog(number: int, segments: int, station: str = STATION, *, cameras: int = CAMERAS) -> list[Draft]:
    """So many segments of the cameras, each round in streams of its own."""
    return [
        encode(
            StreamName.of(station, f"cam-{camera % cameras:03}-{number}", "track_point"),
            points(SEGMENT_EVENTS, camera % CAMERAS),
            PRODUCER,
        )
        for camera in range(segments)
    ]


def _appended(log: Log, groups: Sequence[Sequence[Segment]]) -> float:
    """Seconds for appending the groups of segments, a commit each, as central does."""
    prepared = [
        (
            [each.draft() for each in group],
            [each.header.first_sequence - 1 for each in group],
            [each.header.epoch for each in group],
            [each.chain_hash for each in group],
        )
        for group in groups
    ]
    began = time.perf_counter()
    for drafts, expected, epochs, chain_hashes in prepared:
        log.append(drafts, expected, epochs=epochs, chain_hashes=chain_hashes)
    return time.perf_counter() - began


@contextmanager
def tuned_log(data_dir: Path) -> Iterator[Log]:
    """An embedded log with durable commits and, as for the references, room for what a run writes."""
    with open_log(data_dir=data_dir) as log:
        with psycopg.connect(log.dsn, autocommit=True) as owner:
            for name, value in (("max_wal_size", "4GB"), ("checkpoint_timeout", "30min")):
                owner.execute(f"alter system set {name} = '{value}'")
            owner.execute("select pg_reload_conf()")
        yield log


def wait_until(is_so: Callable[[], bool], every_s: float = _LOOK_SECONDS) -> None:
    """Look again and again until it is so."""
    while not is_so():
        time.sleep(every_s)
