"""What central does with a hello and with segments, apart from HTTP.

Contract: `store_2` is one transaction: all segments of a body are durable when it returns, or none is
stored. A segment that is there already is acknowledged and not stored again, so a body may be sent
any number of times. Nothing a station says of itself is believed: whose stream it is, the payload's
hash, the chain, and for known types the number of events and their times are checked before.
"""

import hashlib
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Protocol

from events import CorruptSegment, PayloadGone, Segment, Station, StreamName, UnknownType, chain, decode
from events.segment import PAYLOAD_MAX_BYTES
from store import ChainBroken, Log, SequenceConflict, Transaction
from store.writing import Appended
from sync.errors import ProtocolMismatch, Refusal, WireError
from sync.keeping.held import held_of, runs_of
from sync.keeping.repair import Wanted
from sync.protocol.unpacking import check_unpacked, unpacked_bytes
from sync.protocol.wire import (
    CURSORS_MAX,
    PROTOCOLS,
    RUNS_MAX,
    Cursor,
    Hello,
    HelloAnswer,
    Record,
    SegmentsAnswer,
    common_protocol,
    cursors_hash,
    decode_records,
    parse,
    program,
)
from sync.runs import Runs, StreamKey

SEQUENCE_MAX = 2**63 - 2
"""What follows the last event must still be a number that the log can hold."""


class Speaker(Protocol):
    """Who sent a request, as central has found out."""

    @property
    def station(self) -> Station:
        """The station for which it speaks."""


def answer_hello_2(
    log: Log,
    caller: Speaker,
    hello: Hello,
    *,
    body_bytes_max: int,
    segments_max: int,
    now: Callable[[], datetime],
    token: str = "",
    token_expires_s: float = 0.0,
    bits_per_s_max: int | None = None,
) -> HelloAnswer:
    """What central holds of the station, and what it takes at most.

    Args:
        log: Central's log.
        caller: Whose hello it is.
        hello: What it says.
        body_bytes_max: Most bytes of a body of segments.
        segments_max: Most segments in one body.
        now: Central's clock.
        token: What the station shows with its requests from now on.
        token_expires_s: How long it is good, in seconds; 0: no end.
        bits_per_s_max: Most that the station may send; None: no limit.

    Raises:
        Refusal: It says it is another station.
        LogUnavailable: The database is away.
    """
    check_station(hello.station, caller.station)
    for state in hello.streams:
        check_owner(caller.station, StreamName.parse(state.stream), state.epoch, None)
    held = held_of(log, caller.station) if hello.wants_cursors else {}
    are_known = hello.wants_cursors and hello.cursors_hash == cursors_hash(held.items())
    return HelloAnswer(
        protocol=common_protocol(hello),
        program=program(),
        station=caller.station,
        time=now(),
        token=token,
        token_expires_s=token_expires_s,
        cursors=() if are_known else tuple(Cursor.of(key, runs) for key, runs in sorted(held.items())),
        are_cursors_known=are_known,
        body_bytes_max=body_bytes_max,
        segments_max=segments_max,
        bits_per_s_max=bits_per_s_max,
        wanted=tuple(damage.wanted() for damage in Wanted(log).of(caller.station)),
    )


def checked_2(log: Log, caller: Speaker, body: bytes, *, body_bytes_max: int, segments_max: int) -> list[Record]:
    """The records of the body: segments of the caller's own, each of which is what it says.

    Args:
        log: Central's log.
        caller: Who sent it.
        body: Records.
        body_bytes_max: Most bytes of it.
        segments_max: Most records in it.

    Raises:
        Refusal: Something is wrong with them.
    """
    records = _records(body, body_bytes_max, segments_max)
    check(log, caller.station, records, may_lack_payload=True)
    return records


def store_2(
    log: Log,
    records: Sequence[Record],
    still_allowed: Callable[[Transaction], None] = lambda _: None,
    on_hollow: Callable[[Sequence[Segment]], None] = lambda _: None,
) -> SegmentsAnswer:
    """Store records that were checked, and say what is held of their streams then.

    Args:
        log: Central's log.
        records: As `checked_2` gives them.
        still_allowed: Called in the transaction that stores them; raises if the caller may no longer write.
        on_hollow: Told of the segments that were stored without payload, if any.

    Raises:
        Refusal: One does not go on from what is held, or the caller may not write; nothing was stored.
        LogUnavailable: The database is away; if it went away during the commit, the segments may have
            been stored.
    """
    _check_room(log, records[0].segment.stream.station, records)
    appended = store_records(log, records, still_allowed)
    duplicates = sum(one.was_there for one in appended)
    new = [record.segment for record, one in zip(records, appended, strict=True) if not one.was_there]
    if hollow := [segment for segment in new if not segment.has_payload]:
        on_hollow(hollow)
    held = runs_of(log, _keys(records))
    return SegmentsAnswer(
        cursors=tuple(Cursor.of(key, runs) for key, runs in held.items()),
        stored=len(appended) - duplicates,
        duplicates=duplicates,
    )


