"""Processes of their own that write to a log, and what they run."""

import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pyarrow as pa

from events import Catalogue, EventBatch, StreamName, TrackPoint, encode, schema_of
from store import Log, Subscription, open_log
from tests.store.samples import PRODUCER, draft, points

WAIT_S = 60
"""Longest wait for a process that does what it should."""

BATCH_MAX = 120
"""Events of the largest batch that a writer appends to a stream."""

_SCHEMA = schema_of(TrackPoint)

SHARED = StreamName.of("brno", "shared", "track_point")


class Writer:
    """A process that says when it is ready, and then waits for leave to go on."""

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        # Forked from a process that has no threads and has imported all that they need once.
        context = get_context("forkserver")
        context.set_forkserver_preload([__name__])
        self._ours, self._theirs = context.Pipe()
        self._process = context.Process(target=target, args=(*arguments, self._theirs))
        self._process.start()

    def wait_until_ready(self) -> None:
        self.said()

    def said(self) -> Any:
        """What the process says next."""
        assert self._ours.poll(WAIT_S), "the process says nothing"
        return self._ours.recv()

    def go_on(self) -> None:
        self._ours.send("go on")

    def wait_until_done(self) -> None:
        self._process.join(WAIT_S)
        assert self._process.exitcode == 0

    def wait_until_dead(self) -> int | None:
        """How it ended, when it had something to die of."""
        self._process.join(WAIT_S)
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()
        self._process.join()

    def close(self) -> None:
        self.kill()
        self._process.close()
        self._ours.close()
        self._theirs.close()


@contextmanager
def started(target: Callable[..., None], *arguments: Any) -> Iterator[Writer]:
    """A process that runs the function, with a connection as its last argument; it is killed in the end."""
    writer = Writer(target, *arguments)
    try:
        yield writer
    finally:
        writer.close()


def own_stream(writer: int) -> StreamName:
    """The stream that only this writer appends to."""
    return StreamName.of("brno", f"writer-{writer}", "track_point")


def frame(writer: int, number: int) -> int:
    """The frame by which a reader knows whose event it is, and which."""
    return writer * 1_000_000 + number


def frames(first: int, last: int) -> EventBatch:
    """Track points of the frames `first` to `last`, made as columns: quick for many."""
    count = last - first + 1
    (one,) = points(first, first).data.to_pylist()
    columns = {name: pa.repeat(pa.scalar(value, _SCHEMA.field(name).type), count) for name, value in one.items()}
    columns["frame"] = pa.array(range(first, last + 1), _SCHEMA.field("frame").type)
    return EventBatch(TrackPoint, pa.RecordBatch.from_pydict(columns, schema=_SCHEMA))


def append_many(dsn: str, writer: int, events: int, ready: Connection) -> None:
    """Append so many events to a stream of one's own, and as many to the shared one.

    In batches of random size, in random order, with random pauses.
    """
    choose = random.Random(writer)
    with Log(dsn, Catalogue.shipped()) as log:
        ready.send(writer)
        ready.recv()
        done = 0
        while done < events:
            count = min(choose.randint(1, BATCH_MAX), events - done)
            batch = frames(frame(writer, done + 1), frame(writer, done + count))
            drafts = [(encode(own_stream(writer), batch, PRODUCER), done), (encode(SHARED, batch, PRODUCER), None)]
            choose.shuffle(drafts)
            log.append([draft for draft, _ in drafts], [expected for _, expected in drafts])
            done += count
            time.sleep(choose.choice((0, 0, 0.002, 0.01)))


def follow(dsn: str, name: str, events: int, ready: Connection) -> None:
    """Read the log as it grows until so many events were seen, and say what was seen, segment by segment."""
    seen: list[tuple[int, bytes]] = []
    left = events
    with Log(dsn, Catalogue.shipped()) as log, Subscription(log, name, limit=7) as subscription:
        ready.send(name)
        ready.recv()
        while left > 0:
            delivery = subscription.poll(WAIT_S / 2)
            assert delivery.segments, f"no segment within {WAIT_S / 2} s, and {left} events are not there"
            seen += [(segment.position, segment.chain_hash) for segment in delivery.segments]
            left -= sum(segment.header.event_count for segment in delivery.segments)
        assert subscription.poll().segments == []
    ready.send(seen)


def append_and_wait(dsn: str, ready: Connection) -> None:
    """Append in a transaction that is never finished."""
    with Log(dsn, Catalogue.shipped()) as log, log.transaction() as transaction:
        transaction.append([draft(SHARED, 1, 5)])
        ready.send("appended")
        ready.recv()


def open_append_and_wait(data_dir: str, source: str, ready: Connection) -> None:
    """Open a data directory, append to it, and stay until told to go."""
    with open_log(data_dir=Path(data_dir)) as log:
        log.append([draft(StreamName.of("brno", source, "track_point"), 1, 3)], [0])
        ready.send(source)
        ready.recv()
