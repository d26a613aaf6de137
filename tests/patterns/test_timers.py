"""TIMER: equal to its definition, online equal to batch, and each thing that it refuses."""

from datetime import timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from patterns import BoundRule, RuleError, RuleRun, bind, check, match, parse_rule
from patterns.processor import Processor, ProcessorLimits
from store import Log
from tests.patterns.examples import examples
from tests.patterns.samples import BEGINNING, SCHEMAS, letter_rows, letter_rule
from tests.patterns.test_online import online, pieces
from tests.patterns.test_processor import STATION, T0, add_video, end, point, say, situations
from tests.patterns.timer_reference import TimedPattern, Tree, matches

A, B, C = (("var", name) for name in "ABC")
TA, TB = ("var", "TA"), ("var", "TB")
LETTERS = {"A": "ad", "B": "bd", "C": "abcd"}
LATENESS_US = 3


def _cat(*parts: Tree) -> Tree:
    return ("cat", parts)


def _rep(body: Tree, least: int, most: int | None, greedy: bool = True) -> Tree:
    return ("rep", body, least, most, greedy)


PATTERNS: dict[str, tuple[str, Tree, int | None]] = {
    "absence": ("A C*? TA", _cat(A, _rep(C, 0, None, False), TA), None),
    "absence of one": ("A B* TA", _cat(A, _rep(B, 0, None), TA), None),
    "the last counts": ("A+ TA", _cat(_rep(A, 1, None), TA), None),
    "came or overdue": ("A (B | TA)", _cat(A, ("alt", (B, TA))), None),
    "it goes on": ("A B* TA C", _cat(A, _rep(B, 0, None), TA, C), None),
    "optional": ("A B+ TA? C", _cat(A, _rep(B, 1, None), _rep(TA, 0, 1), C), None),
    "two timers": ("A B (TA | TB)", _cat(A, B, ("alt", (TA, TB))), None),
    "again and again": ("(A C*? TA)+", _rep(_cat(A, _rep(C, 0, None, False), TA), 1, None), None),
    "one after the other": (
        "A C*? TA B C*? TB",
        _cat(A, _rep(C, 0, None, False), TA, B, _rep(C, 0, None, False), TB),
        None,
    ),
    "within": ("A C*? TA C", _cat(A, _rep(C, 0, None, False), TA, C), 7),
}


def _bound(name: str, after_a: int, after_b: int) -> tuple[BoundRule, TimedPattern]:
    sql, tree, within = PATTERNS[name]
    defines = {
        "A": "letter IN ('a', 'd')", "B": "letter IN ('b', 'd')", "C": "letter IS NOT NULL",
        "TA": f"TIMER(A.time, INTERVAL '{after_a}' MICROSECOND)",
        "TB": f"TIMER(B.time, INTERVAL '{after_b}' MICROSECOND)",
    }  # fmt: skip
    used = [variable for variable in defines if variable in sql.replace("(", " ").replace(")", " ").translate(
        {ord(sign): " " for sign in "?*+|"}).split()]  # fmt: skip
    rule = letter_rule(
        sql, ", ".join(f"{variable} AS {defines[variable]}" for variable in used), "COUNT(*) AS n",
        within=f"INTERVAL '{within}' MICROSECOND" if within else "", more=f"time: {{lateness: {LATENESS_US} us}}",
    )  # fmt: skip
    timers = {each: timer for each, timer in (("TA", ("A", after_a)), ("TB", ("B", after_b))) if each in used}
    return bind(rule, SCHEMAS), TimedPattern(tree, LETTERS, timers, within)


