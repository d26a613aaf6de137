"""A watched folder of rules: what changes in it is deployed, what is wrong in it changes nothing."""

from pathlib import Path

import pytest

from patterns.processor import Processor, deploy, standing
from store import Log
from tests.vian.samples import append, points
from tests.vian.test_rules import write_rule
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.rules import load_all
from vian.watching import RulesWatch, check_there, processor_part

ABOVE = """
rule: above
version: 1
title: "{n} above"
severity: info
match: |
  SELECT * FROM situation('high') MATCH_RECOGNIZE (
    PARTITION BY source ORDER BY time, sequence
    MEASURES COUNT(*) AS n
    PATTERN (a a) WITHIN INTERVAL '1' MINUTE)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "rules"
    path.mkdir()
    return path


@pytest.fixture
def watch(log: Log, folder: Path) -> RulesWatch:
    return RulesWatch(log, "brno", [folder], iter(range(1_000_000)).__next__, 0.5)


def in_service(log: Log) -> list[tuple[str, int]]:
    return [key for key, each in standing(log, "brno").items() if each.retirement is None]


def test_a_new_file_and_a_further_version_are_deployed_while_the_processor_runs(
    log: Log, folder: Path, watch: RulesWatch
) -> None:
    processor = Processor(log, "brno")
    assert watch.look() == 0
    write_rule(folder / "high.yaml")
    assert watch.look() == 1
    append(log, points(2, x=9.0))
    append(log, points(1, first_frame=10, x=0.0))
    assert processor.catch_up() > 0
    write_rule(folder / "high.yaml", version=2, x=6)
    assert watch.look() == 1
    assert watch.look() == 0
    assert in_service(log) == [("high", 2)]


@pytest.mark.parametrize(
    "text, said",
    [
        ("rule: high\nversion: one\n", "version: Input should be a valid integer"),
        ("", "got an empty file"),
        ("rule: [", "not YAML"),
    ],
)
def test_a_bad_file_is_named_and_what_runs_goes_on(
    log: Log, folder: Path, watch: RulesWatch, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    write_rule(folder / "high.yaml")
    watch.look()
    (folder / "high.yaml").write_text(text)
    write_rule(folder / "other.yaml", name="other")
    assert watch.look() == 1
    assert in_service(log) == [("high", 1), ("other", 1)]
    told = capsys.readouterr()
    assert "a rule file is left out; what runs goes on" in told.out + told.err
    assert said in told.out + told.err


def test_a_deployed_version_with_another_content_changes_nothing(log: Log, folder: Path, watch: RulesWatch) -> None:
    write_rule(folder / "high.yaml")
    watch.look()
    write_rule(folder / "high.yaml", x=66)
    assert watch.look() == 0
    assert in_service(log) == [("high", 1)]
    assert "a.x > 5" in standing(log, "brno")["high", 1].text


def test_two_files_of_one_name_are_not_both_deployed(log: Log, folder: Path, watch: RulesWatch) -> None:
    write_rule(folder / "a.yaml")
    watch.look()
    write_rule(folder / "b.yaml", version=2)
    assert watch.look() == 0
    assert in_service(log) == [("high", 1)]


def test_a_removed_file_retires_its_rule_but_not_one_that_is_being_saved(
    log: Log, folder: Path, watch: RulesWatch
) -> None:
    path = write_rule(folder / "high.yaml")
    watch.look()
    path.unlink()
    assert watch.look() == 0
    write_rule(path)
    assert watch.look() == 0
    assert in_service(log) == [("high", 1)]
    path.unlink()
    assert (watch.look(), watch.look()) == (0, 1)
    assert in_service(log) == []
    write_rule(path)
    assert watch.look() == 1
    assert in_service(log) == [("high", 1)]


def test_rules_that_others_deployed_stay(log: Log, folder: Path, watch: RulesWatch, tmp_path: Path) -> None:
    rules = load_all([write_rule(tmp_path / "other.yaml", name="other")])
    deploy(log, "brno", rules, {}, utc_now())
    write_rule(folder / "high.yaml")
    watch.look()
    assert in_service(log) == [("other", 1), ("high", 1)]


def test_a_server_starts_beside_a_bad_file_and_takes_it_up_when_it_is_mended(
    log: Log, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "bad.yaml").write_text("rule: [")
    write_rule(folder / "high.yaml")
    part = processor_part(log, "brno", folder)
    assert in_service(log) == [("high", 1)]
    told = capsys.readouterr()
    assert "a rule file is left out; what runs goes on" in told.out + told.err
    part.close()


def test_a_server_starts_on_an_empty_folder_and_not_on_none(log: Log, folder: Path) -> None:
    check_there(folder)
    processor_part(log, "brno", folder).close()
    assert in_service(log) == []
    with pytest.raises(WrongUsage, match=r"there is no .*rules2 to read rules from. Next: mkdir"):
        check_there(folder.with_name("rules2"))


def test_a_rule_over_situations_of_another_is_taken_up_in_whatever_order_they_come(
    log: Log, folder: Path, watch: RulesWatch
) -> None:
    (folder / "above.yaml").write_text(ABOVE)
    assert watch.look() == 0
    write_rule(folder / "high.yaml")
    assert watch.look() == 2
    assert in_service(log) == [("high", 1), ("above", 1)]


def test_rules_that_come_together_are_deployed_from_the_lowest_stratum_up(
    log: Log, folder: Path, watch: RulesWatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "above.yaml").write_text(ABOVE)
    write_rule(folder / "high.yaml")
    assert watch.look() == 2
    assert in_service(log) == [("high", 1), ("above", 1)]
    assert "left out" not in capsys.readouterr().err
