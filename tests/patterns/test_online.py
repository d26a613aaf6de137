"""Online equals batch: in any split, with any restart, in any order of arrival within the lateness."""

from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from patterns import BoundRule, Limits, Match, RuleRun, bind, match
from tests.patterns.examples import examples
from tests.patterns.samples import BEGINNING, SCHEMAS, define_letters, letter_rows, letter_rule

LATENESS_US = 4
MORE = f"time: {{lateness: {LATENESS_US} us}}"
RULES = {
    "greedy": letter_rule("A+ B?", "A AS letter = 'a', B AS letter = 'b'", "COUNT(A.*) AS many", more=MORE),
    "window": letter_rule(
        "A X*? B", "A AS letter = 'a', B AS letter = 'b'", "B.time - A.time AS took, LAST(X.n) AS n",
        within="INTERVAL '6' MICROSECOND", more=MORE,
    ),
    "overlapping": letter_rule(
        "A B{1,2}", "A AS letter = 'a'", "B.n AS n", skip="TO NEXT ROW", within="INTERVAL '5' MICROSECOND", more=MORE
    ),
    "to last": letter_rule("X Y", "Y AS n > PREV(n)", "Y.n - X.n AS rise", skip="TO LAST Y", more=MORE),
    "looking back": letter_rule("A", "A AS letter <> PREV(letter, 2)", "PREV(A.letter) AS before", more=MORE),
    "one back": letter_rule("A", "A AS n > PREV(n)", "PREV(A.n) AS n", more=MORE),
    "remembering": letter_rule(
        "A B* C", "B AS n >= A.n, C AS n < FIRST(A.n) AND COUNT(B.*) > 0", "FIRST(B.n) AS n", more=MORE
    ),
    "blocked": letter_rule("A (X* C)?", "A AS letter = 'a', C AS letter = 'c'", "C.n AS n", more=MORE),
    "cooled": letter_rule(
        "A", "A AS letter = 'a'", "A.n AS n",
        more="time: {lateness: 4 us}\nemit: {cooldown: 3 us}",
    ),
    "once": letter_rule(
        "A B", "A AS letter = 'a'", "B.letter AS letter",
        more="time: {lateness: 4 us}\nemit: {once_per: [letter]}",
    ),
    "unpartitioned": letter_rule("A B", "A AS letter = 'a', B AS n > A.n", "B.n AS n", partition="", more=MORE),
    "looking ahead": letter_rule("A", "A AS letter <> NEXT(letter)", "NEXT(A.letter, 2) AS after", more=MORE),
    "rising next": letter_rule(
        "A B* C", "A AS letter = 'a', B AS letter <> NEXT(letter), C AS letter = 'c' OR C.n < NEXT(A.n)",
        "NEXT(B.n) AS after, NEXT(FIRST(B.n), 2) AS later", skip="TO NEXT ROW", more=MORE,
    ),
    "ahead in a window": letter_rule(
        "A X*? B", "A AS letter = 'a', B AS letter = 'b' AND NEXT(letter, 2) <> 'a'",
        "NEXT(B.n) AS n, PREV(A.n) AS before", within="INTERVAL '6' MICROSECOND", more=MORE,
    ),
    "window of those ahead": letter_rule(
        "A B*", "A AS letter = 'a' AND NEXT(n) > 0, B AS NEXT(B.n) >= 0", "COUNT(B.*) AS many",
        within="INTERVAL '4' MICROSECOND", skip="TO NEXT ROW", more=MORE,
    ),
    "ahead of a timer": letter_rule(
        "A X*? (B | T)", "A AS letter = 'a', X AS NEXT(n) <> 2, B AS letter = 'b' AND NEXT(letter) = 'b', "
        "T AS TIMER(A.time, INTERVAL '3' MICROSECOND)", "T.time AS due, NEXT(X.n) AS n", more=MORE,
    ),
    "the last in a window": letter_rule(
        "A B* $ | A B{1,2}?", "A AS letter = 'a', B AS letter <> 'c'", "COUNT(B.*) AS many",
        within="INTERVAL '5' MICROSECOND", skip="TO NEXT ROW", more=MORE,
    ),
    "the last or one of those ahead": letter_rule(
        "A B* $ | A B", "A AS letter = 'a', B AS NEXT(letter) <> 'c' OR NEXT(letter) IS NULL", "LAST(B.n) AS n",
        within="INTERVAL '5' MICROSECOND", more=MORE,
    ),
    "numbered": letter_rule(
        "A B?", "A AS letter = 'a', B AS letter = 'b'", "MATCH_NUMBER() AS number, FIRST(n + MATCH_NUMBER()) AS sum",
        more=MORE,
    ),
    "numbered with empty ones": letter_rule(
        "(A B?)?", "A AS letter = 'a', B AS letter = 'b' AND NEXT(n) > 0", "MATCH_NUMBER() AS number",
        skip="TO NEXT ROW", within="INTERVAL '5' MICROSECOND", more=MORE,
    ),
    "filtered": letter_rule("A B", "B AS n > PREV(n)", "B.n AS n", more=MORE),
}  # fmt: skip

