"""Repair: segments that are damaged, or whose payload left the disk, get back the bytes that their hashes name.

Contract: bytes come from the other side, which is not believed: a payload must have the hash that the log holds, a
header must fit between its neighbours' hashes, which the database checks itself (`store.payloads.repair`). So a repair
never changes what was recorded; it brings it back, or fails and says why. What was put back is recorded as
`segments_repaired` in the same transaction. Segments in sealed files are not repaired here: a copy of the file is.

A repair does one segment, or one row of damaged neighbours, a step.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256

from events import Draft, Producer, Segment, SegmentsRepaired, Station, StreamName, batch_of, encode
from store import BadRequest, ChainBroken, Log, SealedFileDamaged, verify
from store.payloads import next_position, place_at, put_back, repair
from store.walk import pages
from sync.errors import Refusal, SyncError, WireError
from sync.protocol.wire import Range, Record, decode_records, encode_records, record_size

PRODUCER = Producer("repairer", "1", sha256(b"{}").digest())
NEIGHBOURS_MAX = 100
"""Most damaged neighbours that are repaired together."""
RANGE_BYTES_MAX = 4096
"""Most bytes of a question for a range."""
WANTED_MAX = 1000
"""Most segments that are asked of stations at a time."""
_GENESIS = bytes(32)

Fetch = Callable[[Range], Sequence[Segment]]
"""The segments that hold the range at the other side; those that it lacks are left out. Raises SyncError."""


@dataclass(frozen=True, slots=True)
class Damage:
    """A segment that is not what it was."""

    position: int
    stream: StreamName
    epoch: int
    first_sequence: int
    """where it begins in its stream; where its header is damaged, where it must have begun"""
    last_sequence: int | None
    """None where the header is damaged"""
    reason: str

    @property
    def is_of_header(self) -> bool:
        """Whether more than the payload is damaged."""
        return self.last_sequence is None

    def wanted(self) -> Range:
        """The range to ask the other side for."""
        last = self.first_sequence if self.last_sequence is None else self.last_sequence
        return Range(stream=str(self.stream), epoch=self.epoch, first_sequence=self.first_sequence, last_sequence=last)


@dataclass(frozen=True, slots=True)
class Repaired:
    """What became of a damage."""

    damage: Damage
    segments: int
    """how many segments were put back; 0: none"""
    failure: str | None = None
    """why it was not repaired"""


def damaged_payloads(log: Log, first: int = 1) -> Iterator[Damage]:
    """The segments from a position on whose payload does not have its hash.

    Raises:
        LogUnavailable: The database or the archive is away.
    """
    for page in pages(log, first, log.head()):
        for segment in page if isinstance(page, list) else ():
            if not segment.is_payload_whole:
                yield _of_payload(segment, "its payload did not have its hash")


def hollow_payloads(log: Log, stream: StreamName, first: int, last: int, epoch: int | None = None) -> Iterator[Damage]:
    """The segments of a stream between two sequences, both inclusive, whose payload left the disk."""
    for segment in log.read(stream, first, epoch=epoch, with_hollow=True):
        if segment.header.first_sequence > last:
            return
        if not segment.has_payload:
            yield _of_payload(segment, "its payload had left the disk")


def damaged_headers(log: Log, broken: Sequence[ChainBroken]) -> Iterator[Damage]:
    """The segments that a verification found broken, as far as their rows are there to be written anew."""
    for each in broken:
        place = None if each.position is None or isinstance(each, SealedFileDamaged) else place_at(log, each.position)
        if place is None or each.position is None:
            continue
        stream, epoch, expected, _ = place
        yield Damage(each.position, stream, epoch, expected, None, each.reason)


def _of_payload(segment: Segment, reason: str) -> Damage:
    header = segment.header
    return Damage(segment.position, header.stream, header.epoch, header.first_sequence, header.last_sequence, reason)


class Repairer:
    """Puts back what the other side holds.

    Args:
        log: The log with the damage.
        station: Whose log it is: it records what was repaired.
        fetch: Asks the other side.
        origin: Who that is: `central`, or a station's name.
        now: The clock.
    """

    def __init__(self, log: Log, station: Station, fetch: Fetch, origin: str, now: Callable[[], datetime]) -> None:
        self._log = log
        self._station = station
        self._fetch = fetch
        self._origin = origin
        self._now = now

    def repair(self, damage: Damage) -> Repaired:
        """Put back what a damage names.

        Raises:
            LogUnavailable: The database is away, or the account may not.
        """
        try:
            return Repaired(damage, self._headers(damage) if damage.is_of_header else self._payload(damage))
        except (BadRequest, SyncError) as error:
            return Repaired(damage, 0, str(error))

    def repair_all(self, *, only: Station | None = None) -> Iterator[Repaired]:
        """Put back damaged payloads, then whatever a verification still finds, until it finds nothing new.

        Args:
            only: Only streams of this station.

        Raises:
            LogUnavailable: The database is away, or the account may not.
        """
        for damage in list(damaged_payloads(self._log)):
            if only in (None, damage.stream.station):
                yield self.repair(damage)
        tried: set[int] = set()
        while new := [each for each in self._broken() if each.position not in tried]:
            for damage in new:
                tried.add(damage.position)
                if only in (None, damage.stream.station):
                    yield self.repair(damage)

    def _broken(self) -> list[Damage]:
        return list(damaged_headers(self._log, verify(self._log).broken))

    def _payload(self, damage: Damage) -> int:
        segment = self._fetched(damage)
        with self._log.transaction() as transaction:
            put_back(transaction, damage.position, segment.payload)
            transaction.append([self._record(damage, segment, 1)])
        return 1

    def _headers(self, damage: Damage) -> int:
        """Write a segment anew, and its neighbours with it where its hashes do not fit theirs."""
        repaired: dict[int, Segment] = {}
        refusal: BadRequest | None = None
        at: Damage | None = damage
        while at is not None and len(repaired) < NEIGHBOURS_MAX:
            try:
                repaired[at.position] = segment = self._fetched(at)
            except (BadRequest, SyncError):
                if refusal is None:
                    raise
                break  # there is no neighbour to add, so it is the refusal that counts
            try:
                with self._log.transaction() as transaction:
                    repair(transaction, repaired)
                    transaction.append([self._record(damage, segment, len(repaired))])
            except BadRequest as error:
                at, refusal = self._behind(at, segment), error
            else:
                return len(repaired)
        assert refusal is not None, "the loop ends with a repair or a refusal"
        raise refusal

    def _behind(self, damage: Damage, segment: Segment) -> Damage | None:
        """The segment of the stream that was taken next; None at the stream's end."""
        position = next_position(self._log, damage.position)
        if position is None:
            return None
        header = segment.header
        return Damage(position, damage.stream, damage.epoch, header.last_sequence + 1, None, damage.reason)

    def _fetched(self, damage: Damage) -> Segment:
        """The other side's segment that begins where the damaged one does."""
        for segment in self._fetch(damage.wanted()):
            if _begin(segment) == (damage.stream, damage.epoch, damage.first_sequence) and segment.has_payload:
                return segment
        raise BadRequest(
            f"{self._origin} does not hold {damage.stream} from sequence {damage.first_sequence} with its payload"
        )

    def _record(self, damage: Damage, last: Segment, segments: int) -> Draft:
        event = SegmentsRepaired(
            time=self._now(),
            stream=str(damage.stream),
            stream_epoch=damage.epoch,
            first_sequence=damage.first_sequence,
            last_sequence=last.header.last_sequence,
            segments=segments,
            origin=self._origin,
            reason=damage.reason,
        )
        stream = StreamName.of(self._station, "sync", SegmentsRepaired.type_name)
        return encode(stream, batch_of([event]), PRODUCER)


