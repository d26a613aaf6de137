"""docs/reference/archive.md tells the truth: its columns, and how to verify a file without ViAn."""

import hashlib
import re
from pathlib import Path

import pyarrow.parquet as pq

from store import Log
from store.sealed import FORMAT, GROUP_BYTES_MAX, GROUP_SEGMENTS_MAX, SCHEMA
from tests.store.samples import GATE, YARD, append
from tests.store.tiered import seal_all

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "archive.md").read_text()
PLAIN = {"binary(32)": "fixed_size_binary[32]", "timestamp, µs, UTC": "timestamp[us, tz=UTC]"}


def test_the_columns_are_those_of_the_page() -> None:
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", PAGE, re.MULTILINE)
    documented = [(name, PLAIN.get(kind.removesuffix(", null"), kind), kind.endswith(", null")) for name, kind in rows]
    assert documented == [(field.name, str(field.type), field.nullable) for field in SCHEMA]
    assert FORMAT in PAGE
    assert f"{GROUP_BYTES_MAX // 2**20} MiB of payload and {GROUP_SEGMENTS_MAX:,} segments" in PAGE


def test_files_verify_as_the_page_says_with_pyarrow_and_hashlib_alone(log: Log, tmp_path: Path) -> None:
    for _ in range(4):
        append(log, GATE, 2)
        append(log, YARD, 1)
    seal_all(log, tmp_path)
    files = sorted(path for path in (tmp_path / "_sealed").iterdir())
    assert len(files) > 1
    last: dict[tuple[str, ...], bytes] = {}
    position = 0
    for path in files:
        begun = set()
        for row in pq.read_table(path).to_pylist():
            position += 1
            assert row["position"] == position
            stream = (row["station"], row["source"], row["type"], row["epoch"])
            assert (row["previous_chain_hash"] is not None) == (stream not in begun)
            begun.add(stream)
            previous = last.get(stream, bytes(32))
            assert row["previous_chain_hash"] in (None, previous)
            assert hashlib.sha256(row["payload"]).digest() == row["payload_hash"]
            assert hashlib.sha256(previous + row["header"] + row["payload_hash"]).digest() == row["chain_hash"]
            last[stream] = row["chain_hash"]
    assert position == 8
    assert sorted(last.values()) == sorted(head.chain_hash for head in log.streams())
