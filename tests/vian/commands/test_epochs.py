"""A station's name on another disk: a replaced machine, a disk put back, at the command line, over TLS."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from events import StreamName
from store import Log, verify
from tests.conftest import MakeLog
from tests.vian.conftest import Ran, Run
from tests.vian.samples import GATE, YARD, append, objects, points, reopened
from vian.admission import access_for, certificate_of
from vian.api import bind, create_app, serving
from vian.settings import load_settings

CENTRAL_DIR = Path("central")


class Machine:
    """A machine that bears the station's name: a log, a key of its own, and a command line."""

    def __init__(self, log: Log, run: Run, folder: Path) -> None:
        self.log = log
        self._run = run
        self._given = ("--dsn", log.dsn, "--station", "brno")
        self._key = folder / "station.key"

    def append(self, count: int, stream: StreamName = GATE, *, x: float = 1.0) -> None:
        with reopened(self.log) as log:
            append(log, points(count, x=x), stream)

    def vian(self, *words: object) -> Ran:
        """Run a command here, with nobody else at the log."""
        return self._run(*words, *self._given, "--key-file", self._key)

    def sync(self) -> Ran:
        with pytest.MonkeyPatch.context() as there:
            there.setenv("VIAN_KEY_FILE", str(self._key))
            return self._run("sync", "--once", *self._given)

    def status(self) -> str:
        return self._run("sync", "status", *self._given).out

    def streams(self) -> list[dict[str, Any]]:
        """What the status says of each stream."""
        ran = self._run("sync", "status", "--json", *self._given)
        return [each for each in objects(ran.out) if each["kind"] == "stream"]

    def doctor(self) -> dict[str, str]:
        with pytest.MonkeyPatch.context() as there:
            there.setenv("VIAN_KEY_FILE", str(self._key))
            return {
                each["check"]: each["verdict"]
                for each in objects(self._run("sync", "doctor", "--json", *self._given).out)
            }


class Central:
    """The central server, and the codes that it makes."""

    def __init__(self, log: Log, address: str, run: Run) -> None:
        self.log = log
        self._address = address
        self._run = run

    def enrol(self, machine: Machine) -> Ran:
        options = ("--dsn", self.log.dsn, "--station", "central", "--json")
        with pytest.MonkeyPatch.context() as there:
            there.setenv("VIAN_CONFIG", "central.toml")
            code = json.loads(self._run("station", "invite", "brno", *options).out)["code"]
        return machine.vian("station", "enrol", code, "--central", self._address)

    def held(self, stream: StreamName = GATE) -> list[tuple[int, int]]:
        """Epochs of the stream, and how far each goes."""
        return sorted((head.epoch, head.sequence) for head in self.log.streams() if head.stream == stream)


@pytest.fixture
def central(make_log: MakeLog, run: Run) -> Iterator[Central]:
    log = make_log()
    Path("central.toml").write_text(f'data_dir = "{CENTRAL_DIR.resolve()}"\ntls = "generate"\n')
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", tls="generate")
    app = create_app(log, access=access_for(log, settings))
    with serving(app, bind("127.0.0.1", 0), certificate_of(settings)) as address:
        yield Central(log, address, run)


@pytest.fixture
def machines(make_log: MakeLog, run: Run, tmp_path: Path) -> Iterator[Machine]:
    """Machines of the station, one after the other; nobody is connected to their logs."""

    def made() -> Iterator[Machine]:
        number = 0
        while True:
            log = make_log()
            log.close()
            number += 1
            yield Machine(log, run, tmp_path / f"machine-{number}")

    return made()


def test_a_replaced_machine_begins_a_new_epoch_when_it_is_enrolled(
    central: Central, machines: Iterator[Machine]
) -> None:
    first, second, third = next(machines), next(machines), next(machines)
    ran = central.enrol(first)
    assert "epoch" not in ran.out
    first.append(20)
    assert first.vian("sign").code == 0
    assert first.sync().code == 0
    for epoch, machine in ((2, second), (3, third)):
        ran = central.enrol(machine)
        assert (ran.code, f"this log is empty: it is in epoch {epoch} from now on" in " ".join(ran.out.split())) == (
            0,
            True,
        )
        machine.append(5, x=float(epoch))
        assert machine.vian("sign").code == 0
        assert machine.sync().code == 0
        assert machine.doctor()["epoch"] == "ok"
    assert central.held() == [(1, 20), (2, 5), (3, 5)]
    assert verify(central.log, station="central").is_sound
    unknown = verify(central.log, station="oslo")  # whose log enrolled nobody
    assert "did not name as its successor" in str(unknown.broken[0])
    assert "(wrong_key)" in second.sync().words


