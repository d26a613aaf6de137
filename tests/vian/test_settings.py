from pathlib import Path

import pytest

from vian.errors import WrongUsage
from vian.settings import Settings, load_settings

SECRET = "hunter2-and-more"


def test_the_defaults_need_no_file() -> None:
    settings = load_settings()
    assert (settings.host, settings.port, settings.dsn) == ("127.0.0.1", 8470, None)
    assert settings.data_dir == Path.cwd().parent / "xdg_data_home" / "vian"


def test_the_command_line_beats_the_environment_and_that_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("vian.toml").write_text('port = 1\nhost = "file"\nstation = "file"\n')
    assert load_settings().port == 1
    monkeypatch.setenv("VIAN_PORT", "2")
    monkeypatch.setenv("VIAN_HOST", "environment")
    assert load_settings().port == 2
    settings = load_settings(port=3)
    assert (settings.port, settings.host, settings.station) == (3, "environment", "file")


def test_what_the_command_line_leaves_out_is_not_given() -> None:
    Path("vian.toml").write_text("port = 1\n")
    assert load_settings(port=None).port == 1


def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_PORT", "")
    assert load_settings().port == 8470


def test_the_users_own_file_serves_where_there_is_none_here(tmp_path: Path) -> None:
    own = tmp_path / "xdg_config_home" / "vian" / "vian.toml"
    own.parent.mkdir(parents=True)
    own.write_text("port = 5\n")
    assert load_settings().port == 5
    Path("vian.toml").write_text("port = 6\n")
    assert load_settings().port == 6


def test_vian_config_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("vian.toml").write_text("port = 6\n")
    (tmp_path / "other.toml").write_text("port = 7\n")
    monkeypatch.setenv("VIAN_CONFIG", str(tmp_path / "other.toml"))
    assert load_settings().port == 7


def test_vian_config_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_CONFIG", "gone.toml")
    with pytest.raises(WrongUsage, match=r"VIAN_CONFIG names gone.toml, which is not a file"):
        load_settings()


def test_a_home_written_as_a_tilde_is_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/somebody")
    Path("vian.toml").write_text('data_dir = "~/log"\nplan = "~/plan.yaml"\n')
    assert load_settings().data_dir == Path("/somebody/log")
    assert load_settings().plan == Path("/somebody/plan.yaml")


def test_an_unknown_key_is_refused_with_those_that_are_known() -> None:
    Path("vian.toml").write_text("prot = 8470\n")
    with pytest.raises(WrongUsage, match=r"there is no setting 'prot'; known: append_events_max, .*, central, .*"):
        load_settings()


@pytest.mark.parametrize("text", ["port = 70000", 'port = "x"', "database_wait_s = -1", "host = 5"])
def test_a_bad_value_names_setting_value_and_the_next_step(text: str) -> None:
    Path("vian.toml").write_text(text)
    name, value = text.split(" = ")
    with pytest.raises(WrongUsage, match=rf"setting {name}: .*got {value.replace(chr(34), chr(39))}\. Next: .*VIAN_"):
        load_settings()


def test_a_file_that_is_not_toml_is_told() -> None:
    Path("vian.toml").write_text("port 5")
    with pytest.raises(WrongUsage, match=r"the settings file vian.toml cannot be read: .*line 1"):
        load_settings()


def test_settings_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        load_settings().port = 1  # type: ignore[misc]


def test_a_password_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_DSN", f"postgresql://me:{SECRET}@db/log")
    settings = load_settings()
    assert SECRET not in f"{settings} {settings!r}"
    assert settings.dsn is not None
    assert SECRET in settings.dsn.get_secret_value()


def test_nor_is_it_when_the_address_is_malformed() -> None:
    Path("vian.toml").write_text(f'[dsn]\npassword = "{SECRET}"\n')
    with pytest.raises(WrongUsage, match="setting dsn: ") as caught:
        load_settings()
    assert SECRET not in str(caught.value)
    assert caught.value.__cause__ is None


@pytest.mark.parametrize("host, station", [("gate.example.com", "gate.example.com"), ("-_böse host_-", "b-se-host")])
def test_the_station_is_named_by_its_host_unless_set(host: str, station: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vian.settings.socket.gethostname", lambda: host)
    assert load_settings().station == station


def test_every_setting_has_a_description() -> None:
    assert all(field.description for field in Settings.model_fields.values())
