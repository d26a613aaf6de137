"""FROM: several event types in one pattern, projected and filtered, united by name."""

from itertools import groupby
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from patterns import MatchError, RuleRun, bind, match, parse_rule, run_tests
from tests.patterns.samples import BEGINNING, SCHEMAS, letter_rows
from tests.patterns.test_online import online

AT_A_THEN_B = """\
rule: a-then-b
version: 1
title: "{plate} went from A to B"
severity: info
params: {limit: 60 s}
match: |
  SELECT * FROM (
    SELECT plate, 'A' AS gate, country FROM plate_read WHERE source = 'gate-a'
    UNION ALL BY NAME
    SELECT plate, 'B' AS gate FROM plate_read WHERE source = 'gate-b')
  MATCH_RECOGNIZE (
    PARTITION BY plate ORDER BY time, sequence
    MEASURES a.time AS left_a, b.time - a.time AS took, b.country AS country
    PATTERN (a other*? b) WITHIN INTERVAL '1' HOUR
    DEFINE a AS gate = 'A', b AS b.gate = 'B' AND b.time < a.time + :limit)
tests:
  - name: one in time, one too late, one the other way round
    given:
      - {time: "2026-01-01T10:00:00Z", source: gate-a, plate: P1, country: CZ}
      - {time: "2026-01-01T10:00:01Z", source: gate-a, plate: P2}
      - {time: "2026-01-01T10:00:02Z", source: gate-b, plate: P3}
      - {time: "2026-01-01T10:00:03Z", source: gate-c, plate: P1}
      - {time: "2026-01-01T10:00:59Z", source: gate-b, plate: P1, country: CZ}
      - {time: "2026-01-01T10:01:01Z", source: gate-b, plate: P2}
      - {time: "2026-01-01T10:01:01Z", source: gate-a, plate: P3}
    expect:
      - {plate: P1, left_a: 2026-01-01T10:00:00Z, took: 59 s, country: null}
"""
PLATES = {
    "plate_read": pa.schema([("time", pa.timestamp("us", "UTC")), ("plate", pa.string()), ("country", pa.string())]),
    "track_point": SCHEMAS["track_point"],
    "letter": SCHEMAS["letter"],
}


def test_two_arms_of_one_type_and_columns_that_one_of_them_lacks() -> None:
    (result,) = run_tests(parse_rule(AT_A_THEN_B), PLATES)
    assert result.passed, result.difference


BOTH = """\
rule: both
version: 1
title: both
severity: info
time: {lateness: 2 us}
match: |
  SELECT * FROM (
    SELECT key, n AS value, letter FROM letter WHERE n > 0
    UNION ALL BY NAME SELECT track_id AS key, x * 2 AS value FROM track_point)
  MATCH_RECOGNIZE (
    PARTITION BY key ORDER BY time, sequence
    MEASURES a.value AS first, b.value AS second, a.type AS kind, b.letter AS letter
    PATTERN (a b)
    DEFINE a AS type = 'letter', b AS b.type = 'track_point' AND b.value > a.value)
"""


def points(records: list[dict[str, Any]]) -> pa.Table:
    """Track points: `us`, `track_id`, `x`, `sequence`."""
    table = letter_rows([{"type": "track_point", **record} for record in records]).drop_columns(["key", "letter", "n"])
    table = table.append_column("track_id", pa.array([each["track_id"] for each in records], pa.int64()))
    return table.append_column("x", pa.array([each["x"] for each in records], pa.float32()))


def test_several_types_in_one_pattern_have_one_order_and_numbers_widen() -> None:
    bound = bind(parse_rule(BOTH), PLATES)
    assert bound.types == {"letter", "track_point"}
    letters = letter_rows(
        [{"us": 0, "key": 1, "n": 3, "letter": "a"}, {"us": 2, "key": 2, "n": 0}, {"us": 3, "key": 1, "n": 5}]
    )
    others = points([{"us": 1, "track_id": 1, "x": 4.25}, {"us": 3, "track_id": 2, "x": 9}])
    (found,) = match(bound, pa.concat_tables([letters, others], promote_options="default"))
    assert found.measures == {"first": 3.0, "second": 8.5, "kind": "letter", "letter": None}
    assert {name: ranges[0].stream for name, ranges in found.lineage.items()} == {
        "a": "here/cam-01/letter", "b": "here/cam-01/track_point",
    }  # fmt: skip


def test_of_one_time_the_stream_decides_then_the_sequence() -> None:
    bound = bind(parse_rule(BOTH), PLATES)
    letters = letter_rows([{"us": 5, "key": 1, "n": 1, "sequence": 9}])
    others = points([{"us": 5, "track_id": 1, "x": 4, "sequence": 1}])
    run = RuleRun(bound)
    run.hold(others)
    run.hold(letters)
    assert len(run.finish().matches) == 1, "here/cam-01/letter comes before here/cam-01/track_point"


