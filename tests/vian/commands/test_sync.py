"""`vian sync` and `vian serve` at the command line, central in this process."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from store import Log
from tests.conftest import MakeLog
from tests.vian.conftest import Run
from tests.vian.samples import YARD, append, heads, points
from vian.api import bind, create_app, serving
from vian.stations import add_station, read_grants

LIST, TOKEN = Path("stations.toml"), Path("brno.token")


@pytest.fixture
def station(make_log: MakeLog) -> Log:
    log = make_log()
    append(log, points(20))
    append(log, points(5), YARD)
    return log


@pytest.fixture
def central(make_log: MakeLog) -> Log:
    return make_log()


@pytest.fixture
def address(central: Log) -> Iterator[str]:
    """Address of the central server, to which station brno may replicate."""
    add_station(LIST, "brno", TOKEN)
    with serving(create_app(central, read_grants(LIST)), bind("127.0.0.1", 0)) as address:
        yield address


Sync = Callable[..., object]


def test_sync_once_sends_everything_and_says_where_it_stands(
    station: Log, central: Log, address: str, run: Run
) -> None:
    options = ("--dsn", station.dsn, "--station", "brno", "--central", address, "--token-file", TOKEN, "--once")
    ran = run("sync", *options, "--json")
    assert ran.code == 0, ran.err
    assert heads(central) == heads(station)
    rows = [json.loads(line) for line in ran.out.splitlines()]
    assert {(row["stream"], row["sequence"], row["at_central"], row["backlog"], row["error"]) for row in rows} == {
        ("brno/gate/track_point", 20, 20, 0, None),
        ("brno/yard/track_point", 5, 5, 0, None),
        ("brno/sync/sync_planned", 1, 1, 0, None),
    }
    before = heads(central)
    assert "brno/gate/track_point" in run("sync", *options).out
    assert heads(central) == before


def test_sync_follows_its_plan(station: Log, central: Log, address: str, run: Run) -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/yard/*', priority: points}]\n")
    options = ("--central", address, "--token-file", TOKEN, "--plan", "plan.yaml", "--once")
    assert run("sync", "--dsn", station.dsn, "--station", "brno", *options).code == 0
    assert list(heads(central)) == ["brno/yard/track_point"]


def test_sync_once_says_that_the_plan_is_paused(station: Log, central: Log, address: str, run: Run) -> None:
    assert run("sync", "plan", "pause", "--dsn", station.dsn, "--station", "brno").code == 0
    options = ("--dsn", station.dsn, "--station", "brno", "--central", address, "--token-file", TOKEN, "--once")
    ran = run("sync", *options)
    assert ran.code == 0
    assert "the plan is paused: nothing was sent. Next: vian sync plan resume" in ran.words
    assert heads(central) == {}


def test_sync_sends_what_a_filter_leaves_and_goes_on_with_the_plan_that_was_set(
    station: Log, central: Log, address: str, run: Run
) -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/gate/track_point', where: 'frame >= 15'}]\n")
    options = ("--dsn", station.dsn, "--station", "brno")
    to = ("--central", address, "--token-file", TOKEN, "--once")
    assert run("sync", "plan", "set", "plan.yaml", *options).code == 0
    assert run("sync", *options, *to).code == 0
    ((name, (sequence, _)),) = heads(central).items()
    assert (name.startswith("brno/gate~"), sequence) == (True, 5)
    append(station, points(4, first_frame=20))
    assert run("sync", *options, *to).code == 0
    assert heads(central)[name][0] == 9


@pytest.mark.parametrize(
    "token, said",
    [
        ("another-token-that-nobody-granted", "answered 401"),
        ("short", "a token must be 16 to 512 visible ASCII characters"),
    ],
)
def test_a_wrong_token_is_told(station: Log, central: Log, address: str, run: Run, token: str, said: str) -> None:
    TOKEN.write_text(token)
    options = ("--central", address, "--token-file", TOKEN, "--once")
    ran = run("sync", "--dsn", station.dsn, "--station", "brno", *options)
    assert (ran.code, ran.out) == (1 if "401" in said else 2, "")
    assert said in ran.words
    assert token not in ran.err
    assert central.head() == 0


def test_a_central_that_cannot_be_reached_is_told(station: Log, run: Run) -> None:
    TOKEN.write_text("a-token-of-brno-that-nobody-guesses")
    options = ("--central", "http://127.0.0.1:9", "--token-file", TOKEN, "--once")
    ran = run("sync", "--dsn", station.dsn, "--station", "brno", *options)
    assert (ran.code, ran.out) == (1, "")
    assert "central at http://127.0.0.1:9 cannot be reached" in ran.words
    assert "Next: " in ran.words


@pytest.mark.parametrize(
    "options, said",
    [
        ([], "where to? Next: vian station enrol CODE --central URL, with the code that vian station invite brno"),
        (["--central", "https://x"], "this station is not enrolled at https://x. Next: vian station invite brno on"),
        (["--central", "http://x.example", "--token-file", TOKEN], "must be reached over https, got http://x.example"),
        (["--central", "x", "--token-file", TOKEN], "central must be an address such as"),
        (["--central", "https://x", "--token-file", "gone"], "gone: no such file or folder"),
        (["--central", "https://x", "--token-file", TOKEN, "--plan", "gone.yaml"], "gone.yaml"),
        (["--central", "https://x", "--token-file", TOKEN, "--station", "typo"], "Next: give --station brno"),
        (["--central", "https://x", "--token-file", TOKEN, "--station", "a/b"], "a/b"),
    ],
)
def test_what_is_missing_or_wrong_is_told_before_anything_is_sent(
    station: Log, run: Run, options: list[object], said: str
) -> None:
    TOKEN.write_text("a-token-of-brno-that-nobody-guesses")
    before = heads(station)
    ran = run(
        "sync",
        "--dsn",
        station.dsn,
        "--once",
        *(options if "--station" in options else [*options, "--station", "brno"]),
    )
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.words
    assert heads(station) == before


@pytest.mark.parametrize(
    "options, code, said",
    [
        (["--role", "central", "--tls-certificate", "."], 2, "the certificate . with the key ."),
        (["--role", "central", "--tls-key", "."], 2, "a key without its certificate. Next: give --tls-cert"),
        (["--role", "central", "--tls", "generate", "--tls-certificate", "."], 2, "two certificates: give either"),
        (["--role", "central", "--tls", "yes"], 2, "setting tls: Input should be 'off' or 'generate', got 'yes'"),
        (["--role", "central", "--stations-file", "gone.toml"], 2, "the stations file gone.toml cannot be read"),
        (["--role", "station", "--central", "https://x"], 2, "this station is not enrolled at https://x. Next: vian"),
        (["--role", "station", "--rules", "gone"], 2, "there is no gone to read rules from. Next: mkdir gone"),
        (["--role", "station", "--port", "70000"], 2, "port"),
        (["--role", "station", "--host", "192.0.2.1"], 1, "cannot listen on 192.0.2.1"),
        (["--role", "field"], 2, "--role"),
        ([], 2, "--role"),
    ],
)
def test_a_server_that_cannot_start_says_why(log: Log, run: Run, options: list[str], code: int, said: str) -> None:
    ran = run("serve", "--dsn", log.dsn, "--port", "0", *options)
    assert (ran.code, ran.out) == (code, "")
    assert said in ran.words


def test_a_port_in_use_is_told(log: Log, run: Run) -> None:
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        ran = run("serve", "--dsn", log.dsn, "--role", "station", "--port", port)
    assert ran.code == 1
    assert f"cannot listen on 127.0.0.1 port {port}: Address already in use. Next: " in ran.words
