"""`vian rules`: check and run, and what is said of each kind of mistake."""

import json
from pathlib import Path

import pytest

from store import Log, Projector
from tests.vian.conftest import Run
from tests.vian.samples import append, points
from tests.vian.test_rules import HIGH, SHIPPED, write_rule
from vian.querying import query

CASE = """
tests:
  - name: one is high
    given:
      - {{time: 2026-01-01T10:00:00Z, track_id: 1, x: 9}}
      - {{time: 2026-01-01T10:00:01Z, track_id: 1, x: 1}}
    frames: {{gate: [100, 100]}}
    expect: [{{at: {at}}}]
"""


def test_the_shipped_rules_pass_their_tests(run: Run) -> None:
    ran = run("rules", "check", SHIPPED)
    assert ran.code == 0
    assert "zone-intrusion v1, one track walks in" in ran.out
    assert ran.out.count(": passed") == 6


def test_check_prints_json(run: Run) -> None:
    ran = run("rules", "check", SHIPPED, "--json")
    results = [json.loads(line) for line in ran.out.splitlines()]
    assert {result["rule"] for result in results} == {"line-crossing", "loitering", "speeding", "zone-intrusion"}
    assert all(result["passed"] for result in results if "passed" in result)


@pytest.mark.parametrize("at, code", [(9, 0), (8, 2)])
def test_a_test_that_fails_is_wrong_usage_and_shows_the_difference(
    run: Run, tmp_path: Path, at: int, code: int
) -> None:
    path = tmp_path / "high.yaml"
    path.write_text(HIGH.format(name="high", version=1, x=5) + CASE.format(at=at))
    ran = run("rules", "check", path)
    assert ran.code == code
    if code:
        difference = "high v1, one is high: FAILED; wanted (-), got (+)\n- at: 8\n+ at: 9.0\n"
        assert ran.out.endswith(f"\n{path}:13:5: error: {difference}")
        assert f"1 of 1 rule files did not pass: {path}" in ran.words


def test_a_rule_without_tests_fits_and_that_is_said(run: Run, tmp_path: Path) -> None:
    ran = run("rules", "check", write_rule(tmp_path / "high.yaml"))
    assert ran.code == 0
    assert "high v1: fits, but has no tests" in ran.out


@pytest.mark.parametrize(
    "right, wrong, said",
    [
        ("rule: high", "rule: [", "not YAML"),
        ("severity: info", "severity: loud", "severity"),
        ("SELECT *", "SELEC *", "wanted SELECT, got SELEC"),
        ("FROM track_point", "FROM nothing", "nothing"),
        ("PARTITION BY source", "PARTITION source", "PARTITION"),
        ("ORDER BY time", "ORDER time", "ORDER"),
        ("MEASURES a.x AS at", "MEASURES a.nil AS at", "nil"),
        ("ONE ROW PER MATCH", "ALL ROWS PER MATCH", "a situation is one row"),
        ("SKIP PAST LAST ROW", "SKIP SOMEWHERE", "SKIP"),
        ("PATTERN (a)", "PATTERN (a", "PATTERN"),
        ("PATTERN (a)", "PATTERN ()", "PATTERN"),
        ("a.x > 5", "a.x >", "^"),
        ("a.x > 5", "in_zone(a.x, a.y, 'yard')", "yard"),
    ],
)
def test_a_mistake_in_a_rule_is_wrong_usage_with_its_place(
    run: Run, tmp_path: Path, right: str, wrong: str, said: str
) -> None:
    path = tmp_path / "wrong.yaml"
    text = HIGH.format(name="high", version=1, x=5)
    assert right in text
    path.write_text(text.replace(right, wrong))
    ran = run("rules", "check", path)
    assert ran.code == 2
    told = ran.out + ran.err
    assert f"{path}:" in told, told
    assert said in told, told


def test_rules_run_over_the_log_once_and_find_each_situation_once(log: Log, run: Run, tmp_path: Path) -> None:
    rule = write_rule(tmp_path / "high.yaml")
    append(log, points(2, x=9.0))
    append(log, points(2, first_frame=5, x=0.0))
    first = run("rules", "run", rule, "--once", "--dsn", log.dsn, "--station", "brno", "--json")
    assert json.loads(first.out) == {"rules": 1, "situations": 2}
    assert "deployed high version 1" in first.err
    assert Projector(log).position == log.head(), "the row tables were brought up to the log"
    again = run("rules", "run", rule, "--once", "--dsn", log.dsn, "--station", "brno")
    assert again.out == "0 situations found by 1 rule\n"
    assert again.err == ""
    titles = query(log, "select title from situation_detected").column("title").to_pylist()
    assert titles == ["track 1 is at 9.0", "track 1 is at 9.0"]


def test_events_that_came_too_late_are_told(log: Log, run: Run, tmp_path: Path) -> None:
    append(log, points(3, first_frame=100))
    append(log, points(2))
    ran = run("rules", "run", write_rule(tmp_path / "high.yaml"), "--once", "--dsn", log.dsn, "--station", "brno")
    assert "rule high: 2 events came too late to take part" in ran.err


