"""The directory of evidence: segments verbatim, what was signed, events decoded, a manifest, a verifier.

Contract: `export` writes the directory whole or not at all: it grows under another name beside its place. Segments
outside what is wanted come without their payload, as the chain needs only the payload's hash. Nothing in the log is
changed. Layouts: docs/reference/evidence.md.
"""

import hashlib
import json
import platform
import shutil
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import takewhile
from pathlib import Path
from typing import Any

import jinja2
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from events import EventError, Run, Segment, decode, header_bytes, with_envelope
from events.segment import microseconds
from store import Log, SignedCheckpoint, StationKey, key_id
from store.proof import ALGORITHM, head_rows, heads_hash
from store.verification import gaps_in
from vian.errors import WorldFailed, WrongUsage
from vian.evidence import verifier
from vian.evidence.anchors import Anchors, Bracket, ends_of
from vian.evidence.selection import Selection, Wanted
from vian.output import to_json
from vian.version import VERSION

FORMAT = "vian-evidence/1"
SEGMENTS_MAGIC = b"VIANEVI1"
ORDER_MAGIC = b"VIANORD1"
SEAL_MAGIC = b"VIANSEAL1"
_LIBRARIES = ("pyarrow", "zstandard", "pydantic", "cryptography")


@dataclass(frozen=True, slots=True)
class Source:
    """From where, by whom and why evidence is exported."""

    log: Log
    signing: str | None
    """station whose checkpoints cover it; None: nobody's"""
    is_own: bool
    """whether this is that station's own log, so that positions are covered"""
    key: StationKey | None
    exported_by: str
    reason: str
    now: datetime


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export came to."""

    path: Path
    manifest_sha256: str
    files: int
    """files that the manifest lists, as `verify` counts them: beside them stand itself and its seal"""
    bytes: int
    """of all files"""
    events: int
    segments: int
    withheld: int
    """segments without payload"""


def export(source: Source, selection: Selection, path: Path, on_item: Callable[[str], None] | None = None) -> Exported:
    """Write the evidence to a directory that is not there yet.

    Raises:
        WrongUsage: The directory is there.
        WorldFailed: It cannot be written.
    """
    if path.exists():
        raise WrongUsage(f"{path} is there already. Next: give another directory")
    partial = path.with_name(f".{path.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)  # of an export that was interrupted
        partial.mkdir(parents=True)
        exported = _Export(source, selection, partial).write(on_item)
        partial.rename(path)
    except OSError as error:
        raise WorldFailed(f"the evidence cannot be written to {path}: {error}. Next: give another directory") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Exported(path, *exported)


@dataclass(slots=True)
class _Span:
    """First and last frame of what was added."""

    first: int | None = None
    last: int | None = None

    def add(self, table: pa.Table) -> None:
        """Add a table's frames, if it has any."""
        if "frame" in table.column_names and table.num_rows:
            ends = pc.min_max(table.column("frame")).as_py()
            self.first = ends["min"] if self.first is None else min(self.first, ends["min"])
            self.last = ends["max"] if self.last is None else max(self.last, ends["max"])


