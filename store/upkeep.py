"""Upkeep of the row tables: partitions ahead, closed days, retention; and how they stand.

Contract: each step is small, idempotent and in a transaction of its own, so upkeep may stop or be
killed anywhere, and several may run at once. It runs as the writer; the log is never touched. Rows
that retention dropped do not come back: the table remembers the day up to which they are gone.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from typing import Any

import psycopg

from store.errors import TableBusy
from store.log import Log
from store.projector import BEHIND, NAME

_TAIL_PAGES = 256
"""Where a day's newest rows are looked for first; PostgreSQL may have made 64 pages ahead of its rows."""
_COUNTED_BYTES = 16 * 1024 * 1024
"""Rows of a table up to this size are counted, those of a larger one estimated."""


@dataclass(frozen=True, slots=True)
class RowPolicy:
    """What upkeep is to see to."""

    keep_days: int | None = None
    """age in days at which a type's rows go, by event time; None keeps them"""
    keep_days_by_type: Mapping[str, int] = field(default_factory=dict)
    """the same for single types, in place of `keep_days`"""
    ahead_days: int = 2
    """partitions made ahead of today, in days"""
    close_after_h: float = 6.0
    """hours after its end at which a day is closed, if as long no row came to it"""

    def retained_from(self, type_name: str, now: datetime) -> date | None:
        """The first day (UTC) whose rows the type keeps; None keeps all."""
        days = self.keep_days_by_type.get(type_name, self.keep_days)
        if days is None:
            return None
        # Who keeps rows for longer than there are years keeps them all.
        today = now.astimezone(UTC).date()
        return today - timedelta(days=days) if days < today.toordinal() else date.min


@dataclass(frozen=True, slots=True)
class Upkeep:
    """What one step of upkeep did to one row table's day."""

    action: str
    """made, closed, dropped, or postponed where queries that read it were in the way"""
    type: str
    day: date
    """the day; for `dropped` and `postponed` the first one that is to stay"""
    partitions: int = 1


@dataclass(frozen=True, slots=True)
class RowTable:
    """How one row table stands."""

    type: str
    version: int
    position: int
    """position up to which its rows are there"""
    is_behind: bool
    """it is being built or rebuilt, apart from the others"""
    partitions: int
    closed: int
    """partitions of closed days, with an index for tracks and cameras"""
    first_day: date | None
    last_day: date | None
    retained_from: date | None
    bytes: int
    """bytes on disk with indexes"""
    lag_segments: int
    """segments of the type in the log that have no rows yet; at least so many where some are in sealed files"""
    lag_s: float
    """seconds since the oldest of these was recorded, of sealed ones at least so many; 0 where there is none"""
    rows_estimate: int
    """rows, counted where there are few, else as the planner estimates them"""


@dataclass(frozen=True, slots=True)
class _Day:
    type: str
    day: date
    is_closed: bool
    pages: int


def maintain(log: Log, policy: RowPolicy, now: datetime) -> Iterator[Upkeep]:
    """See to all row tables, and tell what was done, step by step.

    Raises:
        LogUnavailable: The database is away; run again later.
    """
    today = now.astimezone(UTC).date()
    days = _days(log)
    for type_name in sorted({each.type for each in days}):
        own = [each for each in days if each.type == type_name]
        yield from _drop(log, type_name, own, policy.retained_from(type_name, now))
        yield from _make_ahead(log, type_name, own, today, policy.ahead_days)
        yield from _close(log, own, now - timedelta(hours=policy.close_after_h))
        _call(log, "select summarize_days(%s)", type_name)


def row_tables(log: Log) -> list[RowTable]:
    """How each row table stands, by name of its type."""
    with log.connection() as connection:
        names = {"name": NAME, "behind": BEHIND}
        found = connection.execute(_STATUS, names).fetchall()
        waiting = {type_name: (segments, lag) for type_name, segments, lag in connection.execute(_LAG, names)}
        tables = []
        for row in found:
            segments, lag = waiting.get(row[0], (0, 0.0))
            rows = _rows_estimate(connection, row[0], row[9])
            tables.append(RowTable(*(*row, segments, lag, rows)))
    return tables


