"""What a backup looks like on disk: a folder with a manifest, segments verbatim, checkpoints.

Contract: a file is written under another name, flushed to the disk and then renamed, so what bears
its name is whole; the manifest names every file with its size and SHA-256, and comes last. Files
are Arrow IPC, so that any Arrow reader opens them. The layout is in docs/operations.md.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Self

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, ValidationError

from events import GENESIS, Base, CorruptSegment, Place, Position, Run, Segment, StreamName
from events.segment import header_bytes, parse_header
from store.errors import BackupDamaged

MANIFEST = "manifest.json"
UNFINISHED = "manifest.unfinished.json"
RESTORES = "restores.jsonl"
FILE_BYTES = 64 * 2**20
"""A file of segments is closed when it holds so many bytes of payload, or `FILE_SEGMENTS`."""
FILE_SEGMENTS = 50_000
_BATCH_BYTES = 8 * 2**20
_BATCH_SEGMENTS = 1_000

_SEGMENTS = pa.schema(
    [
        pa.field("position", pa.int64(), nullable=False),
        pa.field("recorded_at", pa.timestamp("us", tz="UTC"), nullable=False),
        pa.field("header", pa.binary(), nullable=False),
        pa.field("payload", pa.binary(), nullable=False),
        pa.field("payload_hash", pa.binary(32), nullable=False),
        pa.field("chain_hash", pa.binary(32), nullable=False),
    ]
)
_CHECKPOINTS = pa.schema(
    [
        pa.field("name", pa.string(), nullable=False),
        pa.field("position", pa.int64(), nullable=False),
        pa.field("state", pa.binary(), nullable=False),
    ]
)


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class File(_Frozen):
    """One file of the backup."""

    name: str
    bytes: int
    sha256: str


class SegmentFile(File):
    """A file of segments with consecutive positions."""

    first_position: int
    last_position: int


class Head(_Frozen):
    """What there is of one stream at the backup's position: a run; a stream with gaps has several."""

    stream: str
    epoch: int
    sequence: int
    chain_hash: str
    after: int = 0
    """the run begins behind this sequence"""
    after_hash: str = GENESIS.hex()

    @property
    def key(self) -> Place:
        """Which stream in which epoch."""
        return StreamName.parse(self.stream), self.epoch

    @property
    def run(self) -> Run:
        """The run."""
        hashes = bytes.fromhex(self.after_hash), bytes.fromhex(self.chain_hash)
        return Run(self.after, hashes[0], self.sequence, hashes[1])

    @classmethod
    def of(cls, place: Place, run: Run) -> Self:
        """The run as the manifest says it."""
        return cls(
            stream=str(place[0]),
            epoch=place[1],
            sequence=run.sequence,
            chain_hash=run.chain_hash.hex(),
            after=run.after,
            after_hash=run.after_hash.hex(),
        )


class BegunBehind(_Frozen):
    """A base: where a run began without what comes before it."""

    stream: str
    epoch: int
    sequence: int
    chain_hash: str
    position: int

    @property
    def base(self) -> Base:
        """The base."""
        name, chain_hash = StreamName.parse(self.stream), bytes.fromhex(self.chain_hash)
        return Base(name, self.epoch, self.sequence, chain_hash, self.position)

    @classmethod
    def of(cls, base: Base) -> Self:
        """The base as the manifest says it."""
        return cls(
            stream=str(base.stream),
            epoch=base.epoch,
            sequence=base.sequence,
            chain_hash=base.chain_hash.hex(),
            position=base.position,
        )


class Manifest(_Frozen):
    """What the backup holds."""

    format: Literal[1] = 1
    made_at: datetime
    epoch: int
    """epoch of the log that was backed up"""
    position: int
    events: int
    last_chain_hash: str
    """chain hash of the segment at `position`: by it a log is known again"""
    recorded_at: datetime
    """newest recorded_at"""
    segments: tuple[SegmentFile, ...]
    checkpoints: File | None
    streams: tuple[Head, ...]
    """the runs of all streams"""
    bases: tuple[BegunBehind, ...] = ()
    """where runs began, in order of position"""

    @property
    def runs(self) -> dict[Place, list[Run]]:
        """The runs of each stream, ascending."""
        runs: dict[Place, list[Run]] = {}
        for head in self.streams:
            runs.setdefault(head.key, []).append(head.run)
        return runs

    @property
    def bytes(self) -> int:
        """Size of all files."""
        return sum(file.bytes for file in (*self.segments, *([self.checkpoints] if self.checkpoints else [])))


class Restored(_Frozen):
    """One line of what was restored from the backup, and whether it was read back and verified."""

    at: datetime
    position: int
    epoch: int
    verified: bool


