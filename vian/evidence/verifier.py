"""Verify a directory of evidence that ViAn exported. Python 3.9 or newer, nothing else.

    python3 verify.py [DIRECTORY] [--manifest SHA256] [--key KEY_ID]

Checks that every file is there and unchanged, that every chain of segments holds, that each signed checkpoint
says what the chains and the order of recording say, and, where the package `cryptography` is installed, that
the signatures are those of the keys named. `--manifest` and `--key` give what was noted at the export or
published by the station; without them the directory is only compared with itself.

Exit codes: 0 all holds, signed throughout; 1 something was changed, is missing or was added: it is named;
2 wrong usage; 3 all holds, but the signatures could not be checked without `cryptography`; 4 all holds as far as
the directory itself can tell, but not everything in it is signed.

The layouts are those of docs/reference/proof.md, evidence.md and segment.md of ViAn; README.md beside this file
says what is proven and what is not.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

try:
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
except ImportError:
    Ed25519PublicKey = None  # type: ignore[assignment,misc]  # not installed: asked for before use

Said = dict[str, Any]
Order = dict[int, tuple[int, bytes]]

SOUND, USAGE, UNCHECKED, UNSIGNED = 0, 2, 3, 4
SEAL, MANIFEST, CHECKPOINTS = "seal.txt", "manifest.json", "checkpoints.json"
SEAL_HEAD = "VIAN EVIDENCE SEAL 1"
SEAL_LINES = ("manifest sha256", "public key", "signature")
ZEROS = bytes(32)


class Bad(Exception):
    """What is wrong with which file."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason


class Report:
    """What was found so far, told as it is found."""

    def __init__(self, tell: Callable[[str], object]) -> None:
        self.tell = tell
        self.bad: list[tuple[str, str]] = []
        self.unchecked: list[str] = []
        self.unsigned: list[str] = []

    def ok(self, text: str) -> None:
        """Tell what holds."""
        self.tell(f"ok        {text}")

    def fault(self, path: str, reason: str) -> None:
        """Tell and keep what does not."""
        self.bad.append((path, reason))
        self.tell(f"BAD       {path}: {reason}")

    def verdict(self) -> int | str:
        """The exit code and the last words."""
        if self.bad:
            names = ", ".join(sorted({path for path, _ in self.bad}))
            return f"NOT INTACT: {names}"
        if self.unsigned:
            self.tell(f"unsigned  {'; '.join(self.unsigned)}")
            self.tell(
                "INTACT, BUT NOT SIGNED THROUGHOUT: compare the manifest's SHA-256 with the one noted at the export"
            )
            return UNSIGNED
        if self.unchecked:
            self.tell(f"unchecked {len(self.unchecked)} signatures: the package cryptography is not installed here")
            self.tell("INTACT, SIGNATURES NOT CHECKED. Next: pip install cryptography, and run this again")
            return UNCHECKED
        self.tell("INTACT AND SIGNED")
        return SOUND


def verify(
    root: Path, tell: Callable[[str], object], manifest_sha256: str | None = None, key: str | None = None
) -> int | str:
    """Check the directory; what to give to `sys.exit`: a number, or the last words of a failure (exit code 1)."""
    return examine(root, tell, manifest_sha256, key).verdict()


def examine(root: Path, tell: Callable[[str], object], manifest_sha256: str | None, key: str | None) -> Report:
    """What there is to say of the directory."""
    report = Report(tell)
    seal = read_seal(root, report)
    manifest = read_manifest(root, seal, manifest_sha256, report)
    if manifest is None:
        return report
    check_files(root, manifest, report)
    check_seal_signature(seal, manifest, key, report)
    checkpoints = guarded(report, CHECKPOINTS, read_checkpoints, root, manifest, report) or {}
    orders: dict[str, Order] = {}
    for path in sorted({item["order"] for item in manifest["items"] if item["order"]}):
        found = guarded(report, path, read_order, root, path, manifest["orders"][path], checkpoints)
        if found is not None:
            orders[path] = found
            report.ok(f"{path}: order and times of recording of {len(found)} positions")
    for item in manifest["items"]:
        guarded(report, item["segments"], check_item, root, item, checkpoints, orders, report)
    return report


