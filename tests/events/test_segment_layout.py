"""The worked example of docs/reference/segment.md, recomputed without the package's own code."""

import hashlib
import re
import struct
from datetime import UTC, datetime
from pathlib import Path

from events import GENESIS, Header, Producer, Sequence, StreamName, chain, header_bytes, parse_header

PAGE = (Path(__file__).parents[2] / "docs/reference/segment.md").read_text()
PAYLOAD = (Path(__file__).parent / "golden/track_point.v1.bin").read_bytes()
SECOND = 1_000_000


def _text(text: str) -> bytes:
    return struct.pack(">H", len(text.encode())) + text.encode()


NOON_US = 1_767_268_800 * SECOND
HEADER = (
    b"VIANSEG1"
    + struct.pack(">I", 1)
    + _text("brno-2")
    + _text("gate")
    + _text("track_point")
    + struct.pack(">QIIqq", 1, 2, 1, NOON_US, NOON_US + 33_333)
    + _text("motion")
    + _text("1.0.0")
    + hashlib.sha256(b"{}").digest()
)
PAYLOAD_HASH = hashlib.sha256(PAYLOAD).digest()
CHAIN_HASH = hashlib.sha256(bytes(32) + HEADER + PAYLOAD_HASH).digest()


def _printed(title: str) -> bytes:
    """The bytes that the page prints as hexadecimal in the block under this title."""
    (block,) = re.findall(rf"^{re.escape(title)}.*?\n\n((?:    .*\n)+)", PAGE, re.MULTILINE)
    return bytes.fromhex("".join(line.split("#")[0] for line in block.splitlines()))


def test_the_page_prints_the_bytes_that_follow_from_its_table() -> None:
    assert _printed("Header, ") == HEADER
    assert _printed("Payload, ") == PAYLOAD
    assert _printed("Payload hash") == PAYLOAD_HASH
    assert _printed("Chain hash") == CHAIN_HASH
    assert f"Header, {len(HEADER)} bytes" in PAGE
    assert f"Payload, {len(PAYLOAD)} bytes" in PAGE


def test_the_package_writes_and_reads_the_bytes_of_the_page() -> None:
    header = Header(
        stream=StreamName.parse("brno-2/gate/track_point"),
        epoch=1,
        first_sequence=Sequence(1),
        event_count=2,
        schema_version=1,
        time_min=datetime(2026, 1, 1, 12, tzinfo=UTC),
        time_max=datetime(2026, 1, 1, 12, 0, 0, 33_333, tzinfo=UTC),
        producer=Producer("motion", "1.0.0", hashlib.sha256(b"{}").digest()),
    )
    assert header_bytes(header) == HEADER
    assert parse_header(HEADER) == header
    assert chain(GENESIS, header, PAYLOAD_HASH) == CHAIN_HASH
