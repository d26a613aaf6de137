"""`vian find` and `vian query --central`, from enrolment over real TLS to the answer, and without a link."""

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from events import station_name
from store import Log
from sync.central.access import Access
from tests.sync.asking import audit, plate, project, situation, tell
from tests.sync.conftest import NOON
from tests.vian.conftest import Ran, Run
from vian.admission import access_for, certificate_of, invited
from vian.api import bind, create_app, serving
from vian.questions import answering_for
from vian.settings import load_settings

CENTRAL_DIR, STATION_DIR = Path("central-data"), Path("station-data")
SQL = "SELECT station, count(*) AS n FROM plate_read GROUP BY station ORDER BY station"


@pytest.fixture
def station(make_log: Any) -> Log:
    """The station's log."""
    log: Log = make_log()
    tell(log, "brno-2", [plate("1AB 2345", minute) for minute in range(3)])
    tell(log, "brno-2", [situation("speeding", 1, "alarm"), situation("wrong way", 2)], "rules")
    return log


@pytest.fixture
def central_log(make_log: Any) -> Log:
    """Central's log: what the station has, and another station."""
    log: Log = make_log()
    for name in ("brno-2", "oslo-1"):
        tell(log, name, [plate("1AB 2345", minute) for minute in range(3)])
    tell(log, "oslo-1", [situation("speeding", 5, "alarm")], "rules")
    project(log)
    return log


@pytest.fixture
def access(central_log: Log) -> Access:
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", tls="generate")
    return access_for(central_log, settings)


@pytest.fixture
def address(central_log: Log, access: Access) -> Iterator[str]:
    """Address of a central server with a certificate of its own."""
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", tls="generate")
    app = create_app(central_log, access=access, answers=answering_for(central_log, settings, access))
    with serving(app, bind("127.0.0.1", 0), certificate_of(settings)) as address:
        yield address


@pytest.fixture
def ask(station: Log, run: Run) -> Run:
    """Runs a command on the station."""
    Path("vian.toml").write_text(f'dsn = "{station.dsn}"\ndata_dir = "{STATION_DIR.resolve()}"\n')
    return run


def enrol(ask: Run, access: Access, address: str, operations: list[str], reads: list[str]) -> None:
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", tls="generate")
    code, _ = invited(access.registry, settings, station_name("brno-2"), operations, reads)
    ran = ask("station", "enrol", code, "--central", address, "--station", "brno-2")
    assert ran.code == 0, ran.err


def lines(ran: Ran) -> list[dict[str, Any]]:
    assert ran.code == 0, ran.err
    return [json.loads(line) for line in ran.out.splitlines()]


def test_a_station_finds_plates_and_situations_without_any_central(ask: Run) -> None:
    *rows, summary = lines(ask("find", "plate", "1ab*", "--limit", 2, "--json"))
    assert [(row["plate"], row["id"]) for row in rows] == [
        ("1AB 2345", "brno-2/gate/plate_read/3"),
        ("1AB 2345", "brno-2/gate/plate_read/2"),
    ]
    assert (summary["partial"], summary["rows"], summary["cut"]) == (False, 2, "the limit of 2 rows")
    assert len(lines(ask("find", "plate", "1AB2345", "--all", "--json"))) == 4
    shown = ask("find", "situation", "--severity", "alarm")
    assert "speeding at 1" in shown.out
    assert "wrong way" not in shown.out
    nothing = ask("find", "plate", "9*", "--from", NOON.isoformat())
    assert (nothing.code, nothing.words) == (0, "nothing found")


def test_an_enrolled_station_asks_central(ask: Run, access: Access, address: str, central_log: Log) -> None:
    enrol(ask, access, address, ["find", "query"], ["brno-2", "oslo-1"])
    *rows, summary = lines(ask("find", "plate", "1AB2345", "--central", "--limit", 4, "--json"))
    assert (len(rows), summary["answered_by"], summary["partial"]) == (4, "central", False)
    rest = lines(ask("find", "plate", "1AB2345", "--central", "--limit", 4, "--page", summary["next"], "--json"))
    assert (len(rest), rest[-1]["next"]) == (3, None)
    assert len(lines(ask("find", "plate", "1AB2345", "--central", "--limit", 2, "--all", "--json"))) == 7
    (row, _) = lines(ask("find", "situation", "speed*", "--central", "--json"))
    assert (row["station"], row["situation"]) == ("oslo-1", "speeding-5")
    counts = lines(ask("query", SQL, "--central", "--json"))
    assert counts == [{"station": "brno-2", "n": 3}, {"station": "oslo-1", "n": 3}]
    assert {event.person is not None for event in audit(central_log)} == {True}


