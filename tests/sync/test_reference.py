"""docs/reference/sync.md says what the code does."""

import re
from pathlib import Path
from types import ModuleType

import pytest

from events import Catalogue
from sync import LANES, Entry, Pace, Plan
from sync.plans.checking import check_filters
from sync.plans.entries import HASH_DIGITS, WHERE_CHARACTERS_MAX, GiveUp
from sync.plans.preview import SAMPLE_SEGMENTS
from sync.plans.where import DEPTH_MAX, FUNCTIONS
from sync.protocol import wire, wire_v1
from sync.protocol.wire import (
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
    names = ("access", "apply", "bodies", "router", "countersigning", "enrolment", "registry", "sessions", "unpacking")
    sources = "".join(next((ROOT / "sync").rglob(f"{name}.py")).read_text(encoding="utf-8") for name in names)
    refusals = re.findall(
        r'(?:Refusal\(\s*\d+,\s*|Places\(\s*|corrupt\(segment, |_no_code\(|code, first = )"(\w+)"', sources
    )
    codes = {*refusals, "false_header", "bad_header", "other_history", "other_bytes"}

    assert len(codes) > 25
    assert {code for code in codes if f"`{code}`" not in TEXT} == set()


def test_the_plan_shown_is_one() -> None:
    (example,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)

    plan = Plan.parse(example)
    assert [entry.priority for entry in plan.entries if entry.sends] == [LANES["situations"], 25]
    check_filters(plan, Catalogue.shipped())
    keys = {field.alias or name for model in (Plan, Entry, GiveUp) for name, field in model.model_fields.items()}
    assert {key for key in keys - {"now"} if f"{key}:" not in example} == set()
    assert "`now` beside `from: now`" in TEXT
    assert all(re.search(rf"\| `{name}`[^|]*\| {number} \|", TEXT) for name, number in LANES.items())


def test_the_language_of_conditions_is_told() -> None:
    assert ", ".join(f"`{name}`" for name in FUNCTIONS) in TEXT
    assert f"at most {WHERE_CHARACTERS_MAX:,} characters, nested at most {DEPTH_MAX} deep" in TEXT
    assert f"A source name has at most {64 - 1 - HASH_DIGITS}\ncharacters to be filtered" in TEXT
    assert f"from {SAMPLE_SEGMENTS} segments" in TEXT


def test_version_and_pace_are_told() -> None:
    assert TEXT.startswith(f"# The sync protocol, version {PROTOCOL}\n")
    assert f"{Pace().request_bytes_min // 1024} KiB and {Pace().request_bytes // 1024} KiB" in TEXT
    assert f"({Pace().latency_s} s)" in TEXT
    assert f"{Pace().backoff_s:g} s, doubles with each failure up to {Pace().backoff_s_max:g} s" in TEXT
