"""`vian rules new`, `lint`, `test` and `expand`: from a template to a rule that passes its tests."""

import json
from pathlib import Path

import pytest
import yaml

from patterns.files.loading import load_rule
from patterns.files.template import templates
from tests.vian.conftest import Run
from tests.vian.test_rules import HIGH, SHIPPED, write_rule

CASE = """
tests:
  - name: one is high
    given:
      - {time: 2026-01-01T10:00:00Z, track_id: 1, x: 9}
    expect: [{title: track 1 is at 9, at: 8, track_id: 1}]
"""


def test_templates_are_listed_with_their_parameters(run: Run) -> None:
    ran = run("rules", "new", "--json")
    listed = {row["template"]: row for row in map(json.loads, ran.out.splitlines())}
    assert list(listed) == list(templates())
    assert listed["loitering"]["parameters"] == "zone, min_duration: 30 s"


@pytest.mark.parametrize("template", list(templates()))
def test_a_new_rule_of_each_template_passes_its_tests(run: Run, template: str) -> None:
    assert run("rules", "new", "mine", "--template", template, "-o", "mine.yaml").code == 0
    assert load_rule(Path("mine.yaml")).rule == "mine"
    ran = run("rules", "test", "mine.yaml")
    assert ran.code == 0, ran.out
    assert "tests passed" in ran.words


def test_a_place_and_parameters_may_be_given_and_then_the_tests_are_the_authors(run: Run) -> None:
    place = "street:0.1,0.6,0.4,0.6,0.4,0.9"
    ran = run("rules", "new", "mine", "-t", "loitering", "--zone", place, "--with", "min_duration=6 s")
    said = yaml.safe_load(ran.out)
    assert said["zones"] == {"yard": {"source": "street", "polygon": [[0.1, 0.6], [0.4, 0.6], [0.4, 0.9]]}}
    assert said["with"] == {"zone": "yard", "min_duration": "6 s"}
    assert "tests" not in said
    ran = run(
        "rules", "new", "mine", "-t", "line-crossing", "--line", "gate:500,900,500,300", "--with", "direction=any"
    )
    assert yaml.safe_load(ran.out)["lines"]["door"] == {
        "source": "gate", "units": "pixels", "points": [[500, 900], [500, 300]],
    }  # fmt: skip


def test_an_expanded_rule_is_the_same_rule(run: Run) -> None:
    run("rules", "new", "mine", "--template", "loitering", "-o", "mine.yaml")
    assert run("rules", "expand", "mine.yaml", "-o", "whole.yaml").code == 0
    one, whole = (load_rule(Path(name)) for name in ("mine.yaml", "whole.yaml"))
    assert one.hash == whole.hash
    assert "MATCH_RECOGNIZE" in Path("whole.yaml").read_text()
    assert "MATCH_RECOGNIZE" in run("rules", "expand", "mine.yaml").out


WRONG: list[tuple[list[str], str]] = [
    (["new", "mine", "--template", "loitring"], "there is no template 'loitring'; there are: "),
    (["new", "--template", "loitering"], "a new rule needs a name. Next: vian rules new NAME --template loitering"),
    (["new", "mine", "-t", "loitering", "--zone", "0.1,0.2"], "--zone must be SOURCE:X,Y,X,Y..., such as"),
    (
        ["new", "mine", "-t", "loitering", "--zone", "gate:-0.1,0,0.5,1,1,0"],
        "--zone: shares of the picture lie in 0 to 1",
    ),
    (["new", "mine", "-t", "loitering", "--zone", "gate:1,2,3"], "--zone must be SOURCE:X,Y,X,Y..., such as"),
    (["new", "mine", "-t", "loitering", "--zone", "gate:0,0,1,1,0,1,1,0"], "a polygon must have an area"),
    (["new", "mine", "-t", "loitering", "--line", "gate:0,0,1,1"], "this template has no line for --line to place"),
    (["new", "mine", "-t", "loitering", "--with", "dwell"], "--with must be NAME=VALUE"),
    (["new", "mine", "-t", "loitering", "--with", "dwell=5 s"], "dwell"),
    (["new", "mine", "-t", "loitering", "--with", "min_duration=5 km"], "min_duration"),
    (["new", "a b", "-t", "loitering"], "rule"),
    (["new", "mine", "-t", "loitering", "-o", "there.yaml"], "there.yaml is there already"),
    (["expand", "gone.yaml"], "gone.yaml: no such file or folder"),
    (["lint", "there.yaml"], "1 error, 0 warnings"),
    (["test", "there.yaml"], "tests failed in 1 of 1 files: there.yaml"),
]


def test_wrong_use_is_told_with_what_was_wanted(run: Run) -> None:
    Path("there.yaml").write_text("rule: [")
    for arguments, said in WRONG:
        ran = run("rules", *arguments)
        assert ran.code == 2, arguments
        assert said in ran.words, arguments
    assert Path("there.yaml").read_text() == "rule: ["
    assert run("rules", "new", "mine", "-t", "loitering", "-o", "gone/there.yaml").code == 1


def test_a_test_that_fails_shows_value_below_value_and_points_at_what_differs(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "high.yaml"
    path.write_text(HIGH.format(name="high", version=1, x=5) + CASE)
    ran = run("rules", "test", path)
    assert ran.code == 2
    assert ran.out.splitlines() == [
        f" FAILED high: one is high  ({path}:13:5)",
        "        - wanted  + found",
        "        - title: track 1 is at 9,   at: 8,   track_id: 1",
        "        + title: track 1 is at 9.0, at: 9.0, track_id: 1",
        "        ? " + "^" * 24 + "  ^^^^^^^",
    ]
    assert "tests failed in 1 of 1 files" in ran.words


def test_tests_of_stages_run_too(run: Run) -> None:
    ran = run("rules", "test", Path(__file__).parents[2] / "patterns" / "stages" / "cases" / "near.yaml", "--json")
    assert ran.code == 0
    assert all(json.loads(line)["passed"] for line in ran.out.splitlines())


def test_lint_names_what_looks_wrong_at_its_place_and_runs_nothing(run: Run, tmp_path: Path) -> None:
    assert run("rules", "lint", SHIPPED).code == 0
    ran = run("rules", "lint", write_rule(tmp_path / "high.yaml"), "--json")
    assert ran.code == 0
    assert [json.loads(line)["severity"] for line in ran.out.splitlines()].count("error") == 0
    (tmp_path / "wrong.yaml").write_text(HIGH.format(name="wrong", version=1, x=5).replace("a.x", "a.q"))
    ran = run("rules", "lint", tmp_path)
    assert ran.code == 2
    assert "error: " in ran.out
    assert "1 error" in ran.words


def test_a_file_that_cannot_be_read_does_not_keep_others_from_being_checked(run: Run) -> None:
    Path("rules").mkdir()
    Path("rules/folder.yaml").mkdir()
    run("rules", "new", "yard", "--template", "loitering", "-o", "rules/yard.yaml")
    linted = run("rules", "lint", "rules")
    assert linted.code == 2
    assert "rules/folder.yaml:1:1: error: the rule file rules/folder.yaml cannot be read: Is a dir" in linted.out
    assert "1 error, 0 warnings" in linted.words
    tested = run("rules", "test", "rules")
    assert tested.code == 2
    assert "passed yard" in tested.out
    assert "rules/folder.yaml cannot be read: Is a directory" in tested.out
