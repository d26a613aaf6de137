"""The log's cold tier: segments in sealed files, found through the index in PostgreSQL.

Contract: answers the same questions as the table of segments does, with the same segments, for positions up to the
sealed one. Which position that is, the caller knows from a query of its own, so that nothing falls between the tiers
while a range moves from one to the other.
"""

import copy
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import pyarrow as pa

from events import Segment, StreamName
from store.errors import UNKNOWN, ChainBroken, SealedFileDamaged
from store.places import Place
from store.reading import DERIVE, Filter
from store.sealed import (
    End,
    Range,
    SealedFile,
    SealedReader,
    Stream,
    contents_of,
    damaged,
    rows_of,
    segments_of,
)

Rows = Callable[[str, Mapping[str, Any]], list[tuple[Any, ...]]]

GROUPS_KEPT = 4
"""Row groups kept in memory: one for each of the readers that a server has."""
FILES_KEPT = 16
FILES_AT_A_TIME = 16
"""Files looked up in the index at a time."""
_ANY = Filter(with_hollow=True)
_EVERYWHERE = (1, 2**63 - 1)

_FILE_COLUMNS = (
    "f.path, f.first_position, f.last_position, f.sha256, f.bytes, f.segments, f.events, f.time_min, f.time_max, "
    "f.sealed_at"
)


@dataclass(frozen=True, slots=True)
class ArchiveHead:
    """Where the archive is, and how far the log is sealed."""

    location: str
    sealed_position: int
    pending_path: str | None
    """A file that a sealing is writing, or was writing when it was killed."""


