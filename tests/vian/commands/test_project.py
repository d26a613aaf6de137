"""`vian project` and the commands below it."""

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from store import Log, Projector
from tests.store.samples import query
from tests.vian.conftest import Run
from tests.vian.samples import objects


def status(log: Log, run: Run, type_name: str = "track_point") -> dict[str, Any]:
    (found,) = [
        row for row in objects(run("project", "status", "--dsn", log.dsn, "--json").out) if row["type"] == type_name
    ]
    return found


def test_project_brings_the_rows_up_to_the_log(filled: Log, run: Run) -> None:
    assert objects(run("project", "--dsn", filled.dsn, "--json").out) == [{"position": 3, "segments": 3, "skipped": 0}]
    assert run("project", "--dsn", filled.dsn).out == "row tables up to position 3: 0 segments now\n"


def test_the_status_shows_how_far_each_type_is_behind(filled: Log, run: Run) -> None:
    found = status(filled, run)
    assert (found["state"], found["position"], found["lag_segments"]) == ("behind", 0, 3)
    assert found["lag_s"] > 0
    run("project", "--dsn", filled.dsn)
    found = status(filled, run)
    assert (found["state"], found["position"], found["lag_segments"], found["lag_s"]) == ("complete", 3, 0, 0.0)
    assert (found["partitions"], found["rows_estimate"]) == (1, 40)
    people = run("project", "status", "--dsn", filled.dsn)
    assert "head of the log: 3" in people.out
    assert "track_point" in people.out


def test_a_rebuild_makes_a_types_rows_anew(filled: Log, run: Run) -> None:
    run("project", "--dsn", filled.dsn)
    ran = run("project", "rebuild", "track_point", "--dsn", filled.dsn, "--json")
    assert objects(ran.out) == [{"type": "track_point", "resumed": False, "rows_estimate": 40, "skipped": 0}]
    assert query(filled, "select count(*) from track_point") == [(40,)]
    ran = run("project", "rebuild", "track_point", "--dsn", filled.dsn)
    assert ran.out == "row table track_point: made anew, about 40 rows\n"


def test_a_rebuild_goes_on_where_it_was_interrupted(filled: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("store.projector.DELIVERY_SEGMENTS", 1)
    run("project", "--dsn", filled.dsn)
    stepped = Projector.step_behind

    def interrupted(self: Projector, type_name: str) -> bool:
        stepped(self, type_name)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Projector, "step_behind", interrupted)
        ran = run("project", "rebuild", "track_point", "--dsn", filled.dsn)
    assert ran.code == 130
    assert "the same command goes on where it stopped" in ran.words
    found = status(filled, run)
    assert (found["state"], found["position"], found["rows_estimate"]) == ("being built", 1, 30)
    ran = run("project", "rebuild", "track_point", "--dsn", filled.dsn, "--json")
    assert objects(ran.out) == [{"type": "track_point", "resumed": True, "rows_estimate": 40, "skipped": 0}]
    assert status(filled, run)["state"] == "complete"


def test_a_rebuild_leaves_out_what_retention_would_drop(filled: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run("project", "--dsn", filled.dsn)
    monkeypatch.setenv("VIAN_ROWS_KEEP_DAYS", "1")
    assert objects(run("project", "rebuild", "track_point", "--dsn", filled.dsn, "--json").out)[0]["rows_estimate"] == 0
    today = (datetime.now(UTC) - timedelta(days=1)).date()
    assert status(filled, run)["retained_from"] in (str(today), str(today - timedelta(days=1)))


def test_upkeep_drops_what_the_settings_say_and_tells_each_step(
    filled: Log, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("project", "--dsn", filled.dsn)
    assert objects(run("project", "maintain", "--dsn", filled.dsn, "--json").out) == [
        {"dropped": 0, "made": 0, "closed": 0, "postponed": 0}
    ]
    monkeypatch.setenv("VIAN_ROWS_CLOSE_AFTER_H", "0")
    ran = run("project", "maintain", "--dsn", filled.dsn)
    assert ran.out == "partitions: 0 dropped, 0 made ahead, 1 closed\n"
    assert "track_point: closed 2026-01-01" in ran.words
    assert status(filled, run)["closed"] == 1
    monkeypatch.setenv("VIAN_ROWS_KEEP_DAYS_BY_TYPE", '{"track_point": 2}')
    ran = run("project", "maintain", "--dsn", filled.dsn)
    assert ran.out == "partitions: 1 dropped, 0 made ahead, 0 closed\n"
    assert status(filled, run)["partitions"] == 0


@pytest.mark.parametrize(
    "arguments, settings, told",
    [
        (["rebuild", "nothing"], {}, "no event type 'nothing'; known: activity_interval, "),
        (["rebuild"], {}, "Missing argument 'TYPE'"),
        (
            ["maintain"],
            {"VIAN_ROWS_KEEP_DAYS_BY_TYPE": '{"nothing": 1}'},
            "rows_keep_days_by_type: no event type 'nothing'",
        ),
        (
            ["maintain"],
            {"VIAN_ROWS_KEEP_DAYS": "0"},
            "setting rows_keep_days: Input should be greater than",
        ),
        (["--json", "status"], {}, "options stand behind the command's whole name. Next: vian project status --help"),
    ],
)
def test_wrong_usage_is_told(
    log: Log, run: Run, monkeypatch: pytest.MonkeyPatch, arguments: list[str], settings: dict[str, str], told: str
) -> None:
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    ran = run("project", *arguments, "--dsn", log.dsn)
    assert ran.code == 2
    assert told in " ".join(ran.words.replace("│", " ").split())
