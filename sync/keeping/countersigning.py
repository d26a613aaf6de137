"""Countersigning: central signs that it holds what a station's checkpoint says.

Contract: `countersign` is central's side. It signs only the heads of the checkpoint that it holds with that very chain
hash, and from where on it holds their streams with all payloads. `Countersigning` is the station's side: it asks for
its newest checkpoint once central holds that, believes nothing but central's signature, and appends it to the station's
own log.
What is signed is laid out in `sync.keeping.countersigned`.
"""

from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from hashlib import sha256

from events import (
    CheckpointCountersigned,
    CheckpointSigned,
    EventError,
    Producer,
    Station,
    StreamName,
    batch_of,
    decode,
    encode,
    events_of,
)
from store import BadProof, Log, SignedCheckpoint, StationKey, StreamHead
from store.keys import is_signed
from store.proof import ALGORITHM, checkpoint_of, checkpoint_stream, key_id, statement_bytes, statement_hash
from sync.errors import BadAnswer, Refusal, WireError
from sync.keeping.countersigned import Held, countersigned_bytes, held_in, held_text, is_countersigned
from sync.keeping.held import hash_at, held_of
from sync.keeping.wholeness import Wholeness
from sync.protocol.wire import Countersigned, CountersignRequest, parse
from sync.runs import Point, Runs, StreamKey, are_held

SOURCE = "sync"
PRODUCER = Producer("sync", "2", sha256(b"{}").digest())
ASK_EVERY_S = 600.0
"""Time between two questions while central does not hold all of a checkpoint."""
VOID = "countersigned"
"""Name of the checkpoint that says up to which position of the station's log countersignatures prove nothing."""
_LOOK_EVERY_S = 1.0
_OWN_TYPES = (CheckpointSigned.type_name, CheckpointCountersigned.type_name)


def countersign(log: Log, station: Station, body: bytes, key: StationKey, now: datetime) -> Countersigned:
    """Central's signature that it holds what the station's checkpoint says, as far as it does.

    Raises:
        Refusal: It is no request, the checkpoint is not here or no good, or nothing of it is held.
        LogUnavailable: The database is away.
    """
    try:
        asked = parse(CountersignRequest, body)
    except WireError as error:
        raise Refusal(
            400, "bad_request", "the body asks for no signature", str(error), "a CountersignRequest", "upgrade ViAn"
        ) from error
    stream = checkpoint_stream(station)
    checkpoint = _checkpoint(log, stream, asked)
    statement = checkpoint.statement
    runs = held_of(log, station)
    wholeness = Wholeness(log, station)
    found = [_held(log, head, runs.get(StreamKey(head.stream, head.epoch), ()), wholeness) for head in statement.heads]
    wholeness.save()
    held = [each for each in found if each is not None and (asked.reads_bases or not each.after)]
    if not held:
        raise _not_held(statement.heads[0].stream if statement.heads else stream, asked)
    digest = statement_hash(statement)
    said = countersigned_bytes(station, asked.checkpoint_sequence, digest, held, now, key.public)
    return Countersigned(
        of_station=station,
        checkpoint_sequence=asked.checkpoint_sequence,
        statement_hash=digest.hex(),
        held=held_text(held),
        key_id=key.id,
        algorithm=ALGORITHM,
        signature=key.sign(said).hex(),
        time=now,
    )


def _checkpoint(log: Log, stream: StreamName, asked: CountersignRequest) -> SignedCheckpoint:
    """The station's checkpoint, as central holds it.

    Raises:
        Refusal: It is not here, or its signature does not hold.
    """
    segment = next(log.read(stream, asked.checkpoint_sequence, epoch=asked.epoch), None)
    if segment is None or segment.header.first_sequence > asked.checkpoint_sequence:
        raise _not_held(stream, asked)
    try:
        event = events_of(decode(segment, log.catalogue))[asked.checkpoint_sequence - segment.header.first_sequence]
        assert isinstance(event, CheckpointSigned), "the stream holds checkpoints only"
        checkpoint = checkpoint_of(event, stream.station, asked.checkpoint_sequence)
    except (EventError, BadProof, IndexError) as error:
        raise _bad_checkpoint(stream, asked, str(error)) from error
    statement = checkpoint.statement
    if not is_signed(statement.public_key, checkpoint.signature, statement_bytes(statement)):
        raise _bad_checkpoint(stream, asked, f"a signature that is not that of key {key_id(statement.public_key)}")
    return checkpoint


