"""Situations as input: typed columns, strata, the end of the input, and that no rule feeds on its own."""

import json

import pytest

from patterns import Rule, RuleError, bind, parse_rule, run_tests
from patterns.binding.strata import in_strata, situation_schema, strata, with_situations
from patterns.processor import Processor, ProcessorLimits, deploy, readable_by, situation_of, stored_mark
from store import Log
from tests.conftest import MakeLog
from tests.patterns.samples import SCHEMAS, letter_rule
from tests.patterns.walkers import STATION, T0, add_video, end, point, rule, say, situations, walk, walkers
from vian.backtesting import Span, backtested

TWICE = """
rule: twice
version: 1
title: "track {track_id} came in twice within {apart}"
severity: warning
match: |
  SELECT * FROM situation('enters') MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES one.entered_at AS first_at, two.x AS x, two.entered_at - one.entered_at AS apart
    PATTERN (one two) DEFINE two AS two.entered_at > one.entered_at AND two.x > 50)
"""
ALL = """
rule: every
version: 1
title: "{name}"
severity: info
match: |
  SELECT * FROM (SELECT rule AS name, severity FROM situation_detected) MATCH_RECOGNIZE (
    ORDER BY time, sequence MEASURES a.name AS name PATTERN (a) DEFINE a AS severity = 'warning')
"""


def _reading(name: str, *others: str) -> Rule:
    arms = " UNION ALL BY NAME ".join(f"SELECT * FROM situation('{other}')" for other in others)
    sql = f"SELECT * FROM ({arms}) MATCH_RECOGNIZE (ORDER BY time PATTERN (A))"
    return Rule(rule=name, version=1, title=name, severity="info", match=sql)


BASE = letter_rule("A", "A AS letter = 'a'", "A.n AS n, A.time AS at").model_copy(update={"rule": "base"})


def test_a_stratum_is_one_above_the_highest_that_is_read() -> None:
    rules = [_reading("top", "middle", "base"), _reading("middle", "base", "elsewhere"), BASE]
    assert strata(rules) == {"base": 0, "middle": 1, "top": 2}
    assert [each.rule for each in in_strata(rules)] == ["base", "middle", "top"]


@pytest.mark.parametrize(
    ("rules", "path"),
    [
        ([_reading("a", "a")], "a reads a"),
        ([_reading("a", "b"), _reading("b", "c"), _reading("c", "b")], "b reads c reads b"),
    ],
)
def test_rules_that_would_feed_on_their_own_situations_are_refused(rules: list[Rule], path: str) -> None:
    with pytest.raises(RuleError, match=f"a rule cannot feed on its own situations: {path}"):
        strata(rules)
    with pytest.raises(RuleError, match=r"a rule cannot feed on its own|no rule"):
        bind(rules[0], SCHEMAS)


def test_the_columns_are_those_of_every_situation_the_partition_and_the_measures() -> None:
    schema = situation_schema(bind(BASE, SCHEMAS))
    assert {name: str(schema.field(name).type) for name in ("key", "n", "at", "title", "began_at")} == {
        "key": "int64", "n": "int64", "at": "timestamp[us, tz=UTC]", "title": "string",
        "began_at": "timestamp[us, tz=UTC]",
    }  # fmt: skip


def test_a_measure_that_the_rule_does_not_have_is_named_with_those_that_it_has() -> None:
    known = with_situations(SCHEMAS, [BASE])
    sql = "SELECT * FROM situation('base') MATCH_RECOGNIZE (ORDER BY time PATTERN (A) DEFINE A AS m > 1)"
    with pytest.raises(RuleError, match="unknown column 'm'; there are: at, began_at, ended_at, key, n"):
        bind(Rule(rule="b", version=1, title="b", severity="info", match=sql), known)


def test_a_rule_over_situations_finds_what_they_say_whenever_it_runs(log: Log) -> None:
    walkers(log, tracks=2, seconds=12)
    low, high = rule(), parse_rule(TWICE)
    Processor(log, STATION, [high, low]).catch_up()
    found = [each for each in situations(log) if each.rule == "twice"]
    lower = [each for each in situations(log) if each.rule == "enters"]
    entered: dict[int, list[str]] = {1: [], 2: []}
    for each in lower:
        entered[json.loads(each.partition)["track_id"]].append(json.loads(each.measures)["entered_at"])
    wanted = [times[at] for times in entered.values() for at in range(0, len(times) - 1, 2)]
    assert len(wanted) > 0
    assert sorted(json.loads(each.measures)["first_at"] for each in found) == sorted(wanted)
    assert {matched.stream for each in found for matched in each.lineage} == {f"{STATION}/gate/situation_detected"}
    again = Processor(log, STATION, [high, low])
    assert again.catch_up() == 0
    assert len([each for each in situations(log) if each.rule == "twice"]) == len(found)


