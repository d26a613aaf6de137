"""Processes that load a log until they are killed, and what they say of it."""

import logging
import os
import random
import signal
import time
from collections import deque
from collections.abc import Callable
from datetime import datetime, timedelta
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa

from events import Catalogue, EventBatch, StreamName, TrackPoint, events_of, schema_of
from store import Appender, Journal, Log, LogUnavailable, Projector, SequenceConflict, SharedAppender, StoreError
from store.embedded import EmbeddedServer
from store.shared import Limits, Receipt
from tests.store.samples import NOON, PRODUCER, points

T = TypeVar("T")

STREAMS = tuple(StreamName.of("brno", source, "track_point") for source in ("gate", "yard", "roof"))
SHARED = StreamName.of("brno", "shared", "track_point")
SUBMITTED = tuple(StreamName.of("brno", source, "track_point") for source in ("lobby", "door"))
"""Streams of the shared appender."""
JOURNAL = "journal.sqlite"
PRELOADED = [__name__, "tests.faults.sync_load"]
"""What the processes need: imported once, in the process from which they are forked."""
BATCH_MAX = 5
WAIT_S = 60.0
"""Longest wait for a process that does what it should."""

_SCHEMA = schema_of(TrackPoint)
(_ONE,) = points(1, 1).data.to_pylist()


def opened(data_dir: Path) -> Log:
    """The log of a data directory that was migrated before."""
    for name in ("psycopg", "store.shared"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what they lose is what we take away
    server = EmbeddedServer(data_dir)
    return Log(server.dsn, Catalogue.shipped(), server)


def frames(first: int, last: int, at: datetime) -> EventBatch:
    """Track points whose frames are their sequences, at a time."""
    count = last - first + 1
    columns = {name: pa.repeat(pa.scalar(value, _SCHEMA.field(name).type), count) for name, value in _ONE.items()}
    columns["frame"] = pa.array(range(first, last + 1), _SCHEMA.field("frame").type)
    columns["time"] = pa.repeat(pa.scalar(at, _SCHEMA.field("time").type), count)
    return EventBatch(TrackPoint, pa.RecordBatch.from_pydict(columns, schema=_SCHEMA))


def append_until_killed(data_dir: Path, seed: int, say: Connection) -> None:
    """Append to all streams by a clock that jumps by days, and say where each stands once it is acknowledged."""
    choose = random.Random(seed)
    with opened(data_dir) as log:
        appender = Appender(log, PRODUCER, wait_s=WAIT_S)
        heads = {stream: persistently(log, lambda s=stream: log.stream_head(s)).sequence for stream in STREAMS}
        say.send(heads)
        while True:
            batches = []
            for stream in choose.sample(STREAMS, choose.randint(1, len(STREAMS))):
                first, last = heads[stream] + 1, heads[stream] + choose.randint(1, BATCH_MAX)
                at = NOON + timedelta(days=choose.choice((-1, 0, 0, 0, 1)), milliseconds=first)
                batches.append((stream, frames(first, last, at)))
                heads[stream] = last
            try:
                appender.append(batches)
            except StoreError as error:
                say.send(f"the appender gave up: {error}")
                return
            say.send(dict(heads))


def submit_until_killed(data_dir: Path, seed: int, say: Connection) -> None:
    """Submit single events and batches to the shared appender with its journal, and say what is acknowledged.

    Acknowledged is what is in the log or, while PostgreSQL is away, in the journal.
    """
    choose = random.Random(seed)
    limits = Limits(window_s=0.01, waiting_events_max=200)
    with (
        opened(data_dir) as log,
        Journal(data_dir / JOURNAL) as journal,
        SharedAppender(log, limits=limits, journal=journal) as appender,
    ):
        while appender.standing().drafts_in_journal:
            time.sleep(0.01)  # what an earlier life left comes first, and numbers go on behind it
        heads = {stream: persistently(log, lambda s=stream: log.stream_head(s)).sequence for stream in SUBMITTED}
        acknowledged: dict[StreamName, int] = dict(heads)
        waiting: deque[tuple[StreamName, int, Receipt]] = deque()
        say.send(dict(acknowledged))
        while True:
            stream = choose.choice(SUBMITTED)
            first, last = heads[stream] + 1, heads[stream] + choose.choice((1, 1, 1, BATCH_MAX))
            batch = frames(first, last, NOON + timedelta(milliseconds=first))
            item = batch if last > first else events_of(batch)[0]
            waiting.append((stream, last, appender.submit(stream, item, PRODUCER)))
            heads[stream] = last
            is_news = False
            while waiting and (waiting[0][2].done() or len(waiting) > 100):
                done, number, receipt = waiting.popleft()
                receipt.result(WAIT_S)
                acknowledged[done] = number
                is_news = True
            if is_news:
                say.send(dict(acknowledged))


def project_until_killed(data_dir: Path, _seed: int, say: Connection) -> None:
    """Project, and say up to which position."""
    with opened(data_dir) as log:
        projector = persistently(log, lambda: Projector(log))
        while True:
            say.send(persistently(log, lambda: projector.step(0.2)).position)


def persistently(log: Log, action: Callable[[], T]) -> T:
    """The action's result, once the database is there for it; starts the log's server again where it died."""
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return action()
        except LogUnavailable:
            if time.monotonic() > deadline:
                raise
        try:
            log.revive()
        except LogUnavailable:
            time.sleep(0.1)


def append_one(dsn: str, expected: int, say: Connection) -> None:
    """Append one event at the sequence that is expected, at a sign, and say true, or where the stream stood."""
    with Log(dsn, Catalogue.shipped()) as log:
        log.head()
        appender = Appender(log, PRODUCER)
        appender.resume_at(SHARED, expected)
        # What tells the two apart is their time: their bytes differ.
        batch = frames(expected + 1, expected + 1, NOON + timedelta(microseconds=os.getpid()))
        say.send("ready")
        say.recv()
        try:
            appender.append([(SHARED, batch)])
        except SequenceConflict as error:
            say.send((error.expected, error.actual))
        else:
            say.send(True)


class Process:
    """A process with a pipe on which it says how far it has come."""

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        # Forked from a process that has no threads and has imported all that they need once.
        context = get_context("forkserver")
        context.set_forkserver_preload(PRELOADED)
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=target, args=(*arguments, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def said(self, seconds: float = WAIT_S) -> Any:
        """What it says next.

        Raises:
            EOFError: It is gone.
        """
        if not self.pipe.poll(seconds):
            raise AssertionError(f"the process said nothing for {seconds} s")
        return self.pipe.recv()

    def last_words(self) -> list[Any]:
        """All that it said and nobody has heard yet; of a killed one, to its end."""
        words = []
        try:
            while self.pipe.poll(0):
                words.append(self.pipe.recv())
        except (EOFError, OSError):
            pass
        return words

    @property
    def is_running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.is_alive()

    def signal(self, number: int) -> None:
        """Send it a signal."""
        os.kill(self._process.pid or 0, number)

    def kill(self) -> None:
        """SIGKILL."""
        self.signal(signal.SIGKILL)
        self._process.join(WAIT_S)

    def close(self) -> None:
        """Kill it if it runs, and forget it."""
        if self._process.is_alive():
            self.kill()
        self._process.join(WAIT_S)
        self._process.close()
        self.pipe.close()
