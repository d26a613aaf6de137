"""Payloads that leave the log's disk, and come back: which could go, taking them off, putting them back.

Contract: header, hashes, position and time of recording of a segment never change here, so chains, order and
signatures verify as before. Nothing is decided here: which payloads go, and how that is recorded, is the caller's,
who appends the record in the very transaction that takes them off. `put_back` takes only the bytes that the stored
hash names, `repair` only what the segments beside it demand. Segments in sealed files stay as they are.

It runs as the role `vian_pruner`, the only one that may.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any, LiteralString

import psycopg

from events import (
    CameraCalibrated,
    CheckpointCountersigned,
    CheckpointSigned,
    LossRecorded,
    ProcessFailed,
    ProcessFinished,
    ProcessProgressed,
    ProcessStarted,
    QueryAnswered,
    RequestRefused,
    RuleDeployed,
    RuleMissed,
    RuleRetired,
    SceneChanged,
    Segment,
    SegmentsPruned,
    SegmentsRepaired,
    StageDeployed,
    StationEnrolled,
    StationRevoked,
    StreamName,
    SyncPlanned,
    VideoAdded,
    ZoneDefined,
    ZoneRemoved,
)
from store.errors import BadRequest, LogUnavailable, StoreError
from store.log import Log, Transaction

KEPT_TYPES = frozenset(
    each.type_name
    for each in (
        # What programs read back: without it rules, zones and running processes would be forgotten.
        *(CameraCalibrated, ProcessFailed, ProcessFinished, ProcessProgressed, ProcessStarted, RuleDeployed),
        *(RuleMissed, RuleRetired, SceneChanged, StageDeployed, VideoAdded, ZoneDefined, ZoneRemoved),
        # What proves the log, and says what is no longer in it.
        *(CheckpointCountersigned, CheckpointSigned, LossRecorded, QueryAnswered, RequestRefused, SegmentsPruned),
        *(SegmentsRepaired, StationEnrolled, StationRevoked, SyncPlanned),
    )
)
"""Types whose payloads never leave; they are small."""
KEPT_SOURCES = frozenset({"log", "sync"})


@dataclass(frozen=True, slots=True)
class Weight:
    """What one segment with a payload is, and what its payload weighs."""

    position: int
    stream: StreamName
    epoch: int
    first_sequence: int
    last_sequence: int
    time_min: datetime
    time_max: datetime
    recorded_at: datetime
    payload_bytes: int


@dataclass(frozen=True, slots=True)
class Freed:
    """What was taken off."""

    segments: int
    payload_bytes: int


def may_leave(stream: StreamName) -> bool:
    """Whether payloads of the stream may ever leave: not those that prove the log or that programs read back."""
    return stream.source not in KEPT_SOURCES and stream.type not in KEPT_TYPES


def weights(log: Log, after: int, before: datetime, limit: int) -> list[Weight]:
    """The first segments behind a position that have a payload in PostgreSQL, in order of position.

    Args:
        log: The log.
        after: The position behind which to look.
        before: Only up to the first that was recorded at or after this time.
        limit: At most so many.
    """
    with log.connection() as connection:
        rows = connection.execute(
            "select g.position, s.station, s.source, s.type, s.epoch, g.first_sequence, "
            "g.first_sequence + g.event_count - 1, g.time_min, g.time_max, g.recorded_at, octet_length(g.payload) "
            "from segments g join streams s on s.id = g.stream_id where g.position > %s and g.payload is not null "
            "order by g.position limit %s",
            (after, limit),
        ).fetchall()
    found = [Weight(row[0], StreamName.of(*row[1:4]), *row[4:]) for row in rows]
    young = next((at for at, each in enumerate(found) if each.recorded_at >= before), len(found))
    return found[:young]


def take_off(transaction: Transaction, positions: Sequence[int]) -> Freed:
    """Take the payloads of these segments off the disk, as far as they are in PostgreSQL.

    Raises:
        LogUnavailable: The account may not.
    """
    with as_pruner(transaction):
        row = transaction.connection.execute(
            "select segments, payload_bytes from prune_segments(%s::bigint[])", (list(positions),)
        ).fetchone()
    assert row is not None, "the function answers in one row"
    return Freed(*row)


def put_back(transaction: Transaction, position: int, payload: bytes) -> None:
    """Put the payload of a segment that is in PostgreSQL back, whether it is gone or damaged.

    Raises:
        BadRequest: These are not the bytes that the segment's hash names, or there is no such segment.
        LogUnavailable: The account may not.
    """
    with as_pruner(transaction):
        transaction.connection.execute("select restore_payload(%s, %b::bytea)", (position, payload))


def repair(transaction: Transaction, repaired: Mapping[int, Segment]) -> None:
    """Write damaged segments that are in PostgreSQL anew, headers included, each at its position.

    Raises:
        BadRequest: They do not follow what is before them, or are not what comes after them demands.
        LogUnavailable: The account may not.
    """
    headers = [segment.header for segment in repaired.values()]
    with as_pruner(transaction):
        transaction.connection.execute(
            "select repair_segments(%s::bigint[], %s::bigint[], %s::int[], %s::int[], %s::timestamptz[], "
            "%s::timestamptz[], %s::text[], %s::text[], %b::bytea[], %b::bytea[], %b::bytea[], %b::bytea[])",
            (
                list(repaired),
                [header.first_sequence for header in headers],
                [header.event_count for header in headers],
                [header.schema_version for header in headers],
                [header.time_min for header in headers],
                [header.time_max for header in headers],
                [header.producer.name for header in headers],
                [header.producer.version for header in headers],
                [header.producer.configuration_hash for header in headers],
                [segment.payload for segment in repaired.values()],
                [segment.payload_hash for segment in repaired.values()],
                [segment.chain_hash for segment in repaired.values()],
            ),
        )


def place_at(log: Log, position: int) -> tuple[StreamName, int, int, int] | None:
    """Whose segment PostgreSQL has at a position, though it may be damaged; None where it has none.

    Returns:
        Stream, epoch, the sequence behind the segment of the stream that was taken before it, and the first sequence
        that the segment's own row says.
    """
    with log.connection() as connection:
        row = connection.execute(
            "select s.station, s.source, s.type, s.epoch, coalesce("
            "(select b.first_sequence + b.event_count from segments b where b.stream_id = g.stream_id "
            "and b.position < g.position order by b.position desc limit 1), "
            "(select max(r.last_sequence) + 1 from sealed_ranges r where r.stream_id = g.stream_id), 1), "
            "g.first_sequence from segments g join streams s on s.id = g.stream_id where g.position = %s",
            (position,),
        ).fetchone()
    return (StreamName(*row[:3]), *row[3:]) if row else None


def next_position(log: Log, position: int) -> int | None:
    """The position of the segment in PostgreSQL that the stream of the one at a position took next."""
    with log.connection() as connection:
        row = connection.execute(
            "select min(n.position) from segments g join segments n on n.stream_id = g.stream_id "
            "and n.position > g.position where g.position = %s",
            (position,),
        ).fetchone()
    return row[0] if row else None


def reclaim(log: Log) -> None:
    """Let the log use the room of what was taken off again; what lies at the tables' ends goes back to the disk.

    Raises:
        LogUnavailable: The database is away.
    """
    _maintain(log, "vacuum segments")


def shrink(log: Log) -> None:
    """Let PostgreSQL give up what it keeps of its own log beyond need, where the account may ask for that.

    Raises:
        LogUnavailable: The database is away.
    """
    with suppress(psycopg.errors.InsufficientPrivilege):  # it does so by itself, a little later
        _maintain(log, "checkpoint")


def _maintain(log: Log, command: LiteralString) -> None:
    try:
        with psycopg.connect(log.dsn, autocommit=True) as connection:
            connection.execute(command)
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}".strip()) from error


def log_bytes(log: Log) -> int:
    """Bytes that the segments in PostgreSQL take on the disk, indexes included."""
    with log.connection() as connection:
        row = connection.execute("select pg_total_relation_size('segments')").fetchone()
    assert row is not None, "a size is one row"
    return int(row[0])


@contextmanager
def as_pruner(transaction: Transaction) -> Iterator[None]:
    """The transaction as the role that may take payloads off, and then as the one before.

    Raises:
        LogUnavailable: The account may not.
        BadRequest: The database refuses the bytes.
        StoreError: It refuses something else.
    """
    connection = transaction.connection
    with _refusals():
        (role,) = connection.execute("select current_setting('role')").fetchone() or ("none",)
        connection.execute("set local role vian_pruner")
        yield
        connection.execute("select set_config('role', %s, true)", (role,))


@contextmanager
def pruner(log: Log) -> Iterator[psycopg.Connection[Any]]:
    """A connection to the log's database as the role that may take payloads off, in a transaction of its own.

    Raises:
        LogUnavailable: The database is away, or the account may not.
        StoreError: The database refuses.
    """
    with _refusals(), psycopg.connect(log.dsn) as connection:
        connection.execute("set role vian_pruner")
        yield connection


@contextmanager
def _refusals() -> Iterator[None]:
    try:
        yield
    except psycopg.errors.InsufficientPrivilege as error:
        raise LogUnavailable(
            f"this account may not take payloads off the log, or put them back: {error}. "
            "Next: as the database's owner, grant vian_pruner to this account"
        ) from error
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}".strip()) from error
    except psycopg.DatabaseError as error:
        if error.sqlstate == "VA008":
            raise BadRequest(f"the payload was not put back: {error}".strip()) from error
        raise StoreError(f"the database refuses: {error}".strip()) from error