def test_what_a_rule_over_situations_finds_does_not_depend_on_which_others_run(make_log: MakeLog) -> None:
    found = []
    for others in ([], [rule("others")]):
        log = make_log()
        add_video(log, "gate")
        walk(log, range(12), tracks=2)
        Processor(log, STATION, others).catch_up()  # the situations of the others stand in the log before all
        processor = Processor(log, STATION, [*others, rule(), parse_rule(TWICE)])
        processor.catch_up()
        end(log, "gate")
        processor.catch_up()
        found.append([each.measures for each in situations(log) if each.rule == "twice"])
    assert len(found[0]) > 1
    assert found[0] == found[1]


TURNS = TWICE.replace("rule: twice", "rule: turns").replace("source, track_id", "track_id")


@pytest.mark.parametrize("follows", [True, False], ids=["following", "at once"])
def test_a_rule_over_situations_goes_on_while_a_source_of_those_below_lives(log: Log, follows: bool) -> None:
    low, high = rule(partition="track_id"), parse_rule(TURNS)
    deploy(log, STATION, [low, high], {"turns": TURNS}, T0)
    processor = Processor(log, STATION)

    def come() -> None:
        if follows:
            processor.catch_up()

    for source in ("gate", "side"):
        add_video(log, source)
    say(log, "side", point(9, 0, 20))
    say(log, "gate", point(7, 0, 20), point(7, 1, 80), point(7, 2, 20))
    say(log, "gate", point(7, 4, 20))
    say(log, "side", point(9, 4, 20))
    come()
    assert len(situations(log)) == follows
    end(log, "side")
    come()
    say(log, "gate", point(7, 5, 80), point(7, 7, 20))
    come()
    end(log, "gate")
    processor.catch_up()

    stored = [each for each in situations(log) if each.rule == "turns"]
    assert [json.loads(each.measures)["first_at"] for each in stored] == ["2026-01-01T10:00:01+00:00"]
    bound = bind(high, readable_by(log, high))
    found = backtested(log, bound, Span(), ProcessorLimits(), lambda position: None)
    assert [situation_of(each) for each in found.matches] == stored


def test_that_a_rule_over_situations_was_finished_is_remembered_where_it_found_nothing(log: Log) -> None:
    low, high = rule(), parse_rule(TWICE)
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(7, 1, 80))
    end(log, "gate")
    Processor(log, STATION, [low, high]).catch_up()
    assert [each.rule for each in situations(log)] == ["enters"]
    mark = stored_mark(log, STATION, "twice", 1)
    assert mark is not None
    assert (mark.idles, mark.report["rows_waiting"], mark.report["watermark"]) == (1, 0, None)
    Processor(log, STATION, [low, high]).catch_up()
    assert stored_mark(log, STATION, "twice", 1) == mark


def test_a_read_of_all_situations_sees_neither_its_own_nor_those_that_rest_on_situations(log: Log) -> None:
    walkers(log, tracks=2, seconds=12)
    other = parse_rule(ALL.replace("rule: every", "rule: other"))
    Processor(log, STATION, [rule(), parse_rule(TWICE), parse_rule(ALL), other]).catch_up()
    found = situations(log)
    lower = [each for each in found if each.rule == "enters"]
    for name in ("every", "other"):
        told = [json.loads(each.measures)["name"] for each in found if each.rule == name]
        assert told == ["enters"] * len(lower)


def test_deployed_rules_read_each_other_and_a_cycle_is_refused_when_deployed(log: Log) -> None:
    walkers(log, tracks=2, seconds=12)
    low, high = rule(), parse_rule(TWICE)
    deploy(log, STATION, [high, low], {"twice": TWICE}, T0)
    Processor(log, STATION).catch_up()
    assert {each.rule for each in situations(log)} == {"enters", "twice"}
    cycle = [_reading("x", "y"), _reading("y", "x")]
    with pytest.raises(RuleError, match="x reads y reads x"):
        deploy(log, STATION, cycle, {}, T0)


def test_rows_of_a_test_give_measures_as_columns() -> None:
    known = with_situations(SCHEMAS, [BASE])
    text = """
rule: late
version: 1
title: late
severity: info
match: |
  SELECT * FROM situation('base') MATCH_RECOGNIZE (
    PARTITION BY key ORDER BY time MEASURES a.n AS n, b.at AS at PATTERN (a b) DEFINE b AS b.n > a.n)
tests:
  - given:
      - {time: 2026-01-01T10:00:00Z, rule: base, key: 1, n: 3, at: 2026-01-01T09:59:59Z}
      - {time: 2026-01-01T10:00:01Z, rule: another, key: 1, n: 9, at: 2026-01-01T10:00:00Z}
      - {time: 2026-01-01T10:00:01Z, rule: base, key: 1, n: 4, at: 2026-01-01T10:00:00Z}
    expect: [{n: 3, at: 2026-01-01T10:00:00Z}]
"""
    (result,) = run_tests(parse_rule(text), known)
    assert result.passed, result.difference
