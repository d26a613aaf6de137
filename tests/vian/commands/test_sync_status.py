"""`vian sync status` and `vian sync doctor`, at a station and on central, over TLS."""

import socket
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from events import station_name
from store import Log
from store.payloads import weights
from sync.central.refusals import Kind, Refusals
from sync.keeping.pruning import Proven, take_off_held
from sync.keeping.repair import Wanted
from sync.protocol.reports import CHECKPOINT, Status, StreamStatus
from tests.conftest import MakeLog
from tests.vian.conftest import Ran, Run
from tests.vian.samples import GATE, append, objects, points
from tests.vian.test_enrolled_station import CENTRAL_DIR, STATION_DIR, enrol, operators_certificate, serve
from vian.admission import access_for, refusals_for
from vian.api import bind, serving
from vian.clock import utc_now
from vian.membership import load_membership, save_membership
from vian.settings import Settings, load_settings
from vian.spans import size_text, span
from vian.sync_doctor import examine
from vian.tls import own_certificate

BRNO = station_name("brno")


@pytest.fixture
def central(make_log: MakeLog) -> Log:
    return make_log()


@pytest.fixture
def settings() -> Settings:
    return load_settings(data_dir=CENTRAL_DIR, station="central")


@pytest.fixture
def refusals(central: Log, settings: Settings) -> Refusals:
    return refusals_for(central, settings)


@pytest.fixture(autouse=True)
def key_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_KEY_FILE", str(STATION_DIR / "station.key"))


@pytest.fixture
def station(log: Log, run: Run) -> Log:
    append(log, points(20))
    assert run("init", "--dsn", log.dsn, "--station", "brno", "--key-file", STATION_DIR / "station.key").code == 0
    return log


@pytest.fixture
def enrolled(station: Log, central: Log, settings: Settings, refusals: Refusals) -> Iterator[str]:
    """Address of the central server that took the station in."""
    with serve(central, settings, refusals, own_certificate(CENTRAL_DIR)) as address:
        enrol(central, settings, address)
        yield address


def at_station(run: Run, log: Log, *options: object) -> Ran:
    return run("sync", options[0], "--dsn", log.dsn, "--station", "brno", *options[1:])


def streams(ran: Ran) -> dict[str, dict[str, Any]]:
    return {row["stream"]: row for row in objects(ran.out) if row["kind"] == "stream"}


def test_a_station_that_never_synced_shows_what_waits(station: Log, run: Run) -> None:
    ran = at_station(run, station, "status", "--json")
    assert ran.code == 0, ran.err
    whole, *_ = objects(ran.out)
    assert (whole["state"], whole["last_contact_at"], whole["eta_s"]) == ("no daemon yet", None, None)
    gate = streams(ran)[str(GATE)]
    assert (gate["events"], gate["at_central"], gate["is_exact"]) == (20, None, True)
    assert gate["bytes"] > 20
    assert "no daemon ran yet. Next: vian sync" in at_station(run, station, "status").out


def test_what_waits_is_counted_behind_what_central_has(station: Log, enrolled: str, run: Run) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    whole, *_ = objects(at_station(run, station, "status", "--json").out)
    assert (whole["events"], whole["bytes"], whole["eta_s"], whole["lag_s"]) == (0, 0, 0.0, 0.0)
    append(station, points(3, first_frame=20))
    whole, *_ = objects(at_station(run, station, "status", "--json").out)
    assert whole["events"] == 3
    assert whole["rate_bps"] > 0
    assert whole["eta_s"] == pytest.approx(whole["bytes"] * 8 / whole["rate_bps"])
    assert whole["clock_offset_s"] == pytest.approx(0, abs=2)
    shown = at_station(run, station, "status").out
    assert "waiting: 3 events" in shown
    assert "behind" in shown


