"""Signing: a checkpoint over all that the log holds, appended to the log.

Contract: a `Signer` walks along the log from the newest checkpoint of its station, recomputes every hash as
`verify` does, and signs only what it has seen to be sound. It signs nothing where nothing but its own
checkpoints came since. Two signers of one station cannot both follow one checkpoint: the second begins anew.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from typing import NoReturn

from events import GENESIS, Base, Chains, EventError, Place, Producer, Run, Segment, batch_of, encode
from store.audit import checkpoints_in
from store.errors import BadProof, ChainBroken, SequenceConflict
from store.keys import StationKey, is_signed
from store.log import Log
from store.proof import (
    NO_HASH,
    NO_KEY,
    SignedCheckpoint,
    Statement,
    checkpoint_of,
    checkpoint_stream,
    event_of,
    key_id,
    statement_bytes,
    statement_hash,
)
from store.reading import Filter
from store.walk import Walk

PRODUCER = Producer("signer", "1", sha256(b"{}").digest())
_PAGE_SEGMENTS = 250
_ATTEMPTS_MAX = 5
_EVERYTHING = Filter(with_hollow=True)


@dataclass(slots=True)
class _Base:
    """Where a signer goes on from: the newest checkpoint, and the walk behind it."""

    checkpoint: SignedCheckpoint | None
    epoch: int
    walk: Walk
    strangers: int = 0
    """segments behind it that are no checkpoints of this station"""

    @property
    def sequence(self) -> int:
        return 0 if self.checkpoint is None else self.checkpoint.sequence


class Signer:
    """Signs one station's log. Not for several threads at once."""

    def __init__(self, log: Log, station: str, key: Callable[[], StationKey], now: Callable[[], datetime]) -> None:
        """Build a signer.

        Args:
            log: The log.
            station: The station whose log it is.
            key: Reads the station's key; called for each signature, so that a new key is taken up.
            now: The clock.
        """
        self._log = log
        self._stream = checkpoint_stream(station)
        self._key = key
        self._now = now
        self._base: _Base | None = None

    @property
    def position(self) -> int:
        """How far the log was walked."""
        return 0 if self._base is None else self._base.walk.position

    @property
    def unsigned(self) -> int:
        """Segments walked behind the newest checkpoint, other than this station's checkpoints."""
        return 0 if self._base is None else self._base.strangers

    def step(self) -> bool:
        """Walk a bounded stretch; whether the end of the log was reached.

        Raises:
            BadProof: The log is not sound, or its newest checkpoint is no good.
        """
        base = self._base = self._base or self._newest()
        first, head = base.walk.position + 1, self._log.head()
        try:
            page = self._log.page(first, head, _EVERYTHING, _PAGE_SEGMENTS)
        except ChainBroken as broken:
            self._refuse(broken)
        if page:
            # Asked after the segments: the bases of all of them are there.
            base.walk.chains.expect(self._log.bases(first, page[-1].position))
        for segment in page:
            base.walk.take(segment)
            base.strangers += segment.stream != self._stream
        if not page and first <= head:
            base.walk.go_to(head + 1)
        if not base.walk.is_sound:
            self._refuse(base.walk.all_broken()[0])
        return base.walk.position >= head

    def sign(self, *, successor: bytes = NO_KEY) -> SignedCheckpoint | None:
        """Walk to the end of the log and sign it; None where there is nothing new to sign.

        Args:
            successor: Public key that may sign from now on in this one's stead.

        Raises:
            BadProof: The log is not sound, its newest checkpoint is no good, or there is no key.
        """
        for _ in range(_ATTEMPTS_MAX):
            while not self.step():
                pass
            assert self._base is not None, "a step sets it"
            if not self._base.strangers and successor == NO_KEY:
                return None
            try:
                return self._append(self._base, successor)
            except SequenceConflict:
                self._base = None  # another signer was faster
        raise BadProof(f"{self._stream}: other signers were faster {_ATTEMPTS_MAX} times. Next: sign again")

    def _append(self, base: _Base, successor: bytes) -> SignedCheckpoint | None:
        # The key is read behind the newest checkpoint, so that after a successor signed, no older key follows.
        key = self._key()
        statement = Statement(
            station=self._stream.station,
            epoch=self._log.epoch,
            position=base.walk.position,
            time=self._now(),
            order_hash=base.walk.order_hash,
            heads=base.walk.heads(),
            previous=NO_HASH if base.checkpoint is None else statement_hash(base.checkpoint.statement),
            public_key=key.public,
            successor=successor,
        )
        event = event_of(statement, key.sign(statement_bytes(statement)))
        expected = base.sequence if base.epoch == self._log.epoch else 0
        draft = encode(self._stream, batch_of([event]), PRODUCER)
        # Payloads leave a full disk only below a checkpoint.
        (place,) = self._log.append([draft], [expected], from_reserve=True)
        signed = checkpoint_of(event, self._stream.station, place.first_sequence)
        base.checkpoint, base.epoch, base.strangers = signed, self._log.epoch, 0
        return signed

    def _newest(self) -> _Base:
        found = newest_checkpoint(self._log, self._stream.station)
        if found is None:
            return _Base(None, self._log.epoch, Walk())
        segment, checkpoint = found
        statement = checkpoint.statement
        if not is_signed(statement.public_key, checkpoint.signature, statement_bytes(statement)):
            self._refuse(
                ChainBroken(
                    segment.stream,
                    segment.position,
                    checkpoint.sequence,
                    f"its signature is not that of key {key_id(statement.public_key)}",
                )
            )
        if statement.epoch != self._log.epoch:
            return _Base(checkpoint, segment.header.epoch, Walk())  # restored since: look at everything again
        chains = Chains(_signed_runs(statement, self._log.bases(last=statement.position)))
        return _Base(checkpoint, statement.epoch, Walk(statement.position, statement.order_hash, chains=chains))

    def _refuse(self, broken: ChainBroken) -> NoReturn:
        self._base = None
        raise BadProof(f"nothing was signed, the log is not sound: {broken}. Next: vian verify --full")


