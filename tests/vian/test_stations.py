import stat
import tomllib
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from events import InvalidName
from sync.protocol.grants import token_hash
from vian.errors import WorldFailed, WrongUsage
from vian.stations import StationsFile, add_station, read_grants, read_token, write_private

LIST = Path("stations.toml")
TOKEN = Path("brno.token")


def test_a_station_that_was_added_is_known_by_its_token() -> None:
    token = add_station(LIST, "brno-2")
    assert read_grants(LIST).station_of(token) == "brno-2"
    assert read_grants(LIST).station_of(token[:-1]) is None


def test_the_list_holds_hashes_only_and_is_private() -> None:
    token = add_station(LIST, "brno-2")
    assert token not in LIST.read_text()
    assert tomllib.loads(LIST.read_text()) == {"stations": {"brno-2": token_hash(token)}}
    assert stat.S_IMODE(LIST.stat().st_mode) == 0o600


def test_comments_and_order_of_the_list_stay() -> None:
    LIST.write_text(f'# ours\n[stations]\n"zlin" = "{"a" * 64}"  # since May\n')
    token = add_station(LIST, "brno-2")
    assert LIST.read_text() == (
        f'# ours\n[stations]\n"zlin" = "{"a" * 64}"  # since May\n"brno-2" = "{token_hash(token)}"\n'
    )


def test_a_table_behind_the_stations_is_not_added_to() -> None:
    text = '[stations]\n[other]\nx = "y"\n'
    LIST.write_text(text)
    with pytest.raises(WrongUsage, match=r"must end with its table \[stations\]"):
        add_station(LIST, "brno-2")
    assert LIST.read_text() == text


def test_a_station_is_added_once() -> None:
    token = add_station(LIST, "brno-2", TOKEN)
    with pytest.raises(WrongUsage, match=r"brno-2 is in stations.toml already\. Next: .*delete its line"):
        add_station(LIST, "brno-2", TOKEN)
    assert read_token(TOKEN) == token


def test_a_name_outside_the_grammar_is_refused_before_anything_is_written() -> None:
    with pytest.raises(InvalidName):
        add_station(LIST, "a/b")
    assert not LIST.exists()


def test_a_token_that_could_not_be_kept_is_not_listed() -> None:
    TOKEN.mkdir()
    with pytest.raises(WorldFailed, match=r"brno\.token cannot be written: "):
        add_station(LIST, "brno-2", TOKEN)
    assert not LIST.exists()
    assert [path.name for path in Path().iterdir()] == [TOKEN.name]


def test_a_private_file_is_private_even_where_an_open_one_was() -> None:
    TOKEN.write_text("old")
    TOKEN.chmod(0o644)
    write_private(TOKEN, "new")
    assert TOKEN.read_text() == "new"
    assert stat.S_IMODE(TOKEN.stat().st_mode) == 0o600


def test_a_token_is_read_without_the_end_of_its_line() -> None:
    TOKEN.write_text("  a-token-of-brno-2\n")
    assert read_token(TOKEN) == "a-token-of-brno-2"


@pytest.mark.parametrize(
    "content",
    [None, b"", b" \n", b"\xff\xfe", b"short", b"two words, and long enough", b"<html>\n<body>not here</body>"],
)
def test_a_token_file_without_a_token_is_told(content: bytes | None) -> None:
    if content is not None:
        TOKEN.write_bytes(content)
    with pytest.raises(
        WrongUsage,
        match=r"the token file brno.token (cannot be read|is empty|does not hold).*Next: carry over the file",
    ):
        read_token(TOKEN)


@pytest.mark.parametrize(
    "text, said",
    [
        (None, "cannot be read: .*Next: vian station add NAME"),
        ("[stations", "is not TOML: .*Next: correct that line"),
        ("brno = 'x'", r"wanted a table \[stations\]"),
        ("stations = 5", r"wanted a table \[stations\]"),
        ("[stations]\nbrno = 5", r"wanted a table \[stations\]"),
        ("[stations]\nbrno = 'abc'", "stations.toml: .*64 hexadecimal digits"),
        ("[stations]\n'a/b' = 'abc'", "stations.toml: "),
    ],
)
def test_a_list_of_stations_that_is_none_is_told(text: str | None, said: str) -> None:
    if text is not None:
        LIST.write_text(text)
    with pytest.raises(WrongUsage, match=said):
        read_grants(LIST)


def test_a_station_that_is_added_while_central_runs_may_replicate() -> None:
    first = add_station(LIST, "brno-2")
    stations = StationsFile(LIST)
    second = add_station(LIST, "zlin")
    assert (stations.station_of(first), stations.station_of(second)) == ("brno-2", "zlin")


def test_a_station_whose_line_goes_may_not_replicate_any_more() -> None:
    token = add_station(LIST, "brno-2")
    stations = StationsFile(LIST)
    LIST.write_text("[stations]\n")
    assert stations.station_of(token) is None


@pytest.mark.parametrize("text", [None, "[stations"])
def test_a_list_that_became_unreadable_keeps_the_stations_and_is_logged_once(text: str | None) -> None:
    token = add_station(LIST, "brno-2")
    stations = StationsFile(LIST)
    LIST.unlink() if text is None else LIST.write_text(text)
    with capture_logs() as logged:
        assert [stations.station_of(token) for _ in range(3)] == ["brno-2"] * 3
    assert [(each["event"], each["log_level"]) for each in logged] == [("the stations stay as they were", "error")]
    LIST.unlink(missing_ok=True)
    later = add_station(LIST, "brno-2")
    assert (stations.station_of(token), stations.station_of(later)) == (None, "brno-2")


def test_a_list_that_cannot_be_read_at_the_start_is_told() -> None:
    with pytest.raises(WrongUsage, match="cannot be read"):
        StationsFile(LIST)
