"""The online processor over a real log: exactly once, in any split, whatever fails when."""

import json
import logging
from datetime import UTC, datetime, timedelta
from typing import Any

import psycopg
import pytest

from events import PlateRead, Producer, StreamName
from patterns import parse_rule
from patterns.errors import PatternError
from patterns.processor import Processor, ProcessorLimits, deploy, schemas
from store import Log, LogUnavailable, Transaction
from tests.conftest import MakeLog
from tests.patterns.walkers import (
    STATION,
    T0,
    add_video,
    end,
    heads,
    point,
    rule,
    said,
    say,
    situations,
    walkers,
)


@pytest.fixture
def walked(make_log: MakeLog) -> tuple[Log, list[Any]]:
    """A log in which the rule has run at once, undisturbed, and what came of it."""
    log = make_log()
    walkers(log)
    Processor(log, STATION, [rule()]).catch_up()
    assert len(situations(log)) == 8
    return log, heads(log)


def test_a_situation_carries_rule_partition_measures_and_its_events(make_log: MakeLog) -> None:
    log = make_log()
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(8, 0, 20), point(7, 1, 80), point(7, 2, 80))
    end(log, "gate")
    entering = rule()

    assert Processor(log, STATION, [entering]).catch_up() == 1

    (found,) = situations(log)
    assert (found.rule, found.rule_version, found.rule_hash) == ("enters", 1, entering.hash)
    assert found.title == "track 7 came in"
    assert json.loads(found.partition) == {"source": "gate", "track_id": 7}
    assert json.loads(found.measures) == {"entered_at": "2026-01-01T10:00:01+00:00", "x": 80.0}
    assert (found.began_at, found.ended_at) == (T0, T0 + timedelta(seconds=1))
    assert [(r.variable, r.stream, r.first_sequence, r.last_sequence, r.events) for r in found.lineage] == [
        ("outside", "brno/gate/track_point", 1, 1, 1),
        ("inside", "brno/gate/track_point", 3, 3, 1),
    ]
    (segment,) = log.read_all(types=["situation_detected"])
    assert segment.header.producer == Producer("rule/enters", "1", bytes.fromhex(entering.hash))


def test_following_live_finds_what_running_over_history_finds(make_log: MakeLog, walked: tuple[Log, list[Any]]) -> None:
    log = make_log()
    processor = Processor(log, STATION, [rule()])
    add_video(log, "gate")
    processor.catch_up()
    for second in range(12):
        inside = [(track + second) % 4 < 2 for track in range(3)]
        say(log, "gate", *(point(t + 1, second, 80 if i else 20) for t, i in enumerate(inside)))
        processor.catch_up()
    end(log, "gate")
    processor.catch_up()

    assert heads(log) == walked[1]


def test_a_new_processor_for_every_segment_finds_the_same(make_log: MakeLog, walked: tuple[Log, list[Any]]) -> None:
    log = make_log()
    walkers(log)
    position, last = 0, log.head()
    while position < last:
        processor = Processor(log, STATION, [rule()], limits=ProcessorLimits(segments=1))
        processor.step()
        position = processor.position
        processor.close()

    assert heads(log) == walked[1]


def test_a_position_is_told_only_once_what_was_found_up_to_it_is_in_the_log(make_log: MakeLog) -> None:
    log = make_log()
    walkers(log)
    told: list[int] = []

    def now() -> datetime:
        told.append(processor.position)
        return T0

    processor = Processor(log, STATION, [rule()], now=now)
    before = processor.position
    while not processor.step().is_caught_up:
        pass
    assert told[0] == before < processor.position


def test_running_again_over_the_same_log_appends_nothing(walked: tuple[Log, list[Any]]) -> None:
    log, before = walked
    assert Processor(log, STATION, [rule()]).catch_up() == 0
    assert heads(log) == before


