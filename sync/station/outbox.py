"""The outbox: segments that wait, read from the station's log for one request.

Contract: segments come verbatim and in order of sequence in each gap, each checked before it is given out: its
payload's hash, and the chain from where the gap begins to where it ends. So what central holds and what this
station holds are proven to be one history before anything more is sent. A segment whose payload has left this
station's disk goes without it, so that the chain goes on.

It knows no network. It keeps open readers between requests, so that a backlog is read once; after
any doubt they must be forgotten.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from events import Segment, fault_behind
from store import ChainBroken, Log, StreamHead
from sync.errors import Damaged, HeadsDisagree, SegmentRefused
from sync.protocol.wire import Record, record_size
from sync.runs import Gap, Point, StreamKey

READERS_MAX = 8
"""Streams of which a page may be held in memory between two requests."""


@dataclass(frozen=True, slots=True)
class Capacity:
    """What one request may hold."""

    bytes_wanted: int
    """Filled up to here; a single larger segment goes alone."""
    bytes_max: int
    """What central takes at most."""
    segments_max: int


@dataclass(frozen=True, slots=True)
class Filled:
    """What one request carries of one stream: the events behind `after`, up to `end`."""

    key: StreamKey
    after: Point
    end: Point
    size: int
    """bytes of the records"""
    time_max: datetime


@dataclass(frozen=True, slots=True)
class Parcel:
    """What one request carries."""

    records: tuple[Record, ...]
    filled: tuple[Filled, ...]

    @property
    def events(self) -> int:
        """Number of events."""
        return sum(record.segment.header.event_count for record in self.records)

    @property
    def size(self) -> int:
        """Bytes of the records."""
        return sum(each.size for each in self.filled)


def check_heads(here: StreamHead, there: Point, epoch: int) -> None:
    """Nothing, if what central has newest can belong to the history of which `here` is the head.

    Of an earlier epoch central may have more: what came after the backup, or before the disk was put back. Whether
    that goes on from here is looked at apart (`sync.station.comparing`).

    Args:
        here: The stream's head at this station.
        there: Central's.
        epoch: This log's own.

    Raises:
        HeadsDisagree: Central has more than this station, or another last segment.
    """
    is_past = here.epoch < epoch
    if there.sequence > here.sequence and not is_past:
        raise HeadsDisagree(here.stream, here.epoch, there.sequence, None, there.chain_hash)
    if there.sequence == here.sequence and there.chain_hash != here.chain_hash:
        raise HeadsDisagree(here.stream, here.epoch, there.sequence, here.chain_hash, there.chain_hash, is_past)


def check_history(log: Log, here: StreamHead, there: Point) -> None:
    """Nothing, if what central has newest is of this log's history of the stream, as the log itself says.

    Raises:
        HeadsDisagree: It is not.
        LogUnavailable: The database is away.
    """
    check_heads(here, there, log.epoch)
    if 0 < there.sequence < here.sequence:
        segment = next(log.read(here.stream, there.sequence, epoch=here.epoch, with_hollow=True), None)
        if segment is not None and segment.header.first_sequence <= there.sequence:
            end = Point(segment.header.last_sequence, segment.chain_hash)
            _check_end(StreamKey(here.stream, here.epoch), end, there, log.epoch)


class Outbox:
    """Reads what waits in one log."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._readers: dict[tuple[StreamKey, int], _Reader] = {}

    def forget(self) -> None:
        """Begin anew at the gaps that the next `fill` is given."""
        self._readers.clear()

    def fill(self, gaps: Sequence[Gap], capacity: Capacity) -> Parcel:
        """The first segments of the gaps, of the first gap first, as many as go into a request.

        Raises:
            StreamStopped: One of the streams must not be sent further.
            LogUnavailable: The station's database is away.
        """
        records: list[Record] = []
        filled: list[Filled] = []
        room = capacity.bytes_wanted
        try:
            for gap in gaps:
                taken = self._take(gap, room, capacity, len(records))
                if not taken:
                    break
                room -= sum(size for _, size in taken)
                filled.append(_filled(gap, taken))
                records += [record for record, _ in taken]
                if room <= 0 or taken[-1][0].segment.header.last_sequence < gap.until.sequence:
                    break
        except BaseException:
            # What was taken is not sent: read it again.
            self.forget()
            raise
        return Parcel(tuple(records), tuple(filled))

    def _take(self, gap: Gap, room: int, capacity: Capacity, held: int) -> list[tuple[Record, int]]:
        """The gap's first records that there is room for, and their sizes; the first of a request in any case."""
        reader = self._reader(gap)
        taken: list[tuple[Record, int]] = []
        while (record := reader.peek()) is not None:
            size = record_size(record.segment)
            is_first = not held and not taken
            if not is_first and (size > room or held + len(taken) == capacity.segments_max):
                break
            _check_size(record.segment, size, capacity.bytes_max)
            taken.append((reader.take(), size))
            room -= size
        if reader.peek() is not None:
            self._readers[gap.key, reader.at.sequence] = reader
        return taken

    def _reader(self, gap: Gap) -> "_Reader":
        reader = self._readers.pop((gap.key, gap.after.sequence), None)
        if reader is None or reader.at != gap.after or not reader.may_go_to(gap.until):
            reader = _Reader(self._log, gap)
        while len(self._readers) >= READERS_MAX:
            del self._readers[next(iter(self._readers))]
        return reader


