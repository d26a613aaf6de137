"""Facts about the log's database: its settings, its clock, its growth, its schema.

Contract: looks, and changes nothing. Whether a fact is good or bad is for the caller to say.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import psycopg
from alembic.script import ScriptDirectory

from events import Catalogue, StreamName
from store.errors import ArchiveUnavailable, BadRequest, LogUnavailable
from store.log import Log
from store.projector import BEHIND
from store.reading import Filter
from store.schema import configuration, safe_dsn

SETTINGS = (
    "autovacuum",
    "default_transaction_read_only",
    "fsync",
    "full_page_writes",
    "ignore_checksum_failure",
    "max_connections",
    "max_wal_size",
    "server_encoding",
    "statement_timeout",
    "synchronous_commit",
    "TimeZone",
    "zero_damaged_pages",
)
_CONNECT_SECONDS = 15
_SAMPLE = 2_000
"""Segments of which the payloads are measured, where there are more."""


@dataclass(frozen=True, slots=True)
class Clock:
    """What the database's clock says, and the log."""

    now: datetime
    newest: datetime | None
    """newest recorded_at; None in an empty log"""


@dataclass(frozen=True, slots=True)
class Growth:
    """How much the log grew, measured over its times of recording."""

    bytes: int
    """size of the log's database, and of its sealed files where these are on this machine"""
    bytes_log: int
    """the part of it that segments take, indexes included"""
    over: timedelta
    """how long the log was watched: up to the window asked for, less if it is younger"""
    bytes_per_day: float


@dataclass(frozen=True, slots=True)
class Schema:
    """Which schema a database has, and which this program brings."""

    server: str
    """version of PostgreSQL"""
    revision: str | None
    """revision of the database; None where there is no log yet"""
    newest: str
    """newest revision that this program knows"""
    is_known: bool
    """whether this program knows the database's revision"""
    pending: list[tuple[str, str]]
    """revisions that an upgrade would go through, with what each does"""
    row_tables: list[str]
    """row tables that an upgrade would add"""
    outdated: list[str]
    """row tables of an older version of their type, which an upgrade would have filled anew"""
    bytes: int
    """size of the database"""
    bytes_log: int
    """size of the log, sealed files included"""

    @property
    def is_to_migrate(self) -> bool:
        """Whether there is something to upgrade."""
        return bool(self.pending or self.row_tables or self.outdated)


def settings(log: Log) -> Mapping[str, str]:
    """The database's settings that matter here, with their units, as they hold for a program of ours."""
    with log.connection() as connection:
        rows = connection.execute(
            "select name, current_setting(name) from pg_settings where name = any(%s)", (list(SETTINGS),)
        ).fetchall()
        # The session's own time zone is set by us; what others get is what the server was given.
        (zone,) = connection.execute("select reset_val from pg_settings where name = 'TimeZone'").fetchone() or ("",)
    return {**dict(rows), "TimeZone": zone}


def wal_bytes_max(log: Log) -> int:
    """`max_wal_size` in bytes."""
    return _bytes(log, "select pg_size_bytes(current_setting('max_wal_size'))")


def clock(log: Log) -> Clock:
    """The database's time, and that of the newest segment."""
    with log.connection() as connection:
        row = connection.execute(
            "select clock_timestamp(), case when position > 0 then recorded_at end from log_head"
        ).fetchone()
    assert row is not None, "a log has its one row"
    return Clock(*row)


def recorded_at(log: Log, position: int) -> datetime | None:
    """When the first segment from a position on was recorded, wherever it is; None where there is none.

    Raises:
        ArchiveUnavailable: It is sealed, and its file cannot be reached.
        ChainBroken: It does not hold.
    """
    with log.connection() as connection:
        row = connection.execute(
            "select sealed_position, (select recorded_at from segments where position >= %s order by position limit 1) "
            "from archive_head",
            (position,),
        ).fetchone()
    assert row is not None, "an archive has its one row"
    sealed: int = row[0]
    recorded: datetime | None = row[1]
    if position > sealed:
        return recorded
    found = log.archive.page(position, sealed, Filter(with_hollow=True), 1)
    return found[0].recorded_at if found else recorded


def newest_recorded(log: Log, stations: Sequence[str]) -> dict[tuple[StreamName, int], datetime]:
    """When the newest segment of each stream of these stations was recorded here, but for those that are sealed."""
    with log.connection() as connection:
        rows = connection.execute(
            "select s.station, s.source, s.type, s.epoch, (select g.recorded_at from segments g "
            "where g.stream_id = s.id order by g.first_sequence desc limit 1) as newest "
            "from streams s where s.station = any(%s)",
            (list(stations),),
        ).fetchall()
    return {(StreamName.of(*names), epoch): newest for *names, epoch, newest in rows if newest is not None}


def rows_behind(log: Log) -> Mapping[str, int]:
    """The types whose row tables are being built apart from the others, and the position of each."""
    return {
        name.removeprefix(BEHIND): checkpoint.position
        for name, checkpoint in log.checkpoints().items()
        if name.startswith(BEHIND)
    }


