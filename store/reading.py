"""How segments are asked for, and how a row becomes a segment again.

Contract: pure functions; a query is text with named parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Any

from psycopg import DataError
from psycopg.abc import Buffer
from psycopg.types.datetime import TimestamptzBinaryLoader

from events import EventError, Header, Position, Producer, Segment, StreamName
from events import Sequence as SequenceNumber
from store.errors import BadRequest, ChainBroken

_COLUMNS = (
    "s.station, s.source, s.type, s.epoch, g.first_sequence, g.event_count, g.schema_version, g.time_min, g.time_max, "
    "g.producer, g.producer_version, g.configuration_hash, g.payload, g.payload_hash, g.chain_hash, g.position, "
    "g.recorded_at"
)
_FROM = f"{_COLUMNS} from segments g join streams s on s.id = g.stream_id where "
DERIVE = "derive:"
"""Begins the name of the checkpoint of a stream that this log derives from another."""
_NOT_DERIVED = (
    "(strpos(s.source, '~') = 0 or not exists (select from checkpoints c "
    f"where c.name = '{DERIVE}' || s.station || '/' || s.source || '/' || s.type))"
)
_SEALED_POSITION = "(select sealed_position from archive_head)"


class TimeOrNone(TimestamptzBinaryLoader):
    """Loads a time, or None for one outside the years 1 to 9999, which Python cannot hold."""

    def load(self, data: Buffer) -> datetime | None:  # type: ignore[override]  # None for what Python cannot hold
        """The time that the bytes hold, or None."""
        try:
            return super().load(data)
        except DataError:
            return None


@dataclass(frozen=True, slots=True)
class Filter:
    """Which segments are wanted; None lets all through.

    Hollow segments, those without payload, are passed over unless they are asked for: who decodes events has no use
    for them, and who follows chains, or ships, seals and backs up, must have them. So are streams that this log derived
    from others of its own, unless a source is named: who reads them all would get their events twice. In another log,
    such as central's, they are streams like any other.

    Raises:
        BadRequest: A time is naive.
    """

    types: Sequence[str] | None = None
    sources: Sequence[str] | None = None
    stations: Sequence[str] | None = None
    since: datetime | None = None
    until: datetime | None = None
    with_hollow: bool = False
    without: Sequence[str] = ()
    """Names of streams that are not wanted."""

    @property
    def passes_over_derived(self) -> bool:
        """Whether streams that this log derived are left out."""
        return not self.with_hollow and self.sources is None

    def __post_init__(self) -> None:
        for name, time in (("since", self.since), ("until", self.until)):
            if time is not None and time.tzinfo is None:
                raise BadRequest(f"{name} must be aware of its time zone, got {time.isoformat()}")


def check_not_negative(what: str, number: int) -> None:
    """Nothing, if the sequence or position is 0 or more.

    Raises:
        BadRequest: It is negative.
    """
    if number < 0:
        raise BadRequest(f"{what} must be 0 or more, got {number}")


def read_query(from_position: int, to_position: int, chosen: Filter, limit: int) -> tuple[str, dict[str, Any]]:
    """The query for a page of the log, in order of position, and its parameters.

    Each row begins with the position up to which the log is sealed, as of the same moment.
    """
    wanted: dict[str, tuple[str, Any]] = {
        "types": ("s.type = any(%(types)s)", _list(chosen.types)),
        "sources": ("s.source = any(%(sources)s)", _list(chosen.sources)),
        "stations": ("s.station = any(%(stations)s)", _list(chosen.stations)),
        "since": ("g.time_max >= %(since)s", chosen.since),
        "until": ("g.time_min < %(until)s", chosen.until),
    }
    used = {name: part for name, part in wanted.items() if part[1] is not None}
    conditions = ["g.position between %(first)s and %(last)s", *(condition for condition, _ in used.values())]
    if not chosen.with_hollow:
        conditions.append("g.payload is not null")
    if chosen.passes_over_derived:
        conditions.append(_NOT_DERIVED)
    parameters = {"first": from_position, "last": to_position, "limit": limit}
    parameters |= {name: value for name, (_, value) in used.items()}
    where = " and ".join(conditions)
    return f"select {_SEALED_POSITION}, {_FROM}{where} order by g.position limit %(limit)s", parameters


def stream_query(
    stream: StreamName, epoch: int | None, from_sequence: int, limit: int, *, with_hollow: bool
) -> tuple[str, dict[str, Any]]:
    """The query for a page of one stream, in order of sequence, and its parameters.

    Each row begins with the stream's head, as of the same moment.
    """
    wanted = (
        "(select id from streams where station = %(station)s and source = %(source)s and type = %(type)s "
        "and (%(epoch)s::int is null or epoch = %(epoch)s) order by epoch desc limit 1)"
    )
    whole = "" if with_hollow else "and g.payload is not null "
    # Both sub-queries stand alone, so that they are evaluated once and bound the index scan.
    query = (
        f"select s.sequence, {_FROM}g.stream_id = {wanted} and g.first_sequence + g.event_count > %(from)s "
        f"and g.first_sequence >= coalesce((select max(h.first_sequence) from segments h where h.stream_id = {wanted} "
        f"and h.first_sequence <= %(from)s), 0) {whole}order by g.first_sequence limit %(limit)s"
    )
    return query, {**stream_names(stream), "epoch": epoch, "from": from_sequence, "limit": limit}


def place_query(stream: StreamName, epoch: int | None) -> tuple[str, dict[str, Any]]:
    """The query for a stream's id and epoch, and its parameters."""
    query = (
        "select s.id, s.epoch from streams s where s.station = %(station)s and s.source = %(source)s "
        "and s.type = %(type)s and (%(epoch)s::int is null or s.epoch = %(epoch)s) order by s.epoch desc limit 1"
    )
    return query, {**stream_names(stream), "epoch": epoch}