def _held(log: Log, head: StreamHead, runs: Runs, wholeness: Wholeness) -> Held | None:
    """From where on the log holds the stream up to the head, with that chain hash there; None where it does not.

    What it holds without payload it does not vouch for: its station may have that in a backup, and nowhere else.
    """
    run = next((run for run in runs if run.after < head.sequence <= run.sequence), None)
    if run is None:
        return None
    is_there = head.chain_hash == (run.chain_hash if run.sequence == head.sequence else _hash_at(log, head))
    after = wholeness.after(StreamKey(head.stream, head.epoch), run, head.sequence) if is_there else None
    return None if after is None or after.sequence >= head.sequence else Held(head, after.sequence, after.chain_hash)


def _hash_at(log: Log, head: StreamHead) -> bytes | None:
    """The chain hash of the segment that ends where the head says; None where none does."""
    stream = head.stream
    with log.connection() as connection:
        found = connection.execute(
            "select g.first_sequence + g.event_count - 1, g.chain_hash from streams s cross join lateral "
            "(select * from segments g where g.stream_id = s.id and g.first_sequence <= %s "
            "order by g.first_sequence desc limit 1) g "
            "where s.station = %s and s.source = %s and s.type = %s and s.epoch = %s",
            (head.sequence, stream.station, stream.source, stream.type, head.epoch),
            binary=True,
        ).fetchone()
    if found is not None and found[0] >= head.sequence:
        return bytes(found[1]) if found[0] == head.sequence else None
    return hash_at(log, stream, head.epoch, head.sequence)  # it is sealed


def _not_held(stream: StreamName, asked: CountersignRequest) -> Refusal:
    return Refusal(
        409,
        "not_held",
        f"central does not hold what checkpoint {asked.checkpoint_sequence} says",
        f"stream {stream} is not here up to there",
        "all that the checkpoint covers",
        "replicate it, and the stream of checkpoints; then ask again",
        stream,
        asked.epoch,
    )


def _bad_checkpoint(stream: StreamName, asked: CountersignRequest, got: str) -> Refusal:
    return Refusal(
        422,
        "bad_checkpoint",
        f"checkpoint {asked.checkpoint_sequence} is no good",
        got,
        "a checkpoint that its station signed",
        "vian verify on the station",
        stream,
        asked.epoch,
    )


