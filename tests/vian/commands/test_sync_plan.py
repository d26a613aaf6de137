"""`vian sync plan` at the command line."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from events import station_name
from store import Log
from store.payloads import weights
from sync import Plan
from sync.keeping.pruning import Proven, take_off_held
from sync.plans.planning import planned_in
from tests.vian.conftest import Run
from tests.vian.samples import append, objects, points

NOW = datetime.now(UTC) + timedelta(days=1)
PLAN = """\
entries:
  - {stream: "*/*/situation_detected", from: now, priority: alerts}
  - {stream: "*/gate/track_point", where: "confidence > 0.5"}
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


def test_a_preview_says_what_a_plan_would_mean_and_sets_nothing(log: Log, options: tuple[str, ...], run: Run) -> None:
    (found,) = objects(run("sync", "plan", "preview", "plan.yaml", *options, "--rate", "8 kbit/s", "--json").out)
    situations, filtered = found["entries"]
    assert (situations["streams"], situations["events"], situations["is_exact"]) == (0, 0, True)
    assert (filtered["streams"], filtered["events"], filtered["is_exact"]) == (1, 0, False)
    assert (found["rate_bps"], found["streams_staying"], found["warnings"]) == (8000, 0, [])
    assert found["changes"] == [
        {
            "what": f"begins, filtered, as a stream ~{filtered['filter']} of its own, from the beginning",
            "streams": ["brno/gate/track_point"],
        }
    ]
    shown = run("sync", "plan", "preview", "plan.yaml", *options)
    assert "unknown: not measured yet" in shown.out
    assert "brno/gate/track_point: begins, filtered" in shown.out
    assert plans(log) == 0


def test_what_is_said_in_vain_is_a_warning(log: Log, options: tuple[str, ...], run: Run) -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/*/*'}, {stream: '*/gate/*'}]")
    for command in ("preview", "set"):
        assert (
            "warning: entries[1] (*/gate/*) never applies" in run("sync", "plan", command, "plan.yaml", *options).words
        )


@pytest.mark.parametrize("command", ["set", "preview"])
def test_a_filter_that_does_not_fit_is_told_with_its_place(
    log: Log, options: tuple[str, ...], run: Run, command: str
) -> None:
    Path("plan.toml").write_text("[[entries]]\nstream = '*/*/track_point'\nwhere = \"speed > 'fast'\"\n")
    ran = run("sync", "plan", command, "plan.toml", *options)
    assert (ran.code, ran.out) == (2, "")
    assert "entries[0] */*/track_point: where, for track_point: line 1, column 1: track_point has no field" in ran.words
    assert "\n    speed > 'fast'\n    ^" in ran.err
    assert plans(log) == 0


def test_a_rate_that_is_none_is_told(options: tuple[str, ...], run: Run) -> None:
    ran = run("sync", "plan", "preview", "plan.yaml", *options, "--rate", "fast")
    assert ran.code == 2
    assert "--rate must be a rate such as 800 kbit/s or 1.5 Mbit/s" in ran.words


def test_an_entry_that_fits_no_stream_is_told(log: Log, options: tuple[str, ...], run: Run) -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/*/plate_rea'}, {stream: '*/*/plate_read'}, {stream: '*/*/*'}]")
    ran = run("sync", "plan", "set", "plan.yaml", *options)
    assert (ran.code, plans(log)) == (0, 1)
    assert "entries[0] (*/*/plate_rea) fits no stream of this station yet, and no event type" in ran.words
    assert "entries[1] (*/*/plate_read) fits no stream of this station yet. Next" in ran.words
    assert "entries[2]" not in ran.words


def test_what_was_pruned_and_a_filter_wants_is_told_when_the_plan_is_set(
    log: Log, options: tuple[str, ...], run: Run
) -> None:
    take_off_held(log, station_name("brno"), weights(log, 0, NOW, 10), Proven("", {}), NOW)
    said = run("sync", "plan", "set", "plan.yaml", *options).words
    assert "warning: brno/gate/track_point was pruned from sequence 1 to 20 of epoch 1: brno/gate~" in said
    assert "Next: vian sync repair --stream brno/gate/track_point --epoch 1 --from 1 --to 20" in said
    assert "brno/gate/track_point was pruned" in run("sync", "plan", "preview", "plan.yaml", *options).words
