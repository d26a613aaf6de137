"""Sealing: old segments move, verbatim, from PostgreSQL into sealed files.

Contract: nothing leaves PostgreSQL before its sealed copy has been read back from its place and every chain in it
verified. One file at a time: plan (said in the database, so that a later run knows what may lie half-written), write,
read back, then one transaction that enters the file into the index and removes the range. A kill between any two
steps leaves the log whole, and the next run goes on. One process seals at a time; the caller sees to that, and the
database refuses a second plan. Memory is bounded by one row group, however large the file.

Sealing runs as the role `vian_archiver`, the only one that may remove from the log what it has sealed.
"""

import secrets
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any, BinaryIO

import psycopg

from events import GENESIS, Segment
from store.coldtier import ArchiveHead
from store.errors import UNKNOWN, ArchiveUnavailable, ChainBroken, LogUnavailable, StoreError
from store.log import Log
from store.places import Place
from store.sealed import GROUP_BYTES_MAX, GROUP_SEGMENTS_MAX, FileChains, SealedReader, SealedWriter

FOLDER = "_sealed"
FILE_BYTES = 64 * 1024 * 1024
_PLAN_SEGMENTS = 5_000
_ROW_BYTES = 256
"""About what a segment takes besides its payload."""
_BEFORE = """
select coalesce(
  (select b.chain_hash from stream_bases b where b.stream_id = s.id and b.sequence = %(sequence)s),
  (select case when r.last_sequence = %(sequence)s then r.chain_hash end from sealed_ranges r
    where r.stream_id = s.id and r.first_sequence <= %(sequence)s order by r.first_sequence desc limit 1)
) from streams s
where s.station = %(station)s and s.source = %(source)s and s.type = %(type)s and s.epoch = %(epoch)s
"""
_NOTHING_LEFT = "Nothing left the log. Next: check that disk, then run the same command again"


@dataclass(frozen=True, slots=True)
class Outlook:
    """What a sealing would move."""

    first_position: int
    last_position: int
    segments: int
    events: int
    payload_bytes: int


@dataclass(frozen=True, slots=True)
class Sealed:
    """One file that was sealed."""

    path: str
    first_position: int
    last_position: int
    bytes: int


@dataclass(frozen=True, slots=True)
class _Plan:
    path: str
    groups: list[tuple[int, int]]
    """First and last position of each row group."""

    @property
    def first(self) -> int:
        return self.groups[0][0]

    @property
    def last(self) -> int:
        return self.groups[-1][1]


def outlook(log: Log, before: datetime) -> Outlook:
    """What would be sealed of the segments that this log took before a time: the oldest, up to the first younger."""
    with log.connection() as connection:
        row = connection.execute(
            "with tail as (select sealed_position as sealed, coalesce((select g.position from segments g "
            "where g.position > sealed_position and g.recorded_at >= %s order by g.position limit 1), "
            "9223372036854775807) as stop from archive_head) "
            "select coalesce(min(position), 0), coalesce(max(position), 0), count(*), coalesce(sum(event_count), 0), "
            "coalesce(sum(octet_length(payload)), 0) from tail, segments where position > sealed and position < stop",
            (before,),
        ).fetchone()
    assert row is not None, "an aggregate has a row"
    return Outlook(*map(int, row))


