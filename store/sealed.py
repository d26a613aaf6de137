"""The sealed file: segments that left PostgreSQL, verbatim, one row a segment.

Contract: a file holds a contiguous range of positions, in order; its columns `header` and `payload` are the
segments' own bytes, and with `previous_chain_hash` every chain verifies from the file alone. The container is Parquet,
so that it can still be opened with any tool in ten years; docs/reference/archive.md has every column. The columns
from `station` on repeat what the header says, for looking up; what counts is the header.

Reading checks each segment's position, header and payload hash before it gives it out, and never gives out one that
does not hold. Memory is bounded by one row group.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from events import (
    Base,
    Chains,
    EventError,
    Position,
    Segment,
    StreamName,
    header_bytes,
    parse_header,
)
from store.errors import UNKNOWN, ChainBroken, SealedFileDamaged
from store.following import follow
from store.reading import Filter

FORMAT = "VIANSEAL1"
GROUP_BYTES_MAX = 8 * 1024 * 1024
GROUP_SEGMENTS_MAX = 2_000
_NEXT = "Next: bring it back from a copy, then vian verify"

_TIMESTAMP = pa.timestamp("us", tz="UTC")
_HASH = pa.binary(32)
SCHEMA = pa.schema(
    [
        pa.field("position", pa.int64(), nullable=False),
        pa.field("recorded_at", _TIMESTAMP, nullable=False),
        pa.field("header", pa.binary(), nullable=False),
        pa.field("payload", pa.binary(), nullable=False),
        pa.field("payload_hash", _HASH, nullable=False),
        pa.field("chain_hash", _HASH, nullable=False),
        pa.field("previous_chain_hash", _HASH),
        pa.field("station", pa.string(), nullable=False),
        pa.field("source", pa.string(), nullable=False),
        pa.field("type", pa.string(), nullable=False),
        pa.field("epoch", pa.int32(), nullable=False),
        pa.field("first_sequence", pa.int64(), nullable=False),
        pa.field("event_count", pa.int32(), nullable=False),
        pa.field("schema_version", pa.int32(), nullable=False),
        pa.field("time_min", _TIMESTAMP, nullable=False),
        pa.field("time_max", _TIMESTAMP, nullable=False),
    ]
)
_LOOKED_UP = ("position", "station", "source", "type", "epoch", "first_sequence", "event_count", "time_min", "time_max")
_NAMES = ("station", "source", "type")
_INCOMPRESSIBLE = ("payload", "payload_hash", "chain_hash", "previous_chain_hash")

Stream = tuple[StreamName, int]
"""A stream in one epoch."""


@dataclass(frozen=True, slots=True)
class SealedFile:
    """What the index says of one sealed file."""

    path: str
    first_position: int
    last_position: int
    sha256: bytes
    bytes: int
    segments: int
    events: int
    time_min: datetime
    time_max: datetime
    sealed_at: datetime


@dataclass(frozen=True, slots=True)
class End:
    """Where a stream stands behind some segment."""

    sequence: int
    chain_hash: bytes


@dataclass(frozen=True, slots=True)
class Range:
    """What a sealed file holds of one stream, without a gap and in the order in which the log took it."""

    stream: Stream
    first_sequence: int
    last_sequence: int
    first_position: int
    last_position: int
    time_min: datetime
    time_max: datetime
    chain_hash: bytes


@dataclass(frozen=True, slots=True)
class Contents:
    """What a sealed file holds, by its columns for looking up."""

    ranges: set[Range]
    totals: tuple[int, int, int, int, datetime, datetime]
    """First and last position, segments, events, earliest and latest time."""


class FileChains:
    """Follows the chains of one sealed file, in order of position."""

    def __init__(self) -> None:
        self._chains = Chains()
        self.ends: dict[tuple[Stream, int], bytes] = {}
        """the last sequence of each range, and its chain hash"""
        self.hollow: list[int] = []
        """positions of the segments without payload"""

    def goes_on(self, segment: Segment) -> bool:
        """Whether the segment before it in its stream is in the file, and came before it."""
        return (_stream(segment), segment.header.first_sequence - 1) in self.ends

    def follow(self, segment: Segment, previous: bytes | None) -> None:
        """Take the next segment.

        Args:
            segment: The segment.
            previous: The chain hash before it, where it begins a range.

        Raises:
            ChainBroken: It does not follow, or its bytes are not those that were hashed.
        """
        stream, before = _stream(segment), segment.header.first_sequence - 1
        if previous is not None:
            self._chains.expect([Base(*stream, before, previous, segment.position)])
        follow(self._chains, segment)
        self.ends.pop((stream, before), None)
        self.ends[stream, segment.header.last_sequence] = segment.chain_hash
        if not segment.has_payload:
            self.hollow.append(segment.position)


def _stream(segment: Segment) -> Stream:
    return segment.header.stream, segment.header.epoch


class SealedWriter:
    """Writes one sealed file, a row group at a time."""

    def __init__(self, sink: BinaryIO, first: int, last: int) -> None:
        metadata = {
            "vian.format": FORMAT,
            "vian.positions": f"{first}-{last}",
            "vian.chain": "chain_hash = SHA-256(previous chain_hash | header | payload_hash), one chain a stream and "
            "epoch; the previous one is previous_chain_hash where it is given, else that of the row whose events end "
            "right before; payload_hash = SHA-256(payload)",
        }
        looked_up = [name for name in SCHEMA.names if name not in _INCOMPRESSIBLE]
        self._writer = pq.ParquetWriter(
            pa.PythonFile(sink, "w"),
            SCHEMA.with_metadata(metadata),
            compression={name: "zstd" if name in looked_up else "none" for name in SCHEMA.names},
            use_dictionary=[*_NAMES],
            write_statistics=[*_LOOKED_UP],
        )

    def write(self, segments: Sequence[Segment], previous: Sequence[bytes | None]) -> None:
        """Write the segments as one row group.

        Args:
            segments: The next segments.
            previous: For each that begins a range, the chain hash before it.
        """
        rows = [self._row(segment, before) for segment, before in zip(segments, previous, strict=True)]
        columns = [pa.array(column, field.type) for field, column in zip(SCHEMA, zip(*rows, strict=True), strict=True)]
        self.write_table(pa.Table.from_arrays(columns, schema=SCHEMA))

    def write_table(self, table: pa.Table) -> None:
        """Write a table of such rows as one row group."""
        self._writer.write_table(table, row_group_size=table.num_rows)

    def close(self) -> None:
        """Write the end of the file."""
        self._writer.close()

    def _row(self, segment: Segment, previous: bytes | None) -> tuple[Any, ...]:
        header = segment.header
        return (
            segment.position,
            segment.recorded_at,
            header_bytes(header),
            segment.payload,
            segment.payload_hash,
            segment.chain_hash,
            previous,
            header.stream.station,
            header.stream.source,
            header.stream.type,
            header.epoch,
            header.first_sequence,
            header.event_count,
            header.schema_version,
            header.time_min,
            header.time_max,
        )


class SealedReader:
    """Reads one sealed file.

    Raises:
        SealedFileDamaged: The file is no sealed file any more.
    """

    def __init__(self, source: pa.NativeFile, path: str, first: int, last: int) -> None:
        self.path = path
        self._range = (first, last)
        try:
            self._file = pq.ParquetFile(source)
            if not self._file.schema_arrow.equals(SCHEMA, check_metadata=False):
                raise pa.ArrowInvalid("its columns are not those of a sealed file")
            self.groups = self._spans()
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._damaged(first, last, error) from error

    def group(self, number: int) -> pa.Table:
        """A row group.

        Raises:
            SealedFileDamaged: It cannot be read.
        """
        first, last = self.groups[number]
        try:
            table = self._file.read_row_group(number)
            table.validate(full=True)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._damaged(first, last, error) from error
        if table.num_rows != last - first + 1:
            raise self._damaged(first, last, f"it holds {table.num_rows} segments")
        return table

    def chains(self) -> FileChains:
        """Every chain of the file, followed from the file's own bytes to its end.

        Raises:
            ChainBroken: One does not hold.
        """
        chains = FileChains()
        for number in range(len(self.groups)):
            table = self.group(number)
            previous = table.column("previous_chain_hash").to_pylist()
            segments = segments_of(table, self.groups[number][0], list(range(table.num_rows)), self.path)
            for segment, before in zip(segments, previous, strict=True):
                chains.follow(segment, before)
        return chains

    def _spans(self) -> list[tuple[int, int]]:
        """First and last position of each row group, counted from the file's own first."""
        metadata = self._file.metadata
        spans, at = [], self._range[0]
        for number in range(metadata.num_row_groups):
            rows = metadata.row_group(number).num_rows
            spans.append((at, at + rows - 1))
            at += rows
        if at != self._range[1] + 1:
            raise ValueError(f"it ends at position {at - 1}")
        return spans

    def _damaged(self, first: int, last: int, reason: object) -> SealedFileDamaged:
        return damaged(self.path, first, last, f"cannot be read: {reason}")