def records_for(log: Log, station: Station, wanted: Range, *, bytes_max: int, segments_max: int) -> bytes:
    """The segments that hold a range, as records in a body, as many as go into it; at least one.

    Args:
        log: The log that is asked.
        station: Who may have only its own streams.
        wanted: The range.
        bytes_max: Most bytes of the body, but for a single larger record.
        segments_max: Most records.

    Raises:
        Refusal: It is another station's stream, or the log holds nothing of it.
        LogUnavailable: The database is away.
    """
    stream = StreamName.parse(wanted.stream)
    if stream.station != station:
        raise Refusal(
            403,
            "foreign_stream",
            "a station reads back its own streams only",
            f"stream {stream}",
            f"a stream of station {station}",
            "name a stream of this station",
            stream,
            wanted.epoch,
            wanted.first_sequence,
        )
    records: list[Record] = []
    size = 0
    for record in _records(log, stream, wanted):
        size += record_size(record.segment)
        if records and (size > bytes_max or len(records) == segments_max):
            break
        records.append(record)
    if not records:
        raise Refusal(
            404,
            "not_held",
            "nothing of the range is held here",
            f"{stream}, epoch {wanted.epoch}, sequences {wanted.first_sequence} to {wanted.last_sequence}",
            "a range that was sent here",
            "restore the station's backup: vian restore",
            stream,
            wanted.epoch,
            wanted.first_sequence,
        )
    return encode_records(records)