def guarded(report: Report, path: str, check: Callable[..., Any], *arguments: Any) -> Any:
    """The check's result; a fault in the report, and None, where it finds one."""
    try:
        return check(*arguments)
    except Bad as bad:
        report.fault(bad.path, bad.reason)
    except (LookupError, TypeError, ValueError, AttributeError, struct.error) as error:
        report.fault(path, f"it does not hold what it should: {error!r}")
    return None


# The seal, the manifest, the files.


def read_seal(root: Path, report: Report) -> dict[str, str] | None:
    """The seal's values by name; None where the seal itself is damaged."""
    try:
        text = read(root, SEAL).decode("ascii")
    except (Bad, UnicodeDecodeError) as error:
        report.fault(SEAL, f"cannot be read: {error}")
        return None
    values = dict(line.rsplit(" ", 1) for line in text.splitlines()[1:] if " " in line)
    lines = [SEAL_HEAD] + [f"{name} {values.get(name, '')}" for name in SEAL_LINES]
    body = "".join(f"{line}\n" for line in lines)
    if text != f"{body}seal sha256 {sha256(body.encode())}\n":
        report.fault(SEAL, "it was changed: its last line is not the SHA-256 of the lines before it")
        return None
    return values


def read_manifest(root: Path, seal: dict[str, str] | None, wanted: str | None, report: Report) -> Said | None:
    """The manifest; None where it is not the one that was sealed: then nothing else can be judged."""
    try:
        content = read(root, MANIFEST)
    except Bad as bad:
        report.fault(bad.path, bad.reason)
        return None
    digest = sha256(content)
    for who, expected in (("the seal", seal and seal["manifest sha256"]), ("--manifest", wanted)):
        if expected and expected.lower() != digest:
            report.fault(MANIFEST, f"its SHA-256 is {digest}, {who} says {expected}; nothing else can be judged")
            return None
    report.ok(f"{MANIFEST}: SHA-256 {digest}")
    manifest: Said = json.loads(content.decode("utf-8"))
    return manifest


def check_files(root: Path, manifest: Said, report: Report) -> None:
    """Every file that the manifest lists, and no other."""
    listed = manifest["files"]
    present = set(files_in(root, report))
    for path in sorted(present - set(listed) - {SEAL, MANIFEST}):
        report.fault(path, "it was added: the manifest does not list it")
    for path in sorted(set(listed) - present):
        report.fault(path, "it is missing")
    unchanged = 0
    for path in sorted(present & set(listed)):
        digest, size = sha256_of(root / path)
        if (digest, size) != (listed[path]["sha256"], listed[path]["bytes"]):
            expected = f"{listed[path]['sha256']} and {listed[path]['bytes']} bytes"
            report.fault(path, f"it was changed: SHA-256 {digest} and {size} bytes, the manifest says {expected}")
        else:
            unchanged += 1
    report.ok(f"{unchanged} of {len(listed)} files are those of the manifest")


def files_in(root: Path, report: Report) -> Iterator[str]:
    """Paths of all files below the directory, as the manifest writes them."""
    for whole in sorted(root.rglob("*")):
        path = whole.relative_to(root).as_posix()
        if whole.is_symlink() or not (whole.is_file() or whole.is_dir()):
            report.fault(path, "it is no plain file")
        elif whole.is_file():
            yield path


def check_seal_signature(seal: dict[str, str] | None, manifest: Said, key: str | None, report: Report) -> None:
    """The station's signature over the manifest."""
    if seal is None:
        return
    keys = manifest["keys"]
    if seal["public key"] == "-":
        report.unsigned.append(f"{MANIFEST}: the export was made without a key")
    else:
        public = bytes.fromhex(seal["public key"])
        if keys.get(key_id(public)) != seal["public key"]:
            report.fault(SEAL, f"its key {key_id(public)} is not among those of the manifest")
        message = b"VIANSEAL1" + bytes.fromhex(seal["manifest sha256"])
        signed(report, SEAL, public, bytes.fromhex(seal["signature"]), message)
    for name, public in sorted(keys.items()):
        if key_id(bytes.fromhex(public)) != name:
            report.fault(MANIFEST, f"the key {name} does not bear its name")
    if key is not None and (seal["public key"] == "-" or key_id(bytes.fromhex(seal["public key"])) != key):
        report.fault(SEAL, f"it was not signed with key {key}")