def contents_of(file: pa.NativeFile) -> Contents:
    """What a file that is as it was sealed holds, without its payloads."""
    table = pq.read_table(file, columns=[*_LOOKED_UP, "chain_hash"])
    last = pc.subtract(pc.add(table.column("first_sequence"), pc.cast(table.column("event_count"), pa.int64())), 1)
    table = _with_ranges(table.append_column("last_sequence", last))
    wanted = [("first_sequence", "min"), ("last_sequence", "max"), ("position", "min"), ("position", "max")]
    wanted += [("time_min", "min"), ("time_max", "max")]
    # Without threads the last of a group is the last of the table, where a range is in order.
    groups = table.group_by([*_NAMES, "epoch", "range"], use_threads=False).aggregate([*wanted, ("chain_hash", "last")])
    names = [*_NAMES, "epoch", *(f"{name}_{kind}" for name, kind in wanted), "chain_hash_last"]
    rows = zip(*(groups.column(name).to_pylist() for name in names), strict=True)
    position = pc.min_max(table.column("position")).as_py()
    events = pc.sum(table.column("event_count")).as_py()
    span = (pc.min(table.column("time_min")).as_py(), pc.max(table.column("time_max")).as_py())
    ranges = {
        Range((StreamName.of(station, source, type_), epoch), *rest) for station, source, type_, epoch, *rest in rows
    }
    return Contents(ranges, (position["min"], position["max"], table.num_rows, events, *span))


