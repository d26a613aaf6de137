"""How much a part of the log is, without reading its payloads.

Contract: one query for all streams that are asked about. What PostgreSQL holds is counted exactly; what is sealed is
shared out from the index of the archive, by events and times, and marked so: no sealed file is opened.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from events import StreamName
from store.log import Log

SEQUENCE_MAX = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Part:
    """Some of one stream's segments."""

    stream: StreamName
    epoch: int
    since: datetime | None = None
    """only those with an event at or after this time"""
    without: tuple[tuple[int, int], ...] = ()
    """but for those in these ranges of sequences: behind the first number, up to the second"""
    without_since: datetime | None = None
    """of which only segments with an event at or after this time are left out"""
    after: int = 0
    """only those behind this sequence; the rest is not looked at"""
    until: int = SEQUENCE_MAX
    """only those up to this sequence; the rest is not looked at"""


@dataclass(frozen=True, slots=True)
class Size:
    """How much a part is."""

    segments: int = 0
    events: int = 0
    payload_bytes: int = 0
    """as stored, compressed"""
    producer_bytes: int = 0
    """names and versions of the producers, in the segments' headers"""
    is_exact: bool = True
    """nothing of it is sealed"""
    recorded_from: datetime | None = None
    """when the oldest of them that PostgreSQL holds was recorded"""

    def __add__(self, other: "Size") -> "Size":
        return Size(
            self.segments + other.segments,
            self.events + other.events,
            self.payload_bytes + other.payload_bytes,
            self.producer_bytes + other.producer_bytes,
            self.is_exact and other.is_exact,
            min(filter(None, (self.recorded_from, other.recorded_from)), default=None),
        )


_PARTS = """
with part as (
  select p.n, p.since, p.without_since, p.after, p.until, s.id from unnest(%(n)s::int[], %(stations)s::text[],
    %(sources)s::text[], %(types)s::text[], %(epochs)s::int[], %(since)s::timestamptz[],
    %(without_since)s::timestamptz[], %(after)s::bigint[], %(until)s::bigint[])
    as p(n, station, source, type, epoch, since, without_since, after, until)
  join streams s on (s.station, s.source, s.type, s.epoch) = (p.station, p.source, p.type, p.epoch)),
without as (
  select * from unnest(%(without_n)s::int[], %(without_after)s::bigint[], %(without_last)s::bigint[])
    as w(n, after, last))
"""
_HOT = """
select p.n, count(*), sum(g.event_count)::bigint, coalesce(sum(octet_length(g.payload)), 0)::bigint,
  sum(octet_length(g.producer) + octet_length(g.producer_version))::bigint, min(g.recorded_at)
from part p join segments g on g.stream_id = p.id and g.first_sequence > p.after and g.first_sequence <= p.until
  and (p.since is null or g.time_max >= p.since)
where not exists (select from without w where w.n = p.n and g.first_sequence > w.after and g.first_sequence <= w.last
  and (p.without_since is null or g.time_max >= p.without_since))
group by p.n
"""
_SEALED = """
select p.n, ceil(sum(share * f.segments / f.events))::bigint, sum(share)::bigint,
  ceil(sum(share * f.bytes / f.events))::bigint, 0::bigint, null::timestamptz
from part p join sealed_ranges r on r.stream_id = p.id join sealed_files f on f.first_position = r.file
cross join lateral (
  select (greatest(0, least(r.last_sequence, p.until) - greatest(r.first_sequence - 1, p.after)) - coalesce((
      select sum(greatest(0,
        least(w.last, r.last_sequence, p.until) - greatest(w.after, r.first_sequence - 1, p.after)))
      from without w where w.n = p.n and (p.without_since is null or r.time_max >= p.without_since)), 0))
    * case when p.since is null or p.since <= r.time_min then 1.0 when p.since > r.time_max then 0.0
      else (extract(epoch from r.time_max - p.since) + 0.000001)
        / (extract(epoch from r.time_max - r.time_min) + 0.000001) end as share) shares
where share > 0
group by p.n
"""


def sizes(log: Log, parts: Sequence[Part]) -> list[Size]:
    """How much each of the parts is, in their order.

    Raises:
        LogUnavailable: The database is away.
    """
    found = [Size()] * len(parts)
    parameters = _parameters(parts)
    with log.connection() as connection:
        for query, is_exact in ((_HOT, True), (_SEALED, False)):
            for number, segments, events, payloads, producers, begun in connection.execute(_PARTS + query, parameters):
                found[number] += Size(segments, events, payloads, producers, is_exact, begun)
    return found


def _parameters(parts: Sequence[Part]) -> dict[str, Any]:
    without = [(number, *each) for number, part in enumerate(parts) for each in part.without]
    return {
        "n": list(range(len(parts))),
        "stations": [part.stream.station for part in parts],
        "sources": [part.stream.source for part in parts],
        "types": [part.stream.type for part in parts],
        "epochs": [part.epoch for part in parts],
        "since": [part.since for part in parts],
        "without_since": [part.without_since for part in parts],
        "after": [part.after for part in parts],
        "until": [part.until for part in parts],
        "without_n": [number for number, _, _ in without],
        "without_after": [after for _, after, _ in without],
        "without_last": [last for _, _, last in without],
    }
