from pathlib import Path

import pytest

from patterns.errors import PatternError
from store import Log, Subscription
from tests.vian.samples import append, points
from vian.errors import WrongUsage
from vian.parts import Parts
from vian.rules import deploy_all, file_text, load_all
from vian.watching import processor_part

SHIPPED = Path(__file__).parents[2] / "patterns" / "rules"
HIGH = """\
rule: {name}
version: {version}
title: "track {{track_id}} is at {{at}}"
severity: info
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES a.x AS at
    ONE ROW PER MATCH AFTER MATCH SKIP PAST LAST ROW
    PATTERN (a) DEFINE a AS a.x > {x})
"""


def write_rule(path: Path, *, name: str = "high", version: int = 1, x: int = 5) -> Path:
    path.write_text(HIGH.format(name=name, version=version, x=x))
    return path


def test_files_and_folders_of_rules_are_loaded_in_order(tmp_path: Path) -> None:
    own = write_rule(tmp_path / "high.yaml")
    assert [rule.rule for rule in load_all([own, SHIPPED])] == [
        "high",
        "line-crossing",
        "loitering",
        "speeding",
        "zone-intrusion",
    ]


def test_two_rules_of_one_name_are_refused_with_their_places(tmp_path: Path) -> None:
    one, two = (write_rule(tmp_path / name) for name in ("one.yaml", "two.yaml"))
    with pytest.raises(WrongUsage, match=f"two rules are named high: {one}, {two}"):
        load_all([one, two])


def test_a_folder_without_rules_is_told(tmp_path: Path) -> None:
    with pytest.raises(WrongUsage, match=r"no rule files \(\*\.yaml\) in "):
        load_all([tmp_path])


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(WrongUsage, match=r"the rule file .*gone\.yaml cannot be read: No such file.*Next: "):
        load_all([tmp_path / "gone.yaml"])


def test_a_rule_is_recorded_with_its_files_own_text(tmp_path: Path) -> None:
    (rule,) = load_all([write_rule(tmp_path / "high.yaml")])
    assert file_text(rule) == HIGH.format(name="high", version=1, x=5)


def test_a_rule_is_deployed_once_a_version_and_never_changed(log: Log, tmp_path: Path) -> None:
    path = tmp_path / "high.yaml"
    rules = load_all([write_rule(path)])
    assert deploy_all(log, "brno", rules) == rules
    assert deploy_all(log, "brno", rules) == []
    with pytest.raises(PatternError, match=r"high version 1 is deployed with another content.*Next: .*a new version"):
        deploy_all(log, "brno", load_all([write_rule(path, x=6)]))
    assert len(deploy_all(log, "brno", load_all([write_rule(path, x=6, version=2)]))) == 1


def test_rules_run_as_a_part_of_a_server(log: Log, tmp_path: Path) -> None:
    part = processor_part(log, "brno", write_rule(tmp_path / "high.yaml"))
    append(log, points(2, x=9.0))
    append(log, points(1, first_frame=10, x=0.0))
    with Parts([part]) as running, Subscription(log, "tests", types=["situation_detected"]) as situations:
        assert {segment.stream.source for segment in situations.poll(timeout_s=60).segments} == {"gate"}
        running.check()
