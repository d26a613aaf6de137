"""One walk along the log from a position on: chains, order and holes, segment by segment.

Contract: a `Walk` is given every segment in order of position, and says what is wrong with it; it
asks the database for nothing. `pages` reads large segments ahead, in a thread of its own, while the caller
hashes, and holds two pages of about `PAGE_BYTES` at most.
"""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from events import Chains, Fault, Header, Place, Run, Segment, StreamName
from events.chains import NOTHING
from events.segment import microseconds
from store.errors import UNKNOWN, ChainBroken, SealedFileDamaged
from store.log import Log
from store.proof import NO_HASH, order_hash
from store.reading import Filter
from store.standing import Standing, StreamHead

PAGE_BYTES = 4 * 1024 * 1024
_READ_AHEAD_BYTES = 100_000
"""Mean payload from which a second thread pays: below, the threads spend more on each other than on hashing."""
_PAGE_SEGMENTS_MAX = 500
_PAGE_SEGMENTS_FIRST = 64
_EVERYTHING = Filter(with_hollow=True)


@dataclass(slots=True)
class Walk:
    """What was seen so far."""

    position: int = 0
    order_hash: bytes = NO_HASH
    """see `store.proof.order_hash`; starts anew from what a signature says where the two differ"""
    segments: int = 0
    events: int = 0
    chains: Chains = field(default_factory=Chains)
    holes: dict[int, int] = field(default_factory=dict)
    """First and last position of each range that is missing."""
    missed: set[int] = field(default_factory=set)
    """The holes that a stream misses."""
    broken: dict[StreamName, ChainBroken] = field(default_factory=dict)
    """The first break of each broken stream."""
    hollow: dict[Place, list[tuple[int, int]]] = field(default_factory=dict)
    """First and last sequence of the ranges without payload, of each stream."""
    hollow_at: dict[tuple[Place, int], int] = field(default_factory=dict)
    """Position of the first segment of each of these ranges, by its first sequence."""
    hollow_segments: int = 0
    faults: list[ChainBroken] = field(default_factory=list)
    """What is wrong with no stream in particular: order, signatures, sealed files."""

    @property
    def is_sound(self) -> bool:
        """Whether nothing was wrong so far."""
        return not (self.broken or self.holes or self.faults)

    def heads(self) -> tuple[StreamHead, ...]:
        """Where the streams stand; of one with gaps, where each run of it ends."""
        return tuple(
            StreamHead(name, epoch, run.sequence, run.chain_hash)
            for (name, epoch), runs in self.chains.runs.items()
            for run in runs
        )

    def end(self, place: Place) -> Run:
        """The newest run of a stream."""
        runs = self.chains.runs.get(place)
        return runs[-1] if runs else NOTHING

    def take(self, segment: Segment) -> None:
        """Go to the segment and check it."""
        self.go_to(segment.position)
        fault = self.chains.follow(segment)
        if fault is not None:
            if segment.stream not in self.broken:
                self.broken[segment.stream] = self._broken_by(segment, fault)
            self.chains.take_broken(segment)
        self.order_hash = order_hash(
            self.order_hash, segment.position, microseconds(segment.recorded_at), segment.chain_hash
        )
        self.segments += 1
        self.events += segment.header.event_count
        if not segment.has_payload:
            self._take_hollow(segment.header, segment.position)

    def _take_hollow(self, header: Header, position: int) -> None:
        self.hollow_segments += 1
        place = (header.stream, header.epoch)
        spans = self.hollow.setdefault(place, [])
        if spans and spans[-1][1] + 1 == header.first_sequence:
            spans[-1] = (spans[-1][0], header.last_sequence)
        else:
            spans.append((header.first_sequence, header.last_sequence))
            self.hollow_at[place, header.first_sequence] = position

    def take_unreadable(self, broken: ChainBroken) -> None:
        """Go to a segment that cannot be read."""
        self.go_to(broken.position or self.position)
        if isinstance(broken, SealedFileDamaged):
            self._pass_over(broken)
        else:
            self.broken.setdefault(broken.stream, broken)

    def go_to(self, position: int) -> None:
        """Go to the position; what lies between is missing."""
        if position > self.position + 1:
            self.holes[self.position + 1] = position - 1
        self.position = position

    def check_head(self, head: StreamHead) -> None:
        """Compare the end of a stream with what the log says of it."""
        if head.stream in self.broken:
            return
        seen = self.end((head.stream, head.epoch))
        if seen.sequence < head.sequence:
            fault = self._missing(head.stream, seen, head.sequence, None)
        elif seen.sequence > head.sequence:
            reason = f"the stream's head says {head.sequence} events, {seen.sequence} are stored"
            fault = ChainBroken(head.stream, seen.position, head.sequence + 1, reason)
        elif seen.chain_hash != head.chain_hash:
            reason = f"the stream's head has the chain hash {head.chain_hash.hex()}, its newest segment another"
            fault = ChainBroken(head.stream, seen.position or None, seen.sequence + 1, reason)
        else:
            return
        self.broken[head.stream] = fault

    def check_runs(self, standing: Standing) -> None:
        """Compare all that is here of the streams with what the log's heads and bases say."""
        for head in standing.heads:
            self.check_head(head)
        for base in self.chains.not_begun():
            if base.position <= self.position and base.stream not in self.broken:
                self.missed.update(first for first, last in self.holes.items() if first <= base.position <= last)
                reason = f"it has a base at sequence {base.sequence}, position {base.position}, where no run begins"
                self.broken[base.stream] = ChainBroken(base.stream, base.position, base.sequence + 1, reason)
        for place, runs in self.chains.runs.items():
            if place[0] not in self.broken and (fault := self._differing(place[0], runs, standing.runs.get(place, []))):
                self.broken[place[0]] = fault

    def _differing(self, name: StreamName, runs: list[Run], said: list[Run]) -> ChainBroken | None:
        """How the runs that were seen are not those that the log says."""
        by_begin = {run.after: run for run in said}
        for run in runs:
            other = by_begin.get(run.after)
            if other == run:
                continue
            if other is not None and run.sequence < other.sequence:
                return self._missing(name, run, other.sequence, None)
            reason = f"its sequences {run.after + 1} to {run.sequence} are not what its head and bases say"
            return ChainBroken(name, run.position, run.after + 1, reason)
        return None

    def is_broken_between(self, first: int, last: int) -> bool:
        """Whether something was wrong with a range of positions."""
        return any((each.position or 0) <= last and _last(each) >= first for each in self.all_broken())

    def all_broken(self) -> list[ChainBroken]:
        """Every fault in the order of positions, holes that no stream misses included."""
        unclaimed = [_hole(first, last) for first, last in self.holes.items() if first not in self.missed]
        every = [*self.broken.values(), *unclaimed, *self.faults]
        return sorted(every, key=lambda fault: fault.position or self.position + 1)

    def _pass_over(self, damage: SealedFileDamaged) -> None:
        """Go on behind a range that cannot be read; the streams that miss something of it say so too."""
        assert damage.position is not None, "a part of a file has a first position"
        self.faults.append(damage)
        self.holes[damage.position] = self.position = damage.last_position
        self.missed.add(damage.position)

    def _broken_by(self, segment: Segment, fault: Fault) -> ChainBroken:
        """The break that a segment's fault is."""
        header = segment.header
        if fault.missing is not None:
            run = self.chains.below((header.stream, header.epoch), header.first_sequence)
            return self._missing(header.stream, run, header.first_sequence - 1, segment.position)
        return ChainBroken(header.stream, segment.position, header.first_sequence, fault.reason)

    def _missing(self, name: StreamName, at: Run, last_sequence: int, position: int | None) -> ChainBroken:
        """Events that a stream lacks behind a run, at the first position where they may have been."""
        holes = [first for first in self.holes if first > at.position]
        self.missed.update(holes)
        reason = f"sequences {at.sequence + 1} to {last_sequence} are missing"
        return ChainBroken(name, holes[0] if holes else position, at.sequence + 1, reason)


