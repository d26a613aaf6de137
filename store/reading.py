"""How segments are asked for, and how a row becomes a segment again.

Contract: pure functions; a query is text with named parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from events import Header, Position, Producer, Segment, StreamName
from events import Sequence as SequenceNumber

_COLUMNS = (
    "s.station, s.source, s.type, s.epoch, g.first_sequence, g.event_count, g.schema_version, g.time_min, g.time_max, "
    "g.producer, g.producer_version, g.configuration_hash, g.payload, g.payload_hash, g.chain_hash, g.position, "
    "g.recorded_at"
)
_FROM = f"select {_COLUMNS} from segments g join streams s on s.id = g.stream_id where "


@dataclass(frozen=True, slots=True)
class Filter:
    """Which segments are wanted; None lets all through."""

    types: Sequence[str] | None = None
    sources: Sequence[str] | None = None
    stations: Sequence[str] | None = None
    since: datetime | None = None
    until: datetime | None = None


def read_query(from_position: int, to_position: int, chosen: Filter, limit: int) -> tuple[str, dict[str, Any]]:
    """The query for a page of the log, in order of position, and its parameters."""
    wanted: dict[str, tuple[str, Any]] = {
        "types": ("s.type = any(%(types)s)", _list(chosen.types)),
        "sources": ("s.source = any(%(sources)s)", _list(chosen.sources)),
        "stations": ("s.station = any(%(stations)s)", _list(chosen.stations)),
        "since": ("g.time_max >= %(since)s", chosen.since),
        "until": ("g.time_min < %(until)s", chosen.until),
    }
    used = {name: part for name, part in wanted.items() if part[1] is not None}
    conditions = ["g.position between %(first)s and %(last)s", *(condition for condition, _ in used.values())]
    parameters = {"first": from_position, "last": to_position, "limit": limit}
    parameters |= {name: value for name, (_, value) in used.items()}
    return f"{_FROM}{' and '.join(conditions)} order by g.position limit %(limit)s", parameters


def stream_query(stream: StreamName, epoch: int | None, from_sequence: int, limit: int) -> tuple[str, dict[str, Any]]:
    """The query for a page of one stream, in order of sequence, and its parameters."""
    query = (
        f"{_FROM}g.stream_id = (select id from streams where station = %(station)s and source = %(source)s "
        "and type = %(type)s and (%(epoch)s::int is null or epoch = %(epoch)s) order by epoch desc limit 1) "
        "and g.first_sequence + g.event_count > %(from)s "
        "and g.first_sequence >= coalesce((select max(first_sequence) from segments h "
        "where h.stream_id = g.stream_id and h.first_sequence <= %(from)s), 0) "
        "order by g.first_sequence limit %(limit)s"
    )
    return query, {
        "station": stream.station,
        "source": stream.source,
        "type": stream.type,
        "epoch": epoch,
        "from": from_sequence,
        "limit": limit,
    }


def segment_of(row: Sequence[Any]) -> Segment:
    """The segment that a row of these queries holds."""
    station, source, type_, epoch, first, count, version, time_min, time_max, *rest = row
    (
        producer,
        producer_version,
        configuration_hash,
        payload,
        payload_hash,
        chain_hash,
        position,
        recorded_at,
    ) = rest
    header = Header(
        StreamName(station, source, type_),
        epoch,
        SequenceNumber(first),
        count,
        version,
        time_min,
        time_max,
        Producer(producer, producer_version, configuration_hash),
    )
    return Segment(header, payload, payload_hash, chain_hash, Position(position), recorded_at)


def _list(values: Sequence[str] | None) -> list[str] | None:
    return None if values is None else list(values)
