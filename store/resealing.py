"""Taking payloads off sealed files: a file is written anew without them, and takes the other's place.

Contract: all else of the file stays to the byte: positions, times, headers, hashes. The new one is read back from its
place, every chain in it verified and compared with the old one's, before the index names it; that, and whatever the
caller records of it, is one transaction. Only then is the old file deleted. A kill between any two steps leaves the
log whole, and whoever rewrites or seals next clears away what is left: either a file that is named by nothing yet, or
one that is named by nothing any more. One process at a time is at work on the archive: it holds the lock. Whoever
reads the old file meanwhile goes on with the new one (`store.coldtier`).

Memory is bounded by one row group; the archive needs room for one file more.
"""

import secrets
from collections.abc import Callable, Iterator, Set
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC
from typing import BinaryIO

import pyarrow as pa
import pyarrow.compute as pc

from events import StreamName
from store.errors import UNKNOWN, ArchiveUnavailable, ChainBroken
from store.locks import ARCHIVE, tried_lock
from store.log import Log, Transaction
from store.payloads import Freed, Weight, as_pruner, pruner
from store.places import Place
from store.sealed import FileChains, SealedFile, SealedReader, SealedWriter
from store.sealing import FOLDER

_WEIGHED = ("station", "source", "type", "epoch", "first_sequence", "event_count", "time_min", "time_max")


@dataclass(frozen=True, slots=True)
class SealedStream:
    """What a sealed file holds of one stream, as the index says."""

    stream: StreamName
    epoch: int
    last_sequence: int


def streams_of(log: Log, file: SealedFile) -> list[SealedStream]:
    """The streams of a sealed file, each with the last of its sequences there."""
    with log.connection() as connection:
        rows = connection.execute(
            "select s.station, s.source, s.type, s.epoch, max(r.last_sequence) from sealed_ranges r "
            "join streams s on s.id = r.stream_id where r.file = %s group by 1, 2, 3, 4 order by 1, 2, 3, 4",
            (file.first_position,),
        ).fetchall()
    return [SealedStream(StreamName.of(*row[:3]), *row[3:]) for row in rows]


def clear_away(log: Log, place: Place) -> str | None:
    """Delete the file that a sealing or a rewriting left when it was killed; which it was, if any.

    The caller holds the lock on the archive, so nobody is at work on that file.

    Raises:
        ArchiveUnavailable: The archive cannot be reached.
        LogUnavailable: The database is away, or the account may not.
    """
    pending = log.archive.head().pending_path
    if pending is None:
        return None
    with pruner(log) as connection:
        # The plan goes first, so that nobody can enter the file into the index any more; somebody may have.
        connection.execute("select forget_sealing(%s)", (pending,))
        if any(file.path == pending for file in log.archive.files()):
            return None
        place.delete(pending)
    return pending