def test_a_changed_rule_of_the_same_version_is_wrong_usage(log: Log, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "high.yaml"
    assert run("rules", "run", write_rule(path), "--once", "--dsn", log.dsn).code == 0
    ran = run("rules", "run", write_rule(path, x=6), "--once", "--dsn", log.dsn)
    assert ran.code == 2
    assert "Next: give the changed rule a new version" in ran.words


@pytest.mark.parametrize("arguments", [["check", "gone.yaml"], ["run", "gone.yaml", "--once", "--data-dir", "log"]])
def test_a_rule_file_that_is_not_there_is_wrong_usage(run: Run, arguments: list[str]) -> None:
    ran = run("rules", *arguments)
    assert ran.code == 2
    assert "gone.yaml: no such file or folder" in ran.words
    assert not Path("log").exists()


def test_all_files_are_checked_and_each_that_is_wrong_is_named_in_one_form(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("rule: [")
    (tmp_path / "b.yaml").write_bytes(b"rule: \xff")
    write_rule(tmp_path / "c.yaml", name="twice")
    write_rule(tmp_path / "d.yaml", name="twice")
    (tmp_path / "e.yaml").write_text(HIGH.format(name="e", version=1, x=5) + CASE.format(at=8).replace(": 9}", ": z}"))
    (tmp_path / "f.yaml").symlink_to(tmp_path / "gone.yaml")
    (tmp_path / "g.yaml").write_text(HIGH.format(name="g", version=1, x=5) + CASE.format(at=8))
    (tmp_path / "h.yaml").write_text(HIGH.format(name="h", version=1, x=5) + CASE.format(at=9))
    ran = run("rules", "check", tmp_path)
    assert ran.code == 2
    told = [line for line in ran.out.splitlines() if "error: " in line]
    assert [line.removeprefix(f"{tmp_path}/").split(": ")[0] for line in told] == [
        "a.yaml:1:8", "b.yaml:1:7", "d.yaml:1:7", "e.yaml:15:54", "f.yaml", "g.yaml:13:5",
    ]  # fmt: skip
    assert f"the rule 'twice' is also defined in {tmp_path}/c.yaml. Next: rename one" in told[2]
    assert "h v1, one is high: passed" in ran.out
    assert "6 of 8 rule files did not pass: " in ran.words
    objects = [json.loads(line) for line in run("rules", "check", tmp_path, "--json").out.splitlines()]
    assert len([each for each in objects if each.get("severity") == "error"]) == 5


ZONE = "zones: {yard: {source: cam-01, polygon: [[0, 0], [1, 0], [1, 1]]}}\n"


@pytest.mark.parametrize("source, is_warned", [("cam-01", True), ("gate", False)])
def test_a_zone_of_a_source_that_the_log_has_not_is_told_before_the_rule_is_deployed(
    log: Log, run: Run, tmp_path: Path, source: str, is_warned: bool
) -> None:
    append(log, points(1))
    path = write_rule(tmp_path / "high.yaml")
    path.write_text(path.read_text() + ZONE.replace("cam-01", source))
    ran = run("rules", "run", path, "--once", "--dsn", log.dsn, "--station", "brno")
    assert ran.code == 0
    said = f"high: zone 'yard' is of source {source}, of which this log has no track_point; it has: gate. Next: change"
    assert (said in ran.words) == is_warned
    assert ran.words.endswith("deployed high version 1")


TESTED = """tests:
  - name: {name}
    given: [{{time: 2026-01-01T12:00:00Z, track_id: 1, x: {x}}}]
    expect: [{{at: 9}}]
"""


def test_a_rule_whose_own_tests_fail_is_told_when_it_is_deployed(log: Log, run: Run, tmp_path: Path) -> None:
    path = write_rule(tmp_path / "high.yaml")
    path.write_text(path.read_text() + TESTED.format(name="as wanted", x=9))
    assert "warning" not in run("rules", "run", path, "--once", "--dsn", log.dsn).err
    path.write_text(path.read_text().replace("version: 1", "version: 2").replace("x: 9", "x: 8"))
    for command in (("deploy",), ("run", "--once")):
        ran = run("rules", *command, path, "--dsn", log.dsn)
        assert ran.code == 0
        said = f"warning: high: 1 of its own 1 tests fail: as wanted. Next: vian rules test {path}"
        assert said in ran.words


def test_a_rule_on_an_empty_log_waits_for_its_source_in_silence(log: Log, run: Run, tmp_path: Path) -> None:
    path = write_rule(tmp_path / "high.yaml")
    path.write_text(path.read_text() + ZONE)
    assert "warning" not in run("rules", "run", path, "--once", "--dsn", log.dsn).err


def test_rules_of_two_stations_run_over_one_log_beside_each_other(log: Log, run: Run, tmp_path: Path) -> None:
    rule = write_rule(tmp_path / "high.yaml")
    append(log, points(2, x=9.0))
    append(log, points(2, first_frame=5, x=0.0))
    for station in ("brno", "praha"):
        ran = run("rules", "run", rule, "--once", "--dsn", log.dsn, "--station", station, "--json")
        assert json.loads(ran.out) == {"rules": 1, "situations": 2}


def test_a_rule_that_cannot_go_into_service_is_not_deployed(log: Log, run: Run, tmp_path: Path) -> None:
    path = write_rule(tmp_path / "high.yaml")
    path.write_text(path.read_text().replace("track_point", "no_such_type"))
    ran = run("rules", "run", path, "--once", "--dsn", log.dsn, "--station", "brno")
    assert ran.code == 2
    assert log.head() == 0
