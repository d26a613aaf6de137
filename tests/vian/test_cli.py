"""What holds for every command: help with an example, exit codes, errors in one line."""

import os
import re
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest
import typer.main

from store import LogUnavailable, WrongMajor
from tests.vian.conftest import Run
from vian import cli
from vian.commands import log as log_commands
from vian.version import VERSION


def commands(group: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All commands with their path, groups that do nothing by themselves left out."""
    for name, command in (group or typer.main.get_command(cli.app)).commands.items():
        if getattr(command, "invoke_without_command", False):
            yield (*path, name), command
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


ALL = dict(commands())
READERS = [
    ["streams"],
    ["tail"],
    ["query", "select 1"],
    ["verify"],
    ["evidence", "export", "--situation", "3f9c2a71"],
    ["backup", "elsewhere"],
    ["project"],
    ["psql"],
    ["sync", "--once", "--central", "https://x", "--token-file", "token"],
]


def test_the_commands_are_those_that_there_should_be() -> None:
    assert {" ".join(path) for path in ALL} == {
        "archive", "archive project", "archive relocate", "archive status", "backup", "demo", "doctor", "events",
        "evaluate ground", "evaluate horizon", "evaluate tracks",
        "evidence export", "evidence verify", "extract calibration", "extract horizon", "extract motion", "find plate",
        "find situation",
        "init", "project", "project maintain",
        "project rebuild", "project status", "prune", "psql", "query", "restore", "rules backtest",
        "rules check", "rules deploy", "rules expand", "rules explain", "rules flink", "rules lint", "rules new",
        "rules profile", "rules retire", "rules run", "rules status", "rules test", "rules why-not", "serve", "shell",
        "sign", "stages check", "stages run", "station add", "station enrol", "station invite",
        "station leave", "station list", "station new-epoch", "station revoke", "streams", "sync", "sync doctor",
        "sync plan pause", "sync plan preview",
        "sync plan resume", "sync plan set", "sync plan show", "sync repair", "sync status",
        "tail", "truth horizon", "upgrade", "verify",
        "zones calibrate", "zones define", "zones draw", "zones import", "zones list", "zones remove",
    }  # fmt: skip


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_help_says_what_it_does_and_shows_an_example(run: Run, path: tuple[str, ...]) -> None:
    ran = run(*path, "--help")
    assert ran.code == 0
    assert re.search(rf"Example: vian {' '.join(path)}\b", " ".join(ran.out.split()))
    assert ALL[path].help


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_every_option_is_explained(path: tuple[str, ...]) -> None:
    for parameter in ALL[path].params:
        assert getattr(parameter, "help", None), parameter.name


@pytest.mark.parametrize(
    "path",
    [
        p
        for p in ALL
        if p[0] not in ("rules", "stages", "station", "events", "evidence", "truth", "evaluate")
        or p[1:] in (("run",), ("export",))
    ],
    ids=" ".join,
)
def test_every_command_takes_an_embedded_or_an_external_log(path: tuple[str, ...]) -> None:
    options = {option for parameter in ALL[path].params for option in parameter.opts}
    assert {"--data-dir", "--dsn"} <= options
    assert "--json" in options or path == ("psql",)


def test_the_version_is_printed(run: Run) -> None:
    assert run("--version").out == f"vian {VERSION}\n"


@pytest.mark.parametrize("arguments", [["nothing"], ["demo", "--nothing"], ["extract"], ["query"], ["tail", "-n", "x"]])
def test_wrong_usage_is_2_and_points_at_the_help(run: Run, arguments: list[str]) -> None:
    ran = run(*arguments)
    assert ran.code == 2


@pytest.mark.parametrize("arguments", READERS, ids=lambda arguments: arguments[0])
def test_a_folder_without_a_log_is_told_and_left_as_it_is(run: Run, arguments: list[str], tmp_path: Path) -> None:
    Path("token").write_text("a-token-that-nobody-guesses")
    ran = run(*arguments, "--data-dir", tmp_path / "typo")
    assert (ran.code, ran.out) == (1, "")
    assert (
        f"there is no log in {tmp_path}/typo (there is no such folder). Next: vian demo or vian extract makes one"
        in ran.words
    )
    assert not (tmp_path / "typo").exists()


@pytest.mark.parametrize("arguments", READERS[:-1], ids=lambda arguments: arguments[0])
def test_a_folder_and_an_address_at_once_are_wrong_usage(run: Run, arguments: list[str]) -> None:
    ran = run(*arguments, "--data-dir", "x", "--dsn", "postgresql://x/y")
    assert ran.code == 2
    assert "give either --data-dir or --dsn, got both" in ran.words


def test_a_data_directory_of_another_major_is_told_and_not_touched(run: Run, public_folder: Path) -> None:
    data_dir = public_folder / "old"
    (data_dir / "pg").mkdir(parents=True)
    (data_dir / "pg" / "PG_VERSION").write_text("14\n")
    ran = run("streams", "--data-dir", data_dir)
    assert (ran.code, ran.out) == (1, "")
    assert "was made by PostgreSQL 14, this ViAn runs PostgreSQL 18. Next: run its own PostgreSQL 14" in ran.words
    assert [path.name for path in (data_dir / "pg").iterdir()] == ["PG_VERSION"]
    found = run("doctor", "--data-dir", data_dir)
    assert found.code == 1
    assert "was made by PostgreSQL 14" in found.out


def test_a_database_that_is_away_is_told_without_its_password(run: Run) -> None:
    ran = run("streams", "--dsn", "postgresql://me:hunter2@127.0.0.1:1/none?connect_timeout=1")
    assert (ran.code, ran.out) == (1, "")
    assert "127.0.0.1" in ran.words
    assert "hunter2" not in ran.err


@pytest.mark.parametrize("dsn, code", [("nonsense here", 2), ("mysql://x/y", 2), ("postgresql://x:port/z", 1)])
def test_an_address_that_is_none_is_told(run: Run, dsn: str, code: int) -> None:
    ran = run("streams", "--dsn", dsn)
    assert (ran.code, ran.out) == (code, "")
    assert ran.err.startswith("error: ")


def test_a_folder_without_permission_is_told(public_folder: Path) -> None:
    closed = public_folder / "closed"
    closed.mkdir()
    closed.chmod(0o555)
    argv = [sys.executable, "-m", "vian", "extract", "motion", "/dev/null", "--source", "gate"]
    nobody: dict[str, Any] = {"user": 65534, "group": 65534, "extra_groups": []} if os.geteuid() == 0 else {}
    ran = subprocess.run(
        [*argv, "--data-dir", str(closed / "log")],
        capture_output=True,
        text=True,
        cwd=public_folder,
        **nobody,
        env={**os.environ, "HOME": str(public_folder), "XDG_CONFIG_HOME": str(public_folder)},
    )
    assert stat.S_IMODE(closed.stat().st_mode) == 0o555
    assert ran.returncode == 1
    assert "cannot be used: Permission denied. Next: give a folder that you may write to" in " ".join(
        ran.stderr.split()
    )


@pytest.mark.parametrize(
    "error, code", [(LogUnavailable("x [y]"), 1), (WrongMajor("x [y]"), 1), (KeyboardInterrupt(), 130)]
)
def test_errors_become_exit_codes(run: Run, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int) -> None:
    def fail(*_: object, **__: object) -> NoReturn:
        raise error

    monkeypatch.setattr(log_commands, "opened", fail)
    ran = run("streams")
    assert (ran.code, ran.out) == (code, "")
    assert ran.err == "error: x [y]\n" if code == 1 else "the same command goes on where it stopped" in ran.words


def test_a_defect_shows_its_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> NoReturn:
        raise ZeroDivisionError

    monkeypatch.setattr(log_commands, "opened", fail)
    with pytest.raises(ZeroDivisionError):
        run("streams")


@pytest.mark.parametrize(
    "arguments, spared",
    [
        (["--version"], {"pyarrow", "sqlalchemy", "store", "vian.commands.log"}),
        (
            ["streams", "--data-dir", "typo"],
            {"cv2", "scipy", "av", "duckdb", "shapely", "patterns", "sync", "vian.demo"},
        ),
        (
            ["verify", "--data-dir", "typo"],
            {"cv2", "scipy", "av", "duckdb", "shapely", "patterns", "sync", "vian.demo"},
        ),
        (["query", "select 1", "--data-dir", "typo"], {"cv2", "scipy", "av", "patterns", "sync", "vian.demo"}),
        (["station", "add", "a/b", "--stations-file", "x"], {"cv2", "scipy", "av", "duckdb", "patterns", "vian.demo"}),
    ],
    ids=lambda arguments: arguments[0] if isinstance(arguments, list) else "",
)
def test_a_command_imports_what_it_needs_and_no_more(arguments: list[str], spared: set[str]) -> None:
    script = f"import sys\nfrom vian.cli import app\ntry:\n    app({arguments})\nfinally:\n    print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "vian.commands.demo" not in ran.stdout.split()
    assert spared & set(ran.stdout.split()) == set()
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize("name", cli.MODULES)
def test_each_command_of_the_table_is_the_one_of_that_name(name: str) -> None:
    command: Any = typer.main.get_command(cli.app)
    assert command.commands[name].name == name


def test_every_module_of_commands_is_in_the_table() -> None:
    there = {path.stem for path in Path(log_commands.__file__).parent.glob("*.py")} - {"__init__"}
    of_a_group = {
        name for name in there if name.startswith(("rules_", "sync_", "extract_"))
    }  # registered by their group
    assert there - of_a_group == set(cli.MODULES.values())


def test_a_mistyped_command_is_told_with_the_nearest(run: Run) -> None:
    ran = run("streems")
    assert ran.code == 2
    assert "Did you mean 'streams'" in ran.words


def test_more_is_told_when_asked(run: Run, tmp_path: Path) -> None:
    assert run("--verbose", "doctor", "--data-dir", tmp_path / "new").code == 0