def test_the_watermark_is_the_least_over_all_sources_that_feed_an_arm() -> None:
    run = RuleRun(bind(parse_rule(BOTH), PLATES))
    run.push(letter_rows([{"us": 0, "key": 1, "n": 1, "source": "cam-01"}]))
    run.push(points([{"us": 100, "track_id": 1, "x": 4, "source": "cam-02"}]))
    assert run.watermark is not None
    assert run.watermark < BEGINNING
    assert len(run.push(letter_rows([{"us": 200, "key": 7, "n": 1, "sequence": 1}])).matches) == 0
    assert len(run.push(points([{"us": 200, "track_id": 7, "x": 0, "source": "cam-02"}])).matches) == 1


def test_rows_that_the_filter_leaves_out_move_the_watermark_and_do_not_wait() -> None:
    run = RuleRun(bind(parse_rule(BOTH), PLATES))
    run.push(letter_rows([{"us": 50, "key": 1, "n": 0}]))
    assert run.rows_waiting == 0
    assert run.watermark is not None
    assert (run.watermark - BEGINNING).microseconds == 48


def test_the_state_of_waiting_rows_of_several_types_is_saved() -> None:
    bound = bind(parse_rule(BOTH), PLATES)
    run = RuleRun(bound)
    run.push(letter_rows([{"us": 0, "key": 1, "n": 3}]))
    run.push(points([{"us": 1, "track_id": 1, "x": 4}]))
    again = RuleRun(bound)
    again.restore(run.state())
    assert again.rows_waiting == 2
    assert again.finish() == run.finish()


def test_a_column_that_an_arm_reads_must_be_there() -> None:
    run = RuleRun(bind(parse_rule(BOTH), PLATES))
    with pytest.raises(MatchError, match="the rule reads the column n, which the rows do not have"):
        run.push(letter_rows([{"us": 0}]).drop_columns(["n"]))


def test_a_test_of_several_types_says_the_type_of_each_row() -> None:
    text = BOTH + "tests:\n  - given: [{time: '2026-01-01T10:00:00Z', key: 1, n: 1}]\n    expect: []\n"
    with pytest.raises(Exception, match="row 1: the rule reads several types, so a row says its `type`: letter, track"):
        run_tests(parse_rule(text), PLATES)


def test_an_arm_that_lets_nothing_through_lets_time_go_on() -> None:
    text = """
rule: no-guard
version: 1
title: no guard
severity: alarm
match: |
  SELECT * FROM (
    SELECT key FROM letter WHERE letter = 'g'
    UNION ALL BY NAME SELECT track_id AS key FROM track_point WHERE FALSE)
  MATCH_RECOGNIZE (
    ORDER BY time MEASURES overdue.time AS missed_at
    PATTERN (guard overdue) DEFINE overdue AS TIMER(guard.time, INTERVAL '10' SECOND))
"""
    run = RuleRun(bind(parse_rule(text), PLATES))
    assert run.push(letter_rows([{"us": 0, "letter": "g"}, {"us": 5_000_000, "letter": "g"}])).matches == ()
    (found,) = run.push(points([{"us": 15_000_001, "track_id": 1, "x": 0}])).matches
    assert (found.measures["missed_at"] - BEGINNING).total_seconds() == 15
    assert run.counts.rows == 2


@st.composite
def mixed(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Letters and track points of two keys and sources in order of time, with ties."""
    steps = st.tuples(
        st.sampled_from([0, 1, 2, 5]), st.sampled_from(["letter", "track_point"]), st.integers(1, 2),
        st.integers(-1, 4), st.sampled_from(["cam-01", "cam-02"]), st.integers(0, 2),
    )  # fmt: skip
    us, rows = 0, []
    for sequence, (step, kind, key, value, source, delay) in enumerate(draw(st.lists(steps, max_size=14))):
        us += step
        row = {"us": us, "type": kind, "sequence": sequence, "source": source, "delay": delay, "key": key, "n": value}
        rows.append(row | {"track_id": key, "x": float(value)})
    return rows


def both(rows: list[dict[str, Any]]) -> list[pa.Table]:
    """The rows as batches of one type each, in order."""
    runs = [list(run) for _, run in groupby(rows, key=lambda row: row["type"])]
    return [points(run) if run[0]["type"] == "track_point" else letter_rows(run) for run in runs]


@settings(max_examples=50)
@given(rows=mixed(), restarts=st.sets(st.integers(0, 8)))
def test_arms_online_give_what_they_give_in_batch(rows: list[dict[str, Any]], restarts: set[int]) -> None:
    bound = bind(parse_rule(BOTH), PLATES)
    whole = RuleRun(bound)
    for table in both(rows):
        whole.hold(table)
    wanted = list(whole.finish().matches)
    arriving = sorted(rows, key=lambda row: row["us"] + row["delay"])
    assert online(bound, both(arriving), restarts) == wanted
