"""Chains: whether segments follow each other, stream by stream and run by run.

Contract: pure. A `Chains` is given segments in the order in which a log took them, and takes each or says what is wrong
with it. A stream may be here in several **runs**: contiguous ranges of sequences. A run begins with the
stream, or behind a **base**, which is the chain hash after an event that is not here, or not yet; a base must have been
told of (`expect`) before the segment that begins behind it comes. A lower run grows until it meets the run above it:
then its chain hash must be the base's, and the two are one.

Whoever checks one segment against the one before it, without runs, takes `fault_behind`.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

from events.names import StreamName
from events.segment import GENESIS, Segment, chain

Place = tuple[StreamName, int]
"""A stream and its epoch."""


@dataclass(frozen=True, slots=True)
class Run:
    """Events of one stream without a gap: `after + 1` to `sequence`."""

    after: int
    """the last sequence before it; 0: it begins with the stream"""
    after_hash: bytes
    """chain hash after `after`"""
    sequence: int
    chain_hash: bytes
    """chain hash after `sequence`"""
    position: int = field(default=0, compare=False)
    """position of the segment that it ends with; 0 where nobody counts"""

    @property
    def events(self) -> int:
        """How many events it holds."""
        return self.sequence - self.after


@dataclass(frozen=True, slots=True)
class Base:
    """Where a run begins without what comes before it."""

    stream: StreamName
    epoch: int
    sequence: int
    """the run begins behind it"""
    chain_hash: bytes
    """chain hash after that sequence"""
    position: int
    """position of the segment that begins the run"""

    @property
    def place(self) -> Place:
        """The stream and its epoch."""
        return self.stream, self.epoch


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a segment."""

    reason: str
    missing: int | None = None
    """the first sequence that is missing before it, if that is what is wrong"""


NOTHING = Run(0, GENESIS, 0, GENESIS)
"""A stream of which nothing is here."""


def payload_fault(segment: Segment) -> str | None:
    """What is wrong with the segment's payload by itself; None where nothing is."""
    if segment.is_payload_whole:
        return None
    payload_hash = hashlib.sha256(segment.payload).digest()
    return f"the payload's hash is {payload_hash.hex()}, recorded was {segment.payload_hash.hex()}"


def chain_fault(segment: Segment, previous: bytes) -> str | None:
    """What is wrong with the segment's chain hash behind the chain hash `previous`; None where nothing is."""
    chain_hash = chain(previous, segment.header, segment.payload_hash)
    if chain_hash == segment.chain_hash:
        return None
    return f"the chain hash is {chain_hash.hex()}, recorded was {segment.chain_hash.hex()}; its header was changed"


def fault_behind(segment: Segment, sequence: int, chain_hash: bytes) -> str | None:
    """What is wrong with a segment that must follow a sequence with its chain hash; None where nothing is."""
    if segment.header.first_sequence != sequence + 1:
        return f"it follows sequence {sequence}, so it must begin at {sequence + 1}"
    return payload_fault(segment) or chain_fault(segment, chain_hash)