def test_central_shows_each_station_and_what_was_refused(
    station: Log, central: Log, refusals: Refusals, settings: Settings, enrolled: str, run: Run
) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    refusals.note(Kind("brno", "hello", "replayed", None), "a number")
    refusals.note(Kind("nobody\x1b", "hello", "unknown_station", None), "a stranger")
    refusals.record(is_all=True)
    ran = run("sync", "status", "--dsn", central.dsn, "--json")
    assert ran.code == 0, ran.err
    whole, brno, strangers = objects(ran.out)
    assert (whole["kind"], whole["central"]) == ("central", "central")
    assert (brno["station"], brno["state"], brno["behind"], brno["missing"]) == ("brno", "enrolled", 0, 0)
    assert (brno["refusals"], strangers["refusals"]) == ({"replayed": 1}, {"unknown_station": 1})
    assert (brno["protocol"], strangers["station"]) == (2, "(unknown)")
    access_for(central, settings).registry.revoke("brno")
    assert "revoked" in run("sync", "status", "--dsn", central.dsn).out
    one = run("sync", "status", "--dsn", central.dsn, "--station", "brno", "--json")
    assert streams(one)[str(GATE)]["at_station"] == 20
    ran = run("sync", "status", "--dsn", central.dsn, "--station", "oslo")
    assert (ran.code, "central knows no station oslo; known: brno" in ran.words) == (1, True)


def test_what_a_station_said_it_has_more_is_behind(
    station: Log, central: Log, settings: Settings, enrolled: str, run: Run
) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    with central.connection() as connection:
        connection.execute("update station_contacts set heads = %s", (f'[["{GATE}", 1, 50]]',))
    one = objects(run("sync", "status", "--dsn", central.dsn, "--json").out)[1]
    assert one["behind"] == 30
    assert one["lag_s"] >= 0
    shown = run("sync", "status", "--dsn", central.dsn, "--station", "brno").out
    assert "at_station is empty where the station's newest hello names no such stream" in " ".join(shown.split())


@pytest.mark.parametrize(
    "changes, late",
    [
        ({}, None),
        ({"last_contact": timedelta(hours=2)}, "last contact with central 2 h ago"),
        ({"last_contact": None}, "central was never reached"),
        ({"error": "its segment is refused"}, f"{GATE} is stopped"),
        ({"cursor": 19}, None),
    ],
)
def test_what_is_late_ends_a_check_with_1(station: Log, run: Run, changes: dict[str, Any], late: str | None) -> None:
    now = utc_now()
    age = changes.get("last_contact", timedelta(0))
    gate = StreamStatus(GATE, 1, 5, 20, changes.get("cursor", 20), 0, changes.get("error"))
    at = None if age is None else now - age
    status = Status(BRNO, "https://c", (gate,), at, 0.0, 0, None, state="caught_up", saved_at=now)
    with station.transaction() as transaction:
        transaction.save_checkpoint(CHECKPOINT, station.head(), status.to_json())
    ran = at_station(run, station, "status", "--check")
    assert ran.code == (0 if late is None else 1)
    assert late is None or late in ran.words
    assert (": stopped in 1 of" in ran.out) is ("error" in changes)


def test_a_daemon_that_says_nothing_for_long_is_silent(station: Log, run: Run) -> None:
    status = Status(
        BRNO, "https://c", (), None, None, 0, None, state="caught_up", saved_at=utc_now() - timedelta(days=1)
    )
    with station.transaction() as transaction:
        transaction.save_checkpoint(CHECKPOINT, station.head(), status.to_json())
    assert "its daemon is silent, as its daemon said 1 d ago" in at_station(run, station, "status").out


