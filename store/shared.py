"""The shared appender: what all extractors of one machine hand their events to.

Contract: events of one stream are stored in the order of their submission. A submission's receipt is done
when its events are durable: in the log, or, while the database is away, in the journal on the local disk,
from where they follow in order as soon as it is back, after a restart of the program too. Nothing that a
receipt acknowledged is lost, and nothing is stored twice.

Submissions wait at most the window for others to share their commit with; those of one stream and producer
become one segment. Memory is bounded: a submission waits while too much is on its way. One thread makes
segments while another commits those before; the database sees one round trip a commit.
"""

import logging
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self, cast

import pyarrow as pa

from events import (
    Draft,
    EventBatch,
    EventError,
    EventType,
    InvalidEvent,
    Producer,
    Source,
    Station,
    StreamName,
    batch_of_type,
    encode,
    source_name,
    station_name,
)
from store.errors import ChainBroken, DiskNearlyFull, LogUnavailable, SequenceConflict, StoreError
from store.journal import Journal, Kept
from store.log import Log
from store.writing import Appended

logger = logging.getLogger(__name__)

_RETRY_SECONDS_MIN = 0.1
_RETRY_SECONDS_MAX = 5.0
_EVENT_BYTES = 1024
"""What a single event counts for in memory; a batch counts for its columns."""


@dataclass(frozen=True, slots=True)
class Limits:
    """How much is put together, and how much may be on its way."""

    window_s: float = 0.1
    """longest wait for others to share a commit with, in seconds"""
    events_max: int = 10_000
    """events after which a commit does not wait for the window, and most events of one that is made of several"""
    waiting_events_max: int = 100_000
    """events on their way in memory at which a submission waits"""
    waiting_bytes_max: int = 64 * 2**20
    """bytes on their way in memory at which a submission waits"""
    journal_bytes_max: int = 8 * 2**30
    """size of the journal at which submissions wait for the database, in bytes"""
    close_wait_s: float = 60.0
    """how long `close` waits for a database that is away where there is no journal, and how long it empties
    the journal into one that is there, in seconds"""


@dataclass(frozen=True, slots=True)
class Stored:
    """What became of a submission."""

    event_count: int
    position: int | None
    """place of its segment in the log; None while it is in the journal"""
    first_sequence: int | None
    """sequence of its first event; None while it is in the journal"""

    @property
    def is_in_log(self) -> bool:
        """Whether the log holds it already; else the journal does."""
        return self.position is not None


Item = EventBatch | EventType


@dataclass(frozen=True, slots=True)
class Standing:
    """Where the appender stands."""

    events_waiting: int
    """events on their way in memory"""
    drafts_in_journal: int
    """segments on the local disk that the log lacks"""
    away: str | None
    """why the database is away; None when it is there"""


class Receipt:
    """A submission on its way: done when its events are durable, or when it is known that they cannot be.

    One object a submission, and one condition for all: a single event shall cost little.
    """

    __slots__ = ("_error", "_settled", "_stored", "bytes", "count", "item", "producer", "stream")

    def __init__(
        self, stream: StreamName, producer: Producer, item: Item, count: int, size: int, settled: threading.Condition
    ) -> None:
        self.stream = stream
        self.producer = producer
        self.item: Item | None = item
        self.count = count
        self.bytes = size
        self._settled = settled
        self._stored: Stored | None = None
        self._error: BaseException | None = None

    def done(self) -> bool:
        """Whether it is known what became of the events."""
        return self._stored is not None or self._error is not None

    def result(self, timeout: float | None = None) -> Stored:
        """What became of the events, once it is known.

        Args:
            timeout: Longest wait in seconds; without end by default.

        Raises:
            TimeoutError: It is not known yet.
            EventError: The events cannot be stored.
            StoreError: The appender ended before they were stored.
        """
        if not self.done():
            with self._settled:
                if not self._settled.wait_for(self.done, timeout):
                    raise TimeoutError(f"{self.count} events for {self.stream} are not durable after {timeout:g} s")
        if self._error is not None:
            raise self._error
        assert self._stored is not None, "it is done"
        return self._stored

    def succeed(self, stored: Stored) -> None:
        """Say what became of the events; the appender wakes those who wait."""
        self._stored, self.item = stored, None

    def fail(self, error: BaseException) -> None:
        """Say why the events are not stored, unless it is known that they are."""
        if not self.done():
            self._error, self.item = error, None


