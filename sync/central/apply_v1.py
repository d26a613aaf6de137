"""What central does with a hello and with segments in protocol 1, as release N-1 sends them.

Contract: as `sync.central.apply`. A cursor is where the run ends that begins with the stream: a station of that release
knows no gaps, so it sends again what lies behind one, which is acknowledged like any other duplicate.
"""

from collections.abc import Callable, Iterable
from datetime import datetime

from events import GENESIS, Run, Segment, Station, StreamName
from store import Log
from sync.central.apply import check, check_owner, check_station, no_hello, no_segments, store_records, wrong_version
from sync.errors import ProtocolMismatch, WireError
from sync.keeping.held import held_of, runs_of
from sync.protocol.wire import Record, program
from sync.protocol.wire_v1 import (
    PROTOCOL,
    Hello,
    HelloAnswer,
    SegmentsAnswer,
    StreamState,
    decode_records,
    parse_versioned,
)
from sync.runs import StreamKey


def answer_hello(
    log: Log, station: Station, body: bytes, *, body_bytes_max: int, segments_max: int, now: Callable[[], datetime]
) -> HelloAnswer:
    """The cursors of the streams that the hello names.

    Raises:
        Refusal: It is no hello, of another protocol version, or says it is another station.
        LogUnavailable: The database is away.
    """
    hello = _hello(body)
    check_station(hello.station, station)
    wanted = [StreamKey(StreamName.parse(state.stream), state.epoch) for state in hello.streams]
    for key in wanted:
        check_owner(station, key.stream, key.epoch, None)
    held = held_of(log, station)
    return HelloAnswer(
        protocol=PROTOCOL,
        program=program(),
        station=station,
        time=now(),
        cursors=tuple(cursor_of(key, held.get(key, ())) for key in wanted),
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
    for segment in segments:
        check_owner(station, segment.stream, segment.header.epoch, segment.header.first_sequence)
    records = _chained(log, segments)
    check(log, station, records, may_lack_payload=False)
    appended = store_records(log, records)
    duplicates = sum(one.was_there for one in appended)
    held = runs_of(log, dict.fromkeys(StreamKey(s.stream, s.header.epoch) for s in segments))
    return SegmentsAnswer(
        cursors=tuple(cursor_of(key, runs) for key, runs in held.items()),
        stored=len(appended) - duplicates,
        duplicates=duplicates,
    )


def cursor_of(key: StreamKey, runs: Iterable[Run]) -> StreamState:
    """Where the run ends that begins with the stream; sequence 0 where there is none."""
    first = next((run for run in runs if not run.after), Run(0, GENESIS, 0, GENESIS))
    return StreamState(
        stream=str(key.stream), epoch=key.epoch, sequence=first.sequence, chain_hash=first.chain_hash.hex()
    )


def _hello(body: bytes) -> Hello:
    try:
        return parse_versioned(Hello, body)
    except ProtocolMismatch as error:
        raise wrong_version(error, PROTOCOL) from error
    except WireError as error:
        raise no_hello(error) from error


def _segments(body: bytes, body_bytes_max: int, segments_max: int) -> list[Segment]:
    try:
        return decode_records(body, bytes_max=body_bytes_max, segments_max=segments_max)
    except WireError as error:
        raise no_segments(error) from error


def _chained(log: Log, segments: list[Segment]) -> list[Record]:
    """The segments with what each follows: in the body, else where central stands."""
    ends: dict[StreamKey, tuple[int, bytes]] = {}
    records = []
    for segment in segments:
        header = segment.header
        key = StreamKey(header.stream, header.epoch)
        if key not in ends:
            head = log.stream_head(key.stream, epoch=key.epoch)
            ends[key] = head.sequence, head.chain_hash
        sequence, chain_hash = ends[key]
        # What does not follow on what is known is a duplicate or a gap; the log tells which.
        records.append(Record(segment, chain_hash if header.first_sequence == sequence + 1 else GENESIS))
        ends[key] = header.last_sequence, segment.chain_hash
    return records