@st.composite
def records(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Rows of two keys and two sources in order of time, with ties and gaps."""
    drawn = draw(
        st.lists(
            st.tuples(
                st.sampled_from([0, 1, 1, 2, 3, 8]), st.integers(0, 1), st.sampled_from("abcd"),
                st.sampled_from(["cam-01", "cam-02"]), st.integers(0, LATENESS_US),
            ),
            max_size=14,
        )
    )  # fmt: skip
    us, rows = 0, []
    for index, (step, key, letter, source, delay) in enumerate(drawn):
        us += step
        row = {"us": us, "key": key, "letter": letter, "source": source, "sequence": index, "delay": delay}
        rows.append(row)
    return sorted(rows, key=lambda row: (row["us"], row["source"], row["sequence"]))


@examples(0.0125)  # for each of the patterns
@given(rows=records(), after_a=st.integers(1, 5), after_b=st.integers(1, 5))
@pytest.mark.parametrize("name", PATTERNS)
def test_the_engine_finds_what_the_definition_finds(
    name: str, rows: list[dict[str, Any]], after_a: int, after_b: int
) -> None:
    bound, pattern = _bound(name, after_a, after_b)
    wanted = [(key_of(mapped), _times(mapped)) for mapped in matches(pattern, rows)]
    found = match(bound, letter_rows(rows))
    got = [(each.partition["key"], (_us(each.first.time), _us(each.last.time), each.measures["n"])) for each in found]
    assert sorted(got) == sorted(wanted)


def key_of(mapped: Any) -> Any:
    return mapped[0][1]["key"]


def _times(mapped: Any) -> tuple[int, int, int]:
    return mapped[0][1]["us"], mapped[-1][1]["us"], len(mapped)


def _us(time: Any) -> int:
    return (time - BEGINNING) // (time - time).resolution


@examples(0.0075)  # for each of the patterns
@given(
    rows=records(), cuts=st.lists(st.integers(0, 100), max_size=6), restarts=st.sets(st.integers(0, 6)),
    is_shuffled=st.booleans(), after_a=st.integers(1, 5),
)  # fmt: skip
@pytest.mark.parametrize("name", PATTERNS)
def test_any_split_restart_and_order_of_arrival_gives_what_batch_gives(
    name: str, rows: list[dict[str, Any]], cuts: list[int], restarts: set[int], is_shuffled: bool, after_a: int
) -> None:
    bound, _ = _bound(name, after_a, 3)
    arriving = sorted(rows, key=lambda row: row["us"] + row["delay"]) if is_shuffled else rows
    found = online(bound, [letter_rows(piece) for piece in pieces(arriving, cuts)], restarts)
    assert found == match(bound, letter_rows(rows))


def _overdue(pattern: str = "came any*? overdue", **arguments: Any) -> BoundRule:
    define = "came AS letter = 'a', overdue AS TIMER(came.time, INTERVAL '10' SECOND)"
    return bind(
        letter_rule(pattern, define, "overdue.time AS at, overdue.n AS n, COUNT(*) AS many", **arguments), SCHEMAS
    )


def _row(second: float, letter: str = "c", **more: Any) -> dict[str, Any]:
    return {"us": round(second * 1e6), "letter": letter, "n": 1, "sequence": round(second * 10), **more}


def test_a_timer_fires_when_the_watermark_passes_it_whoever_moves_it() -> None:
    run = RuleRun(_overdue(more="time: {lateness: 2 s}"))
    assert run.push(letter_rows([_row(0, "a")])).matches == ()
    assert run.push(letter_rows([_row(12, key=9)])).matches == (), "the watermark is at 10 s, not past it"
    (found,) = run.push(letter_rows([_row(12.1, key=9)])).matches
    assert found.measures == {"at": found.last.time, "n": None, "many": 2}
    assert (found.last.time - found.first.time).total_seconds() == 10
    assert found.decided_at == found.last.time
    assert run.partitions_open == 0


def test_the_lineage_of_a_virtual_row_is_the_row_that_set_it() -> None:
    rows = [_row(0, "a"), _row(5), _row(11, key=9)]
    (found,) = match(_overdue(), letter_rows(rows))
    assert [(each.first_sequence, each.last_sequence, each.rows) for each in found.lineage["overdue"]] == [(0, 0, 1)]
    assert found.last.sequence == 0


def test_a_timer_beyond_the_newest_event_does_not_happen() -> None:
    assert match(_overdue(), letter_rows([_row(0, "a"), _row(9.9)])) == []
    assert len(match(_overdue(), letter_rows([_row(0, "a"), _row(10)]))) == 1


def test_a_real_row_of_the_same_time_comes_first() -> None:
    bound = _overdue("came (left | overdue)")
    assert [found.measures["many"] for found in match(bound, letter_rows([_row(0, "a"), _row(10, key=7)]))] == [2]
    left = match(bound, letter_rows([_row(0, "a"), _row(10, "b")]))
    assert [found.measures["at"] for found in left] == [None], "left has no condition and takes the row of 10 s"


def test_a_silent_source_is_noticed_by_idle_time() -> None:
    run = RuleRun(_overdue(more="time: {lateness: 0 s, idle: 30 s}"))
    run.push(letter_rows([_row(0, "a"), _row(0, "c", source="cam-02", key=2)]))
    run.advance_idle(BEGINNING)
    assert run.push(letter_rows([_row(60, source="cam-02", key=2)])).matches == (), "cam-01 holds the watermark"
    assert len(run.advance_idle(BEGINNING.replace(minute=1)).matches) == 1


def test_other_conditions_beside_a_timer_hold_too() -> None:
    define = "came AS letter = 'a', late AS TIMER(came.time, INTERVAL '2' SECOND) AND COUNT(x.*) > 1 AND came.n = 1"
    bound = bind(letter_rule("came x* late", define), SCHEMAS)
    one, two = [_row(0, "a"), _row(1)], [_row(0, "a"), _row(1), _row(1.5)]
    assert [len(match(bound, letter_rows([*rows, _row(9, key=7)]))) for rows in (one, two)] == [0, 1]


def test_the_columns_of_a_virtual_row_are_null_but_time_type_and_partition() -> None:
    measures = "overdue.key AS key_too, overdue.type AS kind, overdue.source AS source, PREV(overdue.n) AS before"
    define = "came AS letter = 'a', overdue AS TIMER(came.time, INTERVAL '1' SECOND) AND letter IS NULL"
    bound = bind(letter_rule("came overdue", define, measures), SCHEMAS)
    (found,) = match(bound, letter_rows([_row(0, "a", key=4), _row(2, key=7)]))
    assert found.measures == {"key_too": 4, "kind": "timer", "source": None, "before": None}


HEAD = "came AS letter = 'a', overdue AS "


@pytest.mark.parametrize(
    ("define", "wanted"),
    [
        ("TIMER(came.time)", "DEFINE: wanted TIMER(variable.time, duration), got 1 arguments"),
        ("TIMER(came.time, 10)", "DEFINE: TIMER: wanted a constant duration above zero"),
        ("TIMER(came.time, INTERVAL '0' SECOND)", "DEFINE: TIMER: wanted a constant duration above zero"),
        ("TIMER(came.time, came.gap)", "DEFINE: TIMER: wanted a constant duration above zero"),
        ("TIMER(came.n, INTERVAL '1' SECOND)", "it counts from a variable's last row"),
        ("TIMER(FIRST(came.time), INTERVAL '1' SECOND)", "it counts from a variable's last row"),
        ("TIMER(overdue.time, INTERVAL '1' SECOND)", "DEFINE: TIMER counts from a row of another variable"),
        ("TIMER(time, INTERVAL '1' SECOND)", "DEFINE: TIMER counts from a row of another variable"),
        ("NOT TIMER(came.time, INTERVAL '1' SECOND)", "with AND, not under another operator"),
        ("TIMER(came.time, INTERVAL '1' SECOND) OR came.n = 1", "with AND, not under another operator"),
        ("n = 1 AND (flag OR TIMER(came.time, INTERVAL '1' SECOND))", "with AND, not under another operator"),
    ],
)
def test_what_a_timer_is_not_is_refused(define: str, wanted: str) -> None:
    with pytest.raises(RuleError) as caught:
        bind(letter_rule("came overdue", HEAD + define), SCHEMAS)
    assert wanted in caught.value.message


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ({"pattern": "overdue came"}, "PATTERN: no match begins at a virtual row"),
        ({"pattern": "came overdue $"}, "PATTERN: $ asks for the partition's last row"),
        ({"pattern": "came overdue", "skip": "TO LAST overdue"}, "AFTER MATCH SKIP: overdue has TIMER"),
        ({"pattern": "came overdue", "measures": "TIMER(came.time, INTERVAL '1' SECOND) AS x"},
         "MEASURES: TIMER has a meaning in DEFINE only"),
    ],
)  # fmt: skip
def test_where_a_timer_has_no_meaning_it_is_refused(arguments: dict[str, str], wanted: str) -> None:
    with pytest.raises(RuleError) as caught:
        bind(letter_rule(define=HEAD + "TIMER(came.time, INTERVAL '1' SECOND)", **arguments), SCHEMAS)
    assert wanted in caught.value.message


def test_a_within_not_longer_than_the_timer_is_warned_of() -> None:
    define = HEAD + "TIMER(came.time, INTERVAL '10' SECOND)"
    for within, warned in (("10", True), ("11", False)):
        findings = check(letter_rule("came overdue", define, within=f"INTERVAL '{within}' SECOND"), SCHEMAS)
        assert any("WITHIN is not longer than TIMER" in finding.message for finding in findings) is warned


@pytest.mark.parametrize(
    ("pattern", "warned"), [("came x*? overdue", False), ("x came overdue", True), ("came overdue x", True)]
)
def test_a_timer_that_ends_every_partial_match_needs_no_within(pattern: str, warned: bool) -> None:
    define = HEAD + "TIMER(came.time, INTERVAL '10' SECOND)"
    findings = check(letter_rule(pattern, define), SCHEMAS)
    assert any("without WITHIN" in finding.message for finding in findings) is warned


OVERDUE = """
rule: overdue
version: 1
title: "track {track_id} did not come back"
severity: alarm
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES gone.time AS gone_at
    PATTERN (gone away*? overdue)
    DEFINE gone AS x > 50, away AS x > 50, overdue AS TIMER(gone.time, INTERVAL '5' SECOND))
