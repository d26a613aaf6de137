"""The outbox: the segments behind central's cursors, read from the station's log for one request.

Contract: segments come verbatim and in order of sequence in each stream, each checked before it is
given out: its payload's hash, and the chain from central's cursor on. So what central holds and what
this station holds are proven to be one history before anything more is sent.

It knows no network. It keeps open readers between requests, so that a backlog is read once; after
any doubt they must be forgotten.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from events import Segment, StreamName, fault_behind
from store import ChainBroken, Log, StreamHead
from sync.errors import Damaged, HeadsDisagree, SegmentRefused
from sync.wire_v1 import encode_records, record_size

StreamKey = tuple[StreamName, int]
"""A stream in one epoch: what has a cursor of its own."""

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
class Parcel:
    """What one request carries."""

    body: bytes
    segments: int
    events: int
    ends: dict[StreamKey, StreamHead]
    """Where central will stand when it has stored it."""


def key_of(head: StreamHead) -> StreamKey:
    """Which stream in which epoch it is the head of."""
    return head.stream, head.epoch


def check_heads(here: StreamHead, cursor: StreamHead) -> None:
    """Nothing, if the cursor can belong to the history of which `here` is the head.

    Raises:
        HeadsDisagree: Central has more than this station, or another last segment.
    """
    if cursor.sequence > here.sequence:
        raise HeadsDisagree(here.stream, here.epoch, cursor.sequence, None, cursor.chain_hash)
    if cursor.sequence == here.sequence and cursor.chain_hash != here.chain_hash:
        raise HeadsDisagree(here.stream, here.epoch, cursor.sequence, here.chain_hash, cursor.chain_hash)


class Outbox:
    """Reads backlogs of one log."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._readers: dict[StreamKey, _Reader] = {}

    def forget(self) -> None:
        """Begin anew at the cursors that the next `fill` gives."""
        self._readers.clear()

    def fill(self, cursors: Sequence[StreamHead], capacity: Capacity) -> Parcel:
        """The next segments behind the cursors, of the first stream first, as many as go into a request.

        Raises:
            StreamStopped: One of the streams must not be sent further.
            LogUnavailable: The station's database is away.
        """
        chosen: list[Segment] = []
        size = 0
        try:
            for cursor in cursors:
                reader = self._reader(cursor)
                while (segment := reader.peek()) is not None:
                    more = record_size(segment)
                    if chosen and (size + more > capacity.bytes_wanted or len(chosen) == capacity.segments_max):
                        return _parcel(chosen)
                    _check_size(segment, more, capacity.bytes_max)
                    chosen.append(reader.take())
                    size += more
                del self._readers[key_of(cursor)]
        except BaseException:
            # What was taken is not sent: read it again.
            self.forget()
            raise
        return _parcel(chosen)

    def _reader(self, cursor: StreamHead) -> "_Reader":
        key = key_of(cursor)
        reader = self._readers.pop(key, None)
        if reader is None or reader.cursor != cursor:
            reader = _Reader(self._log, cursor)
        while len(self._readers) >= READERS_MAX:
            del self._readers[next(iter(self._readers))]
        self._readers[key] = reader
        return reader


class _Reader:
    """Checked segments of one stream; `cursor` is where central stands once the taken ones are stored."""

    def __init__(self, log: Log, cursor: StreamHead) -> None:
        self.cursor = cursor
        self._segments = _checked(log, cursor)
        self._next: Segment | None = None

    def peek(self) -> Segment | None:
        """The next segment; None at the stream's end."""
        if self._next is None:
            self._next = next(self._segments, None)
        return self._next

    def take(self) -> Segment:
        """The segment that `peek` showed."""
        segment, self._next = self._next, None
        assert segment is not None, "take follows a peek that showed a segment"
        header = segment.header
        self.cursor = StreamHead(header.stream, header.epoch, header.last_sequence, segment.chain_hash)
        return segment


def _checked(log: Log, cursor: StreamHead) -> Iterator[Segment]:
    sequence, chain_hash = cursor.sequence, cursor.chain_hash
    for segment in _stored(log, cursor):
        if segment.header.first_sequence <= cursor.sequence:
            _check_cursor(segment, cursor)
            continue
        _check_segment(segment, sequence, chain_hash)
        yield segment
        sequence, chain_hash = segment.header.last_sequence, segment.chain_hash


def _stored(log: Log, cursor: StreamHead) -> Iterator[Segment]:
    """The segments from the one at which central stands."""
    try:
        yield from log.read(cursor.stream, max(cursor.sequence, 1), epoch=cursor.epoch, with_hollow=True)
    except ChainBroken as error:
        raise Damaged(cursor.stream, cursor.epoch, error.first_sequence, error.reason) from error


def _check_cursor(segment: Segment, cursor: StreamHead) -> None:
    """Nothing, if the segment is the one at which central stands."""
    is_end = segment.header.last_sequence == cursor.sequence
    if not is_end or segment.chain_hash != cursor.chain_hash:
        here = segment.chain_hash if is_end else None
        raise HeadsDisagree(cursor.stream, cursor.epoch, cursor.sequence, here, cursor.chain_hash)


def _check_segment(segment: Segment, sequence: int, chain_hash: bytes) -> None:
    """Nothing, if the segment is whole and follows that sequence with that chain hash."""
    reason = fault_behind(segment, sequence, chain_hash)
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


def _parcel(segments: list[Segment]) -> Parcel:
    headers = [segment.header for segment in segments]
    return Parcel(
        body=encode_records(segments),
        segments=len(segments),
        events=sum(header.event_count for header in headers),
        ends={
            (s.stream, s.header.epoch): StreamHead(s.stream, s.header.epoch, s.header.last_sequence, s.chain_hash)
            for s in segments
        },
    )
