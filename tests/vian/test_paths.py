"""Whatever command is told to read a path that is not there says so in the same words, as wrong usage."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from store import Log
from tests.vian.conftest import Run
from vian.archiving import location_for
from vian.errors import ExitCode, WrongUsage
from vian.reference import all_commands

MADE = {
    "--data-dir": "a log that is not there yet is made, or told as missing",
    "--key-file": "`vian init` makes it, and others tell that it has not",
    "--stations-file": "`vian station add` makes it",
    "--rules": "told with how to make it: a service may wait for rules",
    **dict.fromkeys(("--output", "--out", "--report", "--plot", "--overlays", "--draw"), "it is written"),
}
"""Options of paths that need not be there, each with why."""
WRITTEN = {("vian station add", "--token-file"), ("vian backup", "destination")}
"""Paths of these commands that are written, too."""


def read_by_commands() -> Iterator[tuple[str, list[str]]]:
    """For each path that a command reads the command, and its arguments with `gone` for it."""
    for path, command in all_commands():
        before: list[str] = []
        for parameter in command.params:
            name = parameter.opts[0]
            is_path = "Path" in str(parameter.type_descriptor.annotation)
            if is_path and name not in MADE and (path, name) not in WRITTEN:
                yield path, [*before, "gone"] if parameter.param_type_name == "argument" else [name, "gone"]
            if parameter.param_type_name == "argument":
                before.append(_some(parameter))


def _some(parameter: Any) -> str:
    """An argument that is none of a path that is not there."""
    return "." if "Path" in str(parameter.type_descriptor.annotation) else "cam-01"


@pytest.mark.parametrize(
    "command, arguments", [pytest.param(*each, id=" ".join([each[0], *each[1]])) for each in read_by_commands()]
)
def test_a_path_that_is_not_there_is_wrong_usage(run: Run, command: str, arguments: list[str]) -> None:
    ran = run(*command.split()[1:], *arguments)
    assert (ran.code, ran.out) == (ExitCode.WRONG_USAGE, "")
    assert "error: gone: no such file or folder. Next: check the name" in ran.words
    assert not Path("gone").exists()


@pytest.mark.parametrize("command", ["extract motion --source gate", "rules flink"])
def test_so_it_is_where_an_argument_may_be_something_else(run: Run, command: str) -> None:
    ran = run(*command.split(), "gone.yaml")
    assert (ran.code, "no such file" in ran.words.lower()) == (ExitCode.WRONG_USAGE, True)


@pytest.mark.parametrize("path", ["~nosuch/x", "~/there.yaml"])
def test_a_home_that_the_shell_did_not_fill_in_is_a_name_like_any_other(
    run: Run, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.setenv("HOME", str(Path.cwd()))
    Path("there.yaml").touch()
    ran = run("zones", "calibrate", "gate", path)
    assert ran.code == ExitCode.WRONG_USAGE
    assert f"error: {path}: no such file or folder. Next: check the name" in ran.words


def test_a_folder_at_the_home_of_nobody_is_wrong_usage(run: Run) -> None:
    ran = run("query", "select 1", "--data-dir", "~nosuch/x")
    assert ran.code == ExitCode.WRONG_USAGE
    assert "setting data_dir: Value error, ~nosuch is nobody's home here, got" in ran.words


def test_so_is_an_archive_there(log: Log) -> None:
    with pytest.raises(WrongUsage, match="the archive cannot be at ~nosuch/x: ~nosuch is nobody's home here"):
        location_for(log, "~nosuch/x")
