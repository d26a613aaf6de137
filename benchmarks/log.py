"""How fast the log is, beside the plain or the usual way to do the same, in one run.

    python -m benchmarks.log [--quick] [--folder DIR] [--results FILE]

Embedded PostgreSQL with durable commits (`fsync` and `synchronous_commit` on), realistic track points of a
hundred cameras, medians of five rounds in which the candidates take turns. Results go to a file, from which
`python -m benchmarks.report` writes docs/performance.md.
"""

import argparse
import platform
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

import pyarrow as pa

from benchmarks import references
from benchmarks.measuring import Row, compared, keep, rate
from benchmarks.points import PRODUCER, points, row_batch, stream
from events import EventType, decode, encode, events_of
from store import Log, Projector, SharedAppender, open_log, verify

EVENTS_READ = 1_000_000


@dataclass(frozen=True, slots=True)
class Plan:
    """How much of everything."""

    rounds: int
    scale: float

    def times(self, number: int) -> int:
        """A number of calls, smaller for a quick look."""
        return max(2, int(number * self.scale))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the table, and keep it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three rounds of less, in under 3 minutes")
    parser.add_argument("--folder", type=Path, help="where the databases live, on a real disk")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/log.json"))
    parser.add_argument("--only", help="only measurements whose name holds this text")
    options = parser.parse_args(arguments)
    plan = Plan(3, 0.25) if options.quick else Plan(5, 1.0)
    rows = []
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        Path(folder).chmod(0o755)
        for measurement in MEASUREMENTS:
            name = measurement.__name__.removeprefix("_").replace("_", " ")
            if options.only and options.only not in name:
                continue
            data_dir = Path(folder) / measurement.__name__
            with open_log(data_dir=data_dir) as log:
                _tuned(log)
                for row in measurement(log, plan):
                    rows.append(row)
                    print(_line(row), flush=True)
    if not options.only:
        machine = f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"
        keep(options.results, is_quick=options.quick, machine=machine, rows=[row.plain() for row in rows])


def _tuned(log: Log) -> None:
    """The same server for ours and for the references; commits stay durable."""
    import psycopg

    with psycopg.connect(log.dsn, autocommit=True) as owner:
        for name, value in (("max_wal_size", "4GB"), ("checkpoint_timeout", "30min")):
            owner.execute(f"alter system set {name} = '{value}'")
        owner.execute("select pg_reload_conf()")


def _line(row: Row) -> str:
    target = "" if row.target is None else f"  target {row.target:g}: {'reached' if row.is_reached else 'MISSED'}"
    return (
        f"{row.what:54} {row.ours:>12,.0f} {row.unit:12} {row.reference_name}: {row.reference:,.0f}"
        f"  ratio {row.ratio:.2f}{target}"
    )


# Append.


def _append(log: Log, plan: Plan) -> Iterator[Row]:
    """Segments of 10,000 and 1,000 events beside COPY of the same rows, a commit each."""
    yield from _appended(log, plan, 10_000, 40, 2.5)
    yield from _appended(log, plan, 1_000, 150, 1.2)


def _appended(log: Log, plan: Plan, size: int, calls: int, target: float) -> Iterator[Row]:
    table = references.TypedTable(log.dsn)
    batches = [points(size, seed) for seed in range(20)]
    rows = [row_batch(batch, camera, 1) for camera, batch in enumerate(batches)]
    number = plan.times(calls)

    def ours(_: int) -> float:
        def work() -> None:
            for call in range(number):
                log.append([encode(stream(call), batches[call % 20], PRODUCER)])

        return rate(number * size, work)

    def pipelined(_: int) -> float:
        with SharedAppender(log) as appender:

            def work() -> None:
                for call in range(number):
                    appender.submit(stream(call), batches[call % 20], PRODUCER)
                appender.flush()

            return rate(number * size, work)

    reference = ("binary COPY", lambda _: rate(number * size, lambda: _copied(table, rows, number)))
    yield compared(f"append, {size:,} events a segment", "events/s", plan.rounds, ours, reference, target)
    yield compared(f"append, {size:,} a segment, shared appender", "events/s", plan.rounds, pipelined, reference, None)


def _copied(table: references.TypedTable, rows: Sequence[pa.RecordBatch], calls: int) -> None:
    for call in range(calls):
        table.copy(rows[call % len(rows)])


def _shared(log: Log, plan: Plan) -> Iterator[Row]:
    """Many producers through the shared appender, beside pyeventsourcing's recorder with as many threads."""
    yield _producers(log, plan, "single events, 8 producers", 1, 8, (6000, 150), 15)
    yield _producers(log, plan, "100 a call, 8 producers", 100, 8, (600, 25), 10)
    yield _producers(log, plan, "1,000 a call, 1 producer", 1000, 1, (400, 10), 20)


