from pathlib import Path

import pytest

from events import source_name
from patterns.files.loading import parse_rule
from patterns.linting.lint import check
from patterns.processor import deploy, schemas
from store import Log
from tests.vian.samples import START
from vian.demo.clip import Clip, Origin
from vian.demo.scenes import RULES, RULES_IN_METRES, rules_for, source_of
from vian.rules import file_text

CLIPS = [Clip(Path(__file__), origin, None) for origin in Origin]


@pytest.mark.parametrize("clip", CLIPS, ids=lambda each: each.origin)
def test_the_rules_of_each_scene_fit_and_lie_on_its_source(clip: Clip, log: Log) -> None:
    for rule in rules_for(clip):
        assert [finding for finding in check(rule, schemas(log.catalogue)) if finding.severity == "error"] == []
        places = [*rule.zones.values(), *rule.lines.values()]
        assert [place.source for place in places] == [source_of(clip)]


@pytest.mark.parametrize("clip", CLIPS, ids=lambda each: each.origin)
def test_what_is_recorded_of_a_rule_is_the_rule_that_runs(clip: Clip) -> None:
    for rule in rules_for(clip):
        assert parse_rule(file_text(rule)).hash == rule.hash


def test_one_log_takes_the_rules_of_all_scenes(log: Log) -> None:
    for clip in CLIPS:
        rules = rules_for(clip)
        deploy(log, "demo", rules, {rule.rule: file_text(rule) for rule in rules}, START)
    # Sample and download are the same clip.
    assert len({rule.hash for clip in CLIPS for rule in rules_for(clip)}) == 3 * len(RULES) + len(RULES_IN_METRES)


@pytest.mark.parametrize("name", ["gate.mp4", "böse kamera (1).mp4", "...", "x" * 100 + ".mkv", "__.mp4"])
def test_a_users_video_is_a_source_of_its_own(tmp_path: Path, name: str) -> None:
    sources = set()
    for content in (b"one", b"two"):
        (tmp_path / name).write_bytes(content)
        source = source_of(Clip(tmp_path / name, Origin.GIVEN, None))
        assert source_name(source) == source
        sources.add(source)
    assert len(sources) == 2
