"""What central does with a hello and with segments, apart from HTTP.

Contract: `apply` is one transaction: all segments of a body are durable when it returns, or none is
stored. A segment that is there already is acknowledged and not stored again, so a body may be sent
any number of times. Nothing a station says of itself is believed: whose stream it is, the payload's
hash, the chain, and for known types the number of events and their times are checked before.
"""

import hashlib
from collections.abc import Callable
from datetime import datetime

from events import CorruptSegment, Draft, PayloadGone, Segment, Station, StreamName, UnknownType, chain, decode
from store import ChainBroken, Log, SequenceConflict, StreamHead
from sync.errors import ProtocolMismatch, Refusal, WireError
from sync.wire import (
    PROTOCOL,
    Hello,
    HelloAnswer,
    SegmentsAnswer,
    StreamState,
    decode_records,
    parse_versioned,
    program,
)


def answer_hello(
    log: Log, station: Station, body: bytes, *, body_bytes_max: int, segments_max: int, now: Callable[[], datetime]
) -> HelloAnswer:
    """The cursors of the streams that the hello names.

    Raises:
        Refusal: It is no hello, of another protocol version, or says it is another station.
        LogUnavailable: The database is away.
    """
    hello = _hello(body)
    if hello.station != station:
        raise Refusal(
            403,
            "foreign_station",
            "the token speaks for another station than the hello",
            f"station {hello.station}",
            f"station {station}",
            "give the station the name that central granted, or central a grant for this name",
        )
    wanted = [state.head() for state in hello.streams]
    for head in wanted:
        _check_owner(station, head.stream, head.epoch, None)
    known = {(head.stream, head.epoch): head for head in log.streams() if head.stream.station == station}
    cursors = [
        known.get((head.stream, head.epoch), StreamHead(head.stream, head.epoch, 0, bytes(32))) for head in wanted
    ]
    return HelloAnswer(
        protocol=PROTOCOL,
        program=program(),
        station=station,
        time=now(),
        cursors=tuple(map(StreamState.of, cursors)),
        body_bytes_max=body_bytes_max,
        segments_max=segments_max,
    )


def apply(log: Log, station: Station, body: bytes, *, body_bytes_max: int, segments_max: int) -> SegmentsAnswer:
    """Store the segments of the body, and say where their streams stand then.

    Raises:
        Refusal: Something is wrong with them; nothing was stored.
        LogUnavailable: The database is away; if it went away during the commit, the segments may have
            been stored.
    """
    segments = _segments(body, body_bytes_max, segments_max)
    _check(log, station, segments)
    try:
        appended = log.append(
            [_draft(segment) for segment in segments],
            [segment.header.first_sequence - 1 for segment in segments],
            epochs=[segment.header.epoch for segment in segments],
            chain_hashes=[segment.chain_hash for segment in segments],
        )
    except (SequenceConflict, ChainBroken) as error:
        raise _conflict(log, segments, error) from error
    duplicates = sum(one.was_there for one in appended)
    return SegmentsAnswer(
        cursors=tuple(map(StreamState.of, _cursors(log, segments))),
        stored=len(appended) - duplicates,
        duplicates=duplicates,
    )


def _hello(body: bytes) -> Hello:
    try:
        return parse_versioned(Hello, body)
    except ProtocolMismatch as error:
        raise Refusal(
            400,
            "protocol_version",
            "the sync protocol has another version here",
            str(error),
            f"version {PROTOCOL}",
            "bring station and central to the same ViAn: pip install --upgrade vian",
        ) from error
    except WireError as error:
        raise Refusal(
            400, "bad_hello", "the body is no hello", str(error), "a Hello in JSON", "upgrade ViAn on the older side"
        ) from error


def _segments(body: bytes, body_bytes_max: int, segments_max: int) -> list[Segment]:
    try:
        return decode_records(body, bytes_max=body_bytes_max, segments_max=segments_max)
    except WireError as error:
        raise Refusal(
            400, "bad_body", "the body does not hold segments", str(error), "whole segment records", "send it again"
        ) from error


def _check(log: Log, station: Station, segments: list[Segment]) -> None:
    """Nothing, if each segment is the station's own and is what its header says.

    Raises:
        Refusal: One is not.
    """
    previous: dict[tuple[StreamName, int], Segment] = {}
    for segment in segments:
        header = segment.header
        _check_owner(station, header.stream, header.epoch, header.first_sequence)
        payload_hash = hashlib.sha256(segment.payload).digest()
        if payload_hash != segment.payload_hash:
            got, wanted = f"payload {payload_hash.hex()}", f"payload {segment.payload_hash.hex()}"
            raise _corrupt(segment, "bad_payload", got, wanted)
        try:
            decode(segment, log.catalogue, as_stored=True)
        except UnknownType:
            pass  # A newer station's: kept, shipped on and verified; whoever reads it is told.
        except (CorruptSegment, PayloadGone) as error:
            is_meant = _is_chained(log, segment, previous.get((header.stream, header.epoch)))
            code = "false_header" if is_meant else "bad_header"
            raise _corrupt(segment, code, str(error), "a payload that holds what the header says") from error
        previous[header.stream, header.epoch] = segment


def _is_chained(log: Log, segment: Segment, before: Segment | None) -> bool:
    """Whether the chain proves that the header left the station like this, and was not damaged on the way."""
    header = segment.header
    if before is not None:
        sequence, chain_hash = int(before.header.last_sequence), before.chain_hash
    else:
        cursor = log.stream_head(header.stream, epoch=header.epoch)
        sequence, chain_hash = cursor.sequence, cursor.chain_hash
    is_next = header.first_sequence == sequence + 1
    return is_next and chain(chain_hash, header, segment.payload_hash) == segment.chain_hash


def _check_owner(station: Station, stream: StreamName, epoch: int, first_sequence: int | None) -> None:
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


def _corrupt(segment: Segment, code: str, got: str, wanted: str) -> Refusal:
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


def _conflict(log: Log, segments: list[Segment], error: SequenceConflict | ChainBroken) -> Refusal:
    cursors = _cursors(log, segments)
    epochs = {segment.stream: segment.header.epoch for segment in segments}
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
        tuple(cursors),
    )


def _cursors(log: Log, segments: list[Segment]) -> list[StreamHead]:
    keys = dict.fromkeys((segment.stream, segment.header.epoch) for segment in segments)
    return [log.stream_head(stream, epoch=epoch) for stream, epoch in keys]


def _draft(segment: Segment) -> Draft:
    header = segment.header
    return Draft(
        stream=header.stream,
        event_count=header.event_count,
        schema_version=header.schema_version,
        time_min=header.time_min,
        time_max=header.time_max,
        producer=header.producer,
        payload=segment.payload,
        payload_hash=segment.payload_hash,
    )
