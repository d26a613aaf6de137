"""Stages over a real log: exactly once, wherever they stop, and rules that read what they derive."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from events import decode, events_of
from patterns import parse_rule
from patterns.errors import PatternError
from patterns.processor import Processor
from patterns.stages import load_stages, parse_stage
from store import Log, LogUnavailable, Transaction
from tests.patterns.walkers import STATION, T0, add_video, end, point, say, situations
from vian.rules import files_of
from vian.staging import StageFollower, deploy_stages, stages_beside_that_run, stages_of

CROWD = """
stage: crowd
version: 1
occupancy:
  zones: {right: {source: gate, polygon: [[0.5, 0], [1, 0], [1, 1], [0.5, 1]]}}
"""
RULE = """
rule: crowded
version: 1
title: "{tracks} in {zone}"
severity: warning
match: |
  SELECT * FROM occupancy MATCH_RECOGNIZE (
    PARTITION BY source, zone ORDER BY time, sequence
    MEASURES many.tracks AS tracks, many.time AS since
    PATTERN (many) DEFINE many AS tracks >= 2 AND tracks_before < 2)
"""


def _walk(log: Log) -> None:
    add_video(log, "gate")
    for second, inside in enumerate([(20, 20), (80, 20), (80, 80), (20, 80), (20, 20)]):
        say(log, "gate", *(point(track, second, x) for track, x in enumerate(inside, start=1)))
    end(log, "gate")


def _derived(log: Log) -> list[Any]:
    segments = log.read_all(types=["occupancy"])
    return [event for segment in segments for event in events_of(decode(segment, log.catalogue))]


def test_a_stage_derives_once_and_rules_read_what_it_derived(log: Log) -> None:
    _walk(log)
    stage = parse_stage(CROWD)
    StageFollower(log, STATION, stage).catch_up()
    assert [(each.time - T0, each.tracks, each.tracks_before) for each in _derived(log)] == [
        (timedelta(seconds=second), now, before) for second, now, before in ((1, 1, 0), (2, 2, 1), (3, 1, 2), (4, 0, 1))
    ]
    StageFollower(log, STATION, stage).catch_up()
    assert len(_derived(log)) == 4
    Processor(log, STATION, [parse_rule(RULE)]).catch_up()
    end(log, "gate", 61)
    Processor(log, STATION, [parse_rule(RULE)]).catch_up()
    (found,) = situations(log)
    assert found.title == "2 in right"


def test_a_stage_goes_on_where_a_commit_failed(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    _walk(log)
    follower = StageFollower(log, STATION, parse_stage(CROWD))
    with monkeypatch.context() as patched:

        def fails(self: Transaction, *_: Any) -> None:
            raise LogUnavailable("away")

        patched.setattr(Transaction, "append", fails)
        with pytest.raises(LogUnavailable):
            follower.step()
    follower.catch_up()
    assert len(_derived(log)) == 4


def test_of_two_followers_of_one_stage_each_event_is_appended_once(log: Log) -> None:
    _walk(log)
    first, second = (StageFollower(log, STATION, parse_stage(CROWD)) for _ in range(2))
    first.catch_up()
    second.catch_up()
    assert len(_derived(log)) == 4


def test_a_stage_that_cannot_go_on_is_set_aside_and_says_why(log: Log) -> None:
    say(log, "gate", point(1, 0, 80.0))
    say(log, "gate", point(1, 1, 80.0))
    follower = StageFollower(log, STATION, parse_stage(CROWD))
    follower.catch_up()
    assert "frame size is not known" in str(follower.failure)


def test_a_deployed_version_never_changes(log: Log, tmp_path: Path) -> None:
    file = tmp_path / "crowd.yaml"
    file.write_text(CROWD)
    (stage,) = stages_of([tmp_path])
    assert deploy_stages(log, STATION, [stage]) == [stage]
    assert deploy_stages(log, STATION, [stage]) == []
    with pytest.raises(PatternError, match="stage crowd version 1 is deployed with another content"):
        deploy_stages(log, STATION, [parse_stage(CROWD.replace("0.5, 0", "0.6, 0"))])


def test_stages_and_rules_lie_side_by_side(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(CROWD)
    (tmp_path / "b.yaml").write_text(RULE)
    assert [stage.stage for stage in load_stages(tmp_path)] == ["crowd"]
    assert files_of([tmp_path]) == [tmp_path / "b.yaml"]
    assert files_of([tmp_path], with_stages=True) == [tmp_path / "a.yaml", tmp_path / "b.yaml"]


@pytest.mark.parametrize(
    ("settings", "wanted"),
    [
        ("{of: nothing, window: 1 h}", "3:13: unknown event type 'nothing'; there are: activity_interval"),
        (
            "{of: track_ended, window: 1 h, by: color}",
            "3:43: unknown column 'color' of track_ended; there are: began",
        ),
    ],
)
def test_a_stage_over_what_there_is_not_is_refused_at_its_place(log: Log, settings: str, wanted: str) -> None:
    stage = parse_stage(f"stage: a\nversion: 1\ntally: {settings}\n", "a.yaml")
    with pytest.raises(PatternError, match=f"a.yaml:{wanted}"):
        StageFollower(log, STATION, stage)


def test_a_stage_file_that_is_wrong_is_left_out_and_the_others_run(
    log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.yaml").write_text(CROWD.replace("occupancy:", "occupance:"))
    (tmp_path / "b.yaml").write_text(CROWD)
    (tmp_path / "c.yaml").write_text(CROWD.replace("right", "left"))
    assert [each.path for each in stages_beside_that_run(log, STATION, tmp_path)] == [tmp_path / "b.yaml"]
    told = "".join(capsys.readouterr())
    assert told.count("a stage file is left out; the others run") == 2
    assert "the stage 'crowd' is also defined in" in told
