"""Streams that were begun behind their first event: runs, bases, and what fills the gaps later."""

from dataclasses import replace

import pytest

from events import GENESIS, Run, Segment, StreamName
from store import BadRequest, ChainBroken, Log, SequenceConflict, verify
from tests.store.replicas import deliver
from tests.store.samples import GATE, YARD, append, draft, owner


@pytest.fixture
def sent(make_log) -> list[Segment]:
    """What a station has to send: ten segments of ten events."""
    origin = make_log()
    append(origin, GATE, *[10] * 10)
    return list(origin.read(GATE))


def spans(log: Log) -> list[tuple[int, int]]:
    return [(run.after, run.sequence) for run in log.runs(GATE)]


def numbers(log: Log, from_sequence: int = 1) -> list[int]:
    return [segment.header.first_sequence // 10 for segment in log.read(GATE, from_sequence)]


def test_a_stream_may_begin_behind_its_first_event(log: Log, sent: list[Segment]) -> None:
    (appended,) = deliver(log, sent, 4)
    assert (appended.position, appended.first_sequence, appended.chain_hash) == (1, 41, sent[4].chain_hash)
    assert log.runs(GATE) == [Run(40, sent[3].chain_hash, 50, sent[4].chain_hash)]
    assert log.all_runs() == {(GATE, 1): log.runs(GATE)}
    assert log.stream_head(GATE).sequence == 50
    assert [(base.stream, base.sequence, base.chain_hash, base.position) for base in log.bases()] == [
        (GATE, 40, sent[3].chain_hash, 1)
    ]


def test_a_gap_without_a_base_is_refused(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 0, 6)
    for number, actual in ((8, 70), (3, 10)):
        with pytest.raises(SequenceConflict) as caught:
            deliver(log, sent, number, may_jump=False)
        assert (caught.value.expected, caught.value.actual) == (10 * number, actual)
    assert spans(log) == [(0, 10), (60, 70)]


def test_gaps_fill_from_below_and_runs_become_one(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 0)
    deliver(log, sent, 8)
    deliver(log, sent, 5)  # into the gap: chosen in retrospect
    assert spans(log) == [(0, 10), (50, 60), (80, 90)]
    deliver(log, sent, 1, 6, 2, 9, may_jump=False)
    assert spans(log) == [(0, 30), (50, 70), (80, 100)]
    deliver(log, sent, 7, may_jump=False)
    assert spans(log) == [(0, 30), (50, 100)]
    deliver(log, sent, 3, 4, may_jump=False)
    assert log.runs(GATE) == [Run(0, GENESIS, 100, sent[9].chain_hash)]
    assert [segment.chain_hash for segment in log.read(GATE)] == [segment.chain_hash for segment in sent]
    assert len(log.bases()) == 2


def test_runs_can_be_had_of_one_station_or_all(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 8, 2, 0, 5, 1)
    append(log, YARD, 3)
    log.append([draft(StreamName.of("plzen", "roof", "track_point"), 1, 2)], epochs=[7])
    every = log.all_runs()
    assert every == log.standing().runs
    assert {place: log.runs(*place) for place in every} == every
    assert [(run.after, run.sequence) for run in every[GATE, 1]] == [(0, 30), (50, 60), (80, 90)]
    assert [place[1] for place in log.all_runs(station="plzen")] == [7]
    assert log.all_runs(station="nobody") == {}
    places = list(every)[:2]
    assert log.some_runs([*places, (YARD, 9), *places]) == {place: every[place] for place in places}
    assert log.some_runs([]) == {}


def test_what_fills_a_gap_takes_new_positions(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 3)
    append(log, YARD, 1)
    (filled,) = deliver(log, sent, 0)
    assert filled.position == 3
    assert [segment.stream for segment in log.read_all()] == [GATE, YARD, GATE]


def test_what_is_sent_again_is_acknowledged_wherever_it_lies(log: Log, sent: list[Segment]) -> None:
    order = (5, 0, 8, 6)
    first = [*deliver(log, sent, *order)]
    assert deliver(log, sent, *order) == [replace(each, was_there=True) for each in first]
    assert deliver(log, sent, *order, may_jump=False) == [replace(each, was_there=True) for each in first]


def test_one_call_may_not_hold_one_place_twice(log: Log, sent: list[Segment]) -> None:
    for order in ((4, 4), (4, 5, 5), (6, 0, 0)):
        with pytest.raises(SequenceConflict):
            deliver(log, sent, *order)
    assert log.heads() == (0, [])


def test_a_base_with_another_hash_is_refused(log: Log, sent: list[Segment]) -> None:
    drafted, expected, out = [draft(GATE, 41, 50)], [40], [sent[4].chain_hash]
    with pytest.raises(ChainBroken, match="differs from the one that was sent"):
        log.append(drafted, expected, chain_hashes=out, bases=[bytes(range(32))])
    with pytest.raises(BadRequest, match="a base is a chain hash of 32 bytes, got 3"):
        log.append(drafted, expected, bases=[b"abc"])
    assert log.head() == 0


def test_a_run_meets_the_one_above_with_its_base_or_is_refused(log: Log, sent: list[Segment]) -> None:
    log.append([draft(GATE, 41, 50)], [40], bases=[bytes(range(32))])
    deliver(log, sent, 0, 1, 2)
    with pytest.raises(ChainBroken, match="the chain hash differs from that behind which sequence 41 was begun"):
        deliver(log, sent, 3)
    with pytest.raises(SequenceConflict, match=r"is here from sequence 41 on: .* reaches beyond 40"):
        log.append([draft(GATE, 31, 41)], [30])
    assert spans(log) == [(0, 30), (40, 50)]


def test_a_base_is_no_leave_to_overlap(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 0, 4)
    for first, last in ((6, 12), (45, 55), (31, 41), (36, 60)):
        with pytest.raises(SequenceConflict):
            log.append([draft(GATE, first, last)], [first - 1], bases=[bytes(32)])
    assert spans(log) == [(0, 10), (40, 50)]


def test_reading_goes_across_gaps(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 8, 2, 3, 0)
    assert numbers(log) == [0, 2, 3, 8]
    assert numbers(log, 15) == numbers(log, 21) == [2, 3, 8]
    assert numbers(log, 35) == [3, 8]
    assert numbers(log, 41) == numbers(log, 85) == [8]
    assert numbers(log, 91) == []


def test_a_base_is_permanent(log: Log, sent: list[Segment]) -> None:
    deliver(log, sent, 0, 4)
    for change in (
        "update stream_bases set chain_hash = filled_hash",
        "update stream_bases set position = 7",
        "update stream_bases set sequence = 41",
        "update stream_bases set filled_sequence = 9",
        "update stream_bases set filled_hash = chain_hash",
        "delete from stream_bases",
        "truncate stream_bases",
    ):
        with owner(log) as connection, pytest.raises(Exception, match="refused: the log is append-only"):
            connection.execute(change)
    assert verify(log).is_sound
