"""Payloads that leave the log's disk, and come back: which could go, taking them off, putting them back.

Contract: header, hashes, position and time of recording of a segment never change here, so chains, order and
signatures verify as before. Nothing is decided here: which payloads go, and how that is recorded, is the caller's,
who appends the record in the very transaction that takes them off. `put_back` takes only the bytes that the stored
hash names. Of segments in sealed files nothing is taken off here (`store.resealing`).

It runs as the role `vian_pruner`, the only one that may.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime

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
from store.errors import BadRequest, LogUnavailable
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
    with _as_pruner(transaction):
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
    with _as_pruner(transaction):
        transaction.connection.execute("select restore_payload(%s, %b::bytea)", (position, payload))


def reclaim(log: Log) -> None:
    """Let the log use the room of what was taken off again; what lies at the tables' ends goes back to the disk.

    Raises:
        LogUnavailable: The database is away.
    """
    try:
        with psycopg.connect(log.dsn, autocommit=True) as connection:
            connection.execute("vacuum segments")
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}".strip()) from error


def log_bytes(log: Log) -> int:
    """Bytes that the segments in PostgreSQL take on the disk, indexes included."""
    with log.connection() as connection:
        row = connection.execute("select pg_total_relation_size('segments')").fetchone()
    assert row is not None, "a size is one row"
    return int(row[0])


@contextmanager
def _as_pruner(transaction: Transaction) -> Iterator[None]:
    """The transaction as the role that may, and then as the one before."""
    connection = transaction.connection
    try:
        (role,) = connection.execute("select current_setting('role')").fetchone() or ("none",)
        connection.execute("set local role vian_pruner")
        yield
        connection.execute("select set_config('role', %s, true)", (role,))
    except psycopg.errors.InsufficientPrivilege as error:
        raise LogUnavailable(
            f"this account may not take payloads off the log, or put them back: {error}. "
            "Next: as the database's owner, grant vian_pruner to this account"
        ) from error
    except psycopg.DatabaseError as error:
        if error.sqlstate != "VA008":
            raise
        raise BadRequest(f"the payload was not put back: {error}".strip()) from error
