"""Whether the log records of each segment without payload that it was pruned or lost.

Contract: reads only, and only where segments without payload were met. A loss counts if the station says it whose
stream it is, or the one whose log this is: nobody excuses what is missing of another's. What was pruned counts only in
the log of who pruned it. A record that says what segments were put back takes nothing away: whoever took them off again
said so again.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from events import LossRecorded, Segment, SegmentsPruned, StreamName, decode, events_of
from store.errors import ChainBroken
from store.log import Log

Place = tuple[StreamName, int]
Span = tuple[int, int]
"""First and last sequence, both inclusive."""

_RECORDS = (LossRecorded.type_name, SegmentsPruned.type_name)


@dataclass(frozen=True, slots=True)
class Absence:
    """What a log records of payloads that left disks, by stream and epoch."""

    pruned: dict[Place, list[Span]] = field(default_factory=lambda: defaultdict(list))
    lost: dict[Place, list[Span]] = field(default_factory=lambda: defaultdict(list))

    def is_lost(self, segment: Segment) -> bool:
        """Whether the segment's payload was given up."""
        header = segment.header
        spans = self.lost.get((header.stream, header.epoch), ())
        return not without((int(header.first_sequence), int(header.last_sequence)), spans)


def unrecorded(log: Log, hollow: Mapping[Place, Sequence[Span]], own: str | None) -> Iterator[tuple[Place, Span]]:
    """What of the spans without payload no event of the log speaks of.

    Args:
        log: The log.
        hollow: The spans of each stream and epoch, ascending.
        own: The station whose log this is, if that is known.

    Raises:
        ChainBroken, EventError: A record cannot be read.
    """
    if not hollow:
        return
    found = recorded(log, {name for name, _ in hollow}, own)
    for place, spans in hollow.items():
        said = [*found.pruned.get(place, ()), *found.lost.get(place, ())]
        for span in spans:
            yield from ((place, rest) for rest in without(span, said))


def pruned_segments(log: Log, stream: StreamName) -> Iterator[Segment]:
    """The stream's segments whose payload was pruned in this log and is not back; not those that were given up.

    Raises:
        ChainBroken, EventError: A record, or a segment, cannot be read.
    """
    found = recorded(log, {stream}, stream.station)
    for (_, epoch), spans in sorted(found.pruned.items()):
        at = 0
        for first, last in sorted(spans):
            for segment in log.read(stream, max(first, at + 1), epoch=epoch, with_hollow=True):
                if segment.header.first_sequence > last:
                    break
                at = int(segment.header.last_sequence)
                if not segment.has_payload and not found.is_lost(segment):
                    yield segment


def without(span: Span, others: Sequence[Span]) -> list[Span]:
    """What is left of a span.

    >>> without((1, 9), [(2, 3), (6, 20)])
    [(1, 1), (4, 5)]
    """
    left, at = [], span[0]
    for first, last in sorted(others):
        if last < at:
            continue
        if first > span[1]:
            break
        if first > at:
            left.append((at, first - 1))
        at = last + 1
    return [*left, (at, span[1])] if at <= span[1] else left


def recorded(log: Log, streams: Collection[StreamName], own: str | None) -> Absence:
    """What the log records of the streams' payloads. A loss names no epoch: it is of the one that records it.

    Args:
        log: The log.
        streams: The streams.
        own: The station whose log this is, if that is known.

    Raises:
        ChainBroken, EventError: A record cannot be read.
    """
    found = Absence()
    wanted = {str(stream): stream for stream in streams}
    for segment in log.read_all(types=_RECORDS):
        for event in events_of(decode(segment, log.catalogue)):
            if not isinstance(event, LossRecorded | SegmentsPruned) or event.stream not in wanted:
                continue
            stream = wanted[event.stream]
            if segment.stream.station not in (own, stream.station):
                continue
            if isinstance(event, SegmentsPruned) and own not in (None, segment.stream.station):
                continue  # its station pruned what this log held, which is no reason that it is not here
            if isinstance(event, SegmentsPruned):
                found.pruned[stream, event.stream_epoch].append((event.first_sequence, event.last_sequence))
            elif event.what == "segments" and event.first_sequence is not None and event.last_sequence is not None:
                epoch = int(segment.header.epoch)
                found.lost[stream, epoch].append((event.first_sequence, event.last_sequence))
    return found


def fault(place: Place, span: Span, position: int | None) -> ChainBroken:
    """The fault of a payload that is gone and of which nothing is recorded."""
    (name, epoch), (first, last) = place, span
    what = f"sequences {first} to {last} of epoch {epoch}"
    return ChainBroken(name, position, first, f"{what} have no payload, and no event says that it was pruned or lost")
