"""The plan that counts is the newest in the log."""

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import pytest

from events import Producer, SyncPlanned, batch_of, encode
from store import Log
from sync import Plan, PlanError
from sync.plans.planning import plan_stream, planned_in, set_plan
from tests.sync.conftest import BRNO, NOON, PRODUCER, MakeDaemon

NOW = {"entries": [{"stream": "*/*/*", "from": "now"}]}


def put(log: Log, plan: Plan, now: datetime = NOON, central: str = "http://central") -> Any:
    return set_plan(log, BRNO, plan, central, now)


def append(log: Log, text: str) -> None:
    event = SyncPlanned(time=NOON, central="http://central", plan=text, plan_hash="")
    log.append([encode(plan_stream(BRNO), batch_of([event]), Producer("sync", "1", bytes(32)))])


def test_no_plan_is_none(station_log: Log) -> None:
    assert planned_in(station_log, BRNO) is None


def test_the_plan_that_was_set_last_counts_and_setting_it_again_appends_nothing(station_log: Log) -> None:
    plan = Plan.of({"entries": [{"stream": "*/*/*", "rate": "8 kbit/s"}], "paused": True})
    put(station_log, Plan.of({"entries": [{"stream": "*/a/*"}]}))
    planned = put(station_log, plan)
    assert planned == put(station_log, plan, NOON + timedelta(days=1)) == planned_in(station_log, BRNO)
    assert (planned.plan, planned.time, planned.sequence) == (plan, NOON, 2)
    assert put(station_log, plan, central="http://other").sequence == 3


def test_now_becomes_the_time_at_which_the_entry_was_first_set(station_log: Log) -> None:
    put(station_log, Plan.of(NOW))
    again = put(station_log, Plan.of(NOW), NOON + timedelta(days=1))
    assert (again.sequence, again.plan.entries[0].since) == (1, NOON)
    other = put(station_log, Plan.of({"entries": [*NOW["entries"], {"stream": "*/a/*", "from": "now"}]}), NOON + HOUR)
    assert [entry.since for entry in other.plan.entries] == [NOON, NOON + HOUR]
    with pytest.raises(PlanError, match="from: now, which has a time once the plan is set"):
        _ = Plan.of(NOW).entries[0].since


HOUR = timedelta(hours=1)


def test_now_stays_however_the_entry_is_spelled(station_log: Log) -> None:
    entry = {"stream": "*/*/plate_read", "from": "now", "leave_out": ["region", "country"], "order": "oldest"}
    for day in range(2):
        planned = put(station_log, Plan.of({"entries": [entry]}), NOON + timedelta(days=day))
    assert (planned.sequence, planned.plan.entries[0].since) == (1, NOON)


def test_a_plan_that_the_log_has_counts_though_the_clock_was_set_back_since(
    station_log: Log, make_daemon: MakeDaemon
) -> None:
    entry = {"stream": "*/*/*", "from": (NOON + HOUR).isoformat()}
    planned = put(station_log, Plan.of({"entries": [entry]}), NOON + 2 * HOUR)

    assert put(station_log, Plan.of({"entries": [entry]})).sequence == planned.sequence
    make_daemon(plan=planned.plan, now=lambda: NOON).catch_up()
    now = planned_in(station_log, BRNO)
    assert now is not None
    assert now.plan == planned.plan


def test_what_lies_ahead_of_the_clock_is_refused(station_log: Log) -> None:
    plan = Plan.of({"entries": [{"stream": "*/*/*", "from": (NOON + HOUR).isoformat()}]})
    with pytest.raises(PlanError, match=r"entries\[0\] \(\*/\*/\*\): from 2026-05-01T13:00:00Z lies ahead of this"):
        put(station_log, plan)
    assert put(station_log, plan, NOON + HOUR).plan == plan


def test_a_plan_that_names_no_stream_of_the_station_is_refused(station_log: Log) -> None:
    with pytest.raises(PlanError, match="names no stream of station brno-2; write"):
        put(station_log, Plan.of({"entries": [{"stream": "oslo-1/*/*"}]}))


def test_a_pause_stays_until_a_plan_says_otherwise(station_log: Log) -> None:
    put(station_log, Plan.of({**NOW, "paused": True}))
    assert put(station_log, Plan.of({"entries": [{"stream": "*/a/*"}]})).plan.paused
    assert not put(station_log, Plan.of({"entries": [{"stream": "*/a/*"}], "paused": False})).plan.paused


def test_a_plan_of_the_first_version_reads_and_has_the_hash_that_it_had(station_log: Log) -> None:
    lines = [(10, "a"), (30, "*")]
    entries = [f'{{"from":"beginning","priority":{number},"stream":"*/*/{each}"}}' for number, each in lines]
    text = f'{{"entries":[{",".join(entries)}]}}'
    append(station_log, text)
    planned = planned_in(station_log, BRNO)
    assert planned is not None
    assert planned.plan.canonical() == text
    assert [entry.order for entry in planned.plan.entries] == ["live", "oldest"]


def test_a_plan_that_does_not_read_is_an_error_and_not_another_plan(station_log: Log) -> None:
    put(station_log, Plan.of(NOW))
    append(station_log, '{"entries":[{"stream":"*/*/*","of_tomorrow":1}]}')
    with pytest.raises(PlanError, match=r"the plan at brno-2/sync/sync_planned/2 does not read here: .*of_tomorrow"):
        planned_in(station_log, BRNO)


def test_the_plan_of_before_a_restore_still_counts(station_log: Log, make_log: Callable[[], Log]) -> None:
    planned = put(station_log, Plan.of(NOW))
    with station_log.connection() as connection:
        connection.execute("reset role")
        connection.execute("update log_head set epoch = 2")
    station_log.epoch = 2
    assert planned_in(station_log, BRNO) == planned
    again = put(station_log, Plan.of({"entries": [{"stream": "*/a/*"}]}))
    assert (again.epoch, again.sequence) == (2, 1)


def test_a_segment_of_several_plans_means_its_last(station_log: Log) -> None:
    texts = ['{"entries":[{"stream":"*/a/*"}]}', '{"entries":[{"stream":"*/b/*"}]}']
    events = [SyncPlanned(time=NOON, central="", plan=text, plan_hash="") for text in texts]
    station_log.append([encode(plan_stream(BRNO), batch_of(events), PRODUCER)])
    planned = planned_in(station_log, BRNO)
    assert planned is not None
    assert planned.plan.entries[0].stream == "*/b/*"