def _signed_runs(statement: Statement, bases: list[Base]) -> dict[Place, list[Run]]:
    """The runs whose ends a statement signed; each begins behind the first base above the run before.

    What begins with the stream is told from what begins behind a base by its end alone: an end above the first base is
    taken as that of a run begun behind it, since nothing can be appended again where the two are one.
    """
    begun: dict[Place, list[Base]] = {}
    for base in sorted(bases, key=lambda each: each.sequence):
        begun.setdefault(base.place, []).append(base)
    runs: dict[Place, list[Run]] = {}
    for head in sorted(statement.heads, key=lambda each: each.sequence):
        place = (head.stream, head.epoch)
        there = runs.setdefault(place, [])
        end = there[-1].sequence if there else -1
        after, after_hash = next(
            ((base.sequence, base.chain_hash) for base in begun.get(place, ()) if end < base.sequence < head.sequence),
            (0, GENESIS),
        )
        there.append(Run(after, after_hash, head.sequence, head.chain_hash, statement.position))
    return runs


def newest_checkpoint(log: Log, station: str) -> tuple[Segment, SignedCheckpoint] | None:
    """The station's newest checkpoint, and the segment that holds it; None where it never signed.

    Raises:
        BadProof: It cannot be read.
    """
    stream = checkpoint_stream(station)
    heads = [head for head in log.streams() if head.stream == stream and head.sequence]
    if not heads:
        return None
    head = max(heads, key=lambda each: each.epoch)
    try:
        segment = next(log.read(stream, head.sequence, epoch=head.epoch), None)
        if segment is None:
            raise BadProof(f"{stream}: sequence {head.sequence} is missing. Next: vian verify --full")
        return segment, checkpoints_in(segment, log)[-1]
    except (ChainBroken, EventError) as error:
        raise BadProof(
            f"{stream}: sequence {head.sequence} cannot be read: {error}. Next: vian verify --full"
        ) from error
