from datetime import UTC, datetime
from pathlib import Path

import pytest

from store import LogUnavailable
from vian.errors import WorldFailed, WrongUsage
from vian.options import has_log, open_from, opened, settings_for, time_of


def test_a_folder_and_an_address_exclude_each_other() -> None:
    with pytest.raises(WrongUsage, match="either --data-dir or --dsn, got both"):
        settings_for(Path("x"), "postgresql://host/db")


def test_a_folder_on_the_command_line_beats_an_address_in_the_file() -> None:
    Path("vian.toml").write_text('dsn = "postgresql://nobody@127.0.0.1:1/none?connect_timeout=1"\n')
    with (
        pytest.raises(WorldFailed, match="there is no log in log"),
        opened(settings_for(Path("log")), data_dir=Path("log")),
    ):
        pass
    with pytest.raises(LogUnavailable, match=r"127\.0\.0\.1"):
        open_from(settings_for())


@pytest.mark.parametrize("text", ["2026-01-31T12:00:00Z", "2026-01-31T12:00", "2026-01-31T14:00:00+02:00"])
def test_a_time_is_read_in_utc(text: str) -> None:
    assert time_of("--since", text) == datetime(2026, 1, 31, 12, tzinfo=UTC)


def test_no_time_is_none() -> None:
    assert time_of("--since", None) is None


@pytest.mark.parametrize("text", ["yesterday", "2026-13-01", "", "12:00"])
def test_what_is_no_time_is_told_with_an_example(text: str) -> None:
    with pytest.raises(WrongUsage, match=r"--since must be a time such as 2026-01-31T12:00:00Z, got '"):
        time_of("--since", text)


@pytest.mark.parametrize("text", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-01:00"])
def test_a_time_that_utc_does_not_have_is_told(text: str) -> None:
    with pytest.raises(WrongUsage, match="--since must lie in the years 1 to 9999 of UTC"):
        time_of("--since", text)


def test_a_folder_without_a_log_is_not_made_one_by_a_reader(tmp_path: Path) -> None:
    settings = settings_for(tmp_path / "typo")
    with pytest.raises(WorldFailed, match="Next: vian demo or vian extract makes one"), opened(settings):
        pass
    assert not (tmp_path / "typo").exists()


def test_a_folder_that_cannot_be_looked_into_may_hold_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "exists", refuse)
    assert has_log(tmp_path)


@pytest.mark.parametrize(
    "names, said",
    [
        (None, "there is no such folder"),
        ([], "it is empty"),
        (["a", "b", "pg/x", "z"], "it holds a, b, pg, ..."),
        (["PG_VERSION"], "it is the inside of one; give "),
    ],
)
def test_what_stands_where_a_log_was_wanted_is_said(tmp_path: Path, names: list[str] | None, said: str) -> None:
    folder = tmp_path / "folder"
    for name in names or []:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    if names == []:
        folder.mkdir()
    with pytest.raises(WorldFailed) as told, opened(settings_for(folder)):
        pass
    assert f"there is no log in {folder} ({said}" in str(told.value)
    assert not (folder / "pg.lock").exists()


def test_a_file_where_a_log_was_wanted_is_told(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(WorldFailed, match=r"it is a file"), opened(settings_for(tmp_path / "clip.mp4")):
        pass
