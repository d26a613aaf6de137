"""A station's segments, and a log that takes them in any order."""

from collections.abc import Sequence

from events import GENESIS, Draft, Segment
from store import Appended, Log


def draft_of(segment: Segment) -> Draft:
    """The draft that a replica appends."""
    header = segment.header
    times = header.time_min, header.time_max
    counts = header.event_count, header.schema_version
    return Draft(header.stream, *counts, *times, header.producer, segment.payload, segment.payload_hash)


def deliver(log: Log, sent: Sequence[Segment], *numbers: int, may_jump: bool = True) -> list[Appended]:
    """Append some of a stream's segments, by number, in one call; they may begin runs where nothing is yet."""
    before = [GENESIS, *(segment.chain_hash for segment in sent)]
    return log.append(
        [draft_of(sent[number]) for number in numbers],
        [sent[number].header.first_sequence - 1 for number in numbers],
        epochs=[sent[number].header.epoch for number in numbers],
        chain_hashes=[sent[number].chain_hash for number in numbers],
        bases=[before[number] for number in numbers] if may_jump else None,
    )