def _with_ranges(table: pa.Table) -> pa.Table:
    """The table in order of stream and sequence, with the number of each row's range.

    A range ends where the next events are not in the file, or the log took them before.
    """
    table = table.sort_by([(name, "ascending") for name in (*_NAMES, "epoch", "first_sequence")])
    first, last, position = (table.column(name).to_numpy() for name in ("first_sequence", "last_sequence", "position"))
    goes_on = (first[1:] == last[:-1] + 1) & (position[1:] > position[:-1])
    return table.append_column("range", pa.array(np.concatenate(([0], np.cumsum(~goes_on)))))


def damaged(path: str, first: int, last: int, reason: str) -> SealedFileDamaged:
    """The error for a range of a sealed file that cannot be had."""
    return SealedFileDamaged(UNKNOWN, first, 0, f"the sealed file {path} {reason}. {_NEXT}", last)


def rows_of(table: pa.Table, first: int, wanted: tuple[int, int], chosen: Filter, stream: Stream | None) -> list[int]:
    """Which rows of a group that begins at position `first` are wanted, in order.

    Args:
        table: The row group.
        first: Its first position.
        wanted: First and last position wanted.
        chosen: What else is wanted of them.
        stream: The only stream wanted, if it is one.
    """
    start, stop = max(0, wanted[0] - first), min(table.num_rows, wanted[1] - first + 1)
    masks = list(_masks(table, chosen, stream))
    if not masks:
        return list(range(start, stop))
    mask = masks[0]
    for each in masks[1:]:
        mask = pc.and_(mask, each)
    return [row for row in pc.indices_nonzero(mask).to_pylist() if start <= row < stop]


def _masks(table: pa.Table, chosen: Filter, stream: Stream | None) -> Iterator[pa.ChunkedArray]:
    for name, wanted in (("type", chosen.types), ("source", chosen.sources), ("station", chosen.stations)):
        if wanted is not None:
            yield pc.is_in(table.column(name), value_set=pa.array(list(wanted), pa.string()))
    if chosen.without:
        names = pc.binary_join_element_wise(*(table.column(name) for name in ("station", "source", "type")), "/")
        yield pc.invert(pc.is_in(names, value_set=pa.array(list(chosen.without), pa.string())))
    if not chosen.with_hollow:
        yield pc.greater(pc.binary_length(table.column("payload")), 0)
    if chosen.since is not None:
        yield pc.greater_equal(table.column("time_max"), pa.scalar(chosen.since, _TIMESTAMP))
    if chosen.until is not None:
        yield pc.less(table.column("time_min"), pa.scalar(chosen.until, _TIMESTAMP))
    if stream is not None:
        (station, source, kind), epoch = (stream[0].station, stream[0].source, stream[0].type), stream[1]
        for column, value in (("station", station), ("source", source), ("type", kind), ("epoch", epoch)):
            yield pc.equal(table.column(column), value)


def segments_of(table: pa.Table, first: int, rows: Sequence[int], path: str) -> Iterator[Segment]:
    """The segments in these rows of a group that begins at position `first`, each checked.

    Raises:
        ChainBroken: One does not hold.
    """
    part = table.select(SCHEMA.names[:6]).take(pa.array(rows, pa.int64()))
    try:
        columns = [column.to_pylist() for column in part.columns]
    except (ValueError, OverflowError) as error:  # a time that Python does not know
        raise damaged(path, first, first + table.num_rows - 1, f"cannot be read: {error}") from error
    for row, values in zip(rows, zip(*columns, strict=True), strict=True):
        yield _segment(first + row, values, path)


def _segment(place: int, values: Sequence[Any], path: str) -> Segment:
    position, recorded_at, header_raw, payload, payload_hash, chain_hash = values
    try:
        header = parse_header(header_raw)
    except EventError as error:
        raise ChainBroken(UNKNOWN, place, 0, f"in the sealed file {path}: {error}. {_NEXT}") from error
    if position != place:
        reason = f"in the sealed file {path} it has the position {position}. {_NEXT}"
        raise ChainBroken(header.stream, place, header.first_sequence, reason)
    found = hashlib.sha256(payload).digest()
    if payload and found != payload_hash:
        reason = (
            f"in the sealed file {path} the payload's hash is {found.hex()}, recorded was {payload_hash.hex()}. {_NEXT}"
        )
        raise ChainBroken(header.stream, place, header.first_sequence, reason)
    return Segment(header, payload, payload_hash, chain_hash, Position(position), recorded_at.astimezone(UTC))