Record = dict[str, Any]


@st.composite
def records(draw: st.DrawFn) -> list[Record]:
    """Rows of two keys and two sources in order of time, with ties."""
    rows = draw(
        st.lists(
            st.tuples(
                st.sampled_from([0, 1, 1, 2, 3, 9]),
                st.integers(0, 1),
                st.sampled_from("abc"),
                st.one_of(st.none(), st.integers(0, 3)),
                st.sampled_from(["cam-01", "cam-02"]),
                st.integers(0, LATENESS_US),
            ),
            max_size=16,
        )
    )
    us = 0
    result = []
    for index, (step, key, letter, n, source, delay) in enumerate(rows):
        us += step
        result.append(
            {"us": us, "key": key, "letter": letter, "n": n, "source": source, "sequence": index, "delay": delay}
        )
    return result


def pieces(rows: list[Record], cuts: list[int]) -> list[list[Record]]:
    bounds = [0, *sorted(cut % (len(rows) + 1) for cut in cuts), len(rows)]
    return [rows[begin:end] for begin, end in pairwise(bounds)]


def online(bound: BoundRule, pieces: Sequence[pa.Table], restarts: set[int]) -> list[Match]:
    """What the rule finds in rows that come piece by piece, none of them late, with restarts after some pieces."""
    run = RuleRun(bound)
    found: list[Match] = []
    for index, piece in enumerate(pieces):
        outcome = run.push(piece)
        assert outcome.late == ()
        found += outcome.matches
        if index in restarts:
            state = run.state()
            run = RuleRun(bound)
            run.restore(state)
            assert run.state() == state
    return [*found, *run.finish().matches]


@examples(0.0225)  # for each of the rules
@given(
    rows=records(), cuts=st.lists(st.integers(0, 100), max_size=6), restarts=st.sets(st.integers(0, 6)),
    is_shuffled=st.booleans(),
)  # fmt: skip
@pytest.mark.parametrize("name", RULES)
def test_any_split_restart_and_order_of_arrival_gives_what_batch_gives(
    name: str, rows: list[Record], cuts: list[int], restarts: set[int], is_shuffled: bool
) -> None:
    arriving = sorted(rows, key=lambda row: row["us"] + row["delay"]) if is_shuffled else rows
    bound = bind(RULES[name], SCHEMAS)
    wanted = match(bound, letter_rows(rows))
    assert online(bound, [letter_rows(piece) for piece in pieces(arriving, cuts)], restarts) == wanted


def _run(more: str = "time: {lateness: 2 s}", **arguments: str) -> RuleRun:
    rule = letter_rule("A B", "A AS letter = 'a', B AS letter = 'b'", "B.n AS n", more=more, **arguments)
    return RuleRun(bind(rule, SCHEMAS))


def _row(second: float, letter: str = "a", source: str = "cam-01", sequence: int | None = None, **more: Any) -> Record:
    return {
        "us": round(second * 1e6), "letter": letter, "source": source, "n": 1,
        "sequence": round(second) if sequence is None else sequence, **more,
    }  # fmt: skip


def _push(run: RuleRun, *rows: Record) -> list[Match]:
    return list(run.push(letter_rows(rows)).matches)


def test_a_row_is_final_only_below_the_watermark() -> None:
    run = _run()
    assert _push(run, _row(0, "a"), _row(1, "b")) == []
    assert _push(run, _row(3, "c")) == [], "watermark 1 s: the row of 1 s is not below it"
    (found,) = _push(run, _row(3.5, "c"))
    assert (found.first.sequence, found.last.sequence) == (0, 1)
    assert found.decided_at == found.last.time


def test_rows_in_time_are_sorted_and_late_rows_are_reported_not_lost() -> None:
    run = _run()
    _push(run, _row(10, "b"))
    assert run.push(letter_rows([_row(8, "a")])).late == (), "exactly the lateness old is in time"
    outcome = run.push(letter_rows([_row(7.9, "a", sequence=3)]))
    (late,) = outcome.late
    assert (late.stream, late.sequence) == ("here/cam-01/letter", 3)
    assert (run.counts.late, run.counts.rows) == (1, 2)
    assert len(run.finish().matches) == 1


def test_rows_of_one_push_are_judged_by_the_watermark_before_it() -> None:
    run = _run()
    assert run.push(letter_rows([_row(100, "b"), _row(0, "a")])).late == ()