@pytest.mark.parametrize("fails_at", ["append", "save_checkpoints"])
def test_a_commit_that_fails_is_done_again_from_the_log(
    make_log: MakeLog, walked: tuple[Log, list[Any]], monkeypatch: pytest.MonkeyPatch, fails_at: str
) -> None:
    log = make_log()
    walkers(log)
    processor = Processor(log, STATION, [rule()], limits=ProcessorLimits(segments=3, save_every_events=1))
    original = getattr(Transaction, fails_at)
    calls = 0

    def sometimes(self: Transaction, *arguments: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        result = original(self, *arguments, **named)
        if calls % 2:
            raise LogUnavailable("gone before the commit")
        return result

    monkeypatch.setattr(Transaction, fails_at, sometimes)
    failures = 0
    while processor.position < log.head():
        try:
            processor.step()
        except LogUnavailable:
            failures += 1

    assert failures >= 3
    assert heads(log) == walked[1]


def test_two_processors_at_once_append_each_situation_once(make_log: MakeLog, walked: tuple[Log, list[Any]]) -> None:
    log = make_log()
    walkers(log)
    pair = [Processor(log, STATION, [rule()], limits=ProcessorLimits(segments=2)) for _ in range(2)]
    for _ in range(20):
        for processor in pair:
            processor.step()

    assert heads(log) == walked[1]


def test_many_rules_run_in_one_pass_and_each_remembers_its_own_place(make_log: MakeLog) -> None:
    log = make_log()
    walkers(log)
    Processor(log, STATION, [rule("early")]).catch_up()
    found = Processor(log, STATION, [rule("early"), rule("later")]).catch_up()

    by_rule = [each.rule for each in situations(log)]
    assert found == 8
    assert by_rule.count("early") == by_rule.count("later") == 8


def test_a_rule_that_fails_is_set_aside_and_the_others_go_on(
    make_log: MakeLog, caplog: pytest.LogCaptureFixture
) -> None:
    log = make_log()
    walkers(log)
    failing = rule("failing", skip="SKIP TO FIRST outside")  # back to the match's first row: an error at run time
    processor = Processor(log, STATION, [failing, rule()])
    with caplog.at_level(logging.ERROR):
        assert processor.catch_up() == 8

    assert list(processor.failures) == ["failing"]
    assert "rule failing is set aside: " in caplog.text
    assert {each.rule for each in situations(log)} == {"enters"}


def test_a_rule_that_was_set_aside_stays_so_when_the_state_is_read_again(
    make_log: MakeLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = make_log()
    walkers(log)
    processor = Processor(log, STATION, [rule("failing", skip="SKIP TO FIRST outside"), rule()])
    processor.catch_up()
    processor._is_stale = True
    walkers(log, "street")
    processor.catch_up()

    assert list(processor.failures) == ["failing"]


def test_zones_belong_to_one_source(make_log: MakeLog) -> None:
    log = make_log()
    walkers(log, "street")
    walkers(log, "gate")
    Processor(log, STATION, [rule()]).catch_up()

    assert {str(segment.stream) for segment in log.read_all(types=["situation_detected"])} == {
        "brno/gate/situation_detected"
    }


def test_situations_of_no_single_source_are_the_rules_own(make_log: MakeLog) -> None:
    log = make_log()
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(7, 1, 80))
    end(log, "gate")
    Processor(log, STATION, [rule(partition="track_id")]).catch_up()

    (segment,) = log.read_all(types=["situation_detected"])
    assert str(segment.stream) == "brno/rules/situation_detected"


def test_a_silent_source_stops_holding_the_watermark_after_the_idle_time(make_log: MakeLog) -> None:
    log = make_log()
    for source in ("gate", "street"):
        add_video(log, source)
    say(log, "street", point(1, 0, 20))
    say(log, "gate", point(7, 0, 20), point(7, 1, 80), point(7, 9, 80))
    clock = [datetime(2026, 6, 1, tzinfo=UTC)]
    processor = Processor(log, STATION, [rule(time="{lateness: 1 s, idle: 30 s}")], now=lambda: clock[0])

    processor.catch_up()
    assert situations(log) == []  # the street's camera may still say something of second 1
    clock[0] += timedelta(seconds=29)
    processor.catch_up()
    assert situations(log) == []
    clock[0] += timedelta(seconds=2)
    processor.catch_up()
    assert [each.title for each in situations(log)] == ["track 7 came in"]
    again = Processor(log, STATION, [rule(time="{lateness: 1 s, idle: 30 s}")], now=lambda: clock[0])
    assert again.catch_up() == 0


def test_late_events_are_counted_and_recorded(make_log: MakeLog) -> None:
    log = make_log()
    add_video(log, "gate")
    say(log, "gate", point(7, 10, 20))
    say(log, "gate", point(7, 3, 80))
    processor = Processor(log, STATION, [rule()])
    processor.catch_up()

    assert processor.late == {"enters": 1}
    (missed,) = said(log, "rule_missed")
    assert (missed.rule, missed.what, missed.count, missed.stream) == (
        "enters", "late_events", 1, "brno/gate/track_point",
    )  # fmt: skip
    assert (missed.first_sequence, missed.last_sequence, missed.began_at) == (2, 2, T0 + timedelta(seconds=3))
    assert "time.lateness of the rule (1 s)" in missed.reason


def test_a_rule_is_deployed_once_for_each_version(make_log: MakeLog) -> None:
    log = make_log()
    first, second = rule(), rule(version=2, measures="inside.x AS x")

    assert deploy(log, STATION, [first], {}, T0) == [first]
    assert deploy(log, STATION, [first], {}, T0) == []
    assert deploy(log, STATION, [second], {}, T0) == [second]
    assert log.stream_head(StreamName.of(STATION, "rules", "rule_deployed")).sequence == 2


def test_rules_that_were_deployed_before_a_restore_are_deployed_still(make_log: MakeLog) -> None:
    log = make_log()
    first, second = rule(), rule("leaves")
    deploy(log, STATION, [first], {}, T0)
    with psycopg.connect(log.dsn) as owner:
        owner.execute("update log_head set epoch = 2")
    with Log(log.dsn, log.catalogue) as restored:
        assert deploy(restored, STATION, [second], {}, T0) == [second]
        assert deploy(restored, STATION, [first, second], {}, T0) == []
        with pytest.raises(PatternError, match="enters version 1 is deployed with another content"):
            deploy(restored, STATION, [rule(measures="inside.x AS x")], {}, T0)


def test_a_deployed_version_cannot_change(make_log: MakeLog) -> None:
    log = make_log()
    deploy(log, STATION, [rule()], {}, T0)
    with pytest.raises(PatternError, match=r"enters version 1 is deployed with another content.*a new version"):
        deploy(log, STATION, [rule(measures="inside.x AS x")], {}, T0)


def test_rules_may_use_every_column_of_envelope_and_type(make_log: MakeLog) -> None:
    known = schemas(make_log().catalogue)["track_point"]
    assert known.names[:6] == ["station", "source", "type", "subject", "sequence", "time"]
    assert {"track_id", "x", "confidence"} <= set(known.names)


PLATES = """
rule: plates
version: 1
title: "{plate}"
severity: info
match: |
  SELECT * FROM plate_read MATCH_RECOGNIZE (ORDER BY time, sequence MEASURES a.plate AS plate PATTERN (a))
"""


@pytest.mark.parametrize("first", ["plates", "points"])
def test_what_is_believed_of_a_type_does_not_depend_on_rules_over_other_types(make_log: MakeLog, first: str) -> None:
    found = []
    for others in ([], [rule()]):
        log = make_log()
        add_video(log, "gate")
        if first == "points":
            say(log, "gate", point(7, 0, 20))
        say(log, "gate", _plate(10.0 * 365 * 86400))
        for second in (5, 9):
            say(log, "gate", point(7, second, 20))
            say(log, "gate", _plate(second))
        end(log, "gate")
        processor = Processor(log, STATION, [parse_rule(PLATES), *others])
        processor.catch_up()
        found.append(([each.title for each in situations(log) if each.rule == "plates"], processor.late["plates"]))
    assert found[0] == found[1]


def _plate(second: float) -> PlateRead:
    rest: dict[str, Any] = {"candidates": None, "country": None, "region": None}
    box = dict.fromkeys(("x1", "y1", "x2", "y2"), 1.0)
    return PlateRead(time=T0 + timedelta(seconds=second), plate=f"at {second}", confidence=0.9, frame=1, **box, **rest)
