"""Verify: recompute every hash of the log from its stored bytes.

Contract: `verify` reads; it changes nothing. It finds a changed payload, a changed header, a
missing, doubled or reordered segment, and a head that does not belong to its stream, and names the
first bad position of each stream. It needs no knowledge of event types.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

from events import GENESIS, Segment, StreamName, chain
from store.errors import ChainBroken
from store.log import Log, StreamHead


@dataclass(frozen=True, slots=True)
class Verification:
    """What a verification found."""

    segments: int
    events: int
    streams: int
    position: int
    """The log was verified up to here."""
    broken: list[ChainBroken]
    """The first break of each broken stream, and breaks in the order of positions; empty when all is well."""

    @property
    def is_sound(self) -> bool:
        """Whether every hash is right."""
        return not self.broken


@dataclass(slots=True)
class _Stream:
    sequence: int = 0
    chain_hash: bytes = GENESIS
    is_broken: bool = False


@dataclass(slots=True)
class _Progress:
    segments: int = 0
    events: int = 0
    position: int = 0
    streams: dict[tuple[StreamName, int], _Stream] = field(default_factory=dict)
    broken: list[ChainBroken] = field(default_factory=list)


def verify(log: Log, on_segment: Callable[[Segment], None] | None = None) -> Verification:
    """Check the whole log, as it stood when the call began.

    Args:
        log: The log.
        on_segment: Called after each segment, to show progress.
    """
    heads = log.streams()
    end = log.head()
    progress = _Progress()
    for segment in log.read_all(to_position=end):
        _check(segment, progress)
        if on_segment is not None:
            on_segment(segment)
    if progress.position < end:
        progress.broken.append(_hole(None, progress.position + 1, end))
    for head in heads:
        _check_head(head, progress)
    return Verification(progress.segments, progress.events, len(progress.streams), end, progress.broken)


def _check(segment: Segment, progress: _Progress) -> None:
    header = segment.header
    stream = progress.streams.setdefault((header.stream, header.epoch), _Stream())
    if segment.position != progress.position + 1:
        progress.broken.append(_hole(segment, progress.position + 1, segment.position - 1))
    fault = None if stream.is_broken else _fault(segment, stream)
    if fault is not None:
        stream.is_broken = True
        progress.broken.append(ChainBroken(header.stream, segment.position, header.first_sequence, fault))
    stream.sequence, stream.chain_hash = header.last_sequence, segment.chain_hash
    progress.position = segment.position
    progress.segments += 1
    progress.events += header.event_count


def _fault(segment: Segment, stream: _Stream) -> str | None:
    """What is wrong with a segment that follows the stream's state; None when nothing is."""
    header = segment.header
    payload_hash = hashlib.sha256(segment.payload).digest()
    if payload_hash != segment.payload_hash:
        return f"the payload's hash is {payload_hash.hex()}, recorded was {segment.payload_hash.hex()}"
    if header.first_sequence != stream.sequence + 1:
        return f"it follows sequence {stream.sequence}, so it must begin at {stream.sequence + 1}"
    chain_hash = chain(stream.chain_hash, header, segment.payload_hash)
    if chain_hash != segment.chain_hash:
        return f"the chain hash is {chain_hash.hex()}, recorded was {segment.chain_hash.hex()}; its header was changed"
    return None


def _check_head(head: StreamHead, progress: _Progress) -> None:
    seen = progress.streams.get((head.stream, head.epoch), _Stream())
    if seen.is_broken:
        return
    if seen.sequence < head.sequence:
        reason = f"the stream's head says {head.sequence} events, only {seen.sequence} are stored"
    elif seen.sequence == head.sequence and seen.chain_hash != head.chain_hash:
        reason = f"the stream's head has the chain hash {head.chain_hash.hex()}, its newest segment another"
    else:
        return
    progress.broken.append(ChainBroken(head.stream, None, seen.sequence + 1, reason))


def _hole(segment: Segment | None, first: int, last: int) -> ChainBroken:
    reason = f"positions {first} to {last} are missing" if last >= first else f"position {last + 1} stands twice"
    if segment is None:
        return ChainBroken(StreamName.of("log", "log", "log"), last, 0, reason)
    return ChainBroken(segment.stream, segment.position, segment.header.first_sequence, reason)