def signed(report: Report, path: str, public: bytes, signature: bytes, message: bytes) -> None:
    """Check one signature, or note that it could not be checked."""
    if Ed25519PublicKey is None:
        report.unchecked.append(path)
        return
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, message)
    except (InvalidSignature, ValueError):
        report.fault(path, f"a signature is not that of key {key_id(public)}")


# Checkpoints.


def read_checkpoints(root: Path, manifest: Said, report: Report) -> dict[int, Said]:
    """The checkpoints by sequence: each statement rebuilt, linked to the one before, its signature checked."""
    found: dict[int, Said] = {}
    previous: Said | None = None
    for said in read_json(root, CHECKPOINTS):
        number = said["sequence"]
        statement = statement_bytes(said)
        if said["heads"] is not None and heads_hash(said["heads"]).hex() != said["heads_hash"]:
            raise Bad(CHECKPOINTS, f"checkpoint {number}: its heads do not have the hash that it names")
        if previous is not None and said["previous"] != sha256(statement_bytes(previous)):
            raise Bad(CHECKPOINTS, f"checkpoint {number} does not follow checkpoint {previous['sequence']}")
        lawful = previous is None or said["public_key"] in (previous["public_key"], *previous["successors"])
        if not lawful and key_id(bytes.fromhex(said["public_key"])) not in manifest["keys"]:
            raise Bad(CHECKPOINTS, f"checkpoint {number} is signed by a key that no key before it named")
        signed(report, CHECKPOINTS, bytes.fromhex(said["public_key"]), bytes.fromhex(said["signature"]), statement)
        kept = previous["successors"] if previous and previous["public_key"] == said["public_key"] else []
        said["successors"] = kept + ([said["successor"]] if said["successor"] != ZEROS.hex() else [])
        found[number] = previous = said
    if found:
        report.ok(f"{CHECKPOINTS}: {len(found)} signed checkpoints, each following the one before")
    return found


def statement_bytes(said: Said) -> bytes:
    """What the station signed, to the byte."""
    return b"".join(
        (
            b"VIANCHK1",
            text(said["station"]),
            struct.pack(">IQq", said["epoch"], said["position"], said["time_us"]),
            bytes.fromhex(said["order_hash"]),
            bytes.fromhex(said["heads_hash"]),
            bytes.fromhex(said["previous"]),
            bytes.fromhex(said["public_key"]),
            bytes.fromhex(said["successor"]),
        )
    )


def heads_hash(heads: list[list[Any]]) -> bytes:
    """SHA-256 over the heads, in the order in which they stand."""
    parts = [b"VIANHDS1", struct.pack(">I", len(heads))]
    for station, epoch, source, kind, sequence, chain_hash in heads:
        parts += [text(station), struct.pack(">I", epoch), text(source), text(kind)]
        parts += [struct.pack(">Q", sequence), bytes.fromhex(chain_hash)]
    return hashlib.sha256(b"".join(parts)).digest()


def heads_of(checkpoint: Said | None, item: Said) -> list[tuple[int, bytes]]:
    """Sequences and chain hashes that a checkpoint signed for an item's stream, in order; one with gaps has several."""
    station, source, kind = item["stream"].split("/")
    heads = checkpoint["heads"] if checkpoint else []
    return sorted((h[4], bytes.fromhex(h[5])) for h in heads if h[:4] == [station, item["epoch"], source, kind])


# Order of recording.


def read_order(root: Path, path: str, said: Said, checkpoints: dict[int, Said]) -> Order:
    """Time of recording and chain hash by position, between what two checkpoints signed."""
    data = read(root, path)
    first, count = said["first_position"], (len(data) - 16) // 40
    if data[:8] != b"VIANORD1" or (len(data) - 16) % 40 or struct.unpack(">Q", data[8:16])[0] != first:
        raise Bad(path, "it does not begin, or end, as such a file does")
    start, end = (checkpoints.get(number) for number in (said["from_checkpoint"], said["to_checkpoint"]))
    order = bytes.fromhex(start["order_hash"]) if start else ZEROS
    if end is None or first != (start["position"] + 1 if start else 1) or first + count - 1 != end["position"]:
        raise Bad(path, "it does not reach from one signed position to the next")
    found = {}
    for number in range(count):
        recorded_at, chain_hash = struct.unpack(">q32s", data[16 + 40 * number : 56 + 40 * number])
        order = hashlib.sha256(order + struct.pack(">Qq", first + number, recorded_at) + chain_hash).digest()
        found[first + number] = (recorded_at, chain_hash)
    if order.hex() != end["order_hash"]:
        raise Bad(path, f"its order hash is {order.hex()}, checkpoint {end['sequence']} signed {end['order_hash']}")
    return found