class Sealer:
    """Seals the oldest segments of a log."""

    def __init__(
        self,
        log: Log,
        location: str,
        *,
        file_bytes: int = FILE_BYTES,
        on_step: Callable[[str], None] = lambda step: None,
    ) -> None:
        """Build a sealer.

        Args:
            log: The log.
            location: Where sealed files go; the same for all files of a log, and of no other.
            file_bytes: About how large a file becomes; one segment at least goes into each.
            on_step: Told after each step: planned, writing, written, read back, removed.
        """
        self._log = log
        self._location = location
        self._place = Place(location, log.server.data_dir if log.server else None)
        self._file_bytes = file_bytes
        self._on_step = on_step

    def resume(self) -> str | None:
        """Clear away the file that an interrupted sealing left half-written, and say which it was.

        Raises:
            ArchiveUnavailable: The archive cannot be reached.
        """
        head = self._head()
        if head.pending_path is None:
            return None
        with self._archiver() as connection:
            # The plan goes first, so that nobody can enter the file into the index any more; somebody may have.
            connection.execute("select forget_sealing(%s)", (head.pending_path,))
            if connection.execute("select 1 from sealed_files where path = %s", (head.pending_path,)).fetchone():
                return None
            self._place.delete(head.pending_path)
        return head.pending_path

    def seal(self, before: datetime) -> Iterator[Sealed]:
        """Seal what this log took before a time, file by file; each is done with when it comes out.

        Raises:
            ChainBroken: A stored segment does not verify: it stays, and so do all after it.
            ArchiveUnavailable: The archive cannot be reached, or holds something else than was written.
            LogUnavailable: The database is away, or the role may not seal.
        """
        while (plan := self._plan(before)) is not None:
            yield self._seal(plan)

    def _seal(self, plan: _Plan) -> Sealed:
        with self._archiver() as connection:
            connection.execute("select plan_sealing(%s, %s, %s)", (self._location, plan.path, plan.last))
        self._on_step("planned")
        written, sha256, size = self._write(plan)
        self._on_step("written")
        read = self._read_back(plan, sha256, size)
        self._on_step("read back")
        if read.ends != written.ends:
            raise ArchiveUnavailable(f"{self._place.full(plan.path)} holds other chains than were written to it")
        self._remove(plan, read, sha256, size)
        self._on_step("removed")
        return Sealed(plan.path, plan.first, plan.last, size)

    def _head(self) -> ArchiveHead:
        head = self._log.archive.head()
        if head.location != self._location and (head.sealed_position or head.pending_path):
            raise ArchiveUnavailable(
                f"the sealed files of this log are at {head.location}, got {self._location}. "
                "Next: leave out --to; to move the archive, copy all its files, then vian archive relocate --to URL"
            )
        return head

    def _plan(self, before: datetime) -> _Plan | None:
        """The next file: which positions, in which row groups; None when nothing is old enough."""
        head = self._head()
        at = head.sealed_position
        groups: list[tuple[int, int]] = []
        total = group_bytes = 0
        for position, size in self._sizes(at + 1, before):
            weight = size + _ROW_BYTES
            if groups and total + weight > self._file_bytes:
                break
            first, last = groups[-1] if groups else (position, position - 1)
            if not groups or group_bytes + weight > GROUP_BYTES_MAX or last - first + 1 >= GROUP_SEGMENTS_MAX:
                groups.append((position, position))
                group_bytes = 0
            else:
                groups[-1] = (first, position)
            total += weight
            group_bytes += weight
        if not groups:
            return None
        if not at and head.pending_path is None:
            self._require_own_place()
        if groups[0][0] != at + 1:
            raise ChainBroken(
                UNKNOWN,
                at + 1,
                0,
                f"positions {at + 1} to {groups[0][0] - 1} are missing. Next: vian verify",
            )
        stem = f"{groups[0][0]:012d}-{groups[-1][1]:012d}-{secrets.token_hex(4)}"
        return _Plan(f"{FOLDER}/{stem}.parquet", groups)

    def _require_own_place(self) -> None:
        """Nothing, if no other log's sealed files are where this log's first one is to go.

        Who reads the Parquet of two logs in one place counts twice what both hold, as a log and its restored copy do.
        """
        if self._place.has_files(FOLDER):
            raise ArchiveUnavailable(
                f"{self._place.full(FOLDER)} holds files of another log, and this log has sealed none yet: "
                "wanted a place of its own. Next: vian archive --to a new folder or URL"
            )

    def _sizes(self, first: int, before: datetime) -> Iterator[tuple[int, int]]:
        """Position and payload's size of the segments from a position on, up to the first that is too young."""
        while True:
            with self._log.connection() as connection:
                rows = connection.execute(
                    "select position, coalesce(octet_length(payload), 0), recorded_at < %s from segments "
                    "where position >= %s order by position limit %s",
                    (before, first, _PLAN_SEGMENTS),
                ).fetchall()
            for position, size, is_old in rows:
                if not is_old:
                    return
                yield position, size
            if len(rows) < _PLAN_SEGMENTS:
                return
            first = rows[-1][0] + 1

    def _write(self, plan: _Plan) -> tuple[FileChains, bytes, int]:
        """Write the file, each chain checked on the way; where the chains end, and the file's SHA-256 and size."""
        chains = FileChains()

        def fill(sink: BinaryIO) -> None:
            with closing(SealedWriter(sink, plan.first, plan.last)) as writer:
                for first, last in plan.groups:
                    segments = list(self._log.read_all(first, to_position=last, with_hollow=True))
                    _check_positions(segments, first, last)
                    previous: list[bytes | None] = []
                    for segment in segments:
                        previous.append(None if chains.goes_on(segment) else self._before(segment))
                        chains.follow(segment, previous[-1])
                    writer.write(segments, previous)
                    self._on_step("writing")

        sha256, size = self._place.write(plan.path, fill)
        return chains, sha256, size

    def _before(self, segment: Segment) -> bytes:
        """The chain hash before a segment, as the base of its run or the sealed files have it.

        Raises:
            ChainBroken: None has.
        """
        header, stream = segment.header, segment.stream
        if header.first_sequence == 1:
            return GENESIS
        with self._log.connection() as connection:
            row = connection.execute(
                _BEFORE,
                {
                    "station": stream.station,
                    "source": stream.source,
                    "type": stream.type,
                    "epoch": header.epoch,
                    "sequence": header.first_sequence - 1,
                },
                binary=True,
            ).fetchone()
        if row is None or row[0] is None:
            reason = f"nothing before it ends at sequence {header.first_sequence - 1}"
            raise ChainBroken(stream, segment.position, header.first_sequence, reason)
        chain_hash: bytes = row[0]
        return chain_hash

    def _read_back(self, plan: _Plan, sha256: bytes, size: int) -> FileChains:
        """Where the chains end in what lies in the archive now, every hash recomputed from it.

        Raises:
            ArchiveUnavailable: It is not what was written.
        """
        path = self._place.full(plan.path)
        try:
            found = self._place.digest(plan.path)
            if found != (sha256, size):
                raise ArchiveUnavailable(
                    f"{path} was written with {size} bytes and SHA-256 {sha256.hex()}, and read back with {found[1]} "
                    f"and {found[0].hex()}. {_NOTHING_LEFT}"
                )
            with self._place.open(plan.path) as source:
                return SealedReader(source, path, plan.first, plan.last).chains()
        except (FileNotFoundError, ChainBroken) as error:
            raise ArchiveUnavailable(
                f"{path} does not verify when it is read back: {error}. {_NOTHING_LEFT}"
            ) from error

    def _remove(self, plan: _Plan, chains: FileChains, sha256: bytes, size: int) -> None:
        ends = [(name, epoch, sequence, chain_hash) for ((name, epoch), sequence), chain_hash in chains.ends.items()]
        with self._archiver() as connection:
            connection.execute(
                "select seal_segments(%s, %b::bytea, %s, %s::text[], %s::int[], %s::text[], %s::text[], "
                "%s::bigint[], %b::bytea[], %s::bigint[])",
                (
                    plan.path,
                    sha256,
                    size,
                    [name.station for name, _, _, _ in ends],
                    [epoch for _, epoch, _, _ in ends],
                    [name.source for name, _, _, _ in ends],
                    [name.type for name, _, _, _ in ends],
                    [sequence for _, _, sequence, _ in ends],
                    [chain_hash for _, _, _, chain_hash in ends],
                    chains.hollow,
                ),
            )

    @contextmanager
    def _archiver(self) -> Iterator[psycopg.Connection[Any]]:
        with archiver(self._log) as connection:
            yield connection


@contextmanager
def archiver(log: Log) -> Iterator[psycopg.Connection[Any]]:
    """A connection to the log's database that may seal, in a transaction of its own.

    Raises:
        LogUnavailable: The database is away, or the role may not seal.
        StoreError: The database refuses.
    """
    try:
        with psycopg.connect(log.dsn) as connection:
            connection.execute("set role vian_archiver")
            connection.execute("set timezone to 'UTC'")
            yield connection
    except psycopg.errors.InsufficientPrivilege as error:
        raise LogUnavailable(
            f"this role may not seal: {error}. Next: as the database's owner, grant vian_archiver to this role"
        ) from error
    except psycopg.OperationalError as error:
        raise LogUnavailable(f"the database is away: {error}".strip()) from error
    except psycopg.Error as error:
        raise StoreError(f"the database refuses: {error}".strip()) from error


def _check_positions(segments: list[Segment], first: int, last: int) -> None:
    if [segment.position for segment in segments] != list(range(first, last + 1)):
        raise ChainBroken(
            UNKNOWN,
            first,
            0,
            f"of positions {first} to {last} {last - first + 1 - len(segments)} are missing. Next: vian verify",
        )
