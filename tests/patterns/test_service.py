"""Rules into service and out of it while the processor runs: nothing is lost, nothing is said twice."""

import json
import random
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import pytest

from events import CameraCalibrated, PlateRead, SceneChanged, StreamName, VideoAdded, batch_of, encode
from patterns import parse_rule
from patterns.engine.ruleset import RuleSetRun
from patterns.engine.situations import Narrator
from patterns.errors import MatchError, PatternError
from patterns.files.expanding import expand
from patterns.files.rule import Rule
from patterns.limits import Limits
from patterns.processor import (
    Processor,
    ProcessorLimits,
    deploy,
    reports,
    retire,
    standing,
    stored_mark,
    stored_state,
)
from patterns.processor.cameras import known_at
from patterns.processor.members import Pace
from patterns.processor.passes import UNCALIBRATED
from store import Checkpoint, Log, LogUnavailable, Transaction
from tests.conftest import MakeLog
from tests.events.examples import camera_calibrated
from tests.patterns.walkers import (
    PRODUCER,
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
    walk,
    walkers,
)

LATER = T0 + timedelta(days=1)


def deployed(log: Log, *rules: Any, **options: Any) -> None:
    deploy(log, STATION, rules, {}, T0, **options)


def found(log: Log) -> list[tuple[str, int, Any]]:
    """Rule, version and time of each situation."""
    return [(each.rule, each.rule_version, (each.began_at - T0).total_seconds()) for each in situations(log)]


def saved_often(segments: int = 200, events: int = 1) -> ProcessorLimits:
    return ProcessorLimits(segments=segments, save_every_events=events)


def test_what_is_deployed_runs_from_the_beginning_and_live(log: Log) -> None:
    walkers(log)
    deployed(log, rule())
    processor = Processor(log, STATION)
    assert processor.catch_up() == 8
    walkers(log, "street")
    deployed(log, rule("leaves", pattern="(inside outside)"))
    assert processor.catch_up() > 0
    assert {each.rule for each in situations(log)} == {"enters", "leaves"}
    assert [service.key for service, _ in processor.rules] == [("enters", 1), ("leaves", 1)]