def test_the_slowest_live_source_holds_the_watermark() -> None:
    run = _run(partition="source")
    _push(run, _row(0, "a"), _row(0, "a", "cam-02"))
    assert _push(run, _row(1, "b"), _row(50, "c")) == []
    (found,) = run.source_ended("cam-02").matches
    assert found.partition == {"source": "cam-01"}


def test_when_every_source_has_ended_the_input_has_and_begins_anew() -> None:
    run = _run()
    _push(run, _row(50, "a"), _row(51, "b"))
    assert run.source_ended("nobody").matches == ()
    assert len(run.source_ended("cam-01").matches) == 1
    assert run.watermark is None
    assert run.push(letter_rows([_row(0, "a"), _row(1, "b")])).late == (), "an older recording follows"
    assert len(run.source_ended("cam-01").matches) == 1


def test_a_silent_source_stops_holding_the_watermark_until_it_speaks() -> None:
    run = _run("time: {lateness: 1 s, idle: 30 s}")
    _push(run, _row(0, "a", "cam-02"), _row(0, "a"), _row(1, "b"), _row(9, "c"))
    base = letter_rows([_row(0)]).column("time")[0].as_py()
    seconds = base.__class__.resolution * 1_000_000
    assert run.advance_idle(base).matches == ()
    assert run.advance_idle(base + 20 * seconds).matches == ()
    _push(run, _row(9.5, "c"))
    run.advance_idle(base + 25 * seconds)
    (found,) = run.advance_idle(base + 40 * seconds).matches
    assert found.measures == {"n": 1}
    assert run.rows_waiting == 2, "cam-01 spoke 15 s ago and holds its lateness"
    run.advance_idle(base + 60 * seconds)
    assert run.rows_waiting == 0, "all are silent: what has come is final"
    late = run.push(letter_rows([_row(3, "a", "cam-02")])).late
    assert len(late) == 1


def test_without_idle_a_silent_source_holds_for_ever() -> None:
    run = _run()
    _push(run, _row(0, "a"), _row(1, "b"))
    time = letter_rows([_row(0)]).column("time")[0].as_py()
    assert run.advance_idle(time).matches == ()
    assert run.advance_idle(time.replace(year=2030)).matches == ()
    assert run.rows_waiting == 2


def test_rows_of_other_types_move_the_watermark_only() -> None:
    run = _run()
    _push(run, _row(0, "a"), _row(1, "b"))
    other = letter_rows([_row(9, "a", type="track_ended")]).drop_columns(["letter", "n", "key"])
    assert len(run.push(other).matches) == 1
    assert run.counts.rows == 2


def test_a_match_that_time_decides_is_found_without_another_row_of_its_partition() -> None:
    rule = letter_rule("A+", "A AS letter = 'a'", within="INTERVAL '5' SECOND", more="time: {lateness: 0 s}")
    run = RuleRun(bind(rule, SCHEMAS))
    assert _push(run, _row(0, "a", key=1), _row(1, "a", key=1)) == []
    assert _push(run, _row(4.9, "b", key=2)) == []
    (found,) = _push(run, _row(5, "b", key=2))
    assert found.decided_at is not None
    assert (found.decided_at - found.first.time).total_seconds() == 5
    assert run.partitions_open == 0


def test_a_cooldown_lasts_over_pushes_and_restarts() -> None:
    more = "time: {lateness: 0 s}\nemit: {cooldown: 10 s}"
    bound = bind(letter_rule("A", "A AS letter = 'a'", more=more), SCHEMAS)
    found: list[int] = []
    run = RuleRun(bound)
    for second in range(0, 40, 3):
        found += [match.first.sequence for match in _push(run, _row(second, "a"))]
        state = run.state()
        run = RuleRun(bound)
        run.restore(state)
    assert found == [0, 12, 24, 36]


def test_a_row_before_the_match_is_remembered_for_prev() -> None:
    bound = bind(letter_rule("A", "A AS n > PREV(n)", more="time: {lateness: 0 s}"), SCHEMAS)
    run = RuleRun(bound)
    found: list[int] = []
    for second, n in enumerate([1, 2, 2, 3, 0]):
        found += [match.first.sequence for match in _push(run, {**_row(second), "n": n})]
    assert found == [1, 3]


