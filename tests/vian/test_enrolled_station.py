"""An enrolled station and central, both at the command line, over TLS: replication, and what a station is told."""

import json
import ssl
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from events import station_name
from store import Log
from sync.central.refusals import Refusals
from sync.protocol.enrolment import new_secret
from sync.protocol.wire import Problem
from tests.certificates import self_signed
from tests.conftest import MakeLog
from tests.vian.conftest import Ran, Run
from tests.vian.samples import append, heads, points
from vian.admission import access_for, refusals_for
from vian.api import bind, create_app, serving
from vian.clock import utc_now
from vian.enrolling import enrol_at
from vian.membership import save_membership, station_key
from vian.settings import Settings, load_settings
from vian.tls import Certificate, own_certificate

Serve = Callable[..., AbstractContextManager[str]]
CENTRAL_DIR, STATION_DIR = Path("central"), Path("station")


@pytest.fixture
def central(make_log: MakeLog) -> Log:
    return make_log()


@pytest.fixture
def station(log: Log, run: Run) -> Log:
    append(log, points(20))
    assert run("init", "--dsn", log.dsn, "--station", "brno", "--key-file", STATION_DIR / "station.key").code == 0
    return log


@pytest.fixture
def settings() -> Settings:
    return load_settings(data_dir=CENTRAL_DIR, station="central")


@pytest.fixture
def refusals(central: Log, settings: Settings) -> Refusals:
    return refusals_for(central, settings)


def serve(
    central: Log, settings: Settings, refusals: Refusals, certificate: Certificate, port: int = 0
) -> AbstractContextManager[str]:
    app = create_app(central, access=access_for(central, settings), note=refusals.note)
    return serving(app, bind("127.0.0.1", port), certificate)


@pytest.fixture
def address(central: Log, settings: Settings, refusals: Refusals) -> Iterator[str]:
    """Address of a central server that made its certificate."""
    with serve(central, settings, refusals, own_certificate(CENTRAL_DIR)) as address:
        yield address


def enrol(central: Log, settings: Settings, address: str, pem: str | None = None) -> None:
    here, secret = load_settings(data_dir=STATION_DIR, station="brno"), new_secret()
    until = utc_now() + timedelta(hours=1)
    access_for(central, settings).registry.invite(station_name("brno"), secret, ["replicate"], ["brno"], until)
    pinned = pem or own_certificate(CENTRAL_DIR).certificate.read_text()
    joined = enrol_at(httpx.URL(address), pinned, secret, station_name("brno"), station_key(here))
    save_membership(here, joined.membership)


def sync(run: Run, station: Log, *options: object) -> Ran:
    given = ("--dsn", station.dsn, "--station", "brno", "--once", *options)
    return run("sync", *given)


@pytest.fixture(autouse=True)
def station_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_KEY_FILE", str(STATION_DIR / "station.key"))


def test_an_enrolled_station_replicates(
    station: Log, central: Log, settings: Settings, refusals: Refusals, address: str, run: Run
) -> None:
    enrol(central, settings, address)
    ran = sync(run, station, "--json")
    assert ran.code == 0, ran.err
    assert heads(station).items() <= heads(central).items()
    assert {json.loads(line)["backlog"] for line in ran.out.splitlines()} == {0}
    assert refusals.counts() == {}


def test_central_knows_the_key_that_its_station_signs_with(
    station: Log, central: Log, settings: Settings, address: str, run: Run
) -> None:
    enrol(central, settings, address)
    assert run("sign", "--dsn", station.dsn, "--station", "brno").code == 0
    assert sync(run, station).code == 0
    key_file = CENTRAL_DIR / "station.key"
    ran = run("verify", "--dsn", central.dsn, "--station", "central", "--key-file", key_file)
    assert ran.code == 0, ran.err
    assert "(the one by which the station is enrolled here)" in ran.out


def test_what_is_no_request_of_sync_is_refused_in_its_words_and_noted(
    settings: Settings, refusals: Refusals, address: str
) -> None:
    context = ssl.create_default_context(cafile=str(own_certificate(CENTRAL_DIR).certificate))
    context.check_hostname = False
    with httpx.Client(base_url=address, verify=context) as client:
        answers = [
            client.get("/sync/v2/hello"),
            client.post("/sync/v2/no-such", headers={"vian-station": "brno"}),
            client.post("/sync/v9/hello"),
            client.request("DELETE", f"/sync/{'x' * 2000}"),
        ]
    problems = [Problem.model_validate_json(answer.content) for answer in answers]
    assert [(answer.status_code, problem.code) for answer, problem in zip(answers, problems, strict=True)] == [
        (405, "wrong_method"),
        (404, "unknown_request"),
        (404, "unknown_request"),
        (405, "wrong_method"),
    ]
    assert {problem.next for problem in problems} == {
        "bring station and central to the same ViAn: pip install --upgrade vian"
    }
    assert refusals.counts() == {("unknown", "wrong_method"): 2, ("unknown", "unknown_request"): 2}