def test_a_watch_ends_with_ctrl_c(station: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupted:
        def wait(self, seconds: float) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr("vian.commands.sync_status.Pause", Interrupted)
    ran = at_station(run, station, "status", "--watch")
    assert ran.code == 0
    assert "station brno" in ran.out


def verdicts(ran: Ran) -> dict[str, str]:
    return {row["check"]: row["verdict"] for row in objects(ran.out)}


def test_doctor_finds_nothing_in_the_way_of_an_enrolled_station(station: Log, enrolled: str, run: Run) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    ran = at_station(run, station, "doctor", "--json")
    assert ran.code == 0, ran.out
    found = verdicts(ran)
    assert {found[name] for name in ("plan", "enrolment", "name", "route", "certificate", "central", "epoch")} == {"ok"}


def test_doctor_does_not_disturb_what_central_knows(station: Log, central: Log, enrolled: str, run: Run) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    at_station(run, station, "doctor")
    one = run("sync", "status", "--dsn", central.dsn, "--station", "brno", "--json")
    assert streams(one)[str(GATE)]["at_station"] == 20


def test_doctor_names_a_revocation(station: Log, central: Log, settings: Settings, enrolled: str, run: Run) -> None:
    access_for(central, settings).registry.revoke("brno")
    ran = at_station(run, station, "doctor", "--json")
    assert (ran.code, verdicts(ran)["central"]) == (1, "bad")
    assert "central has shut this station out" in ran.out


def test_doctor_names_a_station_that_is_not_enrolled(station: Log, run: Run) -> None:
    ran = at_station(run, station, "doctor")
    assert ran.code == 1
    assert "this station is not enrolled. Next: vian station invite brno on central" in ran.out


def test_doctor_names_what_stands_between(station: Log, enrolled: str, run: Run) -> None:
    here = load_settings(data_dir=STATION_DIR, station="brno")
    membership = load_membership(here)
    assert membership is not None
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    for address, check, said in (
        ("https://no-such-host.invalid", "name", "does not resolve"),
        (f"https://127.0.0.1:{port}", "route", "Connection refused. Next: check link and firewall"),
    ):
        save_membership(here, membership.model_copy(update={"address": address}))
        ran = at_station(run, station, "doctor", "--json")
        assert (ran.code, verdicts(ran)[check]) == (1, "bad")
        assert said in ran.out
        assert "central" not in verdicts(ran)


def test_doctor_names_a_login_page_and_another_certificate(station: Log, enrolled: str, run: Run) -> None:
    portal = FastAPI()

    @portal.post("/{path:path}")
    def page(path: str) -> HTMLResponse:
        return HTMLResponse("<html>Please accept the terms</html>")

    here = load_settings(data_dir=STATION_DIR, station="brno")
    membership = load_membership(here)
    assert membership is not None
    with serving(portal, bind("127.0.0.1", 0)) as address:
        save_membership(here, membership.model_copy(update={"address": address, "certificate": None}))
        ran = at_station(run, station, "doctor", "--json")
    assert "a web page answers in central's place" in ran.out
    with serving(portal, bind("127.0.0.1", 0), own_certificate(Path("other"))) as address:
        save_membership(here, membership.model_copy(update={"address": address}))
        ran = at_station(run, station, "doctor", "--json")
    assert verdicts(ran)["certificate"] == "bad"


@pytest.mark.parametrize(
    "days, verdict, said",
    [
        ((-10, -1), "bad", "it has expired: for 127.0.0.1, until "),
        ((-10, 20), "note", "Next: renew it on central of 127.0.0.1"),
        ((-10, 22), "ok", "for 127.0.0.1, until "),
    ],
)
def test_doctor_names_how_long_an_operators_certificate_lasts(
    station: Log,
    enrolled: str,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
    days: tuple[int, int],
    verdict: str,
    said: str,
) -> None:
    here = load_settings(data_dir=STATION_DIR, station="brno")
    membership = load_membership(here)
    assert membership is not None
    authority = operators_certificate("127.0.0.1", days)
    monkeypatch.setenv("SSL_CERT_FILE", str(authority.certificate))
    with serving(FastAPI(), bind("127.0.0.1", 0), authority) as address:
        save_membership(here, membership.model_copy(update={"address": address, "certificate": None}))
        ran = at_station(run, station, "doctor", "--json")
    assert verdicts(ran)["certificate"] == verdict
    assert said in ran.out


def test_doctor_names_a_proxy_and_keeps_its_password(
    station: Log, enrolled: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        monkeypatch.setenv("HTTPS_PROXY", f"http://me:secret@127.0.0.1:{closed.getsockname()[1]}")
        monkeypatch.delenv("NO_PROXY", raising=False)
        monkeypatch.delenv("no_proxy", raising=False)
        ran = at_station(run, station, "doctor", "--json")
    assert (ran.code, verdicts(ran)["proxy"], verdicts(ran)["central"]) == (1, "note", "bad")
    assert "NO_PROXY=127.0.0.1 goes past it" in ran.out
    assert "secret" not in ran.out + ran.err
    assert "route" not in verdicts(ran)


@pytest.mark.parametrize(
    "ahead_s, verdict", [(0, "ok"), (1.5, "ok"), (30, "note"), (-30, "note"), (3600, "bad"), (-3600, "bad")]
)
def test_doctor_names_a_clock_that_is_not_centrals(station: Log, enrolled: str, ahead_s: float, verdict: str) -> None:
    here = load_settings(dsn=station.dsn, data_dir=STATION_DIR, station="brno")
    found = list(examine(station, here, lambda: utc_now() + timedelta(seconds=ahead_s)))
    last = [each for each in found if each.check == "clock"][-1]
    assert last.verdict == verdict
    side = "" if verdict == "ok" else "ahead of central's" if ahead_s > 0 else "behind central's"
    assert side in last.text


def test_doctor_names_a_log_that_is_not_the_one_that_central_knows(
    station: Log, make_log: MakeLog, enrolled: str, run: Run
) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    other = make_log()
    append(other, points(5))
    ran = at_station(run, other, "doctor", "--json")
    assert verdicts(ran)["epoch"] == "bad"
    assert "then vian station new-epoch" in ran.out


def test_a_stream_of_another_history_is_not_said_to_be_at_central(
    station: Log, make_log: MakeLog, enrolled: str, run: Run
) -> None:
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    other = make_log()
    append(other, points(5))
    assert run("sync", "--dsn", other.dsn, "--station", "brno", "--once").code == 1
    row = streams(at_station(run, other, "status", "--json"))[str(GATE)]
    assert (row["at_central"], row["events"]) == (None, 5)
    shown = at_station(run, other, "status").out
    assert "last contact: never" not in shown
    assert "in a row" not in shown
    assert f"stopped: {GATE}: stream {GATE} (epoch 1) is stopped: at sequence 20" in shown


def test_the_checkpoint_that_central_countersigned_is_named(station: Log, enrolled: str, run: Run) -> None:
    for number in (1, 2, 3):
        append(station, points(3))
        assert run("sign", "--dsn", station.dsn, "--station", "brno").code == 0, number
    assert run("sync", "--dsn", station.dsn, "--station", "brno", "--once").code == 0
    shown = at_station(run, station, "status").out
    assert "checkpoints: 3 signed here, newest that central countersigned: 3" in shown


def test_what_is_not_filtered_yet_is_said(station: Log, run: Run) -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/*/track_point', where: 'frame >= 15'}]\n")
    assert run("sync", "plan", "set", "plan.yaml", "--dsn", station.dsn, "--station", "brno").code == 0
    assert "note: of 1 stream the plan sends what a filter leaves" in at_station(run, station, "status").out


def test_doctor_names_a_plan_that_fits_nothing(station: Log, run: Run) -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/no-such/*'}]\n")
    assert run("sync", "plan", "set", "plan.yaml", "--dsn", station.dsn, "--station", "brno").code == 0
    assert "it fits none of the" in at_station(run, station, "doctor").out


def test_lengths_and_sizes_are_for_people() -> None:
    assert (span(93784), span(0.2), span(3600)) == ("1 d 2 h", "0 s", "1 h")
    assert (size_text(812), size_text(81_234), size_text(3.5e9)) == ("812 B", "81.2 kB", "3.5 GB")


def test_what_is_gone_at_both_sides_is_loud_until_it_is_noted(
    station: Log, central: Log, enrolled: str, run: Run
) -> None:
    now = utc_now() + timedelta(days=1)
    take_off_held(station, BRNO, weights(station, 0, now, 1), Proven("", {}), now)  # what central held once
    gone = f"{GATE}, epoch 1, sequences 1 to 20"
    once = run("sync", "--once", "--dsn", station.dsn, "--station", "brno")
    assert once.code == 1
    assert f"payload gone here and at central: {gone}" in said(once)
    assert run("sync", "--once", "--dsn", station.dsn, "--station", "brno").code == 0, "it says so once"
    assert f"payload gone here and at central: {gone}" in said(at_station(run, station, "status"))
    on_central = ("--dsn", central.dsn)
    shown = run("sync", "status", *on_central)
    assert f"payload gone here and at its station: {gone}" in said(shown)
    assert run("sync", "status", "--check", *on_central).code == 1
    verified = run("verify", "--station", "central", *on_central)
    assert verified.code == 1
    assert "every hash is right, but payloads are gone: " in said(verified)
    asked = run("sync", "repair", "--stream", str(GATE), "--station", "central", *on_central)
    assert "station brno is asked for it at its next hello" in said(asked)
    assert len(Wanted(central).of(BRNO)) == 1
    noted = run("sync", "repair", "--lost", "--station", "central", *on_central)
    assert "1 ranges are noted as lost" in said(noted)
    assert Wanted(central).of(BRNO) == []
    assert run("verify", "--station", "central", *on_central).code == 0


def said(ran: Ran) -> str:
    """All that was said, in one line."""
    return " ".join((ran.out + ran.err).split())
