"""`vian stages`: files are checked, and run over a log."""

from pathlib import Path

from store import Log
from tests.patterns.test_processor import STATION
from tests.vian.conftest import Run
from tests.vian.test_staging import CROWD, _derived, _walk

BAD_TEST = CROWD + "tests:\n  - given: [{time: '2026-01-01T10:00:00Z', track_id: 1, x: 1, y: 1}]\n    expect: []\n"


def test_stages_are_checked_with_their_tests_and_run_over_the_log(log: Log, run: Run, tmp_path: Path) -> None:
    (tmp_path / "crowd.yaml").write_text(CROWD)
    _walk(log)
    assert run("stages", "check", tmp_path).code == 0
    ran = run("stages", "run", tmp_path, "--once", "--dsn", log.dsn, "--station", STATION)
    assert ran.code == 0, ran.err
    assert len(_derived(log)) == 4


def test_a_failed_test_and_a_mistake_are_named_with_their_place(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "crowd.yaml"
    file.write_text(BAD_TEST)
    ran = run("stages", "check", file)
    assert ran.code == 2
    assert f"{file}:7:5: error: crowd v1, test 1: FAILED" in ran.out + ran.err
    file.write_text(CROWD.replace("zones", "zone"))
    ran = run("stages", "check", file)
    assert ran.code == 2
    assert f"{file}:5:3: occupancy.zone: unknown key; there are: gone_after, zones" in ran.out + ran.err
    assert run("stages", "check", tmp_path / "none").code == 2
