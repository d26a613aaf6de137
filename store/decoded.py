"""The archive's Parquet: decoded events of sealed files, for DuckDB and every other tool, without ViAn.

Contract: a projection of the sealed files, which it never changes: it can be deleted and made again. One sealed file
becomes `TYPE/date=YYYY-MM-DD/station=STATION/FIRST-LAST-ID.vN.parquet` for each type, day and station in it, with the
columns of the type's row table; types, units and descriptions stand in each file's own metadata. A segment that cannot
be decoded here has no rows; it is counted and named. A kill leaves at most a `.part` file, which the next run
replaces. Memory is bounded, and so is the number of open files.
"""

import json
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from events import EventBatch, EventError, EventType, Segment, decode, schema_of, with_envelope
from store.coldtier import ColdTier
from store.log import Log
from store.places import Place
from store.sealed import SealedFile
from store.sealing import archiver

FILES_OPEN_MAX = 200
ROWS_KEPT_MAX = 200_000
ROW_GROUP = 100_000
CONVENTIONS = "times are UTC; pixels: origin top-left, x right, y down; id of an event: station/source/type/sequence"

_TIMESTAMP = pa.timestamp("us", tz="UTC")
_DAY_US = 86_400_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FRONT = (
    pa.field("station", pa.string(), False, {"description": "station that recorded it"}),
    pa.field("source", pa.string(), False, {"description": "camera or sensor"}),
    pa.field("subject", pa.string(), True, {"description": "what it is about"}),
    pa.field("time", _TIMESTAMP, False, {"description": "when it happened (UTC, microseconds)"}),
    pa.field("epoch", pa.int32(), False, {"description": "life of the station's log, from 1"}),
    pa.field("sequence", pa.int64(), False, {"description": "place in its stream"}),
    pa.field("position", pa.int64(), False, {"description": "position of its segment in this log"}),
    pa.field("recorded_at", _TIMESTAMP, False, {"description": "when this log took it (UTC)"}),
)


@dataclass(frozen=True, slots=True)
class Projected:
    """What became of one sealed file."""

    path: str
    paths: tuple[str, ...]
    """The Parquet files made of it."""
    events: int
    segments_skipped: int
    note: str | None
    """Why the first of the skipped segments could not be decoded."""


@dataclass(frozen=True, slots=True)
class Key:
    """What one Parquet file holds of a sealed file."""

    type: type[EventType]
    day: str
    station: str

    def path(self, sealed: str) -> str:
        """Where it lies in the archive."""
        stem = PurePosixPath(sealed).stem
        folder = f"{self.type.type_name}/date={self.day}/station={self.station}"
        return f"{folder}/{stem}.v{self.type.version}.parquet"


@dataclass(slots=True)
class _Tally:
    events: int = 0
    skipped: int = 0
    note: str | None = None


@dataclass(slots=True)
class _Open:
    """A Parquet file that is being written."""

    sink: pa.NativeFile
    writer: pq.ParquetWriter
    waiting: list[pa.RecordBatch] = field(default_factory=list)

    def flush(self) -> None:
        if self.waiting:
            self.writer.write_table(pa.Table.from_batches(self.waiting), row_group_size=ROW_GROUP)
            self.waiting = []

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self.writer.close()
            self.sink.close()


def waiting(log: Log) -> list[SealedFile]:
    """The sealed files that have no Parquet yet, in order."""
    done = _done(log)
    return [file for file in log.archive.files() if file.first_position not in done]


def project(log: Log, file: SealedFile) -> Projected:
    """Write the Parquet of a sealed file, anew if there is some, and remember that.

    Raises:
        ChainBroken: A sealed segment does not hold; `vian verify` tells more.
        ArchiveUnavailable: The archive cannot be reached or written.
    """
    place = log.archive.place()
    made, tally = _write(log, file, place)
    before = _done(log).get(file.first_position, [])
    for path in set(before) - set(made):
        place.delete(path)
    with archiver(log) as connection:
        connection.execute(
            "insert into archive_projections (file, paths, events, segments_skipped, note) values (%s, %s, %s, %s, %s) "
            "on conflict (file) do update set paths = excluded.paths, events = excluded.events, "
            "segments_skipped = excluded.segments_skipped, note = excluded.note, projected_at = now()",
            (file.first_position, made, tally.events, tally.skipped, tally.note),
        )
    return Projected(file.path, tuple(made), tally.events, tally.skipped, tally.note)


def _done(log: Log) -> dict[int, list[str]]:
    """The Parquet files of each sealed file that has some."""
    with log.connection() as connection:
        return dict(connection.execute("select file, paths from archive_projections").fetchall())


