"""What signatures cover: each signed checkpoint is checked against the log that a walk goes along.

Contract: an `Audit` accompanies a `Walk`. Checkpoints of the log's own station are compared where the
walk reaches the position that they signed: heads, and the order hash over position, recorded_at and chain hash of
every segment before. Checkpoints of other stations, whose positions are those of another log, are compared by
heads alone, as soon as those streams are here. Faults go into the walk.

A key is lawful where it is its station's first, where the lawful key before it named it as successor, where this log's
own station has enrolled the other by it, as central does with a machine that takes another's place, or where the
caller knows it. With keys known to the caller, a station's own first key must be one of them.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime

from events import (
    CheckpointSigned,
    EventError,
    Place,
    Run,
    Segment,
    Sequence,
    Station,
    StationEnrolled,
    StreamName,
    decode,
    events_of,
)
from store.errors import BadProof, ChainBroken
from store.keys import is_signed
from store.log import Log
from store.proof import (
    NO_HASH,
    NO_KEY,
    SignedCheckpoint,
    checkpoint_of,
    checkpoint_stream,
    key_id,
    statement_bytes,
    statement_hash,
)
from store.standing import StreamHead
from store.walk import Walk

_RECENT = 64
"""Segments of a replicated stream whose chain hashes are remembered until the station's checkpoint comes."""


@dataclass(slots=True)
class Trail:
    """How far a station's checkpoints were checked."""

    station: Station
    epoch: int = 0
    sequence: int = 0
    previous: bytes = NO_HASH
    key: bytes = NO_KEY
    successors: list[bytes] = field(default_factory=list)
    former: list[bytes] = field(default_factory=list)
    """keys that signed before, and may not again"""
    position: int = 0
    """position, in the station's own log, that the newest one signed"""
    signed_at: datetime | None = None
    checkpoints: int = 0
    heads: dict[Place, dict[int, bytes]] = field(default_factory=dict)
    """signed heads that were found in this log, the newest of each run: sequence and chain hash"""


@dataclass(frozen=True, slots=True)
class Covered:
    """What a station's signatures cover in this log."""

    station: Station
    key_id: str
    is_known: bool
    """whether the caller knows the key; else it is only known to be one and the same"""
    checkpoints: int
    signed_at: datetime
    position: int | None
    """order, positions and recorded_at are covered up to here; None for another log's station"""
    streams: int
    """streams with a signed head"""
    events: int
    """events that signed heads cover"""