def pages(log: Log, first: int, last: int) -> Iterator[list[Segment] | ChainBroken]:
    """The segments between two positions, and in the place of each that cannot be read what is wrong with it."""
    with ThreadPoolExecutor(1, thread_name_prefix="vian-read-ahead") as reader:
        limit = _PAGE_SEGMENTS_FIRST
        ahead: Future[list[Segment]] | None = None
        while first <= last:
            try:
                page = ahead.result() if ahead else log.page(first, last, _EVERYTHING, limit)
            except ChainBroken as broken:
                if broken.position is None:
                    raise
                yield from _readable(log, first, broken.position - 1)
                yield broken
                first, ahead = _last(broken) + 1, None
                continue
            if not page:
                return
            first = page[-1].position + 1
            mean = sum(len(segment.payload) for segment in page) // len(page) + 1
            limit = max(1, min(PAGE_BYTES // mean, _PAGE_SEGMENTS_MAX))
            is_worth_it = mean >= _READ_AHEAD_BYTES and first <= last
            ahead = reader.submit(log.page, first, last, _EVERYTHING, limit) if is_worth_it else None
            yield page


def _last(broken: ChainBroken) -> int:
    """The last position that cannot be read."""
    return broken.last_position if isinstance(broken, SealedFileDamaged) else broken.position or 0


def _readable(log: Log, first: int, last: int) -> Iterator[list[Segment]]:
    """Pages before a segment that cannot be read; they can."""
    if first <= last:
        yield list(log.read_all(first, to_position=last, with_hollow=True))


def _hole(first: int, last: int) -> ChainBroken:
    return ChainBroken(UNKNOWN, first, 0, f"positions {first} to {last} are missing, and no stream misses them")