# Segments.


def check_item(root: Path, item: Said, checkpoints: dict[int, Said], orders: dict[str, Order], report: Report) -> None:
    """One stream's segments: payloads, headers, chain, anchors, order."""
    path, name = item["segments"], item["stream"]
    start, end = (checkpoints.get(item[key]) for key in ("from_checkpoint", "to_checkpoint"))
    base = item.get("base")
    begin = (base["sequence"], bytes.fromhex(base["chain_hash"])) if base else (0, ZEROS)
    wanted = (item["ranges"][0][0], item["ranges"][-1][1])
    data = read(root, path)
    # The chain begins behind what was signed last before it, or with the run.
    first = next(segments_in(path, data), None)
    signed_before = [
        head for head in heads_of(start, item) if first is not None and begin[0] < head[0] < first["first"]
    ]
    anchor = max([begin, *signed_before])
    sequence, chain_hash = anchor
    passed = {anchor[0]: anchor[1]}
    whole: list[tuple[int, int]] = []
    for segment in segments_in(path, data):
        place = f"segment from sequence {segment['first']} (byte {segment['at']})"
        if segment["stream"] != name or segment["epoch"] != item["epoch"]:
            raise Bad(path, f"{place} is of stream {segment['stream']}, epoch {segment['epoch']}")
        if segment["first"] != sequence + 1:
            raise Bad(path, f"{place} follows sequence {sequence}")
        payload = segment["payload"]
        if payload is not None and hashlib.sha256(payload).digest() != segment["payload_hash"]:
            raise Bad(path, f"{place}: its payload does not have the hash that the chain covers")
        chain_hash = hashlib.sha256(chain_hash + segment["header"] + segment["payload_hash"]).digest()
        if chain_hash != segment["chain_hash"]:
            raise Bad(path, f"{place}: its chain hash is not that of its header, its payload and the segment before")
        if item["order"] in orders:
            recorded = orders[item["order"]].get(segment["position"])
            if recorded is not None and recorded != (segment["recorded_at"], chain_hash):
                raise Bad(path, f"{place}: position or time of recording are not those that were signed")
            if recorded is None and payload is not None:
                raise Bad(path, f"{place}: its position {segment['position']} is outside what was signed")
        sequence = segment["last"]
        passed[sequence] = chain_hash
        if payload is not None:
            whole.append((segment["first"], sequence))
    for first, last in item["ranges"]:
        if not covers(whole, first, last):
            raise Bad(path, f"events {first} to {last} are not all there")
    signed_heads = heads_of(end, item)
    if end is None or not signed_heads:
        report.unsigned.append(f"{name}: no checkpoint followed")
        report.ok(f"{path}: chain of {name} holds to sequence {sequence}; not signed")
        return
    number = end["sequence"]
    reached = [head for head in signed_heads if anchor[0] < head[0] <= sequence]
    if not reached or reached[-1][0] < wanted[1]:
        raise Bad(path, f"the chain does not reach what checkpoint {number} signed at {signed_heads[-1][0]}")
    for at, signed_hash in reached:
        if passed.get(at) != signed_hash:
            raise Bad(path, f"the chain does not reach what checkpoint {number} signed at {at}")
    behind = f"begins behind sequence {base['sequence']}, and " if base else ""
    report.ok(f"{path}: chain of {name} {behind}holds to sequence {sequence}, as checkpoint {number} signed it")


def covers(whole: list[tuple[int, int]], first: int, last: int) -> bool:
    """Whether the segments, in order, hold every event of a range."""
    for begin, end in whole:
        if begin <= first <= end:
            first = end + 1
        if first > last:
            return True
    return False