class ColdTier:
    """Reads the sealed files of one log."""

    def __init__(self, rows: Rows, data_dir: Path | None) -> None:
        self._rows = rows
        self._data_dir = data_dir
        self._place: Place | None = None
        self._lock = threading.Lock()
        self._files: OrderedDict[str, SealedReader] = OrderedDict()
        self._groups: OrderedDict[tuple[str, int], pa.Table] = OrderedDict()

    def through(self, rows: Rows) -> Self:
        """The same, asking its index through other means; what is kept in memory is shared."""
        other = copy.copy(self)
        other._rows = rows
        return other

    def head(self) -> ArchiveHead:
        """Where the archive is, and how far the log is sealed."""
        (row,) = self._rows("select location, sealed_position, pending_path from archive_head", {})
        return ArchiveHead(*row)

    def sealed_position(self) -> int:
        """The position up to which all segments are in sealed files, and in no other place."""
        return self.head().sealed_position

    def place(self) -> Place:
        """Where the sealed files lie now."""
        location = self.head().location
        if self._place is None or self._place.location != location:
            self._place = Place(location, self._data_dir)
        return self._place

    def files(
        self, first: int = 1, last: int = _EVERYWHERE[1], chosen: Filter = _ANY, limit: int | None = None
    ) -> list[SealedFile]:
        """The files, at most `limit`, that may hold wanted segments between two positions, in order."""
        return [
            SealedFile(*row)
            for row in self._rows(
                f"select {_FILE_COLUMNS} from sealed_files f where f.last_position >= %(first)s "
                "and f.first_position <= %(last)s and exists (select from sealed_ranges r join streams s "
                "on s.id = r.stream_id where r.file = f.first_position "
                "and (%(types)s::text[] is null or s.type = any(%(types)s::text[])) "
                "and (%(sources)s::text[] is null or s.source = any(%(sources)s::text[])) "
                "and (%(stations)s::text[] is null or s.station = any(%(stations)s::text[])) "
                "and (%(since)s::timestamptz is null or r.time_max >= %(since)s::timestamptz) "
                "and (%(until)s::timestamptz is null or r.time_min < %(until)s::timestamptz)) "
                "order by f.first_position limit %(limit)s",
                {
                    "first": first,
                    "last": last,
                    "types": _list(chosen.types),
                    "sources": _list(chosen.sources),
                    "stations": _list(chosen.stations),
                    "since": chosen.since,
                    "until": chosen.until,
                    "limit": limit,
                },
            )
        ]

    def page(self, first: int, last: int, chosen: Filter, limit: int) -> list[Segment]:
        """At most `limit` segments between two positions that the filter lets through, in order.

        Raises:
            ChainBroken: One does not hold, or a file cannot be read there.
            ArchiveUnavailable: The archive cannot be reached.
        """
        found: list[Segment] = []
        if chosen.passes_over_derived:
            chosen = replace(chosen, without=self._derived())
        while files := self.files(first, last, chosen, FILES_AT_A_TIME):
            for file in files:
                for segment in self._segments(file, (first, last), chosen, None):
                    found.append(segment)
                    if len(found) == limit:
                        return found
            first = files[-1].last_position + 1
        return found

    def _derived(self) -> list[str]:
        """The streams that this log derives from others."""
        rows = self._rows("select name from checkpoints where starts_with(name, %(begin)s)", {"begin": DERIVE})
        return [str(name).removeprefix(DERIVE) for (name,) in rows]

    def changed_files(self, files: Iterable[SealedFile], digested: int = 0) -> Iterator[SealedFileDamaged]:
        """What is wrong with each file that is not, to the byte, the one that was sealed, or is not as the index says.

        This covers what no chain does: the file's own structure, the columns for looking up, `recorded_at`, the index.

        Args:
            files: The files.
            digested: Files up to this position are only looked at, whether they are there in their size.

        Raises:
            ArchiveUnavailable: The archive cannot be reached.
        """
        for file in files:
            place = self.place()
            path = place.full(file.path)
            if file.last_position <= digested:
                strange = self._misplaced(file)
                if strange is not None and self._in_its_place(file) is None:
                    yield damaged(path, file.first_position, file.last_position, strange)
                continue
            try:
                sha256, size = place.digest(file.path)
            except FileNotFoundError:
                if self._in_its_place(file) is not None:
                    continue  # written anew meanwhile, which compared it
                yield damaged(path, file.first_position, file.last_position, "is not there")
                continue
            if (sha256, size) != (file.sha256, file.bytes):
                reason = f"has changed: its SHA-256 is {sha256.hex()}, sealed was {file.sha256.hex()}"
                yield damaged(path, file.first_position, file.last_position, reason)
            elif (strange := self._misindexed(file)) is not None:
                yield SealedFileDamaged(UNKNOWN, file.first_position, 0, strange, file.last_position)

    def _misplaced(self, file: SealedFile) -> str | None:
        """What is seen to be wrong with a file without reading it; None where nothing is."""
        size = self.place().size(file.path)
        if size is None:
            self.place().require()
            return "is not there"
        return None if size == file.bytes else f"has changed: it has {size} bytes, sealed was {file.bytes}"

    def _misindexed(self, file: SealedFile) -> str | None:
        """How the index differs from a file that is as it was sealed; None where it does not."""
        place = self.place()
        with place.open(file.path) as source:
            held = contents_of(source)
        indexed = {
            Range((StreamName.of(station, source, type_), epoch), *rest)
            for station, source, type_, epoch, *rest in self._rows(
                "select s.station, s.source, s.type, s.epoch, r.first_sequence, r.last_sequence, r.first_position, "
                "r.last_position, r.time_min, r.time_max, r.chain_hash from sealed_ranges r "
                "join streams s on s.id = r.stream_id where r.file = %(file)s",
                {"file": file.first_position},
            )
        }
        first, last = file.first_position, file.last_position
        totals = (first, last, file.segments, file.events, file.time_min, file.time_max)
        if (indexed, totals) == (held.ranges, held.totals):
            return None
        streams = sorted({str(each.stream[0]) for each in indexed ^ held.ranges}) or ["its totals"]
        return (
            f"the index says otherwise of the sealed file {place.full(file.path)} than it holds: {', '.join(streams)}. "
            "Next: keep this database as it is, and restore it from a backup"
        )

    def of_file(self, file: SealedFile) -> Iterator[Segment]:
        """All segments of a file, in order.

        Raises:
            ChainBroken: One does not hold, or the file cannot be read there.
            ArchiveUnavailable: The archive cannot be reached.
        """
        return self._segments(file, _EVERYWHERE, _ANY, None)

    def of_stream(
        self, stream: Stream, stream_id: int, from_sequence: int, to_sequence: int, chosen: Filter = _ANY
    ) -> Iterator[Segment]:
        """The stream's sealed segments that hold `from_sequence` or a later event, in order.

        Args:
            stream: The stream.
            stream_id: Its id in this log.
            from_sequence: The first event wanted.
            to_sequence: The last event wanted; the last segment may end behind it.
            chosen: What else is wanted of them.

        Raises:
            ChainBroken: One does not hold, or a file cannot be read there.
            ArchiveUnavailable: The archive cannot be reached.
        """
        at = from_sequence
        while rows := self._rows(
            f"select r.first_position, r.last_position, r.first_sequence, r.last_sequence, {_FILE_COLUMNS} "
            "from sealed_ranges r join sealed_files f on f.first_position = r.file "
            "where r.stream_id = %(stream)s and r.first_sequence <= %(to)s and r.last_sequence >= %(at)s "
            # The range that holds the first event wanted, if one does, is the last that begins no later.
            "and r.first_sequence >= coalesce((select max(b.first_sequence) from sealed_ranges b "
            "where b.stream_id = %(stream)s and b.first_sequence <= %(at)s), 0) "
            "order by r.first_sequence limit %(limit)s",
            {"stream": stream_id, "at": at, "to": to_sequence, "limit": FILES_AT_A_TIME},
        ):
            for first, last, first_sequence, last_sequence, *file in rows:
                for segment in self._segments(SealedFile(*file), (first, last), chosen, stream):
                    begin, end = segment.header.first_sequence, segment.header.last_sequence
                    # Between the positions of a range others of the same stream may lie.
                    is_of_range = first_sequence <= begin and end <= last_sequence
                    if is_of_range and begin <= to_sequence and end >= from_sequence:
                        yield segment
            at = rows[-1][3] + 1

    def end_at(self, stream: Stream, at_position: int) -> End | None:
        """Where the stream stood when the log was at a sealed position; None if it was not there yet.

        Raises:
            ChainBroken: One of its segments does not hold, or its file cannot be read.
            ArchiveUnavailable: The archive cannot be reached.
        """
        rows = self._rows(
            "select r.first_position, r.last_position, r.first_sequence, r.last_sequence, r.chain_hash, "
            f"{_FILE_COLUMNS} from sealed_ranges r join sealed_files f on f.first_position = r.file "
            "join streams s on s.id = r.stream_id where s.station = %(station)s and s.source = %(source)s "
            "and s.type = %(type)s and s.epoch = %(epoch)s and r.first_position <= %(at)s "
            "order by r.first_sequence desc limit 1",
            {**_names(stream), "at": at_position},
        )
        if not rows:
            return None
        first, last, first_sequence, last_sequence, chain_hash, *file = rows[0]
        if last <= at_position:
            return End(last_sequence, chain_hash)
        segments = self._segments(SealedFile(*file), (first, at_position), _ANY, stream)
        is_of_range = (each for each in segments if first_sequence <= each.header.first_sequence <= last_sequence)
        newest = deque(is_of_range, maxlen=1)
        if not newest:
            raise ChainBroken(stream[0], first, 0, f"the sealed file {file[0]} does not hold it, which the index says")
        return End(newest[0].header.last_sequence, newest[0].chain_hash)

    def holding(self, stream: Stream, sequence: int) -> tuple[int, Segment | None]:
        """Where a stream stands, and its sealed segment that holds an event; None if that is not sealed.

        Raises:
            ChainBroken: The segment does not hold, or its file cannot be read.
            ArchiveUnavailable: The archive cannot be reached.
        """
        ((stream_id, head),) = self._rows(
            "select id, sequence from streams where station = %(station)s and source = %(source)s and type = %(type)s "
            "and epoch = %(epoch)s",
            _names(stream),
        )
        return head, next(self.of_stream(stream, stream_id, sequence, sequence), None)

    def _segments(
        self, file: SealedFile, wanted: tuple[int, int], chosen: Filter, stream: Stream | None
    ) -> Iterator[Segment]:
        """The wanted segments of a file, in order."""
        first, last = max(wanted[0], file.first_position), min(wanted[1], file.last_position)
        reader = self._reader(file, first)
        for number, (start, stop) in enumerate(reader.groups):
            if stop < first or start > last:
                continue
            table = self._group(reader, file, number, max(start, first))
            rows = rows_of(table, start, (first, last), chosen, stream)
            yield from segments_of(table, start, rows, reader.path)

    def _group(self, reader: SealedReader, file: SealedFile, number: int, first: int) -> pa.Table:
        key = (file.path, number)
        with self._lock:
            if key not in self._groups:
                try:
                    self._groups[key] = reader.group(number)
                except SealedFileDamaged as broken:
                    self._files.pop(file.path, None)  # it may be brought back meanwhile
                    raise _from(first, broken) from broken
            self._groups.move_to_end(key)
            table = self._groups[key]
            while len(self._groups) > GROUPS_KEPT:
                self._groups.popitem(last=False)
            return table

    def _reader(self, file: SealedFile, first: int) -> SealedReader:
        with self._lock:
            if file.path not in self._files:
                self._files[file.path] = self._opened(file, first)
            self._files.move_to_end(file.path)
            reader = self._files[file.path]
            while len(self._files) > FILES_KEPT:
                self._files.popitem(last=False)
            return reader

    def _opened(self, file: SealedFile, first: int) -> SealedReader:
        place = self.place()
        path = place.full(file.path)
        try:
            source = place.open(file.path)
        except FileNotFoundError as error:
            if (newer := self._in_its_place(file)) is not None:
                return self._opened(newer, first)
            raise damaged(path, first, file.last_position, "is not there") from error
        try:
            return SealedReader(source, path, file.first_position, file.last_position)
        except SealedFileDamaged as broken:
            raise _from(first, broken) from broken

    def _in_its_place(self, file: SealedFile) -> SealedFile | None:
        """The file that has taken a file's place since the index was asked; None where none has."""
        rows = self._rows(
            f"select {_FILE_COLUMNS} from sealed_files f where f.first_position = %(first)s and f.path <> %(path)s",
            {"first": file.first_position, "path": file.path},
        )
        return SealedFile(*rows[0]) if rows else None


def _from(first: int, broken: SealedFileDamaged) -> SealedFileDamaged:
    """The damage as it meets a reader who wants positions from `first` on."""
    return SealedFileDamaged(broken.stream, first, 0, broken.reason, broken.last_position)


def _names(stream: Stream) -> dict[str, Any]:
    name, epoch = stream
    return {"station": name.station, "source": name.source, "type": name.type, "epoch": epoch}


def _list(values: Any) -> list[str] | None:
    return None if values is None else list(values)