class _Export:
    """One export at work."""

    def __init__(self, source: Source, selection: Selection, root: Path) -> None:
        self._source = source
        self._selection = selection
        self._root = root
        self._anchors = Anchors.of(source.log, source.signing) if source.signing is not None else None
        self._checkpoints: dict[int, SignedCheckpoint] = {}
        self._orders: dict[str, dict[str, Any]] = {}
        self._counts = {"segments": 0, "withheld": 0, "events": 0}

    def write(self, on_item: Callable[[str], None] | None) -> tuple[str, int, int, int, int, int]:
        items = []
        for wanted in self._selection.wanted:
            if on_item is not None:
                on_item(str(wanted.stream))
            for run in self._source.log.runs(wanted.stream, wanted.epoch):
                if (part := wanted.within(run)) is not None:
                    items.append(self._item(part, run))
            self._selection.missing += self._gaps(wanted)
        if not items:
            raise WorldFailed(f"nothing of what is wanted is in this log: {'; '.join(self._selection.missing)}")
        self._json("checkpoints.json", [self._checkpoint(each) for each in self._chained()])
        shutil.copyfile(verifier.__file__, self._root / "verify.py")
        if self._selection.rule is not None:
            (self._root / "rule.yaml").write_text(self._selection.rule["text"], encoding="utf-8")
        manifest = self._manifest(items)
        self._readme(manifest)
        manifest["files"] = _files(self._root)
        content = (json.dumps(manifest, indent=2, ensure_ascii=False) + "\n").encode()
        (self._root / verifier.MANIFEST).write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        (self._root / verifier.SEAL).write_text(_seal(digest, self._source.key))
        size = sum(each.stat().st_size for each in self._root.rglob("*") if each.is_file())
        counts = self._counts
        return digest, len(manifest["files"]), size, counts["events"], counts["segments"], counts["withheld"]

    def _gaps(self, wanted: Wanted) -> Iterator[str]:
        """What of the wanted events is in a gap of this log, for people."""
        runs = self._source.log.runs(wanted.stream, wanted.epoch)
        for gap in gaps_in({(wanted.stream, wanted.epoch): runs}):
            for first, last in wanted.ranges:
                begin, end = max(first, gap.first), min(last, gap.last)
                if begin <= end:
                    yield f"{wanted.stream} in epoch {wanted.epoch}, sequences {begin} to {end}"

    def _item(self, wanted: Wanted, run: Run) -> dict[str, Any]:
        """Write what is wanted of one run of a stream; what the manifest says of it."""
        name = f"{wanted.stream.station}.{wanted.stream.source}.{wanted.stream.type}.{wanted.epoch}"
        if run.after:
            name = f"{name}.{run.after + 1}"
        inside = [replace(each, payload=b"") for each in self._inside(wanted)]
        if not inside:
            raise WorldFailed(f"{wanted.stream} lacks sequence {wanted.ranges[0][0]}. Next: vian verify --full")
        bracket = Bracket(None, None)
        if self._anchors is not None:
            bracket = self._anchors.around(run, inside, is_own=self._source.is_own)
        used = [each for each in (bracket.start, bracket.end) if each is not None]
        self._checkpoints |= {each.sequence: each for each in used}
        return {
            "stream": str(wanted.stream),
            "epoch": wanted.epoch,
            "why": list(wanted.why),
            "ranges": [list(each) for each in wanted.ranges],
            "base": {"sequence": run.after, "chain_hash": run.after_hash.hex()} if run.after else None,
            "segments": self._segments(wanted, run, bracket, f"segments/{name}.bin"),
            "from_checkpoint": bracket.start.sequence if bracket.start else None,
            "to_checkpoint": bracket.end.sequence if bracket.end else None,
            "order": self._order(bracket),
            "positions": [inside[0].position, inside[-1].position],
            "recorded_at": [inside[0].recorded_at.isoformat(), inside[-1].recorded_at.isoformat()],
            "producers": _producers(inside),
            **self._decoded(wanted, f"events/{name}"),
        }

    def _inside(self, wanted: Wanted) -> Iterator[Segment]:
        """The segments that hold what is wanted."""
        last = wanted.ranges[-1][1]
        segments = self._source.log.read(wanted.stream, wanted.ranges[0][0], epoch=wanted.epoch, with_hollow=True)
        for segment in takewhile(lambda each: each.header.first_sequence <= last, segments):
            if _is_wanted(segment, wanted):
                _check_whole(segment)
                yield segment

    def _segments(self, wanted: Wanted, run: Run, bracket: Bracket, path: str) -> str:
        """Write the chain from the checkpoint before, or the begin of the run, to the checkpoint behind."""
        last = wanted.ranges[-1][1]
        first = 1 + max(_signed(bracket.start, wanted, run), default=run.after)
        last = min((each for each in _signed(bracket.end, wanted, run) if each >= last), default=last)
        with self._open(path) as file:
            file.write(SEGMENTS_MAGIC)
            for segment in self._source.log.read(wanted.stream, first, epoch=wanted.epoch, with_hollow=True):
                if segment.header.first_sequence > last:
                    break
                is_whole = _is_wanted(segment, wanted)
                file.write(_segment_bytes(segment, is_whole))
                self._counts["segments" if is_whole else "withheld"] += 1
        return path

    def _order(self, bracket: Bracket) -> str | None:
        """Write in which order and when all was recorded between two checkpoints; None where nobody signed it."""
        if bracket.end is None or not self._source.is_own:
            return None
        first = bracket.start.statement.position + 1 if bracket.start else 1
        last = bracket.end.statement.position
        path = f"order/{first}-{last}.bin"
        if path not in self._orders:
            with self._open(path) as file:
                file.write(ORDER_MAGIC + struct.pack(">Q", first))
                for segment in self._source.log.read_all(first, to_position=last, with_hollow=True):
                    file.write(struct.pack(">q", microseconds(segment.recorded_at)) + segment.chain_hash)
            self._orders[path] = {
                "first_position": first,
                "last_position": last,
                "from_checkpoint": bracket.start.sequence if bracket.start else None,
                "to_checkpoint": bracket.end.sequence,
            }
        return path

    def _decoded(self, wanted: Wanted, name: str) -> dict[str, Any]:
        """Write the events as Parquet and JSON; what the manifest says of them."""
        paths = [f"{name}.parquet", f"{name}.json"]
        count, frames, writer = 0, _Span(), None
        try:
            with self._open(paths[0]) as columns, self._open(paths[1]) as rows:
                for segment in self._inside(wanted):
                    table = _table(segment, wanted, self._source.log)
                    writer = writer or pq.ParquetWriter(columns, table.schema, compression="zstd")
                    writer.write_table(table)
                    rows.write(_json_rows(table, is_first=count == 0))
                    frames.add(table)
                    count += table.num_rows
                rows.write(b"\n]\n")
                if writer is not None:
                    writer.close()
        except EventError as error:
            for path in paths:
                (self._root / path).unlink()
            return {"events": None, "not_decoded": str(error)}
        self._counts["events"] += count
        said: dict[str, Any] = {"events": {"count": count, "files": paths}}
        return said | ({"frames": [frames.first, frames.last]} if frames.first is not None else {})

    def _chained(self) -> list[SignedCheckpoint]:
        """The checkpoints used, and all between them, so that each follows the one before."""
        if not self._checkpoints or self._anchors is None:
            return []
        return [self._anchors.at(number) for number in range(min(self._checkpoints), max(self._checkpoints) + 1)]

    def _checkpoint(self, signed: SignedCheckpoint) -> dict[str, Any]:
        statement = signed.statement
        return {
            "sequence": signed.sequence,
            "station": statement.station,
            "epoch": statement.epoch,
            "position": statement.position,
            "time": statement.time.isoformat(),
            "time_us": microseconds(statement.time),
            "order_hash": statement.order_hash.hex(),
            "heads_hash": heads_hash(statement.heads).hex(),
            "previous": statement.previous.hex(),
            "public_key": statement.public_key.hex(),
            "key_id": key_id(statement.public_key),
            "successor": statement.successor.hex(),
            "algorithm": ALGORITHM,
            "signature": signed.signature.hex(),
            "heads": head_rows(statement.heads) if signed.sequence in self._checkpoints else None,
        }

    def _manifest(self, items: list[dict[str, Any]]) -> dict[str, Any]:
        source, selection = self._source, self._selection
        keys = {each.statement.public_key for each in self._chained()}
        keys |= {source.key.public} if source.key is not None else set()
        return {
            "format": FORMAT,
            "exported_at": source.now.astimezone(UTC).isoformat(),
            "exported_by": source.exported_by,
            "reason": source.reason,
            "versions": {"vian": VERSION, "python": platform.python_version(), **{n: version(n) for n in _LIBRARIES}},
            "log": {"epoch": source.log.epoch, "position": source.log.head(), "signed_by": source.signing},
            "question": selection.question,
            "situation": selection.situation,
            "rule": selection.rule,
            "videos": selection.videos,
            "missing": selection.missing,
            "keys": {key_id(each): each.hex() for each in sorted(keys)},
            "orders": self._orders,
            "items": items,
        }

    def _readme(self, manifest: Mapping[str, Any]) -> None:
        environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        template = environment.from_string((Path(__file__).parent / "README.md.j2").read_text(encoding="utf-8"))
        (self._root / "README.md").write_text(template.render(manifest), encoding="utf-8")

    def _json(self, path: str, value: Any) -> None:
        with self._open(path) as file:
            file.write((json.dumps(value, indent=1) + "\n").encode())

    def _open(self, path: str) -> Any:
        whole = self._root / path
        whole.parent.mkdir(exist_ok=True)
        return whole.open("wb")


