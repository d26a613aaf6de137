"""`vian sync repair` at the command line, over TLS, as an enrolled station and at central."""

from collections.abc import Callable
from pathlib import Path

import pytest

from store import Log, verify
from store.payloads import take_off
from sync.keeping.repair import Wanted
from tests.store.samples import GATE, YARD, append, owner
from tests.sync.test_repair import BRNO, contents, copy
from tests.vian.commands.test_station import STATION_DIR, central, enrol, invited, on_central
from tests.vian.conftest import Ran, Run
from tests.vian.samples import objects

__all__ = ["central", "on_central"]


@pytest.fixture
def station(make_log: Callable[[], Log], log: Log) -> Log:
    """The log of the station brno; central's is `log`."""
    station = make_log()
    append(station, GATE, 3, 2, 4)
    append(station, YARD, 2)
    copy(station, log)
    return station


@pytest.fixture
def at_station(station: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command at the station."""
    path = Path("station.toml")
    path.write_text(f'dsn = "{station.dsn}"\nstation = "brno"\ndata_dir = "{STATION_DIR.resolve()}"\n')

    def at(*arguments: object) -> Ran:
        with monkeypatch.context() as there:
            there.setenv("VIAN_CONFIG", str(path))
            return run(*arguments)

    return at


def damage(log: Log, statement: str) -> None:
    with owner(log) as connection:
        connection.execute("set session_replication_role = replica")
        connection.execute(statement)  # type: ignore[call-overload]  # statements of this file


def test_a_station_brings_back_what_is_damaged_and_what_left_the_disk(
    station: Log, central: str, on_central: Run, run: Run, at_station: Run
) -> None:
    enrol(run, invited(on_central), central)
    before = contents(station)
    damage(station, "update segments set payload = 'x' where position = 1")
    damage(station, "update segments set event_count = 9 where position = 3")
    ran = at_station("sync", "repair", "--json")
    assert ran.code == 0, ran.err
    assert [(row["stream"], row["position"], row["segments"]) for row in objects(ran.out)] == [
        (str(GATE), 1, 1),
        (str(GATE), 3, 1),
    ]
    assert contents(station) == before
    assert "nothing is damaged" in at_station("sync", "repair").words
    with station.transaction() as transaction:
        take_off(transaction, [1, 2, 3])
    ran = at_station("sync", "repair", "--stream", str(GATE), "--from", 4, "--to", 5)
    assert (ran.code, "1 segment was put back" in ran.words) == (0, True)
    assert [each.has_payload for each in station.read(GATE, with_hollow=True)] == [False, True, False]


def test_what_central_does_not_hold_is_told(
    station: Log, central: str, on_central: Run, run: Run, at_station: Run
) -> None:
    enrol(run, invited(on_central), central)
    append(station, GATE, 1)
    damage(station, "update segments set payload = 'x' where position = 5")
    ran = at_station("sync", "repair")
    assert ran.code == 1
    assert "1 were not put back. Next: vian verify --full" in ran.words
    assert not verify(station).is_sound


def test_central_asks_the_stations(log: Log, station: Log, on_central: Run) -> None:
    damage(log, "update segments set payload = 'x' where position = 2")
    ran = on_central("sync", "repair")
    assert "station brno is asked for it at its next hello" in ran.words + ran.out
    assert [each.first_sequence for each in Wanted(log).of(BRNO)] == [4]


def test_central_tells_what_it_cannot_ask_yet(
    log: Log, station: Log, on_central: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sync.keeping.repair.WANTED_MAX", 1)
    with log.transaction() as transaction:
        take_off(transaction, [1, 2])
    ran = on_central("sync", "repair", "--stream", str(GATE), "--json")
    assert [(row["from"], row["failure"][:35]) for row in objects(ran.out)] == [
        (1, "station brno is asked for it at its"),
        (4, "station brno is not asked for it ye"),
    ]


def test_who_is_not_enrolled_is_told_how(station: Log, at_station: Run) -> None:
    damage(station, "update segments set payload = 'x' where position = 1")
    ran = at_station("sync", "repair")
    assert (ran.code, "Next: vian station enrol CODE --central URL" in ran.words) == (1, True)
    ran = at_station("sync", "repair", "--from", 3)
    assert (ran.code, "Next: give --stream" in ran.words) == (2, True)