def _records(log: Log, stream: StreamName, wanted: Range) -> Iterator[Record]:
    """The records of the range; a damaged segment is left out."""
    previous = _GENESIS
    for segment in log.read(stream, max(wanted.first_sequence - 1, 1), epoch=wanted.epoch, with_hollow=True):
        if segment.header.first_sequence > wanted.last_sequence:
            return
        if segment.header.last_sequence >= wanted.first_sequence and segment.is_payload_whole:
            yield Record(segment, previous)
        previous = segment.chain_hash


class Wanted:
    """What a log wants back from the stations whose streams are damaged in it; asked at their next hello.

    Contract: kept in the log's database, so that whoever finds the damage need not be who answers the stations. What
    was put back is forgotten, and what its station answered without payload: it has no more of it. Asking again for
    the same changes nothing.
    """

    _NAME = "repair"

    def __init__(self, log: Log) -> None:
        self._log = log

    def ask(self, damages: Sequence[Damage]) -> list[Damage]:
        """Want these back; those for which there is no room, as so many are asked for already."""
        at = self._log.head()  # before the transaction: who holds a connection must not wait for another
        with self._log.transaction() as transaction:
            kept = _damages(transaction.checkpoint(self._NAME).state)
            asked = list({each.position: each for each in (*kept, *damages)}.values())
            transaction.save_checkpoint(self._NAME, at, _state(asked[:WANTED_MAX]))
        return asked[WANTED_MAX:]

    def forget(self, is_known: Callable[[Damage], bool]) -> None:
        """Want no more what is so."""
        at = self._log.head()
        with self._log.transaction() as transaction:
            kept = _damages(transaction.checkpoint(self._NAME).state)
            transaction.save_checkpoint(self._NAME, at, _state([each for each in kept if not is_known(each)]))

    def of(self, station: Station) -> list[Damage]:
        """What is wanted of a station."""
        kept = _damages(self._log.checkpoint(self._NAME).state)
        return [each for each in kept if each.stream.station == station]

    def take(self, own: Station, station: Station, segments: Sequence[Segment], now: Callable[[], datetime]) -> int:
        """Put back what of a station's segments is wanted; how many were put back.

        Args:
            own: The station whose log this is: it records the repair.
            station: Who sent them.
            segments: What it sent, not believed.
            now: The clock.

        Raises:
            LogUnavailable: The database is away, or the account may not.
        """
        repairer = Repairer(self._log, own, lambda _: segments, str(station), now)
        done = [repairer.repair(damage) for damage in self.of(station)]
        mended = {each.damage.position for each in done if each.segments}
        hollow = {_begin(each) for each in segments if not each.has_payload and each.stream.station == station}
        self.forget(lambda each: each.position in mended or (each.stream, each.epoch, each.first_sequence) in hollow)
        return sum(each.segments for each in done)


def repair_with(
    log: Log, own: Station, station: Station, body: bytes, *, segments_max: int, now: Callable[[], datetime]
) -> int:
    """Put back what a body of records of a station holds of what is wanted; how many segments were put back.

    Raises:
        Refusal: The body holds no records.
        LogUnavailable: The database is away, or the account may not.
    """
    try:
        records = decode_records(body, bytes_max=len(body), segments_max=segments_max)
    except WireError as error:
        raise Refusal(
            400, "bad_body", "the body does not hold segments", str(error), "whole segment records", "send it again"
        ) from error
    return Wanted(log).take(own, station, [record.segment for record in records], now)


def _begin(segment: Segment) -> tuple[StreamName, int, int]:
    return segment.stream, int(segment.header.epoch), int(segment.header.first_sequence)


def _state(damages: Sequence[Damage]) -> bytes:
    rows = [
        [each.position, str(each.stream), each.epoch, each.first_sequence, each.last_sequence, each.reason]
        for each in damages
    ]
    return json.dumps(rows).encode()


def _damages(state: bytes) -> list[Damage]:
    return [Damage(position, StreamName.parse(stream), *rest) for position, stream, *rest in json.loads(state or b"[]")]