def _write(log: Log, file: SealedFile, place: Place) -> tuple[list[str], _Tally]:
    """The Parquet files made of a sealed file, in as many passes as it takes with so many files open at a time."""
    made: list[str] = []
    done: set[Key] = set()
    while True:
        tally = _Tally()
        keys, is_whole = _pass(log, file, place, done, tally)
        for key in keys:
            path = key.path(file.path)
            place.move(f"{path}.part", path)
            made.append(path)
        done |= keys
        if is_whole:
            return sorted(made), tally


def _pass(log: Log, file: SealedFile, place: Place, done: set[Key], tally: _Tally) -> tuple[set[Key], bool]:
    """Write the files of the first keys that are not done; which these are, and whether no other is left."""
    files: dict[Key, _Open] = {}
    is_whole = True
    rows = 0
    with place.reaching(), ExitStack() as closing_all:
        for key, batch in _batches(log, file, tally):
            if key in done:
                continue
            if key not in files:
                if len(files) == FILES_OPEN_MAX:
                    is_whole = False
                    continue
                files[key] = closing_all.enter_context(closing(_opened(place, key, file)))
            files[key].waiting.append(batch)
            rows += batch.num_rows
            if rows > ROWS_KEPT_MAX:
                rows = 0
                for each in files.values():
                    each.flush()
    return set(files), is_whole


def _opened(place: Place, key: Key, file: SealedFile) -> _Open:
    sink = place.create(f"{key.path(file.path)}.part")
    return _Open(sink, pq.ParquetWriter(sink, file_schema(key.type, file), compression="zstd"))


def file_schema(event_type: type[EventType], file: SealedFile) -> pa.Schema:
    """The columns of a type's Parquet, with all that a reader without ViAn should know in the metadata."""
    fields = [*_FRONT, *(each for each in schema_of(event_type) if each.name != "time")]
    about = [
        {
            "name": each.name,
            "type": str(each.type),
            "nullable": each.nullable,
            "description": each.metadata[b"description"].decode(),
            "json": b"json" in each.metadata,
            "personal": b"personal" in each.metadata,
        }
        for each in fields
    ]
    return pa.schema(
        fields,
        {
            "vian.type": event_type.type_name,
            "vian.version": str(event_type.version),
            "vian.description": " ".join((event_type.__doc__ or event_type.type_name).split()),
            "vian.conventions": CONVENTIONS,
            "vian.fields": json.dumps(about, ensure_ascii=False),
            "vian.sealed_file": file.path,
            "vian.sealed_sha256": file.sha256.hex(),
        },
    )


def _batches(log: Log, file: SealedFile, tally: _Tally) -> Iterator[tuple[Key, pa.RecordBatch]]:
    """The file's events by type, day and station, in order."""
    archive: ColdTier = log.archive
    for segment in archive.of_file(file):
        try:
            batch = decode(segment, log.catalogue)
        except EventError as error:
            tally.skipped += 1
            tally.note = tally.note or f"position {segment.position}: {error}"
            continue
        tally.events += len(batch)
        rows = _rows(segment, batch)
        for day, part in _by_day(rows):
            yield Key(batch.type, day, segment.stream.station), part


def _rows(segment: Segment, batch: EventBatch) -> pa.RecordBatch:
    whole = with_envelope(segment.stream, segment.header.first_sequence, batch)
    count = len(batch)
    added: dict[str, Any] = {
        "epoch": pa.repeat(pa.scalar(segment.header.epoch, pa.int32()), count),
        "position": pa.repeat(pa.scalar(segment.position, pa.int64()), count),
        "recorded_at": pa.repeat(pa.scalar(segment.recorded_at, _TIMESTAMP), count),
    }
    fields = [*_FRONT, *(each for each in schema_of(batch.type) if each.name != "time")]
    columns = [added[each.name] if each.name in added else whole.column(each.name) for each in fields]
    return pa.RecordBatch.from_arrays(columns, schema=pa.schema(fields))


def _by_day(rows: pa.RecordBatch) -> Iterator[tuple[str, pa.RecordBatch]]:
    """The rows by the day (UTC) of their time."""
    days = np.floor_divide(rows.column("time").cast(pa.int64()).to_numpy(zero_copy_only=False), _DAY_US)
    found = np.unique(days)
    for day in found.tolist():
        name = (_EPOCH + timedelta(days=day)).date().isoformat()
        yield name, rows if len(found) == 1 else rows.filter(pc.equal(pa.array(days), pa.scalar(day, pa.int64())))