def _is_wanted(segment: Segment, wanted: Wanted) -> bool:
    first, last = segment.header.first_sequence, segment.header.last_sequence
    return any(begin <= last and first <= end for begin, end in wanted.ranges)


def _check_whole(segment: Segment) -> None:
    """Nothing, if the events of the segment are here."""
    if not segment.has_payload:
        header = segment.header
        raise WorldFailed(
            f"events {header.first_sequence} to {header.last_sequence} of {segment.stream} have left this disk, pruned "
            "or given up; evidence is exported with all its events or not at all. Next: vian sync repair, which has "
            "them back if central holds them, or vian evidence export there"
        )


def _signed(checkpoint: SignedCheckpoint | None, wanted: Wanted, run: Run) -> list[int]:
    """The sequences of a run that a checkpoint signed."""
    return [] if checkpoint is None else ends_of(checkpoint.statement, wanted.stream, wanted.epoch, run)


def _segment_bytes(segment: Segment, is_whole: bool) -> bytes:
    header = header_bytes(segment.header)
    payload = struct.pack(">I", len(segment.payload)) + segment.payload if is_whole else b""
    return b"".join(
        (
            struct.pack(">BI", is_whole, len(header)),
            header,
            segment.payload_hash,
            payload,
            segment.chain_hash,
            struct.pack(">Qq", segment.position, microseconds(segment.recorded_at)),
        )
    )


