from datetime import UTC
from pathlib import Path

import pytest

from events import SHIPPED, StreamName
from store import Log
from sync.errors import PlanError
from tests.vian.samples import START, append, points
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.replication import load_plan, station_daemon

TOKEN = "a-token-of-brno-that-nobody-guesses"


def test_the_default_plan_sends_everything_and_situations_before_points() -> None:
    plan = load_plan(None)
    found = {each.type_name: plan.priority_of(StreamName.of("brno", "gate", each.type_name)) for each in SHIPPED}
    priorities = {name: priority for name, priority in found.items() if priority is not None}
    assert priorities.keys() == found.keys()
    assert priorities["situation_detected"] == priorities["rule_deployed"] == min(priorities.values())
    assert priorities["situation_detected"] < priorities["track_ended"] < priorities["track_point"]


def test_a_plan_comes_from_its_file() -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/*/situation_detected', priority: situations}]\n")
    plan = load_plan(Path("plan.yaml"))
    assert plan.priority_of(StreamName.of("brno", "gate", "track_point")) is None


def test_a_plan_that_is_not_there_is_told() -> None:
    with pytest.raises(PlanError, match=r"gone\.yaml"):
        load_plan(Path("gone.yaml"))


@pytest.mark.parametrize("central", ["central.example", "ftp://x", "http://", ""])
def test_an_address_that_is_none_is_told_with_an_example(log: Log, central: str) -> None:
    daemon = station_daemon(log, "brno", central, TOKEN, load_plan(None))
    with pytest.raises(WrongUsage, match=r"must be an address such as http://central\.example:8470, got '"), daemon:
        pass


def test_a_log_of_another_station_is_not_sent_under_this_name(log: Log) -> None:
    append(log, points(1))
    said = "this log has no streams of station typo, but of brno. Next: give --station brno "
    said += "if central knows that name, else vian station add brno there; or extract with --station typo"
    with pytest.raises(WrongUsage, match=said), station_daemon(log, "typo", "http://x", TOKEN, load_plan(None)):
        pass
    assert len(log.streams()) == 1


def test_an_empty_log_may_become_any_stations(log: Log) -> None:
    with station_daemon(log, "brno", "http://central", TOKEN, load_plan(None), now=lambda: START) as daemon:
        assert daemon.step().did == "planned"


def test_the_clock_is_in_utc() -> None:
    assert utc_now().tzinfo is UTC
