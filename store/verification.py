"""Verify: recompute every hash of the log from its stored bytes.

Contract: `verify` reads; it changes nothing. It finds a changed payload, a changed header, a
missing, doubled or reordered segment, and a head that does not belong to its stream, and names the
first bad position of each stream. It needs no knowledge of event types. `position` and `recorded_at`
are local to a log and not hashed: that two streams' segments changed places is not found, unless they are sealed:
a sealed file is compared to the byte with what was sealed.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from events import GENESIS, Segment, StreamName, chain
from store.errors import ChainBroken, SealedFileDamaged
from store.log import Log, StreamHead

_UNKNOWN = StreamName.of("unknown", "unknown", "unknown")


@dataclass(frozen=True, slots=True)
class Verification:
    """What a verification found."""

    segments: int
    events: int
    streams: int
    position: int
    """The log was verified up to here."""
    broken: list[ChainBroken]
    """The first break of each broken stream, in the order of positions; empty when all is well."""

    @property
    def is_sound(self) -> bool:
        """Whether every hash is right."""
        return not self.broken


@dataclass(slots=True)
class _Stream:
    sequence: int = 0
    chain_hash: bytes = GENESIS
    position: int = 0


@dataclass(slots=True)
class _Progress:
    segments: int = 0
    events: int = 0
    position: int = 0
    streams: dict[tuple[StreamName, int], _Stream] = field(default_factory=dict)
    holes: dict[int, int] = field(default_factory=dict)
    """First and last position of each range that is missing."""
    missed: set[int] = field(default_factory=set)
    """The holes that a stream misses."""
    broken: dict[StreamName, ChainBroken] = field(default_factory=dict)
    damaged: list[SealedFileDamaged] = field(default_factory=list)
    """Parts of sealed files that cannot be read."""


def verify(log: Log, on_segment: Callable[[Segment], None] | None = None) -> Verification:
    """Check the whole log, as it stood when the call began.

    Args:
        log: The log.
        on_segment: Called after each segment, to show progress.
    """
    end, heads = log.heads()
    progress = _Progress()
    for found in _read(log, 1, end):
        if isinstance(found, ChainBroken):
            _go_to(found.position or 0, progress)
            if isinstance(found, SealedFileDamaged):
                _pass_over(found, progress)
            else:
                progress.broken.setdefault(found.stream, found)
            continue
        _go_to(found.position, progress)
        _check(found, progress)
        if on_segment is not None:
            on_segment(found)
    _go_to(end + 1, progress)
    for head in heads:
        _check_head(head, progress)
    unclaimed = [_hole(first, last) for first, last in progress.holes.items() if first not in progress.missed]
    faults = [*progress.broken.values(), *progress.damaged, *unclaimed]
    faults += _changed_files(log, progress.damaged)
    broken = sorted(faults, key=lambda fault: fault.position or end + 1)
    return Verification(progress.segments, progress.events, len(progress.streams), end, broken)


def _read(log: Log, first: int, last: int) -> Iterator[Segment | ChainBroken]:
    """The segments between two positions, and in the place of each that cannot be read what is wrong with it."""
    while first <= last:
        try:
            for segment in log.read_all(first, to_position=last):
                yield segment
                first = segment.position + 1
            return
        except ChainBroken as broken:
            unreadable = broken
        assert unreadable.position is not None, "what was read has a position"
        yield from _read(log, first, unreadable.position - 1)
        yield unreadable
        first = (unreadable.last_position if isinstance(unreadable, SealedFileDamaged) else unreadable.position) + 1


def _go_to(position: int, progress: _Progress) -> None:
    if position > progress.position + 1:
        progress.holes[progress.position + 1] = position - 1
    progress.position = position


def _pass_over(damage: SealedFileDamaged, progress: _Progress) -> None:
    """Go on behind a range that cannot be read; the streams that miss something of it say so too."""
    assert damage.position is not None, "a part of a file has a first position"
    progress.damaged.append(damage)
    progress.holes[damage.position] = progress.position = damage.last_position
    progress.missed.add(damage.position)


def _changed_files(log: Log, damaged: list[SealedFileDamaged]) -> list[SealedFileDamaged]:
    """The sealed files that differ from what was sealed, but for those that are told of already."""
    told = [damage.position or 0 for damage in damaged]
    return [
        changed
        for changed in log.archive.changed_files()
        if not any((changed.position or 0) <= position <= changed.last_position for position in told)
    ]


def _check(segment: Segment, progress: _Progress) -> None:
    header = segment.header
    stream = progress.streams.setdefault((header.stream, header.epoch), _Stream())
    if header.stream not in progress.broken:
        fault = _fault(segment, stream, progress)
        if fault is not None:
            progress.broken[header.stream] = fault
    stream.sequence, stream.chain_hash, stream.position = header.last_sequence, segment.chain_hash, segment.position
    progress.segments += 1
    progress.events += header.event_count


def _fault(segment: Segment, stream: _Stream, progress: _Progress) -> ChainBroken | None:
    """What is wrong with a segment that follows the stream's state; None when nothing is."""
    header = segment.header
    payload_hash = hashlib.sha256(segment.payload).digest()
    chain_hash = chain(stream.chain_hash, header, segment.payload_hash)
    if payload_hash != segment.payload_hash:
        reason = f"the payload's hash is {payload_hash.hex()}, recorded was {segment.payload_hash.hex()}"
    elif header.first_sequence > stream.sequence + 1:
        return _missing(header.stream, stream, header.first_sequence - 1, segment.position, progress)
    elif header.first_sequence != stream.sequence + 1:
        reason = f"it follows sequence {stream.sequence}, so it must begin at {stream.sequence + 1}"
    elif chain_hash != segment.chain_hash:
        reason = (
            f"the chain hash is {chain_hash.hex()}, recorded was {segment.chain_hash.hex()}; its header was changed"
        )
    else:
        return None
    return ChainBroken(header.stream, segment.position, header.first_sequence, reason)


def _check_head(head: StreamHead, progress: _Progress) -> None:
    if head.stream in progress.broken:
        return
    seen = progress.streams.get((head.stream, head.epoch), _Stream())
    if seen.sequence < head.sequence:
        fault = _missing(head.stream, seen, head.sequence, None, progress)
    elif seen.sequence > head.sequence:
        reason = f"the stream's head says {head.sequence} events, {seen.sequence} are stored"
        fault = ChainBroken(head.stream, seen.position, head.sequence + 1, reason)
    elif seen.chain_hash != head.chain_hash:
        reason = f"the stream's head has the chain hash {head.chain_hash.hex()}, its newest segment another"
        fault = ChainBroken(head.stream, seen.position or None, seen.sequence + 1, reason)
    else:
        return
    progress.broken[head.stream] = fault


def _missing(
    name: StreamName, stream: _Stream, last_sequence: int, position: int | None, progress: _Progress
) -> ChainBroken:
    """Events that a stream lacks behind its state, at the first position where they may have been."""
    holes = [first for first in progress.holes if first > stream.position]
    progress.missed.update(holes)
    reason = f"sequences {stream.sequence + 1} to {last_sequence} are missing"
    return ChainBroken(name, holes[0] if holes else position, stream.sequence + 1, reason)


def _hole(first: int, last: int) -> ChainBroken:
    return ChainBroken(_UNKNOWN, first, 0, f"positions {first} to {last} are missing, and no stream misses them")
