"""`vian station`: invite, enrol, list, revoke, leave and add, over real TLS on loopback."""

import json
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from store import Log, load_key, make_key
from tests.vian.conftest import Ran, Run
from tests.vian.samples import objects
from vian.admission import access_for, certificate_of
from vian.api import bind, create_app, serving
from vian.settings import load_settings
from vian.stations import add_station, read_grants

LIST = Path("stations.toml")
CENTRAL_DIR, STATION_DIR = Path("central-data"), Path("station-data")
JOINED = STATION_DIR / "central.json"


@contextmanager
def served(log: Log, **given: str) -> Iterator[str]:
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", **given)
    app = create_app(log, access=access_for(log, settings))
    with serving(app, bind("127.0.0.1", 0), certificate_of(settings)) as address:
        yield address


@pytest.fixture
def central(log: Log) -> Iterator[str]:
    """Address of a central server that made its own certificate."""
    with served(log, tls="generate") as address:
        yield address


@pytest.fixture
def on_central(log: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command on central."""
    Path("central.toml").write_text(f'dsn = "{log.dsn}"\nstation = "central"\ndata_dir = "{CENTRAL_DIR.resolve()}"\n')

    def on(*arguments: object) -> Ran:
        with monkeypatch.context() as there:
            there.setenv("VIAN_CONFIG", "central.toml")
            return run(*arguments)

    return on


def invited(on_central: Run, *options: object, name: str = "brno") -> str:
    ran = on_central("station", "invite", name, *options, "--json")
    assert ran.code == 0, ran.err
    return str(json.loads(ran.out)["code"])


def enrol(run: Run, code: str, central: str, station: str = "brno") -> Ran:
    return run("station", "enrol", code, "--central", central, "--station", station, "--data-dir", STATION_DIR)


def test_a_station_is_invited_enrolled_listed_and_revoked(central: str, on_central: Run, run: Run) -> None:
    shown = on_central("station", "invite", "brno", "--operations", "query,replicate", "--reads", "brno,oslo")
    assert "station brno may enrol until " in shown.out
    code = shown.out.split("vian station enrol ")[1].split()[0]
    ran = enrol(run, code, central)
    assert ran.code == 0, ran.err
    assert f"station brno belongs to central central at {central}. Next: vian sync --station brno" in ran.out
    joined = json.loads(JOINED.read_text())
    assert (joined["operations"], joined["reads"]) == (["replicate", "query"], ["brno", "oslo"])
    assert joined["certificate"].startswith("-----BEGIN CERTIFICATE-----")
    assert stat.S_IMODE(JOINED.stat().st_mode) == 0o600
    key = load_key(STATION_DIR / "station.key")
    code = invited(on_central, name="oslo")
    assert [(row["station"], row["state"], row["key_id"]) for row in listed(on_central)] == [
        ("brno", "enrolled", key.id),
        ("oslo", "invited", None),
    ]
    assert on_central("station", "revoke", "brno", "--reason", "stolen").code == 0
    assert on_central("station", "revoke", "oslo").code == 0
    assert [(row["station"], row["state"]) for row in listed(on_central)] == [("brno", "revoked")]
    again = on_central("station", "revoke", "brno")
    assert (again.code, "brno is shut out already; enrolled: none" in again.words) == (2, True)
    assert "the code was used already" in enrol(run, code, central, "oslo").words


def listed(on_central: Run, *options: object) -> list[dict[str, str]]:
    return objects(on_central("station", "list", "--json", *options).out)


def test_a_station_leaves(central: str, on_central: Run, run: Run) -> None:
    enrol(run, invited(on_central), central)
    ran = run("station", "leave", "--station", "brno", "--data-dir", STATION_DIR)
    assert "Next, on central: vian station revoke brno" in " ".join(ran.out.split())
    assert not JOINED.exists()
    again = run("station", "leave", "--station", "brno", "--data-dir", STATION_DIR)
    assert (again.code, "belongs to no central" in again.words) == (2, True)


def test_a_key_that_is_there_stays_the_stations(central: str, on_central: Run, run: Run) -> None:
    STATION_DIR.mkdir()
    key = make_key(STATION_DIR / "station.key")
    enrol(run, invited(on_central), central)
    assert listed(on_central)[0]["key_id"] == key.id


def test_a_code_that_does_not_count_is_told_with_the_next_command(central: str, on_central: Run, run: Run) -> None:
    code = invited(on_central)
    for given, station, said in (
        (code[:-1], "brno", "not a one-time code: got 49 letters and digits with a slip"),
        (code, "oslo", "the code is for another station: got station oslo, wanted station brno. Next: give --station"),
        (code, "a/b", "a/b"),
    ):
        ran = enrol(run, given, central, station)
        assert (ran.code > 0, ran.out) == (True, "")
        assert said in ran.words
    assert not JOINED.exists()
    assert enrol(run, code, central).code == 0
    used = enrol(run, code, central)
    assert (used.code, "the code was used already" in used.words) == (1, True)


def test_central_refuses_its_own_name_and_unknown_operations(on_central: Run) -> None:
    for arguments, said in (
        (["central"], "central's own name"),
        (["a/b"], "a/b"),
        (["brno", "--operations", "replicate,fly"], "--operations takes replicate, find, query; got fly"),
        (["brno", "--operations", ","], "got none"),
        (["brno", "--reads", "a/b"], "a/b"),
        (["brno", "--reads", ""], "--reads takes names of stations by commas, or * for all; got none"),
        (["brno", "--hours", "0"], "invite_hours"),
    ):
        ran = on_central("station", "invite", *arguments)
        assert (ran.code, ran.out) == (2, "")
        assert said in ran.words


# Which central it is.


def test_another_certificate_than_the_codes_is_refused(central: str, log: Log, on_central: Run, run: Run) -> None:
    code = invited(on_central)
    (CENTRAL_DIR / "central-tls.pem").unlink()
    with served(log, tls="generate") as impostor:
        ran = enrol(run, code, impostor)
    assert (ran.code, ran.out) == (1, "")
    assert "is not the central that made the code: its certificate has another key" in ran.words
    assert [row["state"] for row in listed(on_central)] == ["invited"], "the secret was not shown to it"


def test_a_certificate_of_nobody_known_is_refused_without_a_pin(
    central: str, log: Log, on_central: Run, run: Run
) -> None:
    Path("central.toml").write_text(Path("central.toml").read_text() + 'tls_certificate = "operators.pem"\n')
    code = invited(on_central)
    assert len(code) == 28
    ran = enrol(run, code, central)
    assert ran.code == 1
    assert "its certificate" in ran.words
    assert "vian station enrol CODE" in ran.words


def test_an_address_that_will_not_do_is_told(central: str, on_central: Run, run: Run) -> None:
    one_time_code = invited(on_central)
    for address, code, said in (
        ("http://central.example:8470", 2, "must be reached over https, got http://central.example:8470"),
        ("http://192.0.2.7:8470", 2, "the address https://192.0.2.7:8470"),
        ("central.example", 2, "must be an address such as https://central.example:8470, got 'central.example'"),
        ("ftp://central.example", 2, "must be an address such as"),
        (
            "https://nowhere.invalid:8470",
            1,
            "nowhere.invalid port 8470 shows no certificate: its name does not resolve",
        ),
        ("https://127.0.0.1:9", 1, "port 9 shows no certificate: nothing listens there (connection refused)"),
        ("http://127.0.0.1:9", 1, "nothing listens there (connection refused). Next: vian serve --role central"),
        ("http://nowhere.localhost.:9", 2, "must be reached over https"),
    ):
        ran = enrol(run, one_time_code, address)
        assert (ran.code, ran.out) == (code, "")
        assert said in ran.words
        assert "goes on by itself" not in ran.words
    assert not JOINED.exists()


def test_a_page_of_another_server_is_told(on_central: Run, run: Run, log: Log) -> None:
    code = invited(on_central)
    with serving(create_app(log), bind("127.0.0.1", 0)) as address:
        ran = enrol(run, code, address)
    assert (ran.code, "is not a central server of this ViAn: status 404" in ran.words) == (1, True)


def test_a_port_that_speaks_no_tls_is_told(on_central: Run, run: Run, log: Log) -> None:
    (CENTRAL_DIR).mkdir(exist_ok=True)
    certificate_of(load_settings(data_dir=CENTRAL_DIR, tls="generate"))
    code = invited(on_central)
    with serving(create_app(log), bind("127.0.0.1", 0)) as address:
        ran = enrol(run, code, address.replace("http", "https"))
    assert (ran.code, "shows no certificate" in ran.words) == (1, True)


def test_a_membership_of_another_station_is_not_used(central: str, on_central: Run, run: Run) -> None:
    enrol(run, invited(on_central), central)
    ran = run("station", "leave", "--station", "oslo", "--data-dir", STATION_DIR)
    assert (ran.code, "central knows this station as brno, and --station is oslo" in ran.words) == (2, True)
    JOINED.write_text("{}")
    ran = run("station", "leave", "--station", "brno", "--data-dir", STATION_DIR)
    assert (ran.code, "does not say which central this station belongs to" in ran.words) == (2, True)


# Stations of the release before.


def test_a_station_gets_a_token_of_its_own(run: Run) -> None:
    ran = run("station", "add", "brno-2", "--stations-file", LIST, "--token-file", "brno.token", "--json")
    assert json.loads(ran.out) == {"station": "brno-2", "token_file": "brno.token"}
    assert read_grants(LIST).station_of(Path("brno.token").read_text().strip()) == "brno-2"


def test_a_token_without_a_file_is_shown_once(run: Run) -> None:
    token = json.loads(run("station", "add", "brno-2", "--stations-file", LIST, "--json").out)["token"]
    assert read_grants(LIST).station_of(token) == "brno-2"
    ran = run("station", "add", "zlin", "--stations-file", LIST)
    assert ran.out.startswith("station zlin: token ")
    assert ran.out.endswith(" (shown once)\n")
    assert "vian station invite zlin" in ran.words


def test_the_list_may_be_a_setting(run: Run) -> None:
    Path("vian.toml").write_text(f'stations_file = "{LIST}"\n')
    assert run("station", "add", "brno-2").code == 0
    assert LIST.exists()


def test_a_station_with_a_token_is_listed_and_revoked(on_central: Run) -> None:
    add_station(LIST, "brno")
    add_station(LIST, "oslo")
    assert [(row["station"], row["state"]) for row in listed(on_central, "--stations-file", LIST)] == [
        ("brno", "has a token"),
        ("oslo", "has a token"),
    ]
    assert on_central("station", "revoke", "brno", "--stations-file", LIST).code == 0
    assert read_grants(LIST).stations() == ["oslo"]


@pytest.mark.parametrize(
    "arguments, code, said",
    [
        (["brno-2"], 2, "which list of stations? Next: give --stations-file FILE"),
        (["a/b", "--stations-file", LIST], 2, "'a/b'"),
        (["brno-2", "--stations-file", LIST, "--token-file", "."], 1, "cannot be written"),
        (["brno-2", "--stations-file", "/dev/null/x"], 1, "cannot be written"),
    ],
)
def test_what_cannot_be_added_is_told(run: Run, arguments: list[object], code: int, said: str) -> None:
    ran = run("station", "add", *arguments)
    assert (ran.code, ran.out) == (code, "")
    assert said in ran.words
    assert not LIST.exists()
