"""What is decided about sending, without a network: runs and gaps, order and share, sizes and caps."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from events import GENESIS, Run, StreamName
from sync import Entry, Plan
from sync.protocol.wire import cursors_hash
from sync.runs import BEGINNING, Gap, Point, StreamKey, are_held, gaps_of, split, with_range
from sync.station.pacing import Bucket, Caps, Sizer
from sync.station.scheduling import (
    CAUGHT_UP_EVENTS_MAX,
    LIVE_EVENTS_MAX,
    Planned,
    Share,
    Work,
    chosen,
    mark_of,
    works_of,
)

GATE = StreamKey(StreamName.of("brno-2", "gate", "track_point"), 1)
YARD = StreamKey(StreamName.of("brno-2", "yard", "track_point"), 1)
ALERT, POINT = (Entry(stream="*/*/*", priority=priority) for priority in (0, 30))


def at(sequence: int) -> Point:
    return Point(sequence, sequence.to_bytes(32, "big")) if sequence else BEGINNING


def run(after: int, sequence: int) -> Run:
    return Run(after, at(after).chain_hash, sequence, at(sequence).chain_hash)


def ranges(gaps: list[Gap]) -> list[tuple[int, int, bool]]:
    return [(gap.after.sequence, gap.until.sequence, gap.begins_run) for gap in gaps]


def test_gaps_are_what_no_run_holds_and_say_where_a_run_begins() -> None:
    runs = (run(0, 10), run(20, 30), run(50, 60))

    assert ranges(gaps_of(GATE, runs, BEGINNING, at(70))) == [(10, 20, False), (30, 50, False), (60, 70, False)]
    assert ranges(gaps_of(GATE, runs, at(25), at(60))) == [(30, 50, False)]
    assert ranges(gaps_of(GATE, runs, at(40), at(60))) == [(40, 50, True)]
    assert ranges(gaps_of(GATE, (), at(40), at(60))) == [(40, 60, True)]
    assert ranges(gaps_of(GATE, (run(20, 30),), BEGINNING, at(30))) == [(0, 20, False)]
    assert gaps_of(GATE, runs, at(60), at(60)) == []


@given(st.sets(st.integers(1, 12)), st.randoms())
def test_whatever_order_a_stream_is_filled_in_its_runs_are_what_was_sent(chosen_ends: set[int], order: object) -> None:
    ends = sorted({0, 13, *chosen_ends})
    pieces = list(pairwise(ends))
    order.shuffle(pieces)  # type: ignore[attr-defined]
    runs: tuple[Run, ...] = ()
    for number, (low, high) in enumerate(pieces):
        runs = with_range(runs, at(low), at(high))
        assert sum(each.sequence - each.after for each in runs) == sum(b - a for a, b in pieces[: number + 1])
        assert all(before.sequence < after.after for before, after in pairwise(runs))
        assert are_held(runs, low, at(high))
        assert not are_held(runs, low, Point(high, b"another".ljust(32))) or runs[-1].sequence > high
    assert runs == (run(0, 13),)


def test_two_that_agree_in_the_hash_agree_in_every_cursor() -> None:
    one, other = {GATE: (run(0, 5),), YARD: ()}, {YARD: (), GATE: (run(0, 5),)}

    assert cursors_hash(one.items()) == cursors_hash(other.items()) == cursors_hash([(GATE, [run(0, 5)])])
    assert cursors_hash([(GATE, [run(0, 5)])]) != cursors_hash([(GATE, [run(0, 3), run(4, 5)])])


def planned(entry: Entry, head: int, mark: int, start: int = 0) -> Planned:
    return Planned(GATE, entry, at(start), at(head), at(mark))


def works(each: Planned, *runs: Run, may_jump: bool = True) -> list[tuple[int, int, bool, bool]]:
    found = works_of(each, runs, 0, may_jump=may_jump)
    return [(w.gap.after.sequence, w.gap.until.sequence, w.gap.begins_run, w.is_live) for w in found]


def test_what_is_new_of_an_alert_stream_jumps_over_its_backlog() -> None:
    assert works(planned(ALERT, 500, 480), run(0, 100)) == [(100, 480, False, False), (480, 500, True, True)]
    assert works(planned(ALERT, 500, 480), run(0, 100), run(480, 490)) == [
        (100, 480, False, False),
        (490, 500, False, True),
    ]
    assert works(planned(ALERT, 500, 480), run(0, 480)) == [(480, 500, False, True)]
    assert works(planned(ALERT, 500, 480), run(0, 100), may_jump=False) == [(100, 500, False, False)]


def test_a_stream_in_order_is_live_once_it_has_caught_up() -> None:
    assert works(planned(POINT, 500, 480), run(0, 100)) == [(100, 500, False, False)]
    assert works(planned(POINT, 500, 480), run(0, 480)) == [(480, 500, False, True)]
    assert works(planned(POINT, 500, 480), run(100, 480)) == [(0, 100, False, False), (480, 500, False, False)]
    assert works(planned(POINT, 500, 0)) == [(0, 500, False, True)]


def test_a_stream_of_which_little_is_missing_is_simply_gone_on_with() -> None:
    for entry, most in ((ALERT, LIVE_EVENTS_MAX), (POINT, CAUGHT_UP_EVENTS_MAX)):
        assert mark_of(entry, (run(0, 50),), BEGINNING, at(50 + most)) == at(50)
        assert mark_of(entry, (run(0, 50),), BEGINNING, at(51 + most)) == at(51 + most)
        assert mark_of(entry, (), at(90), at(91)) == at(90)


def test_a_gap_is_split_where_a_run_begins() -> None:
    below, above = split(Gap(GATE, at(3), at(9), False), at(5))

    assert ranges([below, above]) == [(3, 5, False), (5, 9, True)]


def work(key: StreamKey, entry: Entry, *, is_live: bool, turn: int = 0, after: int = 0) -> Work:
    return Work(Gap(key, at(after), at(after + 9), False), entry, is_live, turn)


def test_live_work_goes_before_all_backlog_and_lanes_in_order() -> None:
    old_alert, new_point = work(GATE, ALERT, is_live=False), work(YARD, POINT, is_live=True)
    new_alert = work(GATE, ALERT, is_live=True, after=20)

    assert chosen([old_alert, new_point], Share(), 0.2, 1000) == [new_point]
    assert chosen([new_point, old_alert, new_alert], Share(), 0.2, 1000) == [new_alert, new_point]
    assert chosen([old_alert], Share(), 0.2, 1000) == [old_alert]
    assert chosen([], Share(), 0.2, 1000) == []


def test_equals_take_turns_and_of_a_stream_the_first_gap_goes_first() -> None:
    first, second = work(GATE, POINT, is_live=False, turn=2), work(GATE, POINT, is_live=False, turn=2, after=20)
    other = work(YARD, POINT, is_live=False, turn=1)

    assert chosen([second, first, other], Share(), 0.2, 1000) == [other, first]


@given(st.floats(0.0, 0.9), st.lists(st.integers(1, 100_000), min_size=50, max_size=80))
def test_backlog_has_its_share_of_the_bytes_and_live_the_rest(least: float, sizes: list[int]) -> None:
    share = Share()
    both = [work(GATE, ALERT, is_live=True), work(YARD, POINT, is_live=False)]
    sent = {True: 0, False: 0}
    for size in sizes:
        (one,) = chosen(both, share, least, 1000)
        share.sent(size, was_live=one.is_live)
        sent[one.is_live] += size

    assert abs(sent[False] - least * sum(sizes)) <= max(sizes) + 1000


@given(st.floats(1e3, 1e8), st.floats(0.0, 0.1))
def test_a_request_comes_to_take_the_latency_aimed_at_whatever_the_link(bytes_per_s: float, way_s: float) -> None:
    sizer = Sizer(0.3, 1, 2**40)
    for _ in range(200):
        sizer.took(sizer.size, sizer.size / bytes_per_s + way_s)

    seconds = sizer.size / bytes_per_s + way_s
    assert abs(seconds - max(0.3, 2 * way_s)) < 0.02


def test_a_small_request_says_nothing_of_large_ones_and_sizes_are_bounded() -> None:
    sizer = Sizer(0.3, 1000, 8000)
    sizer.took(1000, 0.001)
    assert sizer.size == 4000
    sizer.took(100, 5.0)
    assert sizer.size == 4000
    for _ in range(9):
        sizer.took(sizer.size, 0.001)
    assert sizer.size == 8000
    for _ in range(9):
        sizer.took(sizer.size, 60.0)
    assert sizer.size == 1000


def test_a_cap_is_paid_off_and_live_traffic_goes_ahead_of_it() -> None:
    bucket = Bucket(8000)  # 1,000 bytes a second
    bucket.sent(3000, 100.0)

    assert (bucket.wait_s(100.0), bucket.wait_s(102.0), bucket.wait_s(103.5)) == (3.0, 1.0, 0.0)
    assert bucket.wait_s(100.0, is_live=True) == 0.0
    bucket.sent(9000, 100.0)
    assert (bucket.wait_s(100.0), bucket.wait_s(100.0, is_live=True)) == (12.0, 2.0)


def test_the_narrowest_cap_counts_and_one_that_stays_keeps_its_debt() -> None:
    plan = Plan.of({"rate": "16 kbit/s", "entries": [{"stream": "*/gate/*", "rate": "8 kbit/s"}, {"stream": "*/*/*"}]})
    gate, rest = plan.entries
    caps = Caps()
    caps.follow(plan)
    caps.sent({gate: 2000}, 0.0)

    assert (caps.wait_s(gate, 0.0, is_live=False), caps.wait_s(rest, 0.0, is_live=False)) == (2.0, 1.0)
    caps.follow(plan.model_copy(update={"paused": True}))
    caps.heed(4000)
    caps.sent({rest: 500}, 0.0)
    assert caps.wait_s(rest, 0.0, is_live=False) == 1.25
    assert (caps.bytes_in(rest, 1.0), Caps().bytes_in(rest, 1.0)) == (500, None)


def test_the_beginning_is_where_a_chain_begins() -> None:
    assert Point(0, GENESIS) == BEGINNING