class Audit:
    """Checks checkpoints along a walk."""

    def __init__(
        self,
        log: Log,
        walk: Walk,
        end: int,
        heads: list[StreamHead],
        runs: Mapping[Place, Iterable[Run]],
        station: str | None,
        trusted: Mapping[str, bytes],
        trails: Mapping[str, Trail],
    ) -> None:
        """Build an audit that begins where the walk stands.

        Args:
            log: The log.
            walk: The walk that it accompanies.
            end: The last position of the walk.
            heads: The heads of all streams.
            runs: What of them is here at the end of the walk.
            station: The station whose log this is.
            trusted: Public keys that are known, by key id.
            trails: How far each station's checkpoints were checked before.
        """
        self._log = log
        self._walk = walk
        self._end = end
        self._trusted = trusted
        self.trails = dict(trails)
        self._runs = runs
        self._own = station
        self._signing = {head.stream.station for head in heads if _is_checkpoints(head.stream)}
        self._recent: dict[Place, deque[tuple[int, bytes]]] = {}
        self._awaited: dict[Place, dict[int, tuple[bytes, SignedCheckpoint]]] = {}
        self._coming = self._own_checkpoints(heads)
        self._last_signed = self.trails[self._own].position if self._own in self.trails else 0
        self._next = next(self._coming, None)
        self.at()

    def at(self) -> None:
        """Compare the checkpoints that signed the position where the walk stands, or one before."""
        while self._next is not None and self._next[1].statement.position <= self._walk.position:
            place, checkpoint = self._next
            self._check_own(place, checkpoint)
            self._next = next(self._coming, None)

    def take(self, segment: Segment) -> None:
        """Look at a segment that the walk took."""
        self.at()
        stream = segment.stream
        if stream.station == self._own or stream.station not in self._signing:
            return
        place, at = (stream, segment.header.epoch), (segment.header.last_sequence, segment.chain_hash)
        self._recent.setdefault(place, deque(maxlen=_RECENT)).append(at)
        if (awaited := self._awaited.get(place)) and at[0] in awaited:
            self._compare_head(StreamHead(stream, segment.header.epoch, *at), *awaited.pop(at[0]))
        if _is_checkpoints(stream):
            self._take_foreign(segment)

    def finish(self) -> None:
        """Report checkpoints that signed more than there is."""
        while self._next is not None:
            place, checkpoint = self._next
            reason = f"it signed the log up to position {checkpoint.statement.position}, which ends at {self._end}"
            self._walk.faults.append(_fault(place, checkpoint.sequence, reason))
            self._next = next(self._coming, None)

    def covered(self) -> tuple[Covered, ...]:
        """What the signatures cover, station by station."""
        return tuple(
            Covered(
                station=trail.station,
                key_id=key_id(trail.key),
                is_known=key_id(trail.key) in self._trusted,
                checkpoints=trail.checkpoints,
                signed_at=trail.signed_at,
                position=trail.position if trail.station == self._own else None,
                streams=len(trail.heads),
                events=sum(self._events_below(*head) for head in trail.heads.items()),
            )
            for _, trail in sorted(self.trails.items())
            if trail.signed_at is not None
        )

    def _events_below(self, place: Place, signed: Mapping[int, bytes]) -> int:
        """How many events of a stream signed heads cover."""
        runs = self._walk.chains.runs.get(place, ())
        newest = (max((each for each in signed if run.after < each <= run.sequence), default=run.after) for run in runs)
        return sum(sequence - run.after for sequence, run in zip(newest, runs, strict=True))

    def _own_checkpoints(self, heads: list[StreamHead]) -> Iterator[tuple[Segment, SignedCheckpoint]]:
        """The log's own checkpoints that were not checked yet, life by life of the station."""
        if self._own is None:
            return
        trail = self.trails.get(self._own) or Trail(Station(self._own))
        stream = checkpoint_stream(self._own)
        for head in sorted((each for each in heads if each.stream == stream), key=lambda each: each.epoch):
            if head.epoch < trail.epoch:
                continue
            first = trail.sequence + 1 if head.epoch == trail.epoch else 1
            yield from self._readable(self._log.read(stream, first, epoch=head.epoch), first)

    def _readable(self, segments: Iterator[Segment], first: int) -> Iterator[tuple[Segment, SignedCheckpoint]]:
        try:
            for segment in segments:
                if segment.position > self._end:
                    return
                for checkpoint in self._checkpoints(segment):
                    if checkpoint.sequence >= first:
                        yield segment, checkpoint
        except ChainBroken:
            return  # the walk comes by and says so

    def _checkpoints(self, segment: Segment) -> Iterator[SignedCheckpoint]:
        try:
            yield from checkpoints_in(segment, self._log)
        except (BadProof, EventError) as error:
            reason = f"the checkpoint cannot be read: {error}"
            self._walk.faults.append(_fault(segment, segment.header.first_sequence, reason))

    def _check_own(self, place: Segment, checkpoint: SignedCheckpoint) -> None:
        statement = checkpoint.statement
        if not self._follow(place, checkpoint):
            return
        trail = self.trails[statement.station]
        if statement.position == self._walk.position:
            self._compare_order(place, checkpoint)
            self._check_all_signed(checkpoint)
        for head in statement.heads:
            self._compare(head, checkpoint, trail)
        self._last_signed = trail.position = statement.position

    def _check_all_signed(self, checkpoint: SignedCheckpoint) -> None:
        """Report what is here of streams, at the signed position, and was not signed."""
        signed: dict[Place, list[int]] = {}
        for head in checkpoint.statement.heads:
            signed.setdefault((head.stream, head.epoch), []).append(head.sequence)
        for place, runs in self._walk.chains.runs.items():
            for run in runs:
                if place not in signed:
                    what = "did not sign it at all"
                elif not any(run.after < sequence <= run.sequence for sequence in signed[place]):
                    what = f"did not sign its sequences {run.after + 1} to {run.sequence}"
                else:
                    continue
                self._fault_of_head(StreamHead(*place, run.sequence, run.chain_hash), checkpoint, what)

    def _compare_order(self, place: Segment, checkpoint: SignedCheckpoint) -> None:
        """Compare the order hash; from here on the walk goes by what was signed."""
        walk, first = self._walk, self._last_signed + 1
        is_explained = walk.is_broken_between(first, walk.position)
        if walk.order_hash != checkpoint.statement.order_hash and not is_explained:
            reason = (
                f"the order or a recorded_at of positions {first} to {walk.position} is not what "
                f"checkpoint {checkpoint.sequence} signed"
            )
            walk.faults.append(ChainBroken(place.stream, first, checkpoint.sequence, reason))
        walk.order_hash = checkpoint.statement.order_hash

    def _take_foreign(self, segment: Segment) -> None:
        for checkpoint in self._checkpoints(segment):
            if self._follow(segment, checkpoint):
                trail = self.trails[checkpoint.statement.station]
                trail.position = checkpoint.statement.position
                for head in checkpoint.statement.heads:
                    self._compare(head, checkpoint, trail)

    def _compare(self, head: StreamHead, checkpoint: SignedCheckpoint, trail: Trail) -> None:
        """Compare a signed head with this log, now or when the stream has come so far."""
        place = (head.stream, head.epoch)
        if trail.heads.get(place, {}).get(head.sequence) == head.chain_hash:
            return
        run = self._walk.chains.below(place, head.sequence)
        if head.sequence == run.sequence:
            self._compare_head(StreamHead(*place, run.sequence, run.chain_hash), head.chain_hash, checkpoint)
        elif head.sequence < run.sequence:
            self._compare_head(self._stood_at(head, checkpoint), head.chain_hash, checkpoint)
        elif trail.station == self._own:
            self._fault_of_head(head, checkpoint, f"signed {head.sequence} events, {run.sequence} are here")
        elif self._is_coming(place, head.sequence):
            self._awaited.setdefault(place, {})[head.sequence] = (head.chain_hash, checkpoint)

    def _is_coming(self, place: Place, sequence: int) -> bool:
        """Whether the walk will reach an event that is not here yet: in a gap it does not."""
        return any(run.after < sequence <= run.sequence for run in self._runs.get(place, ()))

    def _compare_head(self, head: StreamHead, signed: bytes, checkpoint: SignedCheckpoint) -> None:
        if head.chain_hash == signed:
            self._found(head, self.trails[checkpoint.statement.station])
            return
        self._fault_of_head(
            head,
            checkpoint,
            f"signed the chain hash {signed.hex()} at {head.sequence}, here is {head.chain_hash.hex()}",
        )

    def _found(self, head: StreamHead, trail: Trail) -> None:
        """Keep a signed head; of each run the newest counts."""
        place = (head.stream, head.epoch)
        run = self._walk.chains.below(place, head.sequence)
        found = {**trail.heads.get(place, {}), head.sequence: head.chain_hash}
        newest = max(each for each in found if run.after < each <= run.sequence)
        trail.heads[place] = {
            each: chain_hash
            for each, chain_hash in found.items()
            if each == newest or not run.after < each <= run.sequence
        }

    def _stood_at(self, head: StreamHead, checkpoint: SignedCheckpoint) -> StreamHead:
        """The stream in this log where it ended with the signed sequence; a hash of zeros where it never did."""
        of_stream = [each for each in checkpoint.statement.heads if each.stream == head.stream]
        newest = max(each.sequence for each in of_stream if each.epoch == head.epoch)
        if checkpoint.statement.station == self._own and head.sequence == newest:
            at_position = checkpoint.statement.position
            return self._log.stream_head(head.stream, epoch=head.epoch, at_position=at_position)
        for sequence, chain_hash in self._recent.get((head.stream, head.epoch), ()):
            if sequence == head.sequence:
                return StreamHead(head.stream, head.epoch, sequence, chain_hash)
        segment = next(self._log.read(head.stream, head.sequence, epoch=head.epoch, with_hollow=True), None)
        is_end = segment is not None and segment.header.last_sequence == head.sequence
        return StreamHead(head.stream, head.epoch, head.sequence, segment.chain_hash if segment and is_end else NO_HASH)

    def _fault_of_head(self, head: StreamHead, checkpoint: SignedCheckpoint, what: str) -> None:
        at = self._walk.end((head.stream, head.epoch))
        reason = f"checkpoint {checkpoint.sequence} of station {checkpoint.statement.station} {what}"
        self._walk.broken.setdefault(head.stream, ChainBroken(head.stream, at.position or None, head.sequence, reason))

    def _follow(self, place: Segment, checkpoint: SignedCheckpoint) -> bool:
        """Check a checkpoint by itself and against the one before; whether what it says counts."""
        statement = checkpoint.statement
        trail = self.trails.setdefault(statement.station, Trail(statement.station))
        # A restored station goes on from the newest checkpoint that it still has.
        is_linked = statement.previous == trail.previous or place.header.epoch > trail.epoch
        fault = self._fault_of(place, checkpoint, trail, is_linked)
        if fault is not None:
            self._walk.faults.append(_fault(place, checkpoint.sequence, fault))
            return False
        if statement.public_key != trail.key:
            trail.former += [trail.key]
            trail.key, trail.successors = statement.public_key, []
        if statement.successor != NO_KEY:
            trail.successors.append(statement.successor)
        trail.epoch, trail.sequence, trail.checkpoints = place.header.epoch, checkpoint.sequence, trail.checkpoints + 1
        trail.previous, trail.signed_at = statement_hash(statement), statement.time
        return True

    def _fault_of(self, place: Segment, checkpoint: SignedCheckpoint, trail: Trail, is_linked: bool) -> str | None:
        statement = checkpoint.statement
        name = key_id(statement.public_key)
        if not is_signed(statement.public_key, checkpoint.signature, statement_bytes(statement)):
            return f"its signature is not that of key {name}"
        if not is_linked:
            return f"it follows checkpoint {statement.previous.hex()}, the one before it is {trail.previous.hex()}"
        is_first = trail.key == NO_KEY and not (statement.station == self._own and self._trusted)
        is_known = name in self._trusted and statement.public_key not in trail.former
        if is_first or is_known or statement.public_key in (trail.key, *trail.successors):
            return None
        if trail.key == NO_KEY:
            return (
                f"it is signed by key {name}, which is not among this station's: {', '.join(sorted(self._trusted))}. "
                f"Next: if you trust that key, put {name}.pem into public-keys/ beside this station's key, from where "
                "the log was before or from its backup"
            )
        is_new_life = place.header.epoch > trail.epoch
        if (is_new_life or statement.public_key not in trail.former) and self._is_enrolled(place, statement.public_key):
            return None
        return f"it is signed by key {name}, which key {key_id(trail.key)} did not name as its successor"

    def _is_enrolled(self, place: Segment, public_key: bytes) -> bool:
        """Whether that key is the one by which this log's own station, as central, took the other in last."""
        if self._own is None or place.stream.station == self._own:
            return False
        newest = b""
        stream = StreamName.of(self._own, "sync", StationEnrolled.type_name)
        try:
            for segment in self._log.read_lives(stream):
                for event in events_of(decode(segment, self._log.catalogue)):
                    is_before = segment.position is not None and segment.position < (place.position or 0)
                    if is_before and isinstance(event, StationEnrolled) and event.enrolled == place.stream.station:
                        newest = event.public_key
        except (ChainBroken, EventError):
            return False  # what is damaged there is told where it stands
        return newest == public_key


def checkpoints_in(segment: Segment, log: Log) -> list[SignedCheckpoint]:
    """The signed checkpoints of a segment of such a stream.

    Raises:
        BadProof: One of them contradicts itself.
        EventError: The segment cannot be decoded.
    """
    found = []
    for number, event in enumerate(events_of(decode(segment, log.catalogue))):
        if not isinstance(event, CheckpointSigned):
            raise BadProof(f"it must be a checkpoint_signed, got {type(event).__name__}")
        sequence = Sequence(segment.header.first_sequence + number)
        found.append(checkpoint_of(event, segment.stream.station, sequence))
    return found


def _is_checkpoints(stream: StreamName) -> bool:
    return stream.type == CheckpointSigned.type_name


def _fault(segment: Segment, sequence: int, reason: str) -> ChainBroken:
    return ChainBroken(segment.stream, segment.position, sequence, reason)
