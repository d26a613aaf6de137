"""Which signed checkpoints hold a stretch of a stream between them.

Contract: `Anchors.around` gives the newest checkpoint that stands before a stretch and the first that covers
it. Between two checkpoints of the log's own station, the order of recording is covered too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

from events import CheckpointSigned, Run, Segment, StreamName
from store import Log, SignedCheckpoint, Statement
from store.audit import checkpoints_in
from store.proof import checkpoint_stream
from store.reading import Filter

_PAGE = 20


@dataclass(frozen=True, slots=True)
class Bracket:
    """The checkpoints around a stretch."""

    start: SignedCheckpoint | None
    """the stretch begins behind it; None: with the stream"""
    end: SignedCheckpoint | None
    """it covers the stretch; None: nothing was signed since"""


@dataclass(slots=True)
class Anchors:
    """Looks for the checkpoints of one station."""

    log: Log
    station: str
    epoch: int
    """life of that station's log"""
    _cache: dict[int, SignedCheckpoint] = field(default_factory=dict)

    def around(self, run: Run, segments: Sequence[Segment], *, is_own: bool) -> Bracket:
        """The checkpoints around these segments of one run of a stream, first to last.

        Args:
            run: The run that they are of.
            segments: The segments.
            is_own: Whether this is the signing station's own log, so that its checkpoints cover positions, too.
        """
        stream, epoch = segments[0].stream, segments[0].header.epoch
        first, last = segments[0].header.first_sequence, segments[-1].header.last_sequence
        # What fills a gap is recorded later than what is above it.
        earliest, latest = (choose(each.position for each in segments) for choose in (min, max))
        number = self.log.stream_head(self._stream, epoch=self.epoch, at_position=earliest).sequence
        start = self.at(number) if number else None
        while start is not None and max(ends_of(start.statement, stream, epoch, run), default=0) >= first:
            start = self.at(start.sequence - 1) if start.sequence > 1 else None
        number = 1 if start is None else start.sequence + 1
        while (end := self._find(number)) is not None and (
            max(ends_of(end.statement, stream, epoch, run), default=0) < last
            or (is_own and end.statement.position < latest)
        ):
            number += 1
        return Bracket(start, end)

    def at(self, sequence: int) -> SignedCheckpoint:
        """The checkpoint with this sequence."""
        found = self._find(sequence)
        assert found is not None, "asked for one that is there"
        return found

    @classmethod
    def of(cls, log: Log, station: str) -> Self:
        """Those of the station's newest life; before it signed, of this log's own."""
        lives = [head.epoch for head in log.streams() if head.stream == checkpoint_stream(station)]
        return cls(log, station, max(lives, default=log.epoch))

    @property
    def _stream(self) -> StreamName:
        return checkpoint_stream(self.station)

    def _find(self, sequence: int) -> SignedCheckpoint | None:
        if sequence not in self._cache:
            self._read_from(sequence)
        return self._cache.get(sequence)

    def _read_from(self, sequence: int) -> None:
        """Read some checkpoints from one on."""
        segment = next(self.log.read(self._stream, sequence, epoch=self.epoch), None)
        if segment is None:
            return
        chosen = Filter(types=[CheckpointSigned.type_name], stations=[self.station])
        for each in self.log.page(segment.position, self.log.head(), chosen, _PAGE):
            if each.header.epoch == self.epoch:
                self._cache |= {found.sequence: found for found in checkpoints_in(each, self.log)}


def ends_of(statement: Statement, stream: StreamName, epoch: int, run: Run) -> list[int]:
    """The sequences of a run that a statement signed: where it ended, or runs that have become one with it."""
    return [
        each.sequence
        for each in statement.heads
        if (each.stream, each.epoch) == (stream, epoch) and run.after < each.sequence <= run.sequence
    ]