class Resealer:
    """Takes payloads off one sealed file."""

    def __init__(self, log: Log, file: SealedFile) -> None:
        self._log = log
        self._file = file
        self._place = log.archive.place()

    def weights(self) -> list[Weight]:
        """The file's segments that have a payload, in order of position.

        Raises:
            SealedFileDamaged: The file cannot be read.
            ArchiveUnavailable: The archive cannot be reached.
        """
        with self._opened(self._file.path) as source:
            reader = self._reader(source, self._file.path)
            return [weight for number in range(len(reader.groups)) for weight in _weights(reader.group(number))]

    def take_off(self, positions: Set[int], record: Callable[[Transaction, Freed], None]) -> Freed:
        """Take the payloads of these segments off the file.

        Args:
            positions: Segments of the file.
            record: Records it, in the transaction in which the index changes; called last.

        Raises:
            ChainBroken: The file does not verify: it stays as it is.
            ArchiveUnavailable: The archive cannot be reached, holds something else than was written, or another is at
                work on it.
            LogUnavailable: The database is away, or the account may not.
        """
        with tried_lock(self._log, ARCHIVE) as is_mine:
            if not is_mine:
                raise ArchiveUnavailable(
                    "another command is at work on the archive: nothing was taken off its files. Next: nothing, it is "
                    "tried again; or wait until vian archive has ended"
                )
            clear_away(self._log, self._place)
            return self._take_off(positions, record)

    def _take_off(self, positions: Set[int], record: Callable[[Transaction, Freed], None]) -> Freed:
        file = self._file
        path = f"{FOLDER}/{file.first_position:012d}-{file.last_position:012d}-{secrets.token_hex(4)}.parquet"
        with pruner(self._log) as connection:
            connection.execute("select plan_resealing(%s)", (path,))
        freed, sha256, size = self._write(path, positions)
        self._compare(path, sha256, size)
        with self._log.transaction() as transaction:
            with as_pruner(transaction):
                transaction.connection.execute(
                    "select reseal_file(%s, %s, %s, %b::bytea, %s)",
                    (file.first_position, file.path, path, sha256, size),
                )
            record(transaction, freed)
        self._place.delete(file.path)
        with pruner(self._log) as connection:
            connection.execute("select forget_sealing(%s)", (file.path,))
        return freed

    def _write(self, path: str, positions: Set[int]) -> tuple[Freed, bytes, int]:
        gone: list[int] = []

        def fill(sink: BinaryIO) -> None:
            with (
                self._opened(self._file.path) as source,
                closing(SealedWriter(sink, self._file.first_position, self._file.last_position)) as writer,
            ):
                reader = self._reader(source, self._file.path)
                for number in range(len(reader.groups)):
                    table = reader.group(number)
                    chosen = _chosen(table, positions)
                    gone.extend(pc.binary_length(table.column("payload")).filter(chosen).to_pylist())
                    writer.write_table(_without(table, chosen))

        sha256, size = self._place.write(path, fill)
        return Freed(len(gone), sum(gone)), sha256, size

    def _compare(self, path: str, sha256: bytes, size: int) -> None:
        """Nothing, if what lies in the archive now is what was written, with the chains of the old file."""
        full = self._place.full(path)
        try:
            if self._place.digest(path) != (sha256, size):
                raise ArchiveUnavailable(f"{full} is not read back as it was written. {_NOTHING_LEFT}")
            if self._chains(path).ends != self._chains(self._file.path).ends:
                raise ArchiveUnavailable(f"{full} holds other chains than {self._file.path}. {_NOTHING_LEFT}")
        except FileNotFoundError as error:
            raise ArchiveUnavailable(f"{full} is not there when it is read back. {_NOTHING_LEFT}") from error

    def _chains(self, path: str) -> FileChains:
        with self._opened(path) as source:
            return self._reader(source, path).chains()

    def _opened(self, path: str) -> pa.NativeFile:
        try:
            return self._place.open(path)
        except FileNotFoundError as error:
            reason = f"the sealed file {self._place.full(path)} is not there"
            raise ChainBroken(UNKNOWN, self._file.first_position, 0, reason) from error

    def _reader(self, source: pa.NativeFile, path: str) -> SealedReader:
        return SealedReader(source, self._place.full(path), self._file.first_position, self._file.last_position)


_NOTHING_LEFT = "Nothing was taken off. Next: check that disk, then run the same command again"


def _chosen(table: pa.Table, positions: Set[int]) -> pa.ChunkedArray:
    has_payload = pc.greater(pc.binary_length(table.column("payload")), 0)
    return pc.and_(pc.is_in(table.column("position"), value_set=pa.array(sorted(positions), pa.int64())), has_payload)


def _without(table: pa.Table, chosen: pa.ChunkedArray) -> pa.Table:
    """The table with an empty payload in the chosen rows."""
    column = table.schema.get_field_index("payload")
    payloads = pc.if_else(chosen, pa.scalar(b"", pa.binary()), table.column("payload"))
    return table.set_column(column, table.schema.field(column), payloads)


def _weights(table: pa.Table) -> Iterator[Weight]:
    sizes = pc.binary_length(table.column("payload")).to_pylist()
    columns = [table.column(name).to_pylist() for name in ("position", "recorded_at", *_WEIGHED)]
    for size, position, recorded_at, station, source, type_, epoch, first, count, earliest, latest in zip(
        sizes, *columns, strict=True
    ):
        if size:
            stream = StreamName.of(station, source, type_)
            times = (earliest.astimezone(UTC), latest.astimezone(UTC), recorded_at.astimezone(UTC))
            yield Weight(position, stream, epoch, first, first + count - 1, *times, size)