def _table(segment: Segment, wanted: Wanted, log: Log) -> pa.Table:
    """The wanted events of a segment, with the envelope's columns in front."""
    header = segment.header
    batch = decode(segment, log.catalogue)
    data = with_envelope(header.stream, header.first_sequence, batch)
    count = data.num_rows
    fields = {field.name: field for field in batch.data.schema}
    schema = pa.schema([fields.get(field.name, field) for field in data.schema])
    table = pa.table(data.columns, schema=schema)
    table = table.add_column(5, "position", pa.repeat(pa.scalar(segment.position, pa.int64()), count))
    recorded_at = pa.scalar(segment.recorded_at, pa.timestamp("us", tz="UTC"))
    table = table.add_column(6, "recorded_at", pa.repeat(recorded_at, count))
    sequences = table.column("sequence")
    masks = [pc.and_(pc.greater_equal(sequences, a), pc.less_equal(sequences, b)) for a, b in wanted.ranges]
    mask = masks[0]
    for each in masks[1:]:
        mask = pc.or_(mask, each)
    return table.filter(mask)


def _json_rows(table: pa.Table, *, is_first: bool) -> bytes:
    """The rows as members of a JSON array, one a line, that goes on or begins here."""
    return ("[\n" if is_first else ",\n").encode() + ",\n".join(map(to_json, table.to_pylist())).encode()


def _producers(segments: list[Segment]) -> list[dict[str, str]]:
    """Who said the segments: name, version, configuration."""
    seen = {each.header.producer: None for each in segments}
    return [
        {"name": each.name, "version": each.version, "configuration_sha256": each.configuration_hash.hex()}
        for each in seen
    ]


def _files(root: Path) -> dict[str, dict[str, Any]]:
    """SHA-256 and size of every file by path."""
    found = {}
    for path in sorted(root.rglob("*")):
        if path.is_file():
            digest, size = verifier.sha256_of(path)
            found[path.relative_to(root).as_posix()] = {"sha256": digest, "bytes": size}
    return found


def _seal(manifest_sha256: str, key: StationKey | None) -> str:
    """The text of the seal: the manifest's hash, signed where there is a key, and a hash over the seal itself."""
    signature = key.sign(SEAL_MAGIC + bytes.fromhex(manifest_sha256)).hex() if key is not None else "-"
    public = key.public.hex() if key is not None else "-"
    values = dict(zip(verifier.SEAL_LINES, (manifest_sha256, public, signature), strict=True))
    body = "".join(f"{line}\n" for line in [verifier.SEAL_HEAD, *(f"{name} {value}" for name, value in values.items())])
    return f"{body}seal sha256 {hashlib.sha256(body.encode()).hexdigest()}\n"