def _producers(
    log: Log, plan: Plan, what: str, per_call: int, threads: int, calls: tuple[int, int], target: float
) -> Row:
    ours_calls, their_calls = (plan.times(number) for number in calls)
    events: list[EventType] = events_of(points(500, 3)) if per_call == 1 else []
    peer = references.EventSourcing(log.dsn, threads)

    def ours(_: int) -> float:
        with SharedAppender(log) as appender:

            def produce(first: int) -> Callable[[], None]:
                def work() -> None:
                    receipts = []
                    for call in range(ours_calls):
                        item = events[call % 500] if events else points(per_call, call % 20)
                        receipts.append(appender.submit(stream(first * 13 + call), item, PRODUCER))
                    assert all(receipt.result().is_in_log for receipt in receipts)

                return work

            work = [produce(number) for number in range(threads)]
            return rate(threads * ours_calls * per_call, lambda: references.in_threads(work))

    def theirs(_: int) -> float:
        prepared = [peer.prepared(their_calls, per_call) for _ in range(threads)]
        work = [partial(peer.insert, each) for each in prepared]
        return rate(threads * their_calls * per_call, lambda: references.in_threads(work))

    try:
        return compared(what, "events/s", plan.rounds, ours, ("pyeventsourcing", theirs), target)
    finally:
        peer.close()


# Read, verify, project, size.


def _read(log: Log, plan: Plan) -> Iterator[Row]:
    """Catch-up to Arrow beside ADBC, verify beside reading, and what an event takes on disk."""
    yield from _caught_up(log, plan, 1000)
    total = sum(head.sequence for head in log.streams())

    def read_only(_: int) -> float:
        return rate(total, lambda: sum(len(segment.payload) for segment in log.read_all()))

    def verified(_: int) -> float:
        def work() -> None:
            assert verify(log).is_sound

        return rate(total, work)

    yield compared("verify, 1,000 a segment", "events/s", plan.rounds, verified, ("reading the same", read_only), 0.5)
    yield _size(log, total)


def _large(log: Log, plan: Plan) -> Iterator[Row]:
    """Catch-up as after a flood, when commits are full."""
    yield from _caught_up(log, plan, 10_000)


def _caught_up(log: Log, plan: Plan, size: int) -> Iterator[Row]:
    table = references.TypedTable(log.dsn)
    total = plan.times(EVENTS_READ // size) * size
    _fill(log, total, size)
    for number in range(total // size):
        table.copy(row_batch(points(size, number % 20), number, 1 + number // 100 * size))

    def to_arrow(_: int) -> float:
        def work() -> None:
            batches = [decode(segment, log.catalogue).data for segment in log.read_all()]
            assert pa.Table.from_batches(batches).num_rows == total

        return rate(total, work)

    adbc = ("ADBC", lambda _: rate(total, lambda: references.adbc_table(log.dsn, table.name)))
    yield compared(f"catch-up read to Arrow, {size:,} a segment", "events/s", plan.rounds, to_arrow, adbc, 12)


def _fill(log: Log, total: int, size: int) -> None:
    with SharedAppender(log) as appender:
        for number in range(total // size):
            appender.submit(stream(number), points(size, number % 20), PRODUCER)


def _size(log: Log, total: int) -> Row:
    import psycopg

    json_table = references.JsonTable(log.dsn)
    sample = min(total, 50_000)
    for number in range(sample // 1000):
        json_table.copy(points(1000, number % 20), str(stream(number)), 1 + number // 100 * 1000)
    with psycopg.connect(log.dsn, autocommit=True) as owner:
        owner.execute("vacuum segments")
        row = owner.execute(
            "select sum(pg_total_relation_size(t::regclass)) from unnest(array['segments', 'streams', 'log_head']) as t"
        ).fetchone()
    assert row is not None
    ours, theirs = int(row[0]) / total, json_table.bytes() / sample
    return Row(
        "bytes an event on disk, 1,000 a segment", "bytes", ours, theirs, "JSONB, 2 indexes", ours / theirs, 0.1, False
    )


def _project(log: Log, plan: Plan) -> Iterator[Row]:
    """The row projector beside COPY of the same rows into a table without an index."""
    table = references.TypedTable(log.dsn)
    size, number, starts = 10_000, plan.times(40), count()
    rows = [row_batch(points(size, seed), seed, 1) for seed in range(20)]
    projector = Projector(log)

    def ours(_: int) -> float:
        for call in range(number):
            log.append([encode(stream(next(starts)), points(size, call % 20), PRODUCER)])
        return rate(number * size, projector.catch_up)

    copy = ("binary COPY", lambda _: rate(number * size, lambda: _copied(table, rows, number)))
    ours(0)  # partitions and statements are there after a first time
    try:
        yield compared("row projector, 10,000 a batch", "events/s", plan.rounds, ours, copy, 0.55)
    finally:
        projector.close()


MEASUREMENTS: tuple[Callable[[Log, Plan], Iterator[Row]], ...] = (_append, _shared, _read, _large, _project)


if __name__ == "__main__":
    main()
