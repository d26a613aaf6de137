"""From invitation to repair at the command line, over TLS: what a station sends, central signs, and what comes back.

The very first payload left the station's disk before it was sent, as on a full disk: the chain goes on without it.
"""

from typing import Any

import pytest

from store import Log
from tests.conftest import MakeLog
from tests.store.samples import GATE, YARD, append
from tests.sync.test_losses import Disk, give_up, watch, work
from tests.sync.test_repair import contents
from tests.vian.commands.test_station import central, invited, on_central
from tests.vian.commands.test_sync_repair import at_station
from tests.vian.conftest import Ran, Run
from tests.vian.samples import objects

__all__ = ["at_station", "central", "on_central"]


@pytest.fixture
def station(make_log: MakeLog) -> Log:
    """The log of the station brno, whose first segment is hollow; central's is `log`."""
    station = make_log()
    append(station, GATE, 3)
    disk = Disk(station)
    disk.free_mib = 40
    work(watch(station, give_up("*/gate/track_point")))
    disk.free_mib = 1000
    append(station, GATE, 2, 4)
    append(station, YARD, 2)
    return station


def done(ran: Ran) -> list[dict[str, Any]]:
    assert ran.code == 0, ran.err + ran.out
    return objects(ran.out)


def test_the_whole_road(station: Log, log: Log, central: str, on_central: Run, at_station: Run) -> None:
    done(at_station("init", "--json"))
    done(at_station("station", "enrol", invited(on_central), "--central", central, "--json"))
    done(at_station("sign", "--json"))
    assert {row["backlog"] for row in done(at_station("sync", "--once", "--json"))} == {0}
    (whole, *_) = done(at_station("sync", "status", "--json"))
    assert (whole["signed"], whole["countersigned"], whole["events"]) == (1, 1, 0)
    (found,) = done(on_central("verify", "--json"))
    assert (found["sound"], found["segments_without_payload"]) == (True, 1)
    assert {each["station"]: each["is_key_known"] for each in found["signed"]}["brno"]

    before = contents(station)
    pruned = done(at_station("prune", "--after-days", 0, "--json"))
    assert {row["stream"]: row["segments"] for row in pruned} == {str(GATE): 2, str(YARD): 1}
    (found,) = done(at_station("verify", "--full", "--json"))
    assert (found["sound"], found["segments_without_payload"]) == (True, 4)

    done(at_station("sync", "repair", "--stream", str(YARD), "--json"))
    ran = at_station("sync", "repair", "--stream", str(GATE), "--json")
    assert ran.code == 1, "what left the disk before it was sent is nowhere"
    assert [(row["from"], row["to"], row["segments"]) for row in objects(ran.out)] == [(1, 3, 0), (4, 9, 2)]
    assert contents(station) == before
    (found,) = done(at_station("verify", "--full", "--json"))
    assert (found["sound"], found["segments_without_payload"]) == (True, 1)
    assert {row["backlog"] for row in done(at_station("sync", "--once", "--json"))} == {0}
    (found,) = done(on_central("verify", "--full", "--json"))
    assert (found["sound"], found["segments_without_payload"]) == (True, 1)