def test_the_same_disk_keeps_its_epoch_when_it_is_enrolled_again(central: Central, machines: Iterator[Machine]) -> None:
    machine = next(machines)
    central.enrol(machine)
    machine.append(20)
    machine.sync()
    ran = central.enrol(machine)
    assert "this log holds events too: it stays in epoch 1" in " ".join(ran.out.split())
    machine.append(3)
    assert machine.sync().code == 0
    assert central.held() == [(1, 23)]
    needless = machine.vian("station", "new-epoch")
    assert (needless.code, "is of this log, which is in epoch 1: it needs no new epoch" in needless.words) == (2, True)


def test_a_disk_that_was_put_back_goes_on_in_a_new_epoch_by_the_command_that_its_error_names(
    central: Central, machines: Iterator[Machine], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("store.epochs._GONE_SECONDS", 0.2)
    before, put_back = next(machines), next(machines)
    central.enrol(before)
    before.append(20)
    before.append(4, x=7.0)
    before.sync()
    put_back.append(20)  # as the disk was
    central.enrol(put_back)
    put_back.append(5, YARD)

    ran = put_back.sync()

    assert (ran.code, "its disk was put back to an older state" in ran.words) == (1, True)
    assert "then vian station new-epoch" in ran.words
    assert put_back.doctor()["epoch"] == "bad"
    with reopened(put_back.log):
        used = put_back.vian("station", "new-epoch")
    assert (used.code, "the log is in use: 1 other connections. Next: stop vian serve" in used.words) == (2, True)
    ran = put_back.vian("station", "new-epoch")
    assert (ran.code, "goes on in epoch 2" in ran.out) == (0, True), ran.err
    put_back.append(6)
    assert put_back.sync().code == 0
    assert put_back.doctor()["epoch"] == "note"  # of its plan there are two histories now
    assert (central.held(), central.held(YARD)) == ([(1, 24), (2, 6)], [(1, 5)])
    assert {each["events"] for each in put_back.streams()} == {0}


def recorded_apart(central: Central, machines: Iterator[Machine], *more: int) -> Machine:
    """A machine with a put-back disk that recorded before its new epoch; central has so many more events of before."""
    before, put_back = next(machines), next(machines)
    central.enrol(before)
    before.append(20)
    for count in more:
        before.append(count, x=7.0)
    before.sync()
    put_back.append(20)
    put_back.append(9, x=8.0)
    central.enrol(put_back)
    assert put_back.vian("station", "new-epoch").code == 0
    put_back.append(6)
    return put_back


def test_what_a_put_back_disk_recorded_before_its_new_epoch_is_named_and_stays(
    central: Central, machines: Iterator[Machine]
) -> None:
    put_back = recorded_apart(central, machines, 4)

    ran = put_back.sync()

    assert ran.code == 0, ran.err
    assert central.held() == [(1, 24), (2, 6)]
    shown = " ".join(put_back.status().split())
    assert f"vian evidence export --stream {GATE} --epoch 1" in shown
    (kept,) = [each for each in put_back.streams() if (each["stream"], each["epoch"]) == (str(GATE), 1)]
    assert (kept["events"], kept["why_stopped"], kept["is_apart"]) == (0, None, True)
    assert put_back.doctor()["epoch"] == "note"
    again = put_back.vian("station", "new-epoch")
    assert (again.code, "it needs no new epoch" in again.words) == (2, True)
    with reopened(put_back.log) as log:
        assert [(head.epoch, head.sequence) for head in log.streams() if head.stream == GATE] == [(1, 29), (2, 6)]


def test_it_is_named_too_where_central_has_more_of_the_epoch_before(
    central: Central, machines: Iterator[Machine]
) -> None:
    put_back = recorded_apart(central, machines, 4, 8)
    assert put_back.doctor()["epoch"] == "note"

    assert put_back.sync().code == 0

    assert central.held() == [(1, 32), (2, 6)]
    (kept,) = [each for each in put_back.streams() if (each["stream"], each["epoch"]) == (str(GATE), 1)]
    assert (kept["events"], kept["is_apart"]) == (0, True)
    assert f"vian evidence export --stream {GATE} --epoch 1" in " ".join(put_back.status().split())


def test_a_machine_without_a_central_is_told_how_to_join_one(machines: Iterator[Machine]) -> None:
    ran = next(machines).vian("station", "new-epoch")
    assert (ran.code, "belongs to no central. Next: vian station enrol CODE" in ran.words) == (2, True)