def check_station(said: str, station: Station) -> None:
    """Nothing, if a hello speaks for the station that may say it.

    Raises:
        Refusal: It speaks for another.
    """
    if said != station:
        raise Refusal(
            403,
            "foreign_station",
            "the token speaks for another station than the hello",
            f"station {said}",
            f"station {station}",
            "give the station the name that central granted, or central a grant for this name",
        )


def check_owner(station: Station, stream: StreamName, epoch: int, first_sequence: int | None) -> None:
    """Nothing, if the stream is the station's own.

    Raises:
        Refusal: It is another's.
    """
    if stream.station != station:
        raise Refusal(
            403,
            "foreign_stream",
            "a station writes its own streams only",
            f"stream {stream}",
            f"a stream of station {station}",
            "send it with that station's own token",
            stream,
            epoch,
            first_sequence,
        )


def check(log: Log, station: Station, records: Sequence[Record], *, may_lack_payload: bool) -> None:
    """Nothing, if each segment is the station's own and is what its header says.

    Raises:
        Refusal: One is not.
    """
    check_unpacked(record.segment for record in records)
    for record in records:
        segment = record.segment
        header = segment.header
        check_owner(station, header.stream, header.epoch, header.first_sequence)
        if header.first_sequence < 1 or header.last_sequence > SEQUENCE_MAX:
            got = f"sequences {header.first_sequence} to {header.last_sequence}"
            raise corrupt(segment, "bad_header", got, f"sequences from 1 to {SEQUENCE_MAX}")
        if may_lack_payload and not segment.has_payload:
            continue
        _check_payload_hash(segment)
        try:
            _check_holds(log, segment)
        except (CorruptSegment, PayloadGone) as error:
            # The chain tells a lie of the station's from what was damaged on the way.
            is_meant = chain(record.previous, header, segment.payload_hash) == segment.chain_hash
            code = "false_header" if is_meant else "bad_header"
            raise corrupt(segment, code, str(error), "a payload that holds what the header says") from error


def _check_holds(log: Log, segment: Segment) -> None:
    """Nothing, if the payload holds what the header says, as far as its type is known here.

    Raises:
        CorruptSegment: It does not.
    """
    try:
        decode(segment, log.catalogue, as_stored=True)
    except UnknownType:
        # A newer station's: kept, shipped on and verified; whoever reads it is told. Nobody shall unpack a bomb then.
        if (declared := unpacked_bytes(segment.payload)) > PAYLOAD_MAX_BYTES:
            raise CorruptSegment(
                f"{segment.stream} from sequence {segment.header.first_sequence}: the payload declares {declared} "
                f"bytes, at most {PAYLOAD_MAX_BYTES} are allowed"
            ) from None


def _check_room(log: Log, station: Station, records: Sequence[Record]) -> None:
    """Nothing, if an answer to hello can still name all that the station has here with these segments.

    Several requests at once may each take the last place; there are few, so it is a bound all the same.

    Raises:
        Refusal: It cannot.
    """
    begun = [each for each in records if each.begins_run or each.segment.header.first_sequence == 1]
    if not begun:
        return
    held = runs_of(log, _keys(begun))
    added = [each.segment for each in begun if not held[_key(each)]]
    streams = sum(not runs for runs in held.values())
    if added and (there := _streams_of(log, station)) + streams > CURSORS_MAX:
        raise _no_room(added[0], "too_many_streams", f"{there} streams here and {streams} more", CURSORS_MAX)
    for key, runs in held.items():
        jumps = [each.segment for each in begun if each.begins_run and _key(each) == key and not _is_held(each, runs)]
        if jumps and len(runs) + len(jumps) > RUNS_MAX:
            raise _no_room(jumps[0], "too_many_runs", f"{len(runs)} runs of it here and {len(jumps)} more", RUNS_MAX)


def _is_held(record: Record, runs: Runs) -> bool:
    return any(run.after < record.segment.header.first_sequence <= run.sequence for run in runs)


def _streams_of(log: Log, station: Station) -> int:
    with log.connection() as connection:
        row = connection.execute("select count(*) from streams where station = %s", (station,)).fetchone()
    assert row is not None, "a count is a row"
    return int(row[0])