class Chains:
    """Follows the chains of all streams from segment to segment."""

    def __init__(self, runs: Mapping[Place, Iterable[Run]] | None = None, bases: Iterable[Base] = ()) -> None:
        """Build a follower.

        Args:
            runs: What was seen before, of each stream.
            bases: What is known of the runs that are going to begin.
        """
        self.runs: dict[Place, list[Run]] = {
            place: sorted(each, key=lambda run: run.after) for place, each in (runs or {}).items()
        }
        self._coming: dict[tuple[Place, int], Base] = {}
        self.expect(bases)

    def copy(self) -> Self:
        """The same, to go on apart from this one."""
        return type(self)(self.runs, self._coming.values())

    def expect(self, bases: Iterable[Base]) -> None:
        """Allow runs to begin there."""
        self._coming |= {(base.place, base.sequence): base for base in bases}

    def not_begun(self) -> list[Base]:
        """The bases behind which no run began."""
        return list(self._coming.values())

    def below(self, place: Place, sequence: int) -> Run:
        """The run that holds an event, or the one below it; `NOTHING` where there is none."""
        runs = self.runs.get(place)
        if not runs:
            return NOTHING
        if len(runs) == 1 and runs[0].after < sequence:
            return runs[0]
        return next((run for run in reversed(runs) if run.after < sequence), NOTHING)

    def follow(self, segment: Segment) -> Fault | None:
        """Take a segment as the next one; where something is wrong with it, say what, and take nothing."""
        header = segment.header
        place = (header.stream, header.epoch)
        runs = self.runs.get(place)
        if runs is None or len(runs) != 1 or runs[0].sequence != header.first_sequence - 1:
            return self._follow_apart(segment, place)
        # By far the most segments go on with the only run of their stream.
        run = runs[0]
        reason = payload_fault(segment) or chain_fault(segment, run.chain_hash)
        if reason is not None:
            return Fault(reason)
        runs[0] = Run(run.after, run.after_hash, header.last_sequence, segment.chain_hash, segment.position)
        return None

    def _follow_apart(self, segment: Segment, place: Place) -> Fault | None:
        """As `follow`, for a stream that begins or has gaps."""
        if (reason := payload_fault(segment)) is not None:
            return Fault(reason)
        run, above = self._grown_by(segment), self._above(segment)
        if run is None:
            return self._misplaced(segment)
        if (reason := chain_fault(segment, run.chain_hash)) is not None:
            return Fault(reason)
        if above is not None and (fault := _misjoined(segment, above)) is not None:
            return fault
        self._coming.pop((place, run.sequence), None)
        grown = Run(run.after, run.after_hash, segment.header.last_sequence, segment.chain_hash, segment.position)
        others = [each for each in self.runs.get(place, ()) if each.after != run.after]
        if above is not None and above.after == grown.sequence:
            grown = replace(above, after=run.after, after_hash=run.after_hash)
            others.remove(above)
        self.runs[place] = sorted([*others, grown], key=_by_place)
        return None

    def take_broken(self, segment: Segment) -> None:
        """Go on behind a segment that was not taken, as if all before it were here."""
        header = segment.header
        run = Run(0, GENESIS, header.last_sequence, segment.chain_hash, segment.position)
        self.runs[header.stream, header.epoch] = [run]

    def _grown_by(self, segment: Segment) -> Run | None:
        """The run that the segment goes on with, an empty one where it begins it; None where it has no place."""
        header = segment.header
        place, before = (header.stream, header.epoch), header.first_sequence - 1
        run = self.below(place, header.first_sequence)
        if run.sequence == before and (run is not NOTHING or (place, 0) not in self._coming):
            return run
        base = self._coming.get((place, before))
        if base is None or run.sequence > before or base.position != segment.position:
            return None
        return Run(before, base.chain_hash, before, base.chain_hash)

    def _misplaced(self, segment: Segment) -> Fault:
        header = segment.header
        place, before = (header.stream, header.epoch), header.first_sequence - 1
        run = self.below(place, header.first_sequence)
        if (base := self._coming.get((place, before))) is not None and base.position != segment.position:
            return Fault(f"the base at sequence {before} says that a run begins at position {base.position}")
        if header.first_sequence > run.sequence + 1:
            lacking = run.sequence + 1
            return Fault(f"sequences {lacking} to {header.first_sequence - 1} are missing", lacking)
        return Fault(f"it follows sequence {run.sequence}, so it must begin at {run.sequence + 1}")

    def _above(self, segment: Segment) -> Run | None:
        """The run above the segment."""
        header = segment.header
        runs = self.runs.get((header.stream, header.epoch), ())
        return next((run for run in runs if run.after >= header.first_sequence), None)


def _misjoined(segment: Segment, above: Run) -> Fault | None:
    """What is wrong where the segment meets the run above it."""
    last = segment.header.last_sequence
    if last > above.after:
        return Fault(f"it ends at sequence {last}, but from {above.after + 1} on the stream is here already")
    if last == above.after and segment.chain_hash != above.after_hash:
        return Fault(
            f"at sequence {last} the chain hash is {segment.chain_hash.hex()}, what follows was begun behind "
            f"{above.after_hash.hex()}"
        )
    return None


def _by_place(run: Run) -> int:
    return run.after