_PARTITIONS = (
    "select p.name, c.oid, c.relname, to_date(right(c.relname, 8), 'YYYYMMDD') as day, "
    "to_regclass(quote_ident(c.relname || '_track')) is not null as is_closed "
    "from projections p join pg_inherits i on i.inhparent = to_regclass(quote_ident(p.name)) "
    "join pg_class c on c.oid = i.inhrelid and c.relname ~ ('^' || p.name || '_[0-9]{8}$')"
)
_STATUS = f"""
select p.name, p.version, coalesce(b.position, c.position, 0), b.name is not null,
  count(d.oid), count(*) filter (where d.is_closed), min(d.day), max(d.day), p.retained_from,
  coalesce(sum(pg_total_relation_size(d.oid)), 0)::bigint
from projections p
left join checkpoints c on c.name = %(name)s
left join checkpoints b on b.name = %(behind)s || p.name
left join ({_PARTITIONS}) d on d.name = p.name
group by p.name, b.name, b.position, c.position order by p.name
"""
_LAG = """
with standing as (
  select p.name, coalesce(b.position, c.position, 0) as position from projections p
  left join checkpoints c on c.name = %(name)s
  left join checkpoints b on b.name = %(behind)s || p.name), waiting as (
  select s.type, count(*) as segments, min(g.recorded_at) as since
  from segments g join streams s on s.id = g.stream_id join standing t on t.name = s.type
  where g.position > t.position and g.position > (select min(position) from standing)
  group by s.type
  union all
  select s.type, count(*), min(f.sealed_at)
  from sealed_ranges r join sealed_files f on f.first_position = r.file
  join streams s on s.id = r.stream_id join standing t on t.name = s.type
  where r.last_position > t.position
  group by s.type)
select type, sum(segments)::bigint, greatest(0, extract(epoch from clock_timestamp() - min(since)))::float8
from waiting group by type
"""
"""Segments without rows by type, and since when: of sealed ones at least one in each file and stream, before it was
sealed."""


def _days(log: Log) -> list[_Day]:
    """All partitions, by type and day."""
    query = f"select name, day, is_closed, pg_relation_size(oid) / 8192 from ({_PARTITIONS}) d order by 1, 2"
    with log.connection() as connection:
        return [_Day(*row) for row in connection.execute(query)]


def _drop(log: Log, type_name: str, days: list[_Day], retained_from: date | None) -> Iterator[Upkeep]:
    if retained_from is None or not any(each.day < retained_from for each in days):
        return
    try:
        dropped = _call(log, "select drop_days_before(%s, %s)", type_name, retained_from)
    except TableBusy:
        yield Upkeep("postponed", type_name, retained_from)
    else:
        yield Upkeep("dropped", type_name, retained_from, dropped)


def _make_ahead(log: Log, type_name: str, days: list[_Day], today: date, ahead_days: int) -> Iterator[Upkeep]:
    """Partitions of the days to come, for a type that had events yesterday or today."""
    there = {each.day for each in days}
    if not there & {today - timedelta(days=1), today}:
        return
    for ahead in range(1, ahead_days + 1):
        day = today + timedelta(days=ahead)
        if day not in there:
            _call(log, "select ensure_partition(%s, %s)", type_name, day)
            yield Upkeep("made", type_name, day)


def _close(log: Log, days: list[_Day], before: datetime) -> Iterator[Upkeep]:
    """Close the days that ended, and got their newest row, before a time."""
    for each in days:
        if each.is_closed or _end(each.day) > before or not each.pages:
            continue
        newest = _newest_row(log, each)
        if (newest is None or newest <= before) and _call(log, "select close_partition(%s, %s)", each.type, each.day):
            yield Upkeep("closed", each.type, each.day)


def _newest_row(log: Log, day: _Day) -> datetime | None:
    """When the log took the newest row of a day: rows are only ever added at a table's end."""
    query = psycopg.sql.SQL(
        "select max(recorded_at) from {} where time >= %s and time <= %s and ctid >= %s::tid"
    ).format(psycopg.sql.Identifier(day.type))
    first = datetime(day.day.year, day.day.month, day.day.day, tzinfo=UTC)
    last = _end(day.day) - timedelta(microseconds=1)
    with log.connection() as connection:
        for page in (max(0, day.pages - _TAIL_PAGES), 0):
            row = connection.execute(query, (first, last, f"({page},0)")).fetchone()
            if row and row[0] is not None:
                newest: datetime = row[0]
                return newest
    return None


def _end(day: date) -> datetime:
    """The end of a day (UTC); the calendar's last day has its last microsecond in place of one."""
    if day == date.max:
        return datetime.max.replace(tzinfo=UTC)
    return datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(days=1)


def _call(log: Log, statement: str, *parameters: Any) -> Any:
    with log.connection() as connection:
        try:
            row = connection.execute(statement, parameters).fetchone()
        except psycopg.errors.LockNotAvailable as error:
            raise TableBusy(f"a row table is being read: {error}".strip()) from error
    assert row is not None, "a function gives one row"
    return row[0]


def _rows_estimate(connection: psycopg.Connection[Any], type_name: str, size: int) -> int:
    """The number of rows: counted where that is quick, else what the planner believes."""
    table = psycopg.sql.Identifier(type_name)
    if size <= _COUNTED_BYTES:
        row = connection.execute(psycopg.sql.SQL("select count(*) from {}").format(table)).fetchone()
        return int(row[0]) if row else 0
    row = connection.execute(psycopg.sql.SQL("explain (format json) select from {}").format(table)).fetchone()
    assert row is not None, "explain gives one row"
    return int(row[0][0]["Plan"]["Plan Rows"])