@dataclass(slots=True)
class _Ready:
    """A segment ready to go, and whose events are in it."""

    draft: Draft
    submissions: list[Receipt]
    expected: int | None = None


@dataclass(slots=True)
class _Group:
    """Segments that commit together."""

    segments: list[_Ready] = field(default_factory=list)
    events: int = 0
    bytes: int = 0


class SharedAppender:
    """Appends what many threads submit. Close it, or use it as a context, lest what waits stays behind."""

    def __init__(self, log: Log, *, limits: Limits = Limits(), journal: Journal | None = None) -> None:
        """Start the appender; what the journal holds from an earlier run goes first.

        Args:
            log: Where to append.
            limits: How much at a time, and how much at most.
            journal: Where events are kept while the database is away; without one, submissions wait for it.
        """
        self._log = log
        self._limits = limits
        self._journal = journal
        self._lock = threading.Lock()
        self._arrived = threading.Condition(self._lock)
        self._room = threading.Condition(self._lock)
        self._submitted: list[Receipt] = []
        self._first_at = 0.0
        self._queued_events = 0
        self._waiting_events = 0
        self._waiting_bytes = 0
        self._is_closing = False
        self._failure: BaseException | None = None
        self._away: LogUnavailable | None = None
        self._give_up_at = float("inf")
        self._pause_s = _RETRY_SECONDS_MIN
        self._retry_at = 0.0
        self._heads: dict[StreamName, int] = {}
        self._handed: queue.Queue[_Group | None] = queue.Queue(maxsize=1)
        self._woken = threading.Event()
        self._threads = [
            threading.Thread(target=work, name=f"appender-{name}", daemon=True)
            for name, work in (("encodes", self._encode_all), ("commits", self._commit_all))
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, stream: StreamName, item: Item, producer: Producer) -> Receipt:
        """Take an event, or a batch of them, for a stream; a receipt that is done when it is durable.

        Waits while too much is on its way. The receipt's `result()` raises `EventError` if the events cannot
        be a segment; others that shared its commit are stored all the same.

        Raises:
            InvalidEvent: The item is not of the stream's type, or empty.
            UnknownType: Its type is not registered.
            StoreError: The appender is closed, or has failed before.
        """
        kind = item.type if isinstance(item, EventBatch) else type(item)
        if kind.type_name != stream.type:
            raise InvalidEvent(f"stream {stream} takes {stream.type}, got {kind.type_name}")
        self._log.catalogue.check_registered(kind)
        count, size = (len(item), item.data.nbytes) if isinstance(item, EventBatch) else (1, _EVENT_BYTES)
        if not count:
            raise InvalidEvent(f"stream {stream}: a submission holds one event or more, got an empty batch")
        receipt = Receipt(stream, producer, item, count, size, self._room)
        with self._lock:
            while self._is_full(count, size) and not self._is_over:
                self._room.wait()
            if self._is_over:
                raise StoreError(f"the appender takes no more: {self._failure or 'it is closed'}") from self._failure
            if not self._submitted:
                self._first_at = time.monotonic()
                self._arrived.notify()
            self._submitted.append(receipt)
            self._queued_events += count
            self._waiting_events += count
            self._waiting_bytes += size
            if self._queued_events >= self._limits.events_max:
                self._arrived.notify()
        return receipt

    def of(self, station: str, source: str, producer: Producer) -> "SourceAppender":
        """The appender as one extractor of one source uses it.

        Raises:
            InvalidName: The station or the source cannot be one.
        """
        return SourceAppender(self, station_name(station), source_name(source), producer)

    def standing(self) -> Standing:
        """What is on its way, and whether the database is there."""
        kept = self._journal.drafts_kept if self._journal is not None else 0
        with self._lock:
            return Standing(self._waiting_events, kept, str(self._away) if self._away else None)

    def flush(self) -> None:
        """Return when all that was submitted before is durable."""
        with self._lock:
            while self._waiting_events and self._failure is None:
                self._first_at = 0.0
                self._arrived.notify()
                self._room.wait()

    def close(self) -> None:
        """Take no more, and return when all that was taken is durable.

        Raises:
            LogUnavailable: The database stayed away and there is no journal; the receipts say whose events
                are not stored.
            StoreError: The appender failed before.
        """
        with self._lock:
            self._is_closing = True
            self._give_up_at = time.monotonic() + self._limits.close_wait_s
            self._arrived.notify()
            self._room.notify_all()
        self._woken.set()
        for thread in self._threads:
            thread.join()
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Taking and making segments: the first thread.

    @property
    def _is_over(self) -> bool:
        return self._is_closing or self._failure is not None

    def _is_full(self, count: int, size: int) -> bool:
        """Whether one more would be too much; alone, any one may pass."""
        if not self._waiting_events:
            return False
        limits = self._limits
        is_many = self._waiting_events + count > limits.waiting_events_max
        return is_many or self._waiting_bytes + size > limits.waiting_bytes_max

    def _encode_all(self) -> None:
        taken: list[Receipt] = []
        try:
            while taken := self._taken():
                group = _Group([], sum(each.count for each in taken), sum(each.bytes for each in taken))
                for run in _runs(taken):
                    group.segments += _encoded(run)
                self._handed.put(group)
        except BaseException as error:
            _fail(taken, self._end(error))
        finally:
            self._handed.put(None)

    def _taken(self) -> list[Receipt]:
        """The submissions of the next commit; none when the appender is closed and all is taken."""
        with self._lock:
            while not self._submitted and not self._is_over:
                self._arrived.wait()
            while not self._is_over and self._queued_events < self._limits.events_max:
                remaining = self._first_at + self._limits.window_s - time.monotonic()
                if remaining <= 0:
                    break
                self._arrived.wait(remaining)
            taken = self._cut()
            self._queued_events -= sum(each.count for each in taken)
            return taken

    def _cut(self) -> list[Receipt]:
        """Off the queue's front, as many as commit together: at least one."""
        events = 0
        for number, each in enumerate(self._submitted):
            if number and events + each.count > self._limits.events_max:
                taken, self._submitted = self._submitted[:number], self._submitted[number:]
                return taken
            events += each.count
        taken, self._submitted = self._submitted, []
        return taken

    # Committing: the second thread.

    def _commit_all(self) -> None:
        group: _Group | None = _Group()
        try:
            while (group := self._next_group()) is not None:
                self._commit(group)
                self._release(group)
            self._retry_at = 0.0
            while self._has_backlog() and time.monotonic() < self._give_up_at:
                self._drain()
                if self._away is not None:
                    break  # the journal keeps it for the next run
        except BaseException as error:
            failure = self._end(error)
            while group is not None:  # the other thread must not wait for this one for ever
                for each in group.segments:
                    _fail(each.submissions, failure)
                group = self._handed.get()

    def _next_group(self) -> _Group | None:
        """What is to be committed next; meanwhile the journal is emptied. None at the end."""
        while True:
            try:
                return self._handed.get(timeout=self._seconds_to_drain())
            except queue.Empty:
                self._drain()

    def _commit(self, group: _Group) -> None:
        if not self._has_backlog():
            self._store(group)
        else:
            self._keep(group)
            self._drain()

    def _has_backlog(self) -> bool:
        return self._journal is not None and (self._away is not None or self._journal.drafts_kept > 0)

    def _seconds_to_drain(self) -> float | None:
        return max(0.0, self._retry_at - time.monotonic()) if self._has_backlog() else None

    def _release(self, group: _Group) -> None:
        with self._lock:
            self._waiting_events -= group.events
            self._waiting_bytes -= group.bytes
            self._room.notify_all()

    def _store(self, group: _Group) -> None:
        """Append the group, however long the database is away; or keep it in the journal, if there is one."""
        while group.segments:
            try:
                appended = self._append(group.segments)
            except LogUnavailable as error:
                self._is_away(error)
                if self._journal is not None and not isinstance(error, DiskNearlyFull):  # it is on a disk, too
                    self._keep(group)
                    return
                self._wait_for_database(group)
            else:
                self._is_back()
                _acknowledge(group.segments, appended)
                return

    def _append(self, segments: Sequence[_Ready]) -> list[Appended]:
        """Append at the streams' heads; where somebody else appended meanwhile, behind that."""
        while True:
            try:
                self._place(segments)
                appended = self._log.append([each.draft for each in segments], [each.expected for each in segments])
            except SequenceConflict as conflict:
                # The log holds other bytes in this place, so it does not hold these: they go behind.
                self._heads[conflict.stream] = self._log.stream_head(conflict.stream).sequence
                for each in segments:
                    if each.draft.stream == conflict.stream:
                        each.expected = None
            else:
                for each, there in zip(segments, appended, strict=True):
                    self._heads[each.draft.stream] = there.first_sequence + each.draft.event_count - 1
                return appended

    def _place(self, segments: Sequence[_Ready]) -> None:
        """Say where each segment is to stand that has no place yet. What has one keeps it: it may be stored already."""
        heads: dict[StreamName, int] = {}
        for each in segments:
            stream = each.draft.stream
            if each.expected is None:
                each.expected = heads[stream] if stream in heads else self._head(stream)
            heads[stream] = each.expected + each.draft.event_count

    def _head(self, stream: StreamName) -> int:
        if stream not in self._heads:
            self._heads[stream] = self._log.stream_head(stream).sequence
        return self._heads[stream]

    def _is_away(self, error: LogUnavailable) -> None:
        if self._away is None:
            logger.warning("events wait for the database: %s", error)
        self._away = error
        self._heads.clear()
        self._retry_at = time.monotonic() + self._pause_s
        self._pause_s = min(2 * self._pause_s, _RETRY_SECONDS_MAX)

    def _is_back(self) -> None:
        if self._away is not None:
            logger.info("the database is back")
        self._away, self._pause_s = None, _RETRY_SECONDS_MIN

    def _wait_for_database(self, group: _Group) -> None:
        """Wait until it is time to try again, and start the database if it is ours.

        Without a journal nothing can be acknowledged meanwhile; when the appender is closed it ends some day.
        """
        assert self._away is not None, "there is nothing to wait for"
        self._sleep()
        if time.monotonic() > self._give_up_at:
            for each in group.segments:
                _fail(each.submissions, self._away)
            group.segments.clear()
            self._failure = LogUnavailable(f"{self._away}; not all events are stored, their receipts say which")
            return
        try:
            self._log.revive()
        except LogUnavailable as error:
            self._is_away(error)

    def _sleep(self) -> None:
        self._woken.wait(max(0.0, min(self._retry_at, self._give_up_at + 0.01) - time.monotonic()))
        if self._woken.is_set() and time.monotonic() < self._retry_at:
            time.sleep(min(_RETRY_SECONDS_MIN, max(0.0, self._retry_at - time.monotonic())))

    # The journal.

    def _keep(self, group: _Group) -> None:
        """Put the group on the local disk, behind what is there, and acknowledge it."""
        assert self._journal is not None, "only an appender with a journal keeps"
        while self._journal.size_bytes > self._limits.journal_bytes_max and self._has_backlog():
            self._sleep()
            self._drain()
        expected = [each.expected for each in group.segments]
        self._journal.add([each.draft for each in group.segments], expected, self._log.epoch)
        for each in group.segments:
            for submission in each.submissions:
                submission.succeed(Stored(submission.count, None, None))

    def _drain(self) -> None:
        """Append the oldest of what the journal holds, if it is time to try."""
        assert self._journal is not None, "only an appender with a journal drains"
        if time.monotonic() < self._retry_at and self._away is not None:
            return
        try:
            if self._away is not None:
                self._log.revive()
            if kept := _within(self._journal.oldest(1000), self._limits.events_max):
                self._move(kept)
            self._is_back()
            self._retry_at = 0.0
        except LogUnavailable as error:
            self._is_away(error)
        except ChainBroken as error:
            # What was sent before is sealed, and its file cannot be read: the journal keeps it until it can.
            self._is_away(LogUnavailable(f"what the journal holds cannot be compared: {error}"))

    def _move(self, kept: Sequence[Kept]) -> None:
        """From the journal into the log: placed, sent, and only then forgotten."""
        assert self._journal is not None
        new = [each for each in kept if not self._is_in_earlier_life(each)]
        if new:
            is_placed_here = [each.epoch == self._log.epoch for each in new]
            segments = [
                _Ready(each.draft, [], each.expected if is_here else None)
                for each, is_here in zip(new, is_placed_here, strict=True)
            ]
            self._place(segments)
            places = {each.id: cast(int, ready.expected) for each, ready in zip(new, segments, strict=True)}
            self._journal.place(places, self._log.epoch)
            self._append(segments)
        self._journal.remove(kept[-1].id)

    def _is_in_earlier_life(self, kept: Kept) -> bool:
        """Whether the log was restored since, and what it was restored from holds the draft already."""
        if kept.epoch == self._log.epoch or kept.expected is None:
            return False
        there = next(self._log.read(kept.draft.stream, kept.expected + 1, epoch=kept.epoch, with_hollow=True), None)
        return (
            there is not None
            and there.header.first_sequence == kept.expected + 1
            and there.payload_hash == kept.draft.payload_hash
        )

    def _end(self, error: BaseException) -> StoreError:
        """After what nobody expected: take no more, and tell those who wait."""
        logger.error("the appender failed", exc_info=error)
        failure = error if isinstance(error, StoreError) else StoreError(f"the appender failed: {error!r}")
        with self._lock:
            self._failure = failure
            waiting, self._submitted = self._submitted, []
            self._room.notify_all()
            self._arrived.notify_all()
        _fail(waiting, failure)
        return failure