class _Reader:
    """Checked records of one gap; `at` is where central stands once the taken ones are stored."""

    def __init__(self, log: Log, gap: Gap) -> None:
        self.at = gap.after
        self._until = gap.until
        self._records = _checked(log, gap)
        self._next: Record | None = None

    def may_go_to(self, until: Point) -> bool:
        """Whether it ends there, or before and not above."""
        return self._until.sequence <= until.sequence

    def peek(self) -> Record | None:
        """The next record; None at the gap's end."""
        if self._next is None:
            self._next = next(self._records, None)
        return self._next

    def take(self) -> Record:
        """The record that `peek` showed."""
        record, self._next = self._next, None
        assert record is not None, "take follows a peek that showed a record"
        self.at = Point(record.segment.header.last_sequence, record.segment.chain_hash)
        return record


def _checked(log: Log, gap: Gap) -> Iterator[Record]:
    at, begins_run = gap.after, gap.begins_run
    for segment in _stored(log, gap):
        end = Point(segment.header.last_sequence, segment.chain_hash)
        if segment.header.first_sequence <= gap.after.sequence:
            _check_end(gap.key, end, gap.after, log.epoch)
            continue
        _check_segment(segment, at)
        if end.sequence >= gap.until.sequence:
            _check_end(gap.key, end, gap.until, log.epoch)
        yield Record(segment, at.chain_hash, begins_run)
        at, begins_run = end, False
        if end.sequence >= gap.until.sequence:
            return
    reason = f"it is missing: the stream goes to sequence {gap.until.sequence}"
    raise Damaged(*gap.key, at.sequence + 1, reason)


def _stored(log: Log, gap: Gap) -> Iterator[Segment]:
    """The segments from the one behind which the gap begins."""
    stream, epoch = gap.key
    try:
        yield from log.read(stream, max(gap.after.sequence, 1), epoch=epoch, with_hollow=True)
    except ChainBroken as error:
        raise Damaged(stream, epoch, error.first_sequence, error.reason) from error


def _check_end(key: StreamKey, here: Point, there: Point, epoch: int) -> None:
    """Nothing, if a segment of this station ends where central holds that one does, with the same chain hash."""
    if here != there:
        chain_hash = here.chain_hash if here.sequence == there.sequence else None
        raise HeadsDisagree(*key, there.sequence, chain_hash, there.chain_hash, key.epoch < epoch)


def _check_segment(segment: Segment, at: Point) -> None:
    """Nothing, if the segment is whole and goes on from there."""
    reason = fault_behind(segment, at.sequence, at.chain_hash)
    if reason is not None:
        raise Damaged(segment.stream, segment.header.epoch, segment.header.first_sequence, reason)


def _check_size(segment: Segment, size: int, bytes_max: int) -> None:
    if size > bytes_max:
        raise SegmentRefused(
            segment.stream,
            segment.header.epoch,
            segment.header.first_sequence,
            f"its record has {size} bytes, central takes at most {bytes_max}",
        )


def _filled(gap: Gap, taken: Sequence[tuple[Record, int]]) -> Filled:
    last = taken[-1][0].segment
    return Filled(
        gap.key,
        gap.after,
        Point(last.header.last_sequence, last.chain_hash),
        sum(size for _, size in taken),
        max(record.segment.header.time_max for record, _ in taken),
    )