def test_a_station_that_was_shut_out_is_told_and_nothing_is_stored(
    station: Log, central: Log, settings: Settings, refusals: Refusals, address: str, run: Run
) -> None:
    enrol(central, settings, address)
    access_for(central, settings).registry.revoke("brno")
    ran = sync(run, station)
    assert (ran.code, ran.out) == (1, "")
    assert "central has shut this station out (revoked)" in ran.words
    assert "Next: ask central's operator" in ran.words
    assert refusals.counts() == {("hello", "revoked"): 1}
    assert not any(name.startswith("brno/") for name in heads(central))


def test_another_key_is_told(
    station: Log, central: Log, settings: Settings, refusals: Refusals, address: str, run: Run
) -> None:
    enrol(central, settings, address)
    assert run("init", "--new-key", "--dsn", station.dsn, "--station", "brno").code == 0
    ran = sync(run, station)
    assert (ran.code, "(wrong_key)" in ran.words) == (1, True)
    assert "vian station invite brno on central" in ran.words
    assert refusals.counts() == {("hello", "wrong_key"): 1}


def test_another_certificate_than_the_pinned_one_is_told(
    station: Log, central: Log, settings: Settings, refusals: Refusals, run: Run
) -> None:
    with serve(central, settings, refusals, own_certificate(CENTRAL_DIR)) as address:
        enrol(central, settings, address)
    port = httpx.URL(address).port or 0
    with serve(central, settings, refusals, own_certificate(Path("another")), port):
        ran = sync(run, station)
    assert ran.code == 1
    assert "its certificate is one that it made itself, and not the one that was pinned" in ran.words
    assert "then vian station enrol CODE --central URL here" in ran.words
    assert refusals.counts() == {}


@pytest.mark.parametrize(
    "days, name, said",
    [
        ((-10, -1), "127.0.0.1", "its certificate has expired. Next: renew the certificate on central"),
        ((1, 10), "127.0.0.1", "its certificate is not valid yet. Next: set this machine's clock"),
        ((-1, 10), "192.0.2.7", "its certificate is for another address"),
    ],
)
def test_an_operators_certificate_that_does_not_hold_is_told(
    days: tuple[int, int],
    name: str,
    said: str,
    station: Log,
    central: Log,
    settings: Settings,
    refusals: Refusals,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with serve(central, settings, refusals, own_certificate(CENTRAL_DIR)) as address:
        enrol(central, settings, address)
    joined = STATION_DIR / "central.json"
    joined.write_text(json.dumps(json.loads(joined.read_text()) | {"certificate": None}))
    authority = operators_certificate(name, days)
    monkeypatch.setenv("SSL_CERT_FILE", str(authority.certificate))
    with serve(central, settings, refusals, authority, httpx.URL(address).port or 0):
        ran = sync(run, station)
    assert (ran.code, said in ran.words) == (1, True), ran.words


def operators_certificate(address: str, days: tuple[int, int]) -> Certificate:
    """A certificate as an operator's authority makes them, for an address and a time from now on."""
    path = self_signed(Path("operators.pem"), address, days)
    return Certificate(path, path, is_own=False)


def test_what_is_not_central_is_told(
    station: Log, central: Log, settings: Settings, refusals: Refusals, address: str, run: Run
) -> None:
    enrol(central, settings, address)
    page = FastAPI()
    page.post("/{path:path}")(lambda path: HTMLResponse("<html>Please accept the terms of this network</html>"))
    with serving(page, bind("127.0.0.1", 0)) as portal:
        ran = sync(run, station, "--central", portal)
        assert (ran.code, "is not ViAn's central" in ran.words) == (1, True)
        assert "Next: check the address; curl -i" in ran.words
        ran = sync(run, station, "--central", portal.replace("http", "https"))
        assert (ran.code, "speaks no TLS that is understood here" in ran.words) == (1, True)
    ran = sync(run, station, "--central", "https://nowhere.invalid:8470")
    assert (ran.code, "its name does not resolve" in ran.words) == (1, True)
    ran = sync(run, station, "--central", portal)
    assert (ran.code, "nothing listens there (connection refused)" in ran.words) == (1, True)
    assert "then give the same command again" in ran.words
    assert "by itself" not in ran.words
    ran = sync(run, station, "--central", address.replace("https", "http"))
    assert (ran.code, f"perhaps it speaks TLS. Next: --central {address};" in ran.words) == (1, True), ran.words
    assert not any(name.startswith("brno/") for name in heads(central))