class Countersigning:
    """Has a station's newest checkpoint countersigned, when there is something new in it.

    Args:
        log: The station's log.
        station: Whose checkpoints.
        central_key: Central's public key; None: nothing is asked.
        monotonic: Seconds that never go back.
    """

    def __init__(self, log: Log, station: Station, central_key: bytes | None, monotonic: Callable[[], float]) -> None:
        self._log = log
        self._key = central_key
        self._monotonic = monotonic
        self._checkpoints = checkpoint_stream(station)
        self._stream = StreamName.of(station, SOURCE, CheckpointCountersigned.type_name)
        self._seen = 0
        self._newest: SignedCheckpoint | None = None
        self._looked_at: float | None = None
        self._asked_at: float | None = None
        self._request: CountersignRequest | None = None
        self._agreed: set[Held] | None = None
        """what central signed, and what it holds of which it signed what it would"""
        self._there: set[Held] = set()
        """what it held of the checkpoint when that was looked at last"""
        self.sequence: int | None = None
        """Of the newest checkpoint that central countersigned."""

    def is_due(
        self, heads: Mapping[StreamKey, StreamHead], held: Mapping[StreamKey, Runs], *, has_time: bool = True
    ) -> bool:
        """Whether there is something to ask central; it stays so until it was asked.

        Args:
            heads: How the station's streams stand here.
            held: What central holds of them.
            has_time: Whether to look closely even if that was done a moment ago.

        Raises:
            LogUnavailable: The database is away.
        """
        key = StreamKey(self._checkpoints, self._log.epoch)
        if self._request is None and self._key is not None and key in heads:
            self._request = self._next(key, heads[key], held, has_time=has_time)
        return self._request is not None

    def request(self) -> CountersignRequest:
        """What to ask central; it is due no more."""
        request, self._request = self._request, None
        assert request is not None, "it is due"
        self._asked_at = self._monotonic()
        return request

    def take(self, answer: Countersigned) -> None:
        """Append central's signature to the station's log.

        Raises:
            BadAnswer: It is not central's, or not of what was asked.
            LogUnavailable: The database is away.
        """
        checkpoint = self._newest
        assert checkpoint is not None, "it was asked for"
        assert self._key is not None, "it was asked for"
        assert self._agreed is not None, "it was read with the checkpoint"
        event = CheckpointCountersigned(
            time=answer.time,
            of_station=answer.of_station,
            checkpoint_sequence=answer.checkpoint_sequence,
            statement_hash=answer.statement_hash,
            held=answer.held,
            key_id=answer.key_id,
            algorithm=ALGORITHM,
            signature=bytes.fromhex(answer.signature),
        )
        statement = checkpoint.statement
        is_asked = (event.of_station, event.checkpoint_sequence, event.statement_hash) == (
            statement.station,
            checkpoint.sequence,
            statement_hash(statement).hex(),
        )
        if not is_asked or not is_countersigned(event, self._key):
            self.gave_up()
            raise BadAnswer(
                f"central's signature under checkpoint {checkpoint.sequence} is not that of its key "
                f"{key_id(self._key)}, or of another checkpoint. Next: if central's key was changed: "
                "vian station enrol again"
            )
        # Pruning is what makes room, and it waits for this.
        self._log.append([encode(self._stream, batch_of([event]), PRODUCER)], from_reserve=True)
        self.sequence = checkpoint.sequence
        # Of what it holds without payload it signs less than it holds: asking again would change nothing.
        self._agreed |= _told(held_in(event.held)) | self._there

    def heed(self, held: Mapping[StreamKey, Runs]) -> None:
        """Let no countersignature count that says more than central says that it holds: it lost that.

        Whoever takes payloads off this log then waits until central has signed anew (`sync.keeping.pruning`).

        Raises:
            LogUnavailable: The database is away.
        """
        signed = self._last_signed() if self._key is not None else None
        if signed is None or all(_is_still_held(each, held) for each in signed):
            return
        position = self._log.head()
        with self._log.transaction() as transaction:
            transaction.save_checkpoint(VOID, position)
        self._agreed, self.sequence, self._request = set(), None, None

    def gave_up(self) -> None:
        """Central did not sign: the next checkpoint is another chance."""
        self._newest = None

    def _next(
        self, key: StreamKey, head: StreamHead, held: Mapping[StreamKey, Runs], *, has_time: bool
    ) -> CountersignRequest | None:
        """The question about the newest checkpoint that central holds, if it is worth asking now."""
        runs = held.get(key, ())
        if not runs or runs[-1].sequence > head.sequence:
            return None
        there = runs[-1]
        if there.sequence > self._seen:
            self._look(key, Point(there.sequence, there.chain_hash))
        at = self._monotonic()
        was_looked = self._looked_at is not None and at - self._looked_at < _LOOK_EVERY_S
        if self._newest is None or (was_looked and not has_time):
            return None
        self._looked_at = at
        if not self._is_worth_it(self._newest, held, at):
            return None
        return CountersignRequest(epoch=key.epoch, checkpoint_sequence=self._newest.sequence, reads_bases=True)

    def _look(self, key: StreamKey, there: Point) -> None:
        """Take in the newest checkpoint that central holds."""
        self._seen = there.sequence
        self._newest = self._looked_at = None
        segment = next(self._log.read(key.stream, there.sequence, epoch=key.epoch), None)
        if segment is None or Point(segment.header.last_sequence, segment.chain_hash) != there:
            return
        try:
            event = events_of(decode(segment, self._log.catalogue))[-1]
            assert isinstance(event, CheckpointSigned), "the stream holds checkpoints only"
            self._newest = checkpoint_of(event, key.stream.station, there.sequence)
        except (EventError, BadProof):
            return  # vian verify says what is wrong with it
        if self._agreed is None:
            self._agreed = self._agreed_before()

    def _is_worth_it(self, checkpoint: SignedCheckpoint, held: Mapping[StreamKey, Runs], at: float) -> bool:
        """Whether central holds something of the checkpoint that it has not countersigned yet."""
        assert self._agreed is not None, "it was read with the checkpoint"
        heads = [head for head in checkpoint.statement.heads if head.stream.station == self._stream.station]
        wanted = {head for head in heads if head.stream.type not in _OWN_TYPES}
        there = {
            each
            for head in wanted
            if (each := _among(held.get(StreamKey(head.stream, head.epoch), ()), head)) is not None
        }
        self._there = there
        if there <= self._agreed:
            return False
        is_all = len(there) == len(wanted)
        return is_all or self._asked_at is None or at - self._asked_at >= ASK_EVERY_S

    def _agreed_before(self) -> set[Held]:
        """What the log says was countersigned last."""
        return _told(self._last_signed() or ())

    def _last_signed(self) -> list[Held] | None:
        """What the newest countersignature that counts says is held; None where there is none."""
        event = _newest(self._log, self._stream)
        try:
            heads = None if event is None else held_in(event.held)
        except ValueError:
            return None  # of a newer release: asked anew
        self.sequence = None if event is None else event.checkpoint_sequence
        return heads


