"""The worked example of docs/reference/proof.md, recomputed without the package's own code, and its numbers."""

import hashlib
import re
import struct
from datetime import UTC, datetime
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from events import CheckpointSigned, Station, StreamName
from store import SignedCheckpoint, Statement, StreamHead, key_id
from store.proof import (
    HEADS_TEXT_BYTES_MAX,
    NO_HASH,
    checkpoint_of,
    event_of,
    heads_hash,
    order_hash,
    statement_bytes,
)

PAGE = (Path(__file__).parents[2] / "docs/reference/proof.md").read_text(encoding="utf-8")
PRIVATE = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
PUBLIC = PRIVATE.public_key().public_bytes_raw()
CHAIN_HASH = bytes.fromhex("959940d291b350ab40bfcb08817764e0037138e857f4c1eb53300298d934d288")
NOON_US = 1_767_268_800_000_000


def _text(text: str) -> bytes:
    return struct.pack(">H", len(text.encode())) + text.encode()


ORDER = hashlib.sha256(bytes(32) + struct.pack(">Qq", 1, NOON_US + 1_000_000) + CHAIN_HASH).digest()
HEAD = _text("brno-2") + struct.pack(">I", 1) + _text("gate") + _text("track_point") + struct.pack(">Q", 2) + CHAIN_HASH
HEADS = hashlib.sha256(b"VIANHDS1" + struct.pack(">I", 1) + HEAD).digest()
STATEMENT = (
    b"VIANCHK1"
    + _text("brno-2")
    + struct.pack(">IQq", 1, 1, NOON_US + 600_000_000)
    + ORDER
    + HEADS
    + bytes(32)
    + PUBLIC
    + bytes(32)
)


def _printed(title: str) -> bytes:
    """The bytes that the page prints as hexadecimal in the block under this title."""
    (block,) = re.findall(rf"^{re.escape(title)}.*?\n\n((?:    .*\n)+)", PAGE, re.MULTILINE)
    return bytes.fromhex("".join(line.split("#")[0] for line in block.splitlines()))


def test_the_page_prints_the_bytes_that_follow_from_its_tables() -> None:
    assert _printed("Public key, ") == PUBLIC
    assert hashlib.sha256(PUBLIC).hexdigest()[:32] in PAGE
    assert _printed("Order hash:") == ORDER
    assert _printed("Heads hash:") == HEADS
    assert _printed("Statement, ") == STATEMENT
    assert _printed("Signature:") == PRIVATE.sign(STATEMENT)
    assert f"Statement, {len(STATEMENT)} bytes" in PAGE
    assert f"{HEADS_TEXT_BYTES_MAX:,}" in PAGE


def test_the_package_signs_the_bytes_of_the_page() -> None:
    head = StreamHead(StreamName.parse("brno-2/gate/track_point"), 1, 2, CHAIN_HASH)
    time = datetime(2026, 1, 1, 12, 10, tzinfo=UTC)
    order = order_hash(NO_HASH, 1, NOON_US + 1_000_000, CHAIN_HASH)
    statement = Statement(Station("brno-2"), 1, 1, time, order, (head,), NO_HASH, PUBLIC)
    assert heads_hash([head]) == HEADS
    assert statement_bytes(statement) == STATEMENT
    assert key_id(PUBLIC) in PAGE
    event = event_of(statement, PRIVATE.sign(STATEMENT))
    assert checkpoint_of(event, "brno-2", 1) == SignedCheckpoint(statement, PRIVATE.sign(STATEMENT), 1)  # type: ignore[arg-type]


def test_each_field_of_the_event_is_told() -> None:
    assert [name for name in CheckpointSigned.model_fields if f"`{name}`" not in PAGE] == []