def test_a_further_version_begins_at_the_head_and_none_is_lost_or_found_twice(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    processor = Processor(log, STATION)
    walk(log, range(6))
    processor.catch_up()
    deployed(log, rule(version=2, measures="inside.x AS x"))
    walk(log, range(6, 12))
    end(log, "gate")
    processor.catch_up()

    assert len(situations(log)) == len({(each.began_at, each.partition) for each in situations(log)}) == 8
    assert {version for _, version, _ in found(log)} == {1, 2}
    # What began before the change is the old version's, what began after it the new one's.
    assert max(at for _, version, at in found(log) if version == 1) <= 5
    assert min(at for _, version, at in found(log) if version == 2) > 5
    assert [(e.rule_version, e.why, e.open_matches) for e in said(log, "rule_retired")] == [(1, "replaced", "finished")]
    assert [service.key for service, _ in processor.rules] == [("enters", 2)]


@pytest.mark.parametrize("open_matches, finds", [("dropped", 0), ("finished", 1)])
def test_a_rule_that_is_retired_drops_or_finishes_what_it_has_begun(log: Log, open_matches: Any, finds: int) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    processor = Processor(log, STATION)
    say(log, "gate", point(1, 0, 20))
    processor.catch_up()
    retire(log, STATION, "enters", T0, open_matches=open_matches)
    say(log, "gate", point(1, 1, 80), point(2, 1, 20), point(2, 2, 80))
    end(log, "gate")
    processor.catch_up()

    assert len(situations(log)) == finds
    assert processor.rules == []
    assert stored_mark(log, STATION, "enters", 1).is_done  # type: ignore[union-attr]
    assert Processor(log, STATION).rules == []


def test_a_version_that_begins_in_the_past_catches_up_beside_the_others(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    processor = Processor(log, STATION, limits=ProcessorLimits(segments=2))
    walk(log, range(8))
    processor.catch_up()
    deployed(log, rule("again"), after=0)
    steps: list[Any] = []
    walk(log, range(8, 12))
    end(log, "gate")
    while not steps or not steps[-1].is_caught_up:
        steps.append(processor.step())

    both = {name: [at for rule_name, _, at in found(log) if rule_name == name] for name in ("enters", "again")}
    assert both["enters"] == both["again"]
    assert len(steps) > 4  # a page at a time, so that the others do not wait


def test_a_rule_comes_back_behind_its_retirement(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    processor = Processor(log, STATION)
    walk(log, range(4))
    processor.catch_up()
    retire(log, STATION, "enters", T0, open_matches="dropped")
    walk(log, range(4, 12))
    end(log, "gate")
    processor.catch_up()
    before = len(situations(log))
    deployed(log, rule())
    processor.catch_up()

    assert before < 8
    assert len({(each.began_at, each.partition) for each in situations(log)}) == len(situations(log)) > before


def test_a_version_that_runs_again_from_the_beginning_says_nothing_twice(log: Log) -> None:
    walkers(log)
    deployed(log, rule())
    processor = Processor(log, STATION)
    assert processor.catch_up() == 8
    retire(log, STATION, "enters", T0)
    deployed(log, rule(), after=0)
    assert processor.catch_up() == 0
    assert Processor(log, STATION).catch_up() == 0
    assert len(situations(log)) == 8


def test_a_rule_in_shadow_records_and_is_promoted(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule(more="shadow: true"))
    processor = Processor(log, STATION)
    walk(log, range(6))
    processor.catch_up()
    assert situations(log) == []
    shadowed = said(log, "situation_shadowed")
    deployed(log, rule(), is_shadow=False)
    walk(log, range(6, 12))
    end(log, "gate")
    processor.catch_up()

    assert len(shadowed) + len(situations(log)) == 8
    assert len(shadowed) == len(said(log, "situation_shadowed")) > 0


def test_what_cannot_be_deployed_is_said(log: Log) -> None:
    deployed(log, rule())
    with pytest.raises(PatternError, match=r"enters version 1 is in service already.*Next: vian rules retire enters"):
        deployed(log, rule(), after=0)
    with pytest.raises(PatternError, match=r"no version of rule 'enter' is in service; in service: enters\. Next: "):
        retire(log, STATION, "enter", T0)


def test_a_deployed_text_that_is_no_rule_here_is_set_aside_and_the_others_run(log: Log) -> None:
    walkers(log)
    deployed(log, rule("other"), rule())
    event = said(log, "rule_deployed")[0].model_copy(update={"rule": "strange", "text": "rule: strange"})
    say(log, "rules", event)
    processor = Processor(log, STATION)
    assert processor.catch_up() == 16
    assert list(processor.failures) == ["strange"]
    (gone,) = said(log, "rule_retired")
    assert (gone.rule, gone.why) == ("strange", "failed")
    assert "this key is missing" in gone.reason


def test_a_rule_that_raises_anything_is_retired_with_its_position_and_comes_back(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    walkers(log)
    deployed(log, rule("breaks"), rule())
    original = Narrator.matches

    def breaks(self: Narrator, finds: Any) -> Any:
        if self.rule.rule == "breaks":
            raise ZeroDivisionError("by zero")
        return original(self, finds)

    with monkeypatch.context() as broken:
        broken.setattr(Narrator, "matches", breaks)
        processor = Processor(log, STATION)
        processor.catch_up()
    assert len(situations(log)) >= 8
    (gone,) = said(log, "rule_retired")
    assert (gone.rule, gone.why, gone.open_matches) == ("breaks", "failed", "dropped")
    assert gone.reason == "at position 6: ZeroDivisionError: by zero"
    deployed(log, rule("breaks"), after=0)
    processor.catch_up()
    assert sorted(each.rule for each in situations(log)) == ["breaks"] * 8 + ["enters"] * 8
    assert not processor.failures


@pytest.mark.timeout(600)  # one of them compiles the kernel where nobody did
@pytest.mark.parametrize("is_compiled", [True, False])
def test_a_rule_that_fails_among_segments_read_together_has_told_what_it_found_before(
    make_log: MakeLog, monkeypatch: pytest.MonkeyPatch, is_compiled: bool
) -> None:
    monkeypatch.setattr("patterns.engine.compiling.is_compiled", lambda: is_compiled)
    early = "early AS in_zone(early.x, early.y, 'yard') AND early.sequence < 18"
    breaks = rule("breaks", pattern="(outside inside early?)", skip="SKIP TO LAST early")
    breaks = parse_rule(expand(breaks).replace("DEFINE outside", f"DEFINE {early}, outside"))
    said_of = []
    for limits in (ProcessorLimits(segments=1), ProcessorLimits()):
        log = make_log()
        deployed(log, breaks, rule())
        walkers(log)
        Processor(log, STATION, limits=limits).catch_up()
        (gone,) = said(log, "rule_retired")
        said_of.append((gone.reason, [(each.rule, each.situation) for each in situations(log)]))
    assert said_of[0] == said_of[1]
    assert "SKIP TO LAST" in said_of[0][0]
    assert [name for name, _ in said_of[0][1]].count("breaks") >= 1


_WORDY = """
rule: wordy
version: 1
title: "{plate}{plate}{plate}{plate}{plate}"
severity: info
match: |
  SELECT * FROM plate_read MATCH_RECOGNIZE (
    PARTITION BY source ORDER BY time, sequence
    MEASURES seen.plate AS plate
    ONE ROW PER MATCH AFTER MATCH SKIP PAST LAST ROW
    PATTERN (seen) DEFINE seen AS seen.plate IS NOT NULL)
"""


def read(second: float, plate: str) -> PlateRead:
    """A plate where no box matters."""
    box = dict.fromkeys(("x1", "y1", "x2", "y2"), 1.0)
    nothing: dict[str, Any] = dict.fromkeys(("country", "region", "candidates"))
    return PlateRead(time=T0 + timedelta(seconds=second), plate=plate, confidence=1.0, frame=0, **box, **nothing)


def test_a_situation_that_the_log_does_not_take_ends_its_rule_and_no_other(make_log: MakeLog) -> None:
    said_of = []
    for limits in (ProcessorLimits(segments=1), ProcessorLimits()):
        log = make_log()
        deployed(log, parse_rule(_WORDY), rule())
        for second, plate in enumerate(("7A01234", "1" * 2**20, "7A01235")):
            say(log, "gate", read(second, plate))
        walkers(log)
        Processor(log, STATION, limits=limits).catch_up()
        (gone,) = said(log, "rule_retired")
        said_of.append((gone.reason, [(each.rule, each.situation) for each in situations(log)]))
    assert said_of[0] == said_of[1]
    assert "situation_detected.title must be at most 4194304 bytes, got '5242880 bytes'" in said_of[0][0]
    assert [name for name, _ in said_of[0][1]] == ["wordy"] + ["enters"] * 8


def test_a_rule_that_is_too_slow_is_set_aside_and_named(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    walkers(log)
    deployed(log, rule("slow"), rule())
    ticks = iter(range(10_000_000))
    monkeypatch.setattr(
        RuleSetRun, "spent_s", lambda self, name: next(ticks) * 10.0 if name.startswith("slow") else 0.0
    )
    limits = ProcessorLimits(segments=1, window_events=1, slow_windows=3)
    processor = Processor(log, STATION, limits=limits)
    processor.catch_up()

    (gone,) = said(log, "rule_retired")
    assert (gone.rule, gone.why) == ("slow", "too_slow")
    assert "us an event; the limit rules_event_us is 1000 us over 3 windows" in gone.reason
    assert [name for name, _, _ in found(log)].count("enters") == 8


@pytest.mark.parametrize("seed", range(3))
def test_killed_anywhere_the_same_is_found(make_log: MakeLog, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """A transaction may fail before it commits, or commit unconfirmed; a processor may be forgotten at any step."""
    chance = random.Random(seed)
    wanted, log = make_log(), make_log()
    for each in (wanted, log):
        deployed(each, rule(), rule("leaves", pattern="(inside outside)"))
        walkers(each)
        walkers(each, "street")
    Processor(wanted, STATION).catch_up()
    original = Log.transaction

    @contextmanager
    def killed(self: Log) -> Iterator[Transaction]:
        fate = chance.random()
        with original(self) as transaction:
            yield transaction
            if fate < 0.2:
                raise LogUnavailable("before the commit")
        if fate < 0.4:
            raise LogUnavailable("after the commit")

    monkeypatch.setattr(Log, "transaction", killed)
    processors: list[Processor] = []
    while not processors or min(each.position for each in processors) < log.head():
        if not processors or (len(processors) < 3 and chance.random() < 0.3):
            limits = saved_often(chance.randint(1, 6), chance.choice([1, 10, 10_000]))
            processors.append(Processor(log, STATION, limits=limits))
        processor = chance.choice(processors)
        with suppress(LogUnavailable):
            processor.step()
        if chance.random() < 0.1:
            processors.remove(processor)  # forgotten, as a killed process is

    got = {head for head in heads(log) if "situation" in head[0]}
    assert {name: count for name, count, _ in got} == {n: c for n, c, _ in heads(wanted) if "situation" in n}
    assert sorted(found(log)) == sorted(found(wanted))


def test_a_restart_reads_again_from_the_saved_state_and_says_nothing_twice(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    walk(log, range(5))
    first = Processor(log, STATION)
    first.catch_up()
    at = stored_mark(log, STATION, "enters", 1)
    assert at is not None
    walk(log, range(5, 12))
    first.step()
    after = stored_mark(log, STATION, "enters", 1)
    assert after is not None
    assert after.position > after.saved == at.saved
    count = len(situations(log))

    again = Processor(log, STATION)
    assert again.position == at.saved
    assert again.catch_up() == 0
    assert len(situations(log)) == count
    end(log, "gate")
    again.catch_up()
    assert len(situations(log)) == 8


@pytest.mark.parametrize("state", [b"VRS1 of an older ViAn", b"VPS9 of a newer one", b"VPS1\0\0\0\7damaged"])
def test_a_state_that_cannot_be_read_is_made_again_from_the_log(
    log: Log, caplog: pytest.LogCaptureFixture, state: bytes
) -> None:
    deployed(log, rule())
    walkers(log)
    Processor(log, STATION).catch_up()
    name = f"rule-state/{STATION}/enters/1"
    assert stored_state(log, STATION, "enters", 1) is not None
    with log.transaction() as transaction:
        transaction.save_checkpoints({name: Checkpoint(log.head(), state)})
    again = Processor(log, STATION)
    assert "rule enters version 1 is run again from position 0, and nothing is appended twice" in caplog.text
    assert again.catch_up() == 0
    assert len(situations(log)) == 8


def test_what_an_older_vian_left_is_gone_on_from(log: Log) -> None:
    """It kept position and state together, under the name of the mark."""
    deployed(log, rule())
    walkers(log)
    Processor(log, STATION).catch_up()
    with log.transaction() as transaction:
        transaction.save_checkpoint(f"rule/{STATION}/enters/1", log.head(), b"VRS1...")
        transaction.save_checkpoint(f"rule-state/{STATION}/enters/1", 0, b"")
    assert Processor(log, STATION).catch_up() == 0
    walkers(log, "street")
    assert len(situations(log)) == 8


def test_an_event_from_the_far_future_does_not_make_all_others_late(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    say(log, "gate", point(1, 0, 20))
    far = StreamName.of(STATION, "gate", "track_point")
    ahead = point(9, 0, 80).model_copy(update={"time": T0 + timedelta(days=30_000)})
    log.append([encode(far, batch_of([ahead, point(1, 1, 80)]), PRODUCER)])
    say(log, "gate", point(1, 5, 80))
    processor = Processor(log, STATION)
    processor.catch_up()

    assert [at for _, _, at in found(log)] == [0]
    (missed,) = said(log, "rule_missed")
    assert (missed.what, missed.count, missed.first_sequence) == ("future_events", 1, 2)
    assert "rules_ahead_s" in missed.reason
    assert processor.late == {"enters": 0}


def test_a_flood_of_late_events_is_one_event(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    say(log, "gate", point(1, 50, 20))
    for second in range(20):
        say(log, "gate", *(point(track, second, 80) for track in range(1, 6)))
    Processor(log, STATION).catch_up()

    (missed,) = said(log, "rule_missed")
    assert (missed.what, missed.count) == ("late_events", 100)
    assert (missed.first_sequence, missed.last_sequence) == (2, 101)


def test_reports_say_how_each_version_stands(log: Log) -> None:
    walkers(log)
    deployed(log, rule(), rule("shadowed", more="shadow: true"))
    processor = Processor(log, STATION)
    processor.catch_up()
    walkers(log, "street")
    deployed(log, rule(version=2, measures="inside.x AS x"))

    by_key = {each.service.key: each for each in reports(log, STATION)}
    assert {key: each.state for key, each in by_key.items()} == {
        ("enters", 1): "finishes", ("shadowed", 1): "shadow", ("enters", 2): "runs",
    }  # fmt: skip
    assert by_key["enters", 1].counts["matches"] == 8
    assert by_key["enters", 1].lag > by_key["enters", 2].lag == 0
    first_us = by_key["shadowed", 1].counts["event_us"]
    assert first_us > 0, "what few events cost is told, too"
    assert Processor(log, STATION).catch_up() is not None
    assert {each.service.key: each for each in reports(log, STATION)}["shadowed", 1].counts["event_us"] > 0
    processor.catch_up()
    assert [each.state for each in reports(log, STATION)] == ["retired", "shadow", "runs"]


def test_rules_are_reloaded_where_they_are_given(log: Log) -> None:
    add_video(log, "gate")
    processor = Processor(log, STATION, [rule()])
    walk(log, range(6))
    processor.catch_up()
    processor.reload([rule(version=2, measures="inside.x AS x")])
    walk(log, range(6, 12))
    end(log, "gate")
    processor.catch_up()
    assert len({(each.began_at, each.partition) for each in situations(log)}) == len(situations(log)) == 8
    with pytest.raises(PatternError):
        processor.reload([rule(measures="inside.colour AS x")])


def test_what_stood_is_known_at_any_position(log: Log) -> None:
    deployed(log, rule())
    at = log.head()
    deployed(log, rule(version=2, measures="inside.x AS x"))
    assert standing(log, STATION, at)["enters", 1].retirement is None
    now = standing(log, STATION)
    assert now["enters", 1].retirement is not None
    assert now["enters", 2].after == log.head()


def test_a_failure_of_a_rule_in_a_match_is_a_match_error(log: Log) -> None:
    walkers(log)
    deployed(log, rule("failing", skip="SKIP TO FIRST outside"))
    processor = Processor(log, STATION)
    processor.catch_up()
    assert isinstance(processor.failures["failing"], MatchError)
    assert [each.why for each in said(log, "rule_retired")] == ["failed"]


def test_what_a_limit_costs_is_an_event_and_the_rule_goes_on(log: Log) -> None:
    add_video(log, "gate")
    deployed(log, rule())
    limits = ProcessorLimits(rules=Limits(partitions=4))
    processor = Processor(log, STATION, limits=limits)
    say(log, "gate", *[point(track, track / 10, 20) for track in range(1, 10)])
    say(log, "gate", *[point(track, 60 + track / 10, 80) for track in range(1, 10)])
    processor.catch_up()
    say(log, "gate", point(1, 90, 20), point(1, 91, 80))
    end(log, "gate")
    processor.catch_up()

    missed = said(log, "rule_missed")
    assert {(each.rule, each.what) for each in missed} == {("enters", "partial_matches")}
    assert sum(each.count for each in missed) >= 5
    assert "the limit `partitions` is 4" in missed[0].reason
    assert found(log)[-1] == ("enters", 1, 90.0)
    assert not processor.failures


def test_a_source_that_is_not_calibrated_is_left_out_and_named_until_it_is(
    log: Log, caplog: pytest.LogCaptureFixture
) -> None:
    fast = parse_rule(
        "rule: fast\nversion: 1\ntitle: fast\nseverity: info\nmatch: |\n"
        "  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source, track_id ORDER BY time, sequence\n"
        "    MEASURES LAST(A.x) AS x PATTERN (A) DEFINE A AS ground_speed(x, y, vx, vy) > 0.1)\n"
    )
    scale = json.dumps([[0.1, 0, 0], [0, -0.1, 10], [0, 0, 1]])
    calibrated = camera_calibrated(time=T0, homography=scale)
    say(log, "street", calibrated)
    deployed(log, fast)
    walkers(log, "gate", seconds=4)
    walkers(log, "street", seconds=4)
    processor = Processor(log, STATION)
    processor.catch_up()
    assert {each.partition for each in situations(log)} == {
        json.dumps({"source": "street", "track_id": at}) for at in (1, 2, 3)
    }
    assert len(situations(log)) == 12
    (report,) = reports(log, STATION)
    assert (report.state, report.uncalibrated) == ("runs", {"gate": 12})
    told = [each.getMessage() for each in caplog.records if getattr(each, "kind", None) == UNCALIBRATED]
    assert len(told) == 1
    assert "Next: vian zones calibrate gate POINTS.yaml" in told[0]

    say(log, "gate", calibrated)
    walk(log, range(20, 24), "gate")
    end(log, "gate", 90)
    Processor(log, STATION).catch_up()
    assert len(situations(log)) == 24
    (report,) = reports(log, STATION)
    assert report.uncalibrated == {}


def test_a_calibration_that_was_found_while_footage_came_does_not_hold_before_its_turn(log: Log) -> None:
    video = VideoAdded(
        time=T0, video="00", path="v", width=100, height=100, fps=5.0, frames_expected=None, codec="h264", started_at=T0
    )
    of_tracks = camera_calibrated(method="tracks", covariance="[]", time=T0 + timedelta(seconds=9))
    moved = SceneChanged(time=T0, cause="moved", changed_share=1.0, dx=None, dy=None)
    for source, event in [
        ("online", of_tracks),
        ("afterwards", of_tracks.model_copy(update={"time": T0})),
        ("by-hand", camera_calibrated(time=T0 + timedelta(hours=1))),
        ("moved", moved),
        ("moved", camera_calibrated(time=T0)),
    ]:
        say(log, source, video)
        say(log, source, event)
    before = {each.source for each in known_at(log, 0).said if not isinstance(each.event, VideoAdded)}
    assert before == {"afterwards", "by-hand"}
    behind = [each.source for each in known_at(log, log.head()).said if not isinstance(each.event, VideoAdded)]
    assert behind == ["online", "afterwards", "by-hand", "moved", "moved"]


def test_a_calibration_by_hand_holds_for_the_footage_since_the_camera_was_moved_and_not_before(log: Log) -> None:
    moved = moved_at(10)
    of_tracks = camera_calibrated(method="tracks", covariance="[]", time=T0 + timedelta(seconds=9))
    of_later = of_tracks.model_copy(update={"time": T0 + timedelta(seconds=19)})
    first, second = camera_calibrated(time=T0), camera_calibrated(time=T0 + timedelta(hours=1))
    add_video(log, "gate")
    for event in (of_tracks, first, moved):
        say(log, "gate", event)
    at_move = log.head()
    for event in (of_later, second, second):
        say(log, "gate", event)
    assert [each.event for each in known_at(log, 0).said][1:] == [first]
    assert [each.event for each in known_at(log, at_move).said][1:] == [of_tracks, first, moved, second]
    told = {moment: (word.event, word.sequence) for moment, word in known_at(log, 0).words.items()}
    assert told == {(f"{STATION}/gate/scene_changed", 1, 1): (second, 4)}
    assert known_at(log, 0, at_move).words == known_at(log, at_move).words == {}


def filmed_from(second: int) -> VideoAdded:
    time = T0 + timedelta(seconds=second)
    return VideoAdded(
        time=time, video="00", path="v", width=100, height=100, fps=5.0, frames_expected=None, codec="h264",
        started_at=time,
    )  # fmt: skip


def of_tracks_at(second: int, rms_m: float) -> CameraCalibrated:
    return camera_calibrated(method="tracks", covariance="[]", time=T0 + timedelta(seconds=second), rms_m=rms_m)


def test_of_moves_that_were_said_out_of_order_the_newest_is_that_of_the_view(log: Log) -> None:
    for second in (7, 7, 2):
        say(log, "gate", moved_at(second))
    at_moves = log.head()
    by_hand = camera_calibrated(time=T0 + timedelta(seconds=8))
    say(log, "gate", by_hand)
    assert known_at(log, at_moves).said[-1].event == by_hand
    assert list(known_at(log, 0).words) == [(f"{STATION}/gate/scene_changed", 1, 1)]


def test_of_what_was_found_afterwards_of_one_view_the_last_word_is_known(log: Log) -> None:
    say(log, "gate", filmed_from(0))
    say(log, "gate", moved_at(5).model_copy(update={"cause": "unknown"}))
    at_change = log.head()
    of_part, of_all = of_tracks_at(5, 0.1), of_tracks_at(0, 0.2)
    say(log, "gate", of_part)
    say(log, "gate", of_all)
    assert known_at(log, at_change).said[-1].event == of_all


def test_what_is_found_online_of_older_footage_is_not_known_before_its_turn(log: Log) -> None:
    for said_of in (filmed_from(1000), of_tracks_at(1050, 0.1), filmed_from(0), of_tracks_at(60, 0.2)):
        say(log, "gate", said_of)
    known = known_at(log, 0)
    assert {type(each.event) for each in known.said} == {VideoAdded}
    assert not known.words


def test_a_rule_that_is_added_later_knows_the_newest_move(log: Log) -> None:
    add_video(log, "gate")
    processor = Processor(log, STATION, [])
    for second in (9, 3):
        say(log, "gate", moved_at(second))
    processor.catch_up()
    processor.reload([in_metres("A", "A AS x = 7 AND ground_x(x, y) > -1")])
    for second in (6, 9):
        say(log, "gate", camera_calibrated(time=T0 + timedelta(seconds=second)))
        say(log, "gate", point(1, second + 4, 7), point(1, second + 5, 1))
    processor.catch_up()
    assert [(each.began_at - T0).seconds for each in situations(log)] == [13]


def in_metres(pattern: str, define: str) -> Rule:
    return parse_rule(
        "rule: metres\nversion: 1\ntitle: t\nseverity: info\ntime: {lateness: 0 s}\nmatch: |\n"
        "  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence\n"
        f"    MEASURES LAST(A.time) AS at PATTERN ({pattern}) DEFINE {define})\n"
    )


def moved_at(second: int) -> SceneChanged:
    time = T0 + timedelta(seconds=second)
    return SceneChanged(time=time, cause="moved", changed_share=1.0, dx=None, dy=None)


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_kill_does_not_tell_a_rule_what_was_said_of_the_camera_later(log: Log, is_killed: bool) -> None:
    deployed(log, in_metres("A C B", "A AS ground_x(x, y) > -1 AND x = 7, C AS x = 1, B AS x = 8"))
    add_video(log, "gate")
    processor = Processor(log, STATION)
    processor.catch_up()
    say(log, "gate", moved_at(1))
    for second, x in enumerate((7, 7, 1), 2):
        say(log, "gate", point(1, second, x))
    while not processor.step().is_caught_up:
        pass
    say(log, "gate", camera_calibrated(time=T0 + timedelta(seconds=4)))
    if is_killed:
        processor = Processor(log, STATION)
    for second, x in enumerate((8, 8, 7, 1, 8, 1), 5):
        say(log, "gate", point(1, second, x))
    processor.catch_up()
    assert [(each.began_at - T0).seconds for each in situations(log)] == [7]


@pytest.mark.parametrize(
    "kill_at, is_given", [(None, False), (1, False), (2, False), (3, False), (4, False), (None, True), (2, True)]
)
def test_a_rule_over_the_past_that_is_killed_goes_on_with_what_was_known_when_it_began(
    log: Log, kill_at: int | None, is_given: bool
) -> None:
    add_video(log, "gate")
    for second in (0, 2, 4):
        say(log, "gate", point(1, second, 7), point(1, second + 0.5, 1))
        if second < 4:
            say(log, "gate", moved_at(second + 1))
    say(log, "gate", camera_calibrated(time=T0 + timedelta(seconds=4)))
    in_service = in_metres("A", "A AS x = 7 AND ground_x(x, y) > -1")
    deployed(log, in_service, after=0)
    say(log, "gate", camera_calibrated(time=T0 + timedelta(seconds=2)))  # nobody knew it when the rule began
    rules = [in_service] if is_given else None
    processor = Processor(log, STATION, rules, limits=saved_often(segments=1))
    for step in range(6):
        if step == kill_at:
            processor = Processor(log, STATION, rules, limits=saved_often(segments=1))
        processor.step()
    say(log, "gate", point(1, 6, 7))
    processor.catch_up()
    assert [(each.began_at - T0).seconds for each in situations(log)] == [4]


def test_a_rule_that_is_given_and_begins_again_knows_what_was_known_when_its_processor_was_made(log: Log) -> None:
    add_video(log, "gate")
    for second, x in enumerate((7, 80, 1)):
        say(log, "gate", point(1, second * 30, x))
    given = in_metres("A", "A AS x = 7 AND ground_x(x, y) > -1")
    failing = rule("failing", skip="SKIP TO FIRST outside")  # for which all are run again, one by one
    processor = Processor(log, STATION, [given, failing])
    say(log, "gate", camera_calibrated(time=T0))
    say(log, "gate", point(1, 70, 7), point(1, 90, 1))
    processor.catch_up()
    assert list(processor.failures) == ["failing"]
    assert [(each.began_at - T0).seconds for each in situations(log)] == [70]


def _breaks_for(name: str, original: Any) -> Any:
    """The method, but it raises for this rule."""

    def method(self: RuleSetRun, *arguments: Any) -> Any:
        if name in arguments:
            raise IndexError("out of range")
        return original(self, *arguments)

    return method


def test_a_rule_whose_state_cannot_be_had_is_set_aside_with_what_it_found_and_the_others_are_saved(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    walkers(log)
    deployed(log, rule("breaks"), rule())
    monkeypatch.setattr(RuleSetRun, "state", _breaks_for("breaks/1", RuleSetRun.state))
    processor = Processor(log, STATION, limits=saved_often(5))
    processor.catch_up()
    (gone,) = said(log, "rule_retired")
    assert (gone.rule, gone.why) == ("breaks", "failed")
    assert gone.reason.endswith(": IndexError: out of range")
    assert list(processor.failures) == ["breaks"]
    assert [each.rule for each in situations(log)].count("enters") == 8
    mark = stored_mark(log, STATION, "enters", 1)
    assert mark is not None
    assert mark.saved == processor.position


def test_a_rule_that_cannot_join_the_others_is_set_aside_and_they_go_on(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    walkers(log)
    deployed(log, rule(), after=0)
    processor = Processor(log, STATION)
    processor.catch_up()
    deployed(log, rule("breaks"), after=0)
    with monkeypatch.context() as broken:
        broken.setattr(RuleSetRun, "state", _breaks_for("breaks/1", RuleSetRun.state))
        processor.catch_up()
    assert list(processor.failures) == ["breaks"]
    (gone,) = said(log, "rule_retired")
    assert (gone.rule, gone.why) == ("breaks", "failed")
    deployed(log, rule("later"), after=0)
    processor.catch_up()
    assert [service.rule for service, _ in processor.rules] == ["enters", "later"]


def test_a_saved_state_that_nothing_can_read_is_not_used_and_nothing_is_told_twice(
    log: Log, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    walkers(log)
    deployed(log, rule(), after=0)
    Processor(log, STATION).catch_up()
    original = RuleSetRun.add

    def add(self: RuleSetRun, bound: Any, state: bytes | None, *more: Any) -> None:
        original(self, bound, state if state is None else [][0], *more)

    monkeypatch.setattr(RuleSetRun, "add", add)
    processor = Processor(log, STATION)
    monkeypatch.setattr(RuleSetRun, "add", original)
    assert "is run again from position 0, and nothing is appended twice: IndexError" in caplog.text
    assert processor.catch_up() == 0
    assert len(situations(log)) == 8


def test_what_a_rule_has_spent_does_not_go_back_when_it_joins_the_others(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    walkers(log)
    deployed(log, rule(), after=0)
    spent: dict[int, list[float]] = {}
    original = Pace.note

    def note(self: Pace, spent_s: float, *more: Any) -> None:
        original(self, spent_s, *more)
        spent.setdefault(id(self), []).append(spent_s)
        assert self.event_us >= 0

    monkeypatch.setattr(Pace, "note", note)
    processor = Processor(log, STATION, limits=ProcessorLimits(segments=5, window_events=1))
    processor.catch_up()
    deployed(log, rule("later"), after=0)
    processor.catch_up()
    walkers(log, "street")
    processor.catch_up()
    assert len(spent) == 2
    assert all(each == sorted(each) and len(each) > 3 for each in spent.values())


def test_a_rule_that_cannot_begin_is_retired_and_the_others_run(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    walkers(log)
    deployed(log, rule("breaks"), rule(), after=0)
    with monkeypatch.context() as broken:
        broken.setattr(RuleSetRun, "add", _breaks_for("breaks/1", RuleSetRun.add))
        processor = Processor(log, STATION)
    assert processor.catch_up() == 8
    (gone,) = said(log, "rule_retired")
    assert (gone.rule, gone.why) == ("breaks", "failed")
    assert {each.rule for each in situations(log)} == {"enters"}
    again = Processor(log, STATION)
    again.catch_up()
    assert [service.rule for service, _ in again.rules] == ["enters"]
