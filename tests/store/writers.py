"""Processes of their own that write to a log, and what they run."""

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from events import Catalogue, StreamName
from store import Log, open_log
from tests.store.samples import draft

WAIT_S = 60
"""Longest wait for a process that does what it should."""

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
        assert self._ours.poll(WAIT_S), "the process did not get ready"
        self._ours.recv()

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


def append_many(dsn: str, writer: int, events: int, ready: Connection) -> None:
    """Append so many events to a stream of one's own, and as many to the shared one, in random batches and order."""
    choose = random.Random(writer)
    with Log(dsn, Catalogue.shipped()) as log:
        ready.send(writer)
        ready.recv()
        done = 0
        while done < events:
            count = min(choose.randint(1, 12), events - done)
            own = draft(own_stream(writer), frame(writer, done + 1), frame(writer, done + count))
            shared = draft(SHARED, frame(writer, done + 1), frame(writer, done + count))
            drafts = [(own, done), (shared, None)]
            choose.shuffle(drafts)
            log.append([draft for draft, _ in drafts], [expected for _, expected in drafts])
            done += count


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