@dataclass(frozen=True, slots=True)
class SourceAppender:
    """The shared appender as one extractor of one source uses it."""

    shared: SharedAppender
    station: Station
    source: Source
    producer: Producer

    def append(self, item: Item) -> Receipt:
        """Take an event or a batch of them, for the source's stream of its type; see `SharedAppender.submit`."""
        kind = item.type if isinstance(item, EventBatch) else type(item)
        return self.shared.submit(StreamName(self.station, self.source, kind.type_name), item, self.producer)


def _runs(submissions: Sequence[Receipt]) -> Iterator[list[Receipt]]:
    """The submissions that can be one segment each, those of one stream in their order."""
    by_stream: dict[StreamName, list[list[Receipt]]] = {}
    for each in submissions:
        runs = by_stream.setdefault(each.stream, [])
        if runs and _fit(runs[-1][-1], each):
            runs[-1].append(each)
        else:
            runs.append([each])
    for runs in by_stream.values():
        yield from runs


def _fit(one: Receipt, other: Receipt) -> bool:
    return one.producer == other.producer and _kind(one.item) is _kind(other.item)


def _kind(item: Item | None) -> type[EventType]:
    assert item is not None, "what is on its way has its events"
    return item.type if isinstance(item, EventBatch) else type(item)


def _encoded(run: list[Receipt]) -> list[_Ready]:
    """The run as one segment; where one of them cannot be stored, the others each as their own, and it is told."""
    try:
        batch = _merged(_kind(run[0].item), [each.item for each in run if each.item is not None])
        return [_Ready(encode(run[0].stream, batch, run[0].producer), run)]
    except EventError as error:
        if len(run) == 1:
            _fail(run, error)
            return []
        return [ready for each in run for ready in _encoded([each])]


