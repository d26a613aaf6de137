"""A new key at a station and at central: what the operator is told to do, and that it helps."""

from datetime import timedelta
from pathlib import Path

from events import station_name
from store import Log, make_key
from sync.protocol.enrolment import new_secret
from tests.vian.conftest import Run
from tests.vian.samples import objects
from vian.admission import registry_for
from vian.clock import utc_now
from vian.membership import Membership, save_membership
from vian.rekeying import told_of_new_key
from vian.settings import Settings, load_settings


def settings_in(folder: Path, log: Log, station: str) -> Settings:
    return load_settings(key_file=folder / "station.key", dsn=log.dsn, station=station, data_dir=folder)


def test_a_station_is_told_to_enrol_again(log: Log, tmp_path: Path, run: Run) -> None:
    settings = settings_in(tmp_path, log, "brno")
    make_key(tmp_path / "station.key")
    assert told_of_new_key(log, settings) == []
    central = make_key(tmp_path / "central.key")
    save_membership(
        settings,
        Membership(
            station="brno", address="https://central.example", central="central", public_key=central.public.hex()
        ),
    )

    ran = run(
        "init",
        "--new-key",
        "--json",
        "--dsn",
        log.dsn,
        "--key-file",
        str(tmp_path / "station.key"),
        "--station",
        "brno",
    )

    assert ran.code == 0, ran.err
    (note,) = objects(ran.out)[0]["next"]
    assert "vian station invite brno on central" in note
    assert "vian station enrol CODE --central https://central.example here" in note


def test_central_is_told_which_stations_must_enrol_again_and_takes_them_in_with_a_new_code(
    log: Log, tmp_path: Path
) -> None:
    settings = settings_in(tmp_path, log, "central")
    make_key(tmp_path / "station.key")
    registry = registry_for(log, settings)
    for number in range(2):
        secret = new_secret()
        key = make_key(tmp_path / f"{number}.key")
        registry.invite(station_name("brno"), secret, ("replicate",), (), utc_now() + timedelta(hours=1))
        assert registry.enrol(station_name("brno"), secret, key.public, "192.0.2.7").public_key == key.public

    (note,) = told_of_new_key(log, settings)
    assert "1 stations (brno) go on sending" in note
    registry.revoke(station_name("brno"))
    assert told_of_new_key(log, settings) == []