def newest_countersigned(log: Log, station: Station) -> int | None:
    """Sequence of the newest checkpoint of the station that central countersigned; None where none counts.

    Raises:
        LogUnavailable: The database is away.
    """
    event = _newest(log, StreamName.of(station, SOURCE, CheckpointCountersigned.type_name))
    return None if event is None else event.checkpoint_sequence


def _newest(log: Log, stream: StreamName) -> CheckpointCountersigned | None:
    """The newest countersignature; None where there is none that counts, or it is of a newer release."""
    lives = log.lives(stream)
    if not lives:
        return None
    (segment,) = log.read(stream, lives[-1].sequence, epoch=lives[-1].epoch)
    if segment.position <= log.checkpoint(VOID).position:
        return None
    try:
        event = events_of(decode(segment, log.catalogue))[-1]
    except EventError:
        return None
    assert isinstance(event, CheckpointCountersigned), "the stream holds these only"
    return event


def _among(runs: Runs, head: StreamHead) -> Held | None:
    """What of the runs holds the stream up to the head; None where none does."""
    run = next((run for run in runs if run.after < head.sequence <= run.sequence), None)
    if run is None or not are_held([run], run.after, Point(head.sequence, head.chain_hash)):
        return None
    return Held(head, run.after, run.after_hash)


def _is_still_held(signed: Held, held: Mapping[StreamKey, Runs]) -> bool:
    head = signed.head
    runs = held.get(StreamKey(head.stream, head.epoch), ())
    return are_held(runs, signed.after, Point(head.sequence, head.chain_hash))


def _told(held: Iterable[Held]) -> set[Held]:
    """What says something: the streams in which signatures are kept grow by signing alone."""
    return {each for each in held if each.head.stream.type not in _OWN_TYPES}
