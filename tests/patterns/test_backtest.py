"""A backtest says byte for byte what the processor appends, and two versions are compared happening by happening."""

from typing import Any

import pytest

from events import Draft, SituationDetected
from patterns.binding.binder import bind
from patterns.files.loading import parse_rule
from patterns.files.rule import Rule
from patterns.processor import Processor, deploy, drafts_of, readable_by, schemas, situation_of
from patterns.processor.cameras import known_at
from patterns.tools.backtest import CONTROL_TYPES, Backtest, paired
from store import Log
from tests.conftest import MakeLog
from tests.patterns.walkers import STATION, T0, add_video, end, point, rule, say, situations, walkers

COOLED = "{lateness: 1 s}\nemit: {once_per: [source, track_id], cooldown: 5 s}"


def backtested(log: Log, tried: Rule, **span: Any) -> list[Draft]:
    run = Backtest(bind(tried, schemas(log.catalogue)), log.catalogue, **span)
    types = [*run.row_types, *CONTROL_TYPES]
    return [
        draft
        for segment in log.read_all(span.get("after", 0) + 1, types=types)
        for draft in drafts_of(tried, STATION, run.take(segment).matches)
    ]  # fmt: skip


@pytest.mark.parametrize(
    "changed",
    [{}, {"time": COOLED}, {"skip": "SKIP TO NEXT ROW"}, {"partition": "track_id"}, {"pattern": "(outside inside+)"}],
    ids=str,
)
def test_a_backtest_says_byte_for_byte_what_was_appended_online(log: Log, changed: dict[str, str]) -> None:
    walkers(log)
    say(log, "gate", point(9, 30, 20), point(9, 29, 20), point(9, 31, 80), point(9, 28, 80))
    say(log, "gate", point(9, 10, 80))  # too late
    end(log, "gate", 61)
    tried = rule(**changed)
    processor = Processor(log, STATION, [tried])
    processor._subscription._limit = 2
    processor.catch_up()

    stored = list(log.read_all(types=["situation_detected"]))
    drafts = backtested(log, tried)

    assert len(stored) > 1
    assert [(d.stream, d.producer, d.payload) for d in drafts] == [
        (s.stream, s.header.producer, s.payload) for s in stored
    ]


TWICE = """
rule: twice
version: 1
title: "{n} came in"
severity: info
match: |
  SELECT * FROM situation('enters') MATCH_RECOGNIZE (
    PARTITION BY track_id ORDER BY time, sequence
    MEASURES COUNT(*) AS n, LAST(a.x) AS x
    ONE ROW PER MATCH AFTER MATCH SKIP TO NEXT ROW PATTERN (a a))
"""


def test_a_rule_that_reads_situations_is_backtested_over_those_that_the_log_holds(log: Log) -> None:
    walkers(log)
    upper, lower = parse_rule(TWICE), rule()
    deploy(log, STATION, [lower, upper], {}, T0)
    Processor(log, STATION, [lower, upper]).catch_up()

    run = Backtest(bind(upper, readable_by(log, upper)), log.catalogue)
    types = [*run.row_types, *CONTROL_TYPES]
    matches = [each for segment in log.read_all(types=types) for each in run.take(segment).matches]
    matches += run.settle().matches

    stored = [each for each in situations(log) if each.rule == "twice"]
    assert len(stored) > 2
    assert [situation_of(each) for each in matches] == stored


def test_a_rule_that_begins_behind_a_position_knows_the_cameras_from_before_it(make_log: MakeLog) -> None:
    log = make_log()
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(7, 1, 80))
    say(log, "gate", point(7, 2, 20), point(7, 3, 80))
    end(log, "gate")

    assert sum(draft.event_count for draft in backtested(log, rule())) == 2
    assert sum(draft.event_count for draft in backtested(log, rule(), after=2, cameras=known_at(log, 2))) == 1


def found(log: Log, tried: Rule) -> list[SituationDetected]:
    Processor(log, STATION, [tried]).catch_up()
    return [each for each in situations(log) if each.rule == tried.rule]


def test_versions_are_paired_by_partition_and_by_spans_that_share_a_moment(make_log: MakeLog) -> None:
    log = make_log()
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(7, 1, 80), point(8, 1, 20), point(8, 2, 80), point(9, 5, 20))
    say(log, "gate", point(7, 6, 20), point(7, 7, 20), point(7, 8, 80), point(9, 9, 80))
    end(log, "gate")
    one = found(log, rule("one", measures="inside.time AS entered_at"))
    two = found(log, rule("two", pattern="(outside outside inside)", measures="inside.x AS entered_at"))

    pairs = paired(one, two)

    assert [(pair.sides, pair.one.partition) for pair in pairs] == [
        ("only A", '{"source": "gate", "track_id": 7}'),
        ("only A", '{"source": "gate", "track_id": 8}'),
        ("only A", '{"source": "gate", "track_id": 9}'),
        ("both", '{"source": "gate", "track_id": 7}'),
    ]
    assert pairs[-1].differences == ["began_at", "entered_at"]
    assert [pair.sides for pair in paired(two, one)].count("only B") == 3


def test_a_version_differs_in_nothing_from_itself(log: Log) -> None:
    walkers(log)
    events = found(log, rule())
    assert [(pair.sides, pair.differences) for pair in paired(events, events)] == [("both", [])] * len(events)
    assert [pair.sides for pair in paired(events, [])] == ["only A"] * len(events)
    assert paired([], []) == []