def test_without_a_link_the_answer_is_partial_and_the_command_succeeds(
    ask: Run, access: Access, central_log: Log
) -> None:
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", tls="generate")
    app = create_app(central_log, access=access, answers=answering_for(central_log, settings, access))
    with serving(app, bind("127.0.0.1", 0), certificate_of(settings)) as address:
        enrol(ask, access, address, ["find", "query"], ["*"])
    ran = ask("find", "plate", "1AB2345", "--central", "--json")
    *rows, summary = lines(ran)
    assert (len(rows), summary["answered_by"], summary["partial"]) == (3, "brno-2", True)
    assert summary["last_contact_age_s"] is None
    assert ran.words.startswith("PARTIAL: this is what station brno-2 itself holds; central did not answer.")
    told = ask("query", SQL, "--central", "--json")
    assert lines(told) == [{"station": "brno-2", "n": 3}]
    assert told.words.startswith("PARTIAL")


def test_a_refusal_of_central_is_told_and_is_no_partial_answer(ask: Run, access: Access, address: str) -> None:
    enrol(ask, access, address, ["find", "query"], ["brno-2"])
    for arguments, said in (
        (("find", "plate", "*", "--central", "--station", "oslo-1"), "got events of station oslo-1"),
        (("find", "plate", "*", "--central", "--station", "nobody"), "got events of station nobody"),
    ):
        ran = ask(*arguments)
        assert (ran.code, ran.out) == (1, "")
        assert said in ran.words
        assert "PARTIAL" not in ran.err


def test_a_question_that_is_not_right_ends_alike_here_and_at_central(ask: Run, access: Access, address: str) -> None:
    enrol(ask, access, address, ["find", "query"], ["*"])
    sql = "select plate,\n  plaet from plate_read"
    for options in (("query", sql, "--central"), ("query", sql)):
        ran = ask(*options)
        assert (ran.code, ran.out) == (2, "")
        line, caret = next(pair for pair in pairwise(ran.err.splitlines()) if "^" in pair[1])
        assert line[caret.index("^") :].startswith("plaet"), ran.err
    for options in (("--central",), ()):
        ran = ask("find", "plate", "1*", "--station", "nobody", *options)
        assert (ran.code, ran.out) == (2, "")
        assert "no station 'nobody' in" in ran.words
        assert "known: brno-2" in ran.words


def test_a_table_has_the_same_columns_with_a_link_and_without(ask: Run, access: Access, central_log: Log) -> None:
    settings = load_settings(data_dir=CENTRAL_DIR, station="central", tls="generate")
    app = create_app(central_log, access=access, answers=answering_for(central_log, settings, access))
    asked = [f"select * from {name} where station = 'brno-2' limit 1" for name in ("plate_read", "events", "streams")]
    with serving(app, bind("127.0.0.1", 0), certificate_of(settings)) as address:
        enrol(ask, access, address, ["find", "query"], ["*"])
        linked = [lines(ask("query", sql, "--central", "--json")) for sql in asked]
    alone = [lines(ask("query", sql, "--central", "--json")) for sql in asked]
    assert [list(row) for (row,) in linked] == [list(row) for (row,) in alone]


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("find", "plate", "1*", "--central"), "Next: vian station enrol CODE --central URL"),
        (("find", "plate", "1*", "--page", "x"), "--page goes on with an answer of central"),
        (("find", "plate", ""), "plate: String should have at least 1 character"),
        (("find", "situation", "--severity", "loud"), "severity: Input should be 'info', 'warning' or 'alarm'"),
        (("find", "plate", "1*", "--since", "noon"), "--since must be a time"),
        (("query", SQL, "--central", "--source", "gate"), "Next: say it in the SQL: WHERE"),
        (("query", SQL, "--limit", 3), "--limit is for --central"),
    ],
)
def test_what_cannot_be_asked_is_told_with_the_next_step(ask: Run, arguments: tuple[Any, ...], said: str) -> None:
    ran = ask(*arguments)
    assert ran.code == 2
    assert said in ran.words
