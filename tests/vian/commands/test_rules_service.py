"""`vian rules deploy`, `retire` and `status`: rules into service and out, over one log."""

import json
from pathlib import Path

import pytest

from patterns.processor import Processor
from store import Log
from tests.vian.conftest import Run
from tests.vian.samples import append, points
from tests.vian.test_rules import write_rule


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_rule(tmp_path / "high.yaml")


def place(log: Log) -> tuple[str, ...]:
    return ("--dsn", log.dsn, "--station", "brno")


def test_a_rule_is_deployed_runs_and_is_retired(log: Log, path: Path, run: Run) -> None:
    append(log, points(2, x=9.0))
    append(log, points(1, first_frame=10, x=0.0))
    ran = run("rules", "deploy", path, *place(log))
    assert (ran.code, ran.out) == (0, "high version 1: deployed\n")
    assert run("rules", "deploy", path, *place(log)).out == "high version 1: in service already\n"
    processor = Processor(log, "brno")
    assert processor.catch_up() > 0
    assert processor.catch_up() == 0
    (said,) = (json.loads(line) for line in run("rules", "status", "--json", *place(log)).out.splitlines())
    assert (said["rule"], said["version"], said["state"], said["lag_segments"]) == ("high", 1, "runs", 0)
    assert said["rows"] == 3
    ran = run("rules", "retire", "high", "--retire", "now", *place(log))
    assert (ran.code, ran.out) == (0, "high version 1: retired\n")
    processor.catch_up()
    assert processor.rules == []
    assert "No rule is deployed here" in run("rules", "status", *place(log)).words
    assert "retired" in run("rules", "status", "--all", *place(log)).out


def test_a_rule_in_shadow_begins_where_it_is_told_to(log: Log, path: Path, run: Run) -> None:
    append(log, points(2, x=9.0))
    at = log.head()
    run("rules", "deploy", path, "--from", "head", "--shadow", "--json", *place(log))
    (said,) = (json.loads(line) for line in run("rules", "status", "--json", *place(log)).out.splitlines())
    assert (said["state"], said["after_position"]) == ("shadow", at)


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("deploy", "{path}", "--from", "noon"), "--from must be a time such as"),
        (("deploy", "{path}", "--from", "2100-01-01T00:00:00Z"), "the log has no event at or after"),
        (("retire", "hihg"), "no version of rule 'hihg' is in service; in service: none"),
        (("deploy", "{path}.gone"), "no such file or folder"),
    ],
)
def test_wrong_usage_is_told_with_the_next_step(
    log: Log, path: Path, run: Run, arguments: tuple[str, ...], said: str
) -> None:
    append(log, points(2, x=9.0))
    ran = run("rules", *(each.format(path=path) for each in arguments), *place(log))
    assert ran.code == 2
    assert said in ran.words


def test_a_rule_that_was_set_aside_is_told_with_why_and_how_it_comes_back(log: Log, path: Path, run: Run) -> None:
    path.write_text(path.read_text().replace("PATTERN (a)", "PATTERN (a+)").replace("PAST LAST ROW", "TO FIRST a"))
    run("rules", "deploy", path, *place(log))
    append(log, points(2, x=9.0))
    append(log, points(1, first_frame=10, x=0.0))
    append(log, points(1, first_frame=20, x=0.0))
    Processor(log, "brno").catch_up()
    ran = run("rules", "status", *place(log))
    assert "high version 1 was set aside at position" in ran.out
    assert "brings it back" in ran.words


def test_what_to_do_for_metres_names_the_station_where_it_is_not_the_usual_one(
    log: Log, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "far.yaml"
    path.write_text(
        "rule: far\nversion: 1\ntitle: far\nseverity: info\nmatch: |\n"
        "  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence\n"
        "    MEASURES LAST(A.x) AS x PATTERN (A) DEFINE A AS ground_y(x, y) > 9)\n"
    )
    append(log, points(2))
    run("rules", "deploy", path, *place(log))
    processor = Processor(log, "brno")
    processor.catch_up()
    processor.save()
    words = run("rules", "status", *place(log)).words
    assert "Next: vian extract calibration --source gate --station brno says what is missing" in words
    assert "vian zones calibrate gate POINTS.yaml --station brno, or leave" in words
    monkeypatch.setenv("VIAN_STATION", "brno")
    assert "--source gate says what is missing" in run("rules", "status", *place(log)).words