"""


def test_a_timer_fires_once_over_a_log_with_a_restart_at_each_segment(log: Log) -> None:
    add_video(log, "gate")
    add_video(log, "yard")
    for second, (x, other) in enumerate([(20, 20), (80, 80), (80, 20), (20, 20)]):
        say(log, "gate", point(1, second, x), point(2, second, other))
        say(log, "yard", point(3, second, 20))
    for second in range(4, 10):
        say(log, "yard", point(3, second, 20))
    say(log, "gate", point(4, 2, 80))
    end(log, "gate")
    for second in (10, 11):
        say(log, "yard", point(3, second, 80))
    rule = parse_rule(OVERDUE.replace("title", "time: {lateness: 2 s}\ntitle"))
    position = -1
    while True:
        processor = Processor(log, STATION, [rule], limits=ProcessorLimits(segments=1))
        step = processor.step()
        processor.close()
        if step.is_caught_up and step.position == position:
            break
        position = step.position
    (found,) = situations(log)
    assert (found.title, found.time) == ("track 4 did not come back", T0 + timedelta(seconds=7))
    assert [(each.variable, each.stream) for each in found.lineage] == [
        ("gone", f"{STATION}/gate/track_point"), ("overdue", f"{STATION}/gate/track_point"),
    ]  # fmt: skip