def stream_names(stream: StreamName) -> dict[str, Any]:
    """The parts of a stream's name, as parameters."""
    return {"station": stream.station, "source": stream.source, "type": stream.type}


def head_query(stream: StreamName, epoch: int, at_position: int | None) -> tuple[str, dict[str, Any]]:
    """The query for where a stream stands, or stood by the segments that are not sealed, and its parameters."""
    named = "s.station = %(station)s and s.source = %(source)s and s.type = %(type)s and s.epoch = %(epoch)s"
    query = f"select s.sequence, s.chain_hash from streams s where {named}"
    if at_position is not None:
        query = (
            "select g.first_sequence + g.event_count - 1, g.chain_hash from segments g "
            f"join streams s on s.id = g.stream_id where {named} and g.position <= %(at)s "
            "order by g.first_sequence desc limit 1"
        )
    return query, {**stream_names(stream), "epoch": epoch, "at": at_position}


def segment_of(row: Sequence[Any]) -> Segment:
    """The segment that a row of these queries holds.

    Raises:
        ChainBroken: The row's header is one that no log can hold.
    """
    station, source, type_, epoch, first, count, version, time_min, time_max, *rest = row
    producer, producer_version, configuration_hash, payload, payload_hash, chain_hash, position, recorded_at = rest
    stream = _stream(station, source, type_)
    if None in (time_min, time_max, recorded_at):
        raise ChainBroken(stream, position, first, "a time of its row lies outside the years 1 to 9999")
    try:
        said_by = _producer(producer, producer_version, configuration_hash)
        header = Header(stream, epoch, SequenceNumber(first), count, version, time_min, time_max, said_by)
    except EventError as error:
        raise ChainBroken(stream, position, first, f"its header does not hold: {error}") from error
    return Segment(header, payload or b"", payload_hash, chain_hash, Position(position), recorded_at)


def _list(values: Sequence[str] | None) -> list[str] | None:
    return None if values is None else list(values)


@lru_cache(maxsize=4096)
def _stream(station: str, source: str, type_: str) -> StreamName:
    """The name, made once: a log has few streams and many segments."""
    return StreamName(station, source, type_)  # type: ignore[arg-type]  # checked when it was stored


@lru_cache(maxsize=4096)
def _producer(name: str, version: str, configuration_hash: bytes) -> Producer:
    return Producer(name, version, configuration_hash)
