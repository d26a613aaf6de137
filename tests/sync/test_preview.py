"""What a plan would mean is told before anything is sent."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from events import StreamName, header_bytes
from store import Log
from store.sizes import Part, Size, sizes
from sync import Plan
from sync.plans.changes import changes_of
from sync.plans.deriving import Deriver
from sync.plans.preview import RECORD_BYTES, AllHeld, EntryPreview, Held, Preview, held_by, preview
from sync.protocol.reports import Status, StreamStatus
from sync.protocol.wire import record_size
from tests.store.tiered import seal_all
from tests.sync.conftest import BRNO, NOON, append_points, stream_of
from tests.sync.test_deriving import filtered, plan, prune, run

GATE, YARD = stream_of("gate"), stream_of("yard")
LATER = (NOON + timedelta(milliseconds=1000)).isoformat()


def plan_of(*entries: dict[str, Any], **more: Any) -> Plan:
    return Plan.of({"entries": list(entries), **more}).resolved(NOON + timedelta(days=1))


def look(log: Log, chosen: Plan, held: AllHeld | None = None, rate: float | None = None) -> Preview:
    return preview(log, BRNO, chosen, None, held or {}, rate)


def one(log: Log, entry: dict[str, Any], **more: Any) -> EntryPreview:
    (found,) = look(log, plan_of(entry), **more).entries
    return found


def records(log: Log, *streams: StreamName, since: Any = None) -> int:
    """Bytes of the records of the streams."""
    return sum(
        RECORD_BYTES + len(header_bytes(segment.header)) + len(segment.payload)
        for segment in log.read_all(since=since)
        if segment.stream in streams
    )


@pytest.fixture
def filled(station_log: Log) -> Log:
    append_points(station_log, GATE, [1000, 500, 1])
    append_points(station_log, YARD, [30])
    return station_log


def test_what_is_sent_as_it_is_is_counted_to_the_byte(filled: Log) -> None:
    found = one(filled, {"stream": "*/*/track_point"})
    assert (found.streams, found.segments, found.events, found.is_exact) == (2, 4, 1531, True)
    assert found.bytes == records(filled, GATE, YARD)
    assert found.problems == ()


def test_segments_before_the_time_and_what_central_holds_do_not_count(filled: Log) -> None:
    found = one(filled, {"stream": "*/gate/*", "from": LATER})
    assert (found.segments, found.events) == (2, 501)
    assert found.bytes == records(filled, GATE, since=NOON + timedelta(milliseconds=1000))
    found = one(filled, {"stream": "*/gate/*"}, held={(GATE, filled.epoch): Held(((0, 1000), (1500, 1501)))})
    assert (found.segments, found.events) == (1, 500)


def test_a_record_is_counted_as_it_travels(filled: Log) -> None:
    segment = next(filled.read_all())
    assert record_size(segment) == RECORD_BYTES + len(header_bytes(segment.header)) + len(segment.payload)


def test_what_is_filled_in_retrospect_is_what_the_present_plan_left_out(filled: Log) -> None:
    present = plan_of({"stream": "*/gate/*", "from": LATER})
    streams = (StreamStatus(GATE, filled.epoch, 30, 1501, 1501, 0, None),)
    status = Status(BRNO, "http://central", streams, NOON, None, 0, None)
    assert one(filled, {"stream": "*/gate/*"}, held=held_by(status, present)).events == 1000
    assert one(filled, {"stream": "*/gate/*", "from": LATER}, held=held_by(status, present)).events == 0
    assert one(filled, {"stream": "*/gate/*"}, held=held_by(status, None)).events == 0
    assert held_by(None, None) == {}
    behind = Status(BRNO, "", (StreamStatus(GATE, filled.epoch, 0, 1501, 1501, 1000, None),), NOON, None, 0, None)
    assert one(filled, {"stream": "*/gate/*"}, held=held_by(behind, None)).events == 1000


def test_time_is_told_at_the_least_of_rate_and_limits_and_never_made_up(filled: Log) -> None:
    assert one(filled, {"stream": "*/*/*"}).seconds is None
    found = one(filled, {"stream": "*/*/*"}, rate=8000.0)
    assert found.seconds == found.bytes / 1000
    found = one(filled, {"stream": "*/*/*", "rate": "4 kbit/s"}, rate=8000.0)
    assert found.seconds == found.bytes / 500
    whole = look(filled, plan_of({"stream": "*/gate/*"}, {"stream": "*/*/*"}, rate="2 kbit/s"), rate=8000.0)
    assert whole.seconds == sum(each.bytes for each in whole.entries) / 250


def test_streams_that_stay_are_counted(filled: Log) -> None:
    found = look(filled, plan_of({"stream": "*/gate/*", "send": False}, {"stream": "*/none/*"}))
    assert (found.staying, [each.streams for each in found.entries]) == (2, [0, 0])


def test_what_a_filter_leaves_is_estimated_before_it_is_made_and_counted_behind(filled: Log) -> None:
    entry = filtered("track_id = 1")
    before = one(filled, entry)
    assert (before.is_exact, before.streams, before.segments) == (False, 1, 1)
    assert before.events == pytest.approx(1501 / 7, rel=0.02)

    plan(filled, entry)
    run(Deriver(filled, BRNO))
    after = one(filled, entry)
    assert (after.is_exact, after.events) == (True, 215)
    assert before.bytes == pytest.approx(after.bytes, rel=0.2)


def test_a_filter_that_takes_all_and_a_stream_that_cannot_be_filtered_are_told(filled: Log) -> None:
    assert one(filled, filtered("frame > 9999")).events == 0
    found = one(filled, filtered("frame * 9223372036854775807 > 1"))
    assert (found.is_exact, found.events) == (False, 0)
    assert "brno-2/gate/track_point: the condition fails: Out of Range" in found.problems[0]


def test_what_was_pruned_and_a_filter_would_want_is_told_with_its_range(filled: Log) -> None:
    prune(filled, 1, 2)
    found = one(filled, filtered("track_id = 1"))
    assert len(found.problems) == 1
    assert f"{GATE} was pruned from sequence 1 to 1500 of epoch 1: " in found.problems[0]
    assert one(filled, {"stream": "*/gate/*"}).problems == ()
    late = (NOON + timedelta(milliseconds=1500)).isoformat()
    assert one(filled, filtered("track_id = 1", **{"from": late})).problems == ()


def test_what_is_sealed_is_estimated(filled: Log, tmp_path: Path) -> None:
    exact = sizes(filled, [Part(GATE, filled.epoch)])
    seal_all(filled, tmp_path, 10**6)
    append_points(filled, GATE, [10])
    found = sizes(
        filled, [Part(GATE, filled.epoch), Part(GATE, filled.epoch, None, ((0, 1000),)), Part(YARD, filled.epoch)]
    )
    assert [(size.events, size.is_exact) for size in found] == [(1511, False), (511, False), (30, False)]
    assert found[0].payload_bytes >= exact[0].payload_bytes / 2
    assert sizes(filled, [Part(GATE, filled.epoch, NOON + timedelta(days=1))]) == [Size()]


CHANGES: list[tuple[dict[str, Any], dict[str, Any], list[str]]] = [
    ({}, {}, []),
    ({"send": False}, {}, ["begins, from the beginning"]),
    ({"send": False}, {"from": LATER}, ["begins, from 2026-05-01T12:00:01Z"]),
    ({}, {"send": False}, ["stops: nothing more is sent; central keeps what it has"]),
    ({"from": LATER}, {}, ["is filled in retrospect, from the beginning"]),
    ({}, {"from": LATER}, ["nothing older is sent any more than 2026-05-01T12:00:01Z; central keeps what it has"]),
    ({}, {"priority": "alerts"}, ["priority 30 becomes 0", "order oldest becomes live"]),
    ({}, {"rate": "8 kbit/s"}, ["rate without limit becomes 8000 bit/s"]),
    (
        {},
        {"where": "x > 1"},
        ["begins, filtered, as a stream ~HASH of its own, from the beginning; the whole stream stops, central keeps"],
    ),
    ({"where": "x > 1"}, {}, ["begins, from the beginning; the stream ~HASH stops, central keeps what it has of it"]),
    ({"where": "x > 1"}, {"where": "x > 1", "priority": 31}, ["priority 30 becomes 31"]),
]


@pytest.mark.parametrize("before, after, said", CHANGES)
def test_a_change_is_told(before: dict[str, Any], after: dict[str, Any], said: list[str]) -> None:
    plans = [plan_of({"stream": "*/*/track_point", **each}) for each in (before, after)]
    found = list(changes_of(*plans, [GATE, YARD]))
    hashes = [entry.filter_hash for each in plans for entry in each.entries if entry.is_derived]
    assert all(change.streams == (GATE, YARD) for change in found)
    assert len(found) == len(said)
    for change, words in zip(found, said, strict=True):
        assert change.what.startswith(words.replace("HASH", "".join(hashes[:1])))


def test_what_changes_for_the_whole_station_is_told() -> None:
    before = plan_of({"stream": "*/*/*"})
    after = plan_of(
        {"stream": "*/*/*"}, paused=True, rate="8 kbit/s", backlog_share=0.5, give_up=[{"stream": "*/*/track_point"}]
    )
    assert [change.what for change in changes_of(before, after, [GATE])] == [
        "the plan pauses",
        "the station's rate without limit becomes 8000 bit/s",
        "backlog's least share 20% becomes 50%",
        "what may be given up when the disk is full becomes another",
    ]
    assert [change.what for change in changes_of(None, before, [GATE])] == ["begins, from the beginning"]
