"""docs/reference/sync.md says what the code does."""

import re
from pathlib import Path
from types import ModuleType

import pytest

from sync import LANES, Pace, Plan, wire, wire_v1
from sync.wire import (
    CURSORS_MAX,
    HEADER_BYTES_MAX,
    PAYLOAD_BYTES_MAX,
    PROTOCOL,
    RECORD_BYTES_MAX,
    SEGMENTS_MAX,
    STREAMS_MAX,
    Message,
)

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/reference/sync.md").read_text(encoding="utf-8")
TEXT_1 = (ROOT / "docs/reference/sync-1.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "number",
    [HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX, RECORD_BYTES_MAX, SEGMENTS_MAX, STREAMS_MAX, CURSORS_MAX],
    ids=str,
)
def test_each_limit_is_told(number: int) -> None:
    assert f"{number:,}" in TEXT


@pytest.mark.parametrize("module, text", [(wire, TEXT), (wire_v1, TEXT_1)], ids=["2", "1"])
def test_each_key_of_each_message_is_told(module: ModuleType, text: str) -> None:
    messages = [each for each in vars(module).values() if isinstance(each, type) and issubclass(each, Message)]

    assert len(messages) >= 5
    assert {name for message in messages for name in message.model_fields if f"`{name}`" not in text} == set()


def test_each_problem_is_told() -> None:
    sources = "".join(
        (ROOT / "sync" / name).read_text(encoding="utf-8") for name in ("apply.py", "central.py", "countersigning.py")
    )
    refusals = re.findall(r'(?:Refusal\(\s*\d+,\s*|corrupt\(segment, |code, first = )"(\w+)"', sources)
    codes = {*refusals, "false_header", "bad_header", "other_history", "other_bytes"}

    assert len(codes) > 12
    assert {code for code in codes if f"`{code}`" not in TEXT} == set()


def test_the_plan_shown_is_one() -> None:
    (example,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)

    assert [entry.priority for entry in Plan.parse(example).entries] == [LANES["situations"], 25]
    assert all(re.search(rf"\| `{name}`[^|]*\| {number} \|", TEXT) for name, number in LANES.items())


def test_version_and_pace_are_told() -> None:
    assert TEXT.startswith(f"# The sync protocol, version {PROTOCOL}\n")
    assert f"{Pace().request_bytes_min // 1024} KiB and {Pace().request_bytes // 1024} KiB" in TEXT
    assert f"({Pace().latency_s} s)" in TEXT
    assert f"{Pace().backoff_s:g} s, doubles with each failure up to {Pace().backoff_s_max:g} s" in TEXT