def test_a_row_waits_for_the_row_that_it_looks_ahead_to_and_what_it_decides_is_decided_by_that() -> None:
    rule = letter_rule("A", "A AS letter = 'a' AND n < NEXT(n)", "NEXT(n) AS after", more="time: {lateness: 0 s}")
    run = RuleRun(bind(rule, SCHEMAS))
    assert _push(run, {**_row(0, "a"), "n": 1}, {**_row(1, "b", sequence=7), "key": 1}) == []
    assert (run.rows_waiting, run.partitions_open) == (1, 1), "the first is final, and its partition has no other"
    assert _push(run, {**_row(30, "c"), "n": 4}) == []
    (found,) = _push(run, _row(31, "c"))
    assert (found.first.sequence, found.measures, found.decided_at) == (0, {"after": 4}, _time(30))
    assert run.partitions_open == 0, "no row of another letter has to wait"


def test_a_row_that_no_variable_with_next_could_take_does_not_wait() -> None:
    rule = letter_rule("A B", "A AS letter = 'a', B AS letter = 'b' AND NEXT(n) > 0", more="time: {lateness: 0 s}")
    run = RuleRun(bind(rule, SCHEMAS))
    for second in range(20):
        _push(run, _row(second, "c", key=second))
    assert run.partitions_open == 0


def test_a_window_that_is_over_waits_for_the_row_before_its_end_that_waits_itself() -> None:
    rule = letter_rule(
        "A B*", "A AS letter = 'a', B AS NEXT(letter) = 'b'", "COUNT(*) AS many",
        within="INTERVAL '5' SECOND", more="time: {lateness: 0 s}",
    )  # fmt: skip
    run = RuleRun(bind(rule, SCHEMAS))
    assert _push(run, _row(0, "a"), _row(2, "c")) == []
    assert _push(run, _row(50, "c", key=1, sequence=9)) == [], "the row of 2 s may be a B yet"
    (found,) = _push(run, _row(60, "b"), _row(61, "c", key=1, sequence=10))
    assert (found.measures, found.decided_at) == ({"many": 2}, _time(60))


def test_the_row_after_a_window_says_that_the_one_before_was_not_the_last() -> None:
    rule = letter_rule(
        "A B* $ | A", "A AS letter = 'a', B AS letter = 'b'", "COUNT(*) AS many",
        within="INTERVAL '5' SECOND", more="time: {lateness: 0 s}",
    )  # fmt: skip
    run = RuleRun(bind(rule, SCHEMAS))
    rows = [_row(0, "a"), _row(1, "b"), _row(20, "a"), _row(21, "b")]
    assert _push(run, *rows[:2], _row(10, "c", key=1, sequence=9)) == [], "nothing says that it ended there"
    (first,) = _push(run, *rows[2:], _row(90, "c", key=1, sequence=10))
    assert (first.measures, first.decided_at) == ({"many": 1}, _time(20))
    (last,) = run.finish().matches
    assert (last.measures, last.decided_at) == ({"many": 2}, None)


def test_matches_are_numbered_until_their_partition_is_given_up() -> None:
    bound = bind(letter_rule("A", "A AS letter = 'a'", "MATCH_NUMBER() AS n", more="time: {lateness: 0 s}"), SCHEMAS,
                 limits=Limits(expiry=timedelta(seconds=16)))  # fmt: skip
    run, found = RuleRun(bound), []
    for second in (0, 1, 2, 3, 60, 61, 62):
        found += [match.measures["n"] for match in _push(run, _row(second, "a"))]
        state = run.state()
        run = RuleRun(bound)
        run.restore(state)
    assert found == [1, 2, 3, 4, 1, 2]


def _time(second: float) -> datetime:
    return BEGINNING + timedelta(seconds=second)


def test_matches_leave_in_the_order_in_which_they_were_decided() -> None:
    # At 5 s time itself decides the match of key 1, before the row of 5 s decides that of key 2.
    more = "time: {lateness: 0 s}"
    rule = letter_rule("A+ B?", define_letters("AB"), within="INTERVAL '5' SECOND", more=more)
    bound = bind(rule, SCHEMAS)
    rows = [_row(0, "a", key=1), _row(4, "a", key=2), _row(5, "b", key=2), _row(6, "c", key=3)]
    assert [found.partition["key"] for found in match(bound, letter_rows(rows))] == [1, 2]
    run = RuleRun(bound)
    assert [found.partition["key"] for row in rows for found in _push(run, row)] == [1, 2]


def test_partitions_with_nothing_open_are_forgotten() -> None:
    run = _run("time: {lateness: 0 s}")
    for second in range(20):
        _push(run, _row(second, "c", key=second))
    assert run.partitions_open == 0
    _push(run, _row(30, "a", key=1), _row(31, "c", key=2))
    assert run.partitions_open == 1


def test_empty_pushes_change_nothing() -> None:
    run = _run()
    assert run.push(letter_rows([])).matches == ()
    assert run.push(letter_rows([]).to_batches()[0] if letter_rows([]).to_batches() else letter_rows([])).late == ()
    assert run.watermark is None
    assert run.finish().matches == ()