def growth(log: Log, window: timedelta) -> Growth | None:
    """How much the log grew over the window before now; None in an empty log.

    The segments of the window that PostgreSQL holds are counted by their times of recording, which never go back in
    order of position; the size is shared out by their part of all payloads, the sealed ones included.
    """
    size, size_log = _sizes(log)
    with log.connection() as connection:
        row = connection.execute(
            "select h.position, h.recorded_at, clock_timestamp(), a.sealed_position, "
            "(select coalesce(sum(bytes), 0)::bigint from sealed_files) from log_head h, archive_head a"
        ).fetchone()
    assert row is not None, "a log has its one row"
    last, newest, now, sealed_position, sealed = row
    if last == 0:
        return None
    first = sealed_position + 1
    begun_at = recorded_at(log, first) or newest  # where all is sealed, nothing came since the newest
    since = max(now - window, begun_at)
    over = max(now - since, timedelta(seconds=1))
    recent = _payload_bytes(log, _first_since(log, since, first, last + 1), last)
    share = recent / max(1, _payload_bytes(log, first, last) + sealed)
    size += sealed if sealed and _is_archive_local(log) else 0
    return Growth(size, size_log, over, share * size / (over / timedelta(days=1)))


def _is_archive_local(log: Log) -> bool:
    """Whether the sealed files take room on this machine, as far as can be told."""
    try:
        return log.archive.place().is_local
    except (ArchiveUnavailable, BadRequest):
        return False  # it is told as a finding of its own


def schema(dsn: str, catalogue: Catalogue) -> Schema:
    """The schema of the database at an address, which is not migrated by looking.

    Raises:
        LogUnavailable: The database cannot be reached, or the account may not look.
    """
    script = ScriptDirectory.from_config(configuration())
    newest = script.get_current_head()
    assert newest is not None, "there are migrations"
    try:
        with psycopg.connect(dsn, autocommit=True, connect_timeout=_CONNECT_SECONDS) as connection:
            server = connection.execute("show server_version").fetchone() or ("unknown",)
            is_ours = connection.execute("select to_regclass('alembic_version') is not null").fetchone() == (True,)
            row = connection.execute("select version_num from alembic_version").fetchone() if is_ours else None
            # The first revisions had no version there: theirs is 1.
            known = (
                connection.execute(
                    "select name, coalesce((to_jsonb(p) ->> 'version')::integer, 1) from projections p"
                ).fetchall()
                if row
                else []
            )
            size, hot = connection.execute(
                "select pg_database_size(current_database()), "
                "coalesce(pg_total_relation_size(to_regclass('segments')), 0)"
            ).fetchone() or (0, 0)
            has_archive = connection.execute("select to_regclass('sealed_files') is not null").fetchone() == (True,)
            (sealed,) = connection.execute(
                "select coalesce(sum(bytes), 0)::bigint from sealed_files" if has_archive else "select 0"
            ).fetchone() or (0,)
    except psycopg.Error as error:
        raise LogUnavailable(f"the database at {safe_dsn(dsn)} cannot be examined: {error}".strip()) from error
    revision = row[0] if row else None
    revisions = {each.revision: each for each in script.walk_revisions()}
    is_known = revision is None or revision in revisions
    pending = [
        (each.revision, each.doc)
        for each in (script.iterate_revisions(newest, revision or "base") if is_known else ())
        if each.revision != revision
    ]
    versions: dict[str, int] = dict(known)
    missing = sorted(str(each.type_name) for each in catalogue if each.type_name not in versions)
    outdated = sorted(
        str(each.type_name) for each in catalogue if versions.get(each.type_name, each.version) < each.version
    )
    return Schema(server[0], revision, newest, is_known, pending[::-1], missing, outdated, size, hot + sealed)


def _sizes(log: Log) -> tuple[int, int]:
    return (
        _bytes(log, "select pg_database_size(current_database())"),
        _bytes(log, "select pg_total_relation_size('segments')"),
    )


def _bytes(log: Log, statement: str) -> int:
    with log.connection() as connection:
        row = connection.execute(statement).fetchone()
    assert row is not None, "a size is one row"
    return int(row[0])


def _first_since(log: Log, since: datetime, first: int, end: int) -> int:
    """The first position recorded at or after a time, by bisection: times follow positions."""
    while first < end:
        middle = (first + end) // 2
        at = recorded_at(log, middle)
        if at is not None and at < since:
            first = middle + 1
        else:
            end = middle
    return first


def _payload_bytes(log: Log, first: int, last: int) -> float:
    """Bytes of payload between two positions: of all where they are few, else of an even sample."""
    count = last - first + 1
    if count <= 0:
        return 0.0
    step = max(1, count // _SAMPLE)
    with log.connection() as connection:
        row = connection.execute(
            "select count(*), coalesce(sum(octet_length(payload)), 0) from segments "
            "where position in (select generate_series(%s::bigint, %s::bigint, %s::bigint))",
            (first, last, step),
        ).fetchone()
    assert row is not None, "an aggregate has one row"
    sampled, size = row
    return float(size / max(1, sampled) * count)
