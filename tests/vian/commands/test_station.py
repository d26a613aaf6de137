"""`vian station add`."""

import json
from pathlib import Path

import pytest

from tests.vian.conftest import Run
from vian.stations import read_grants

LIST = Path("stations.toml")


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


def test_the_list_may_be_a_setting(run: Run) -> None:
    Path("vian.toml").write_text(f'stations_file = "{LIST}"\n')
    assert run("station", "add", "brno-2").code == 0
    assert LIST.exists()


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