def _no_room(segment: Segment, code: str, got: str, most: int) -> Refusal:
    return Refusal(
        422,
        code,
        f"there is no room for the segment of {segment.stream} from sequence {segment.header.first_sequence}",
        got,
        f"at most {most}",
        "send less: vian sync plan set FILE on the station, with fewer streams, or with order: oldest",
        segment.stream,
        segment.header.epoch,
        segment.header.first_sequence,
    )


def store_records(
    log: Log, records: Sequence[Record], still_allowed: Callable[[Transaction], None] = lambda _: None
) -> list[Appended]:
    """What became of each record in the log; all or none is stored.

    Raises:
        Refusal: One does not go on from what is held, or other bytes are there, or the caller may not write any more.
        LogUnavailable: The database is away.
    """
    try:
        with log.transaction() as transaction:
            still_allowed(transaction)
            return transaction.append(
                [record.segment.draft() for record in records],
                [record.segment.header.first_sequence - 1 for record in records],
                epochs=[record.segment.header.epoch for record in records],
                chain_hashes=[record.segment.chain_hash for record in records],
                bases=[record.previous if record.begins_run else None for record in records],
            )
    except (SequenceConflict, ChainBroken) as error:
        raise _conflict(log, records, error) from error


def read_hello(body: bytes) -> Hello:
    """The hello that a body holds.

    Raises:
        Refusal: It holds none, or speaks no version that is known here.
    """
    try:
        hello = parse(Hello, body)
        common_protocol(hello)
    except ProtocolMismatch as error:
        raise wrong_version(error, " or ".join(map(str, PROTOCOLS))) from error
    except WireError as error:
        raise no_hello(error) from error
    return hello


def wrong_version(error: ProtocolMismatch, spoken: object) -> Refusal:
    """The refusal of a hello in a version that is not spoken here."""
    return Refusal(
        400,
        "protocol_version",
        "the sync protocol has another version here",
        str(error),
        f"version {spoken}",
        "bring station and central to the same ViAn: pip install --upgrade vian",
    )


def no_hello(error: WireError) -> Refusal:
    """The refusal of a body that is no hello."""
    return Refusal(
        400, "bad_hello", "the body is no hello", str(error), "a Hello in JSON", "upgrade ViAn on the older side"
    )


def no_segments(error: WireError) -> Refusal:
    """The refusal of a body that holds no records."""
    return Refusal(
        400, "bad_body", "the body does not hold segments", str(error), "whole segment records", "send it again"
    )


def _records(body: bytes, body_bytes_max: int, segments_max: int) -> list[Record]:
    try:
        return decode_records(body, bytes_max=body_bytes_max, segments_max=segments_max)
    except WireError as error:
        raise no_segments(error) from error


def _check_payload_hash(segment: Segment) -> None:
    payload_hash = hashlib.sha256(segment.payload).digest()
    if payload_hash != segment.payload_hash:
        got, wanted = f"payload {payload_hash.hex()}", f"payload {segment.payload_hash.hex()}"
        raise corrupt(segment, "bad_payload", got, wanted)


def corrupt(segment: Segment, code: str, got: str, wanted: str) -> Refusal:
    """The refusal of a segment that is not what it claims to be."""
    return Refusal(
        422,
        code,
        f"the segment of {segment.stream} from sequence {segment.header.first_sequence} is not what it claims to be",
        got,
        wanted,
        "send it again; if that does not help: vian verify on the station",
        segment.stream,
        segment.header.epoch,
        segment.header.first_sequence,
    )


def _conflict(log: Log, records: Sequence[Record], error: SequenceConflict | ChainBroken) -> Refusal:
    epochs = {record.segment.stream: record.segment.header.epoch for record in records}
    if isinstance(error, ChainBroken):
        code, first, got, wanted = (
            "other_history",
            error.first_sequence,
            str(error),
            "a segment that continues the chain",
        )
    elif error.stored_hash is not None:
        code, first = "other_bytes", error.expected + 1
        got, wanted = f"payload {error.sent_hash}", f"payload {error.stored_hash}, which is stored"
    elif error.until is not None:
        code, first = "other_bytes", error.expected + 1
        got, wanted = "a segment that reaches over where a run begins", f"one that ends at sequence {error.until}"
    else:
        code, first = "gap", error.expected + 1
        got, wanted = f"sequence {error.expected + 1}", f"sequence {error.actual + 1}"
    return Refusal(
        409,
        code,
        f"stream {error.stream} does not stand where the segment begins",
        got,
        wanted,
        "say hello again and go on from the cursors",
        error.stream,
        epochs[error.stream],
        first,
        tuple(runs_of(log, _keys(records)).items()),
    )


def _keys(records: Sequence[Record]) -> list[StreamKey]:
    return list(dict.fromkeys(map(_key, records)))


def _key(record: Record) -> StreamKey:
    return StreamKey(record.segment.stream, record.segment.header.epoch)