def _merged(kind: type[EventType], items: Sequence[Item]) -> EventBatch:
    if len(items) == 1 and isinstance(items[0], EventBatch):
        return items[0]
    batches: list[pa.RecordBatch] = []
    events: list[EventType] = []
    for item in items:
        if not isinstance(item, EventBatch):
            events.append(item)
            continue
        if events:
            batches.append(batch_of_type(kind, events).data)
            events = []
        batches.append(item.data)
    if events:
        batches.append(batch_of_type(kind, events).data)
    if len(batches) == 1:
        return EventBatch(kind, batches[0])
    (whole,) = pa.Table.from_batches(batches).combine_chunks().to_batches()
    return EventBatch(kind, whole)


def _within(kept: list[Kept], events_max: int) -> list[Kept]:
    """As many of the oldest as commit together: at least one."""
    events = 0
    for number, each in enumerate(kept):
        events += each.draft.event_count
        if number and events > events_max:
            return kept[:number]
    return kept


def _acknowledge(segments: Sequence[_Ready], appended: Sequence[Appended]) -> None:
    for each, there in zip(segments, appended, strict=True):
        first = there.first_sequence
        for submission in each.submissions:
            submission.succeed(Stored(submission.count, there.position, first))
            first += submission.count


def _fail(submissions: Sequence[Receipt], error: BaseException) -> None:
    for each in submissions:
        each.fail(error)
