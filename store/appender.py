"""The appender: what extractors hand their batches to.

Contract: batches of one stream are stored in the order of their calls; when `append` returns they
are durable, or were already there. It keeps each stream's sequence, so an append whose
confirmation was lost is sent again safely, and it waits for a database that is away.

`resume_at` makes a restart harmless: events that the stream already holds are skipped, not stored
again, which needs an extractor that says the same thing for the same input.
"""

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from events import Draft, EventBatch, InvalidEvent, Producer, StreamName, encode
from store.errors import LogUnavailable
from store.log import Log
from store.writing import Appended

T = TypeVar("T")

_RETRY_SECONDS_MIN = 0.1
RETRY_SECONDS_MAX = 5.0


class Appender:
    """Appends batches of many streams of one producer."""

    def __init__(
        self,
        log: Log,
        producer: Producer,
        *,
        wait_s: float = 60.0,
        on_wait: Callable[[LogUnavailable], None] | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Build an appender.

        Args:
            log: Where to append.
            producer: Who says it.
            wait_s: How long to wait for a database that is away, in seconds.
            on_wait: Told once for each wait.
            sleep: How to wait.
        """
        self._log = log
        self._producer = producer
        self._wait_s = wait_s
        self._on_wait = on_wait
        self._sleep = sleep
        self._heads: dict[StreamName, int] = {}
        self._stored: dict[StreamName, int] = {}

    def resume_at(self, stream: StreamName, sequence: int) -> None:
        """The next batch of the stream begins behind `sequence`, though the log may hold more of it.

        Below 0 it begins in an earlier life of the stream, so many events before that life's end.
        """
        self._heads[stream] = sequence
        self._stored.pop(stream, None)

    def append(self, batches: Sequence[tuple[StreamName, EventBatch]]) -> list[Appended]:
        """Store the batches in one transaction; those that the log holds already are left out.

        Raises:
            LogUnavailable: The database stayed away for `wait_s`; the same call may be made again.
            SequenceConflict: Somebody else appended to one of the streams.
            InvalidEvent: A batch is empty or cannot be encoded; nothing of the call is stored.
            UnknownType: A batch is of a type that the log's catalogue does not hold; nothing is stored.
        """
        drafts: list[Draft] = []
        expected: list[int | None] = []
        heads: dict[StreamName, int] = {}
        for stream, batch in batches:
            self._log.catalogue.check_registered(batch.type)
            if not len(batch):
                raise InvalidEvent(f"{stream}: an append holds one event or more, got an empty batch")
            head = heads[stream] if stream in heads else self._head(stream)
            fresh = self._unstored(stream, head, batch)
            heads[stream] = head + len(batch)
            if len(fresh):
                drafts.append(encode(stream, fresh, self._producer))
                expected.append(heads[stream] - len(fresh))
        appended = self.persistently(lambda: self._log.append(drafts, expected)) if drafts else []
        self._heads |= heads
        return appended

    def persistently(self, action: Callable[[], list[T]]) -> list[T]:
        """The action's result; a database that is away is waited for, and the action done again.

        Raises:
            LogUnavailable: The database stayed away for `wait_s`.
        """
        deadline = time.monotonic() + self._wait_s
        pause = _RETRY_SECONDS_MIN
        try:
            return action()
        except LogUnavailable as error:
            reason = error
        if self._on_wait is not None:
            self._on_wait(reason)
        while time.monotonic() < deadline:
            self._sleep(pause)
            pause = min(pause * 2, RETRY_SECONDS_MAX)
            try:
                self._log.revive()
                return action()
            except LogUnavailable as error:
                reason = error
        raise LogUnavailable(
            f"{reason}; waited {self._wait_s:g} s for it. Nothing acknowledged is lost. "
            "Next: vian doctor, then run the same command again: it goes on where the log stands"
        ) from reason

    def _unstored(self, stream: StreamName, head: int, batch: EventBatch) -> EventBatch:
        """The part of the batch that lies behind what the stream held when this appender began."""
        return batch.slice(min(len(batch), max(0, self._stored[stream] - head)))

    def _head(self, stream: StreamName) -> int:
        if stream not in self._stored:
            self._stored[stream] = self.persistently(lambda: [self._log.stream_head(stream).sequence])[0]
        return self._heads.setdefault(stream, self._stored[stream])
