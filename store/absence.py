"""Whether the log records of each segment without payload that it was pruned or lost.

Contract: reads only, and only where segments without payload were met. A record counts if the station says it whose
stream it is, or the one whose log this is: nobody excuses what is missing of another's. A record that says what
segments were put back takes nothing away: whoever took them off again said so again.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

from events import LossRecorded, SegmentsPruned, StreamName, decode, events_of
from store.errors import ChainBroken
from store.log import Log

Place = tuple[StreamName, int]
Span = tuple[int, int]
"""First and last sequence, both inclusive."""

_RECORDS = (LossRecorded.type_name, SegmentsPruned.type_name)


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
    recorded = _recorded(log, {str(name) for name, _ in hollow}, own)
    for (name, epoch), spans in hollow.items():
        for span in spans:
            yield from (((name, epoch), rest) for rest in without(span, recorded[str(name), epoch]))


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


def _recorded(log: Log, wanted: set[str], own: str | None) -> dict[tuple[str, int], list[Span]]:
    """The spans that records speak of, by stream and epoch; a loss names no epoch: it is of the one that records it."""
    spans: dict[tuple[str, int], list[Span]] = defaultdict(list)
    for segment in log.read_all(types=_RECORDS):
        for event in events_of(decode(segment, log.catalogue)):
            if not isinstance(event, LossRecorded | SegmentsPruned) or event.stream not in wanted:
                continue
            if segment.stream.station not in (own, StreamName.parse(event.stream).station):
                continue
            if isinstance(event, SegmentsPruned):
                spans[event.stream, event.stream_epoch].append((event.first_sequence, event.last_sequence))
            elif event.what == "segments" and event.first_sequence is not None and event.last_sequence is not None:
                spans[event.stream, segment.header.epoch].append((event.first_sequence, event.last_sequence))
    return spans


def fault(place: Place, span: Span, position: int | None) -> ChainBroken:
    """The fault of a payload that is gone and of which nothing is recorded."""
    (name, epoch), (first, last) = place, span
    what = f"sequences {first} to {last} of epoch {epoch}"
    return ChainBroken(name, position, first, f"{what} have no payload, and no event says that it was pruned or lost")
