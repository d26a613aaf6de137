"""Where a stream begins for a plan that wants it from a time on: behind the last segment that lies wholly before.

Contract: segments are the unit: the first one that holds an event of that time or later begins what is sent, and all
that follow it in the stream are sent, also what happened earlier and was recorded later. What was found is remembered;
a stream that holds nothing of that time yet is looked at again from where the last look ended.
"""

from datetime import datetime

from events import Segment
from store import ChainBroken, Log, StreamHead
from store.reading import Filter
from sync.errors import Damaged
from sync.runs import BEGINNING, Point, StreamKey

_PAGE_SEGMENTS = 20


class Starts:
    """Finds beginnings in one log."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._found: dict[tuple[StreamKey, datetime], Point] = {}
        self._looked: dict[tuple[StreamKey, datetime], int] = {}

    def start_of(self, head: StreamHead, since: datetime | None, log_head: int) -> Point:
        """Behind which place the stream is wanted; its head where it holds nothing of that time yet.

        Args:
            head: Where the stream stands.
            since: From when on it is wanted; None: from its beginning.
            log_head: Where the log stands.

        Raises:
            LogUnavailable: The database is away.
            Damaged: A segment is one that no log can hold.
        """
        if since is None:
            return BEGINNING
        wanted = StreamKey(head.stream, head.epoch), since
        if wanted not in self._found:
            try:
                segment = self._first(*wanted, log_head)
                if segment is None:
                    self._looked[wanted] = log_head
                    return Point(head.sequence, head.chain_hash)
                self._found[wanted] = self._before(segment)
            except ChainBroken as error:
                raise Damaged(head.stream, head.epoch, error.first_sequence, error.reason) from error
        return self._found[wanted]

    def _first(self, key: StreamKey, since: datetime, log_head: int) -> Segment | None:
        """The stream's first segment that holds an event of that time or later, behind what was looked at."""
        stream = key.stream
        chosen = Filter([stream.type], [stream.source], [stream.station], since, with_hollow=True)
        at = self._looked.get((key, since), 0) + 1
        while page := self._log.page(at, log_head, chosen, _PAGE_SEGMENTS):
            for segment in page:
                if segment.header.epoch == key.epoch:
                    return segment
            at = page[-1].position + 1
        return None

    def _before(self, segment: Segment) -> Point:
        """The place before the segment."""
        header = segment.header
        if header.first_sequence == 1:
            return BEGINNING
        before = next(self._log.read(header.stream, header.first_sequence - 1, epoch=header.epoch, with_hollow=True))
        return Point(before.header.last_sequence, before.chain_hash)