def read_manifest(folder: Path, name: str = MANIFEST) -> Manifest | None:
    """The folder's manifest; None where there is none.

    Raises:
        BackupDamaged: It cannot be read.
    """
    path = folder / name
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (ValidationError, OSError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.strerror
        raise BackupDamaged(f"{path} is no manifest of a backup: {reason}. Next: restore from another copy") from error


def write_manifest(folder: Path, manifest: Manifest, name: str = MANIFEST) -> None:
    """Put the manifest in its place, all or nothing."""
    _write_whole(folder / name, (manifest.model_dump_json(indent=1) + "\n").encode())


def write_segments(folder: Path, segments: Iterator[Segment]) -> tuple[SegmentFile, int] | None:
    """The next file of segments, and how many events it holds; None when there are no segments left."""
    first = next(segments, None)
    if first is None:
        return None
    part = folder / "segments.part"
    last, events = first, 0
    with pa.OSFile(str(part), "wb") as sink, pa.ipc.new_file(sink, _SEGMENTS) as writer:
        for batch in _batched(first, segments):
            writer.write_batch(_rows(batch))
            last, events = batch[-1], events + sum(segment.header.event_count for segment in batch)
    name = f"segments-{first.position:012}-{last.position:012}.arrow"
    file = _finish(part, name)
    return SegmentFile(**file.model_dump(), first_position=first.position, last_position=last.position), events


def write_checkpoints(folder: Path, position: int, rows: Iterable[tuple[str, int, bytes]]) -> File:
    """The file of the subscribers' checkpoints as they stood at the backup's position."""
    part = folder / "checkpoints.part"
    names, positions, states = (list(column) for column in zip(*rows, strict=True)) if rows else ([], [], [])
    table = pa.table({"name": names, "position": positions, "state": states}, schema=_CHECKPOINTS)
    with pa.OSFile(str(part), "wb") as sink, pa.ipc.new_file(sink, _CHECKPOINTS) as writer:
        writer.write_table(table)
    return _finish(part, f"checkpoints-{position:012}.arrow")


def read_segments(folder: Path, file: SegmentFile) -> Iterator[Segment]:
    """The segments of a file, once its hash was found to be right.

    Raises:
        BackupDamaged: The file is missing, or not what the manifest says.
    """
    with _opened(folder, file) as reader:
        for index in range(reader.num_record_batches):
            for row in reader.get_batch(index).to_pylist():
                yield _segment(row, file)


def read_checkpoints(folder: Path, file: File) -> list[tuple[str, int, bytes]]:
    """The checkpoints of a file, once its hash was found to be right.

    Raises:
        BackupDamaged: The file is missing, or not what the manifest says.
    """
    with _opened(folder, file) as reader:
        return [(row["name"], row["position"], row["state"]) for row in reader.read_all().to_pylist()]


def restores(folder: Path) -> list[Restored]:
    """What was restored from the backup, oldest first; a torn last line is left out.

    Raises:
        BackupDamaged: It cannot be read.
    """
    found = []
    try:
        lines = (folder / RESTORES).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise BackupDamaged(f"{folder / RESTORES} cannot be read: {error}") from error
    for line in lines:
        try:
            found.append(Restored.model_validate_json(line))
        except ValidationError:
            continue
    return found


def note_restore(folder: Path, restored: Restored) -> None:
    """Add a line to what was restored from the backup.

    Raises:
        OSError: The folder cannot be written.
    """
    with (folder / RESTORES).open("a") as file:
        file.write(restored.model_dump_json() + "\n")


def remove_strays(folder: Path, known: Iterable[File]) -> None:
    """Take away what an interrupted backup left, and checkpoints that newer ones replace."""
    names = {file.name for file in known}
    for pattern in ("segments*", "checkpoints*", "*.part"):
        for path in folder.glob(pattern):
            if path.name not in names:
                path.unlink()


def has_file(folder: Path, file: File) -> bool:
    """Whether a file of that size is there; its bytes are looked at when they are read."""
    path = folder / file.name
    return path.is_file() and path.stat().st_size == file.bytes


def _batched(first: Segment, segments: Iterator[Segment]) -> Iterator[list[Segment]]:
    """Segments for one file, in batches of bounded size."""
    batch, size, total, count = [first], len(first.payload), len(first.payload), 1
    while total < FILE_BYTES and count < FILE_SEGMENTS and (segment := next(segments, None)) is not None:
        if size >= _BATCH_BYTES or len(batch) == _BATCH_SEGMENTS:
            yield batch
            batch, size = [], 0
        batch.append(segment)
        size += len(segment.payload)
        total += len(segment.payload)
        count += 1
    yield batch


def _rows(segments: list[Segment]) -> pa.RecordBatch:
    columns = {
        "position": [segment.position for segment in segments],
        "recorded_at": [segment.recorded_at for segment in segments],
        "header": [header_bytes(segment.header) for segment in segments],
        "payload": [segment.payload for segment in segments],
        "payload_hash": [segment.payload_hash for segment in segments],
        "chain_hash": [segment.chain_hash for segment in segments],
    }
    return pa.RecordBatch.from_pydict(columns, schema=_SEGMENTS)


def _segment(row: dict[str, Any], file: File) -> Segment:
    try:
        header = parse_header(row["header"])
    except CorruptSegment as error:
        raise BackupDamaged(f"{file.name}: position {row['position']}: {error}") from error
    return Segment(
        header,
        row["payload"],
        row["payload_hash"],
        row["chain_hash"],
        Position(row["position"]),
        row["recorded_at"].astimezone(UTC),
    )


def _opened(folder: Path, file: File) -> pa.RecordBatchFileReader:
    path = folder / file.name
    try:
        digest, size = _digest(path)
        if (size, digest) != (file.bytes, file.sha256):
            raise BackupDamaged(
                f"{path} is damaged: SHA-256 {digest} of {size} bytes, wanted {file.sha256} of {file.bytes}. "
                "Next: restore from another copy"
            )
        return pa.ipc.open_file(pa.memory_map(str(path)))
    except (OSError, pa.ArrowInvalid) as error:
        raise BackupDamaged(f"{path} cannot be read: {error}. Next: restore from another copy") from error


def _finish(part: Path, name: str) -> File:
    """Give a file that is complete its name."""
    _flush(part)
    digest, size = _digest(part)
    part.replace(part.with_name(name))
    _flush(part.parent)
    return File(name=name, bytes=size, sha256=digest)


def _write_whole(path: Path, content: bytes) -> None:
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    _flush(part)
    part.replace(path)
    _flush(path.parent)


def _digest(path: Path) -> tuple[str, int]:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest(), os.fstat(file.fileno()).st_size


def _flush(path: Path) -> None:
    """Bring a file or a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
