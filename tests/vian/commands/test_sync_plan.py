"""`vian sync plan` at the command line."""

import json
from pathlib import Path

import pytest

from events import station_name
from store import Log
from sync import Plan
from sync.planning import planned_in
from tests.vian.conftest import Run
from tests.vian.samples import append, points

PLAN = """\
entries:
  - {stream: "*/*/situation_detected", from: now, priority: alerts}
  - {stream: "*/gate/track_point", where: "confidence > 0.5", leave_out: [vx]}
"""


@pytest.fixture
def options(log: Log) -> tuple[str, ...]:
    append(log, points(20))
    Path("plan.yaml").write_text(PLAN)
    return ("--dsn", log.dsn, "--station", "brno")


def plans(log: Log) -> int:
    planned = planned_in(log, station_name("brno"))
    return planned.sequence if planned else 0


def test_a_plan_is_shown_before_one_was_set_and_behind_it(log: Log, options: tuple[str, ...], run: Run) -> None:
    assert "no plan was set yet" in run("sync", "plan", "show", *options).words
    assert run("sync", "plan", "set", "plan.yaml", *options).code == 0

    shown = json.loads(run("sync", "plan", "show", *options, "--json").out)

    planned = planned_in(log, station_name("brno"))
    assert planned is not None
    assert shown.pop("plan_hash") == planned.plan_hash
    assert {"set_at", "central"} <= shown.keys()
    said = {name: value for name, value in shown.items() if name not in ("set_at", "central")}
    assert Plan.of(said) == planned.plan
    assert "confidence > 0.5" in run("sync", "plan", "show", *options).out


def test_setting_a_plan_again_appends_nothing(log: Log, options: tuple[str, ...], run: Run) -> None:
    for _ in range(2):
        assert run("sync", "plan", "set", "plan.yaml", *options).code == 0
    assert plans(log) == 1


def test_a_pause_outlasts_a_change_of_the_plan(log: Log, options: tuple[str, ...], run: Run) -> None:
    run("sync", "plan", "pause", *options)
    said = run("sync", "plan", "set", "plan.yaml", *options).words
    assert "the plan is paused: nothing is sent. Next: vian sync plan resume" in said
    planned = planned_in(log, station_name("brno"))
    assert planned is not None
    assert planned.plan.paused
    run("sync", "plan", "resume", *options)
    planned = planned_in(log, station_name("brno"))
    assert planned is not None
    assert not planned.plan.paused
    assert planned.plan.entries == Plan.load(Path("plan.yaml")).resolved(planned.time, planned.plan).entries


@pytest.mark.parametrize(
    "text, said",
    [
        ("entries: []", "the plan names no stream"),
        ("entries: [{stream: 'oslo/*/*'}]", "the plan names no stream of station brno; write */... or brno/..."),
        ("entries: [{stream: '*/*/*', from: 2999-01-01T00:00:00Z}]", "lies ahead of this station's clock"),
    ],
)
def test_a_plan_that_cannot_be_is_told_and_not_set(
    log: Log, options: tuple[str, ...], run: Run, text: str, said: str
) -> None:
    Path("plan.yaml").write_text(text)
    ran = run("sync", "plan", "set", "plan.yaml", *options)
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.words
    assert plans(log) == 0


def test_options_before_the_name_of_the_command_are_not_lost(run: Run) -> None:
    ran = run("sync", "--station", "brno", "plan", "show")
    assert ran.code == 2
    assert "options stand behind the command's whole name. Next: vian sync plan --help" in ran.words


def test_a_log_of_another_station_is_told(log: Log, options: tuple[str, ...], run: Run) -> None:
    ran = run("sync", "plan", "show", "--dsn", log.dsn, "--station", "typo")
    assert ran.code == 1
    assert "no streams of station typo, but of brno. Next: give --station brno" in ran.words