def segments_in(path: str, data: bytes) -> Iterator[Said]:
    """The segments of a file, each with its place in it."""
    if data[:8] != b"VIANEVI1":
        raise Bad(path, "it does not begin as a file of segments does")
    at = 8
    while at < len(data):
        try:
            segment, at = segment_at(data, at)
        except (struct.error, UnicodeDecodeError, ValueError) as error:
            raise Bad(path, f"what stands from byte {at} on is no segment: {error}") from error
        yield segment


def segment_at(data: bytes, start: int) -> tuple[Said, int]:
    """The segment that begins at a byte, and where the next one does."""
    kind, size = struct.unpack_from(">BI", data, start)
    at = start + 5
    header, at = data[at : at + size], at + size
    payload_hash, at = data[at : at + 32], at + 32
    payload = None
    if kind == 1:
        (size,) = struct.unpack_from(">I", data, at)
        payload, at = data[at + 4 : at + 4 + size], at + 4 + size
    elif kind != 0:
        raise ValueError(f"unknown kind {kind}")
    chain_hash, position, recorded_at = struct.unpack_from(">32sQq", data, at)
    segment = header_of(header)
    segment.update(at=start, header=header, payload_hash=payload_hash, payload=payload, chain_hash=chain_hash)
    segment.update(position=position, recorded_at=recorded_at)
    return segment, at + 48


def header_of(header: bytes) -> Said:
    """What is needed of a segment's header: stream, epoch, first and last sequence."""
    if header[:8] != b"VIANSEG1":
        raise ValueError("no header of a segment")
    (epoch,) = struct.unpack_from(">I", header, 8)
    at = 12
    names: list[str] = []
    for _ in range(3):
        (size,) = struct.unpack_from(">H", header, at)
        names.append(header[at + 2 : at + 2 + size].decode("utf-8"))
        at += 2 + size
    first, count = struct.unpack_from(">QI", header, at)
    return {"stream": "/".join(names), "epoch": epoch, "first": first, "last": first + count - 1}


# Bytes.


def read(root: Path, path: str) -> bytes:
    """The content of a file of the directory."""
    try:
        return (root / path).read_bytes()
    except OSError as error:
        raise Bad(path, f"cannot be read: {error.strerror}") from error


def read_json(root: Path, path: str) -> Any:
    """The content of a JSON file of the directory."""
    try:
        return json.loads(read(root, path).decode("utf-8"))
    except ValueError as error:
        raise Bad(path, f"is no JSON: {error}") from error


def sha256(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def sha256_of(path: Path) -> tuple[str, int]:
    """SHA-256 in hexadecimal, and size, of a file."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        for part in iter(lambda: file.read(1 << 20), b""):
            digest.update(part)
            size += len(part)
    return digest.hexdigest(), size


def key_id(public: bytes) -> str:
    """Name of a key."""
    return sha256(public)[:32]


def text(value: str) -> bytes:
    """A text as statements and headers hold it."""
    data = value.encode("utf-8")
    return struct.pack(">H", len(data)) + data


def arguments(given: list[str]) -> tuple[Path, str | None, str | None] | None:
    """Directory, manifest's SHA-256 and key id from the command line; None where they make no sense."""
    options: dict[str, str | None] = {"--manifest": None, "--key": None}
    rest: list[str] = []
    words = iter(given)
    for word in words:
        if word in options:
            options[word] = next(words, "").lower()
        else:
            rest.append(word)
    if len(rest) > 1 or any(word.startswith("-") for word in rest):
        return None
    sizes = {"--manifest": 64, "--key": 32}
    for name, value in options.items():
        if value is not None and not re.fullmatch(f"[0-9a-f]{{{sizes[name]}}}", value):
            return None
    root = Path(rest[0]) if rest else Path(__file__).resolve().parent
    return root, options["--manifest"], options["--key"]


def main(given: list[str]) -> int | str:
    """Run from the command line; what to give to `sys.exit`."""
    found = arguments(given)
    if found is None or not found[0].is_dir():
        sys.stderr.write("usage: python3 verify.py [DIRECTORY] [--manifest SHA256] [--key KEY_ID]\n")
        return USAGE
    return verify(found[0], lambda line: sys.stdout.write(line + "\n"), found[1], found[2])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
