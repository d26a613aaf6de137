"""The command `vian`: which commands there are, and what an error looks like.

Exit codes: 0 done; 1 the world failed; 2 wrong usage, such as the name of a file that is not there;
130 interrupted with Ctrl-C or SIGTERM (what was stored stays; the same command goes on where it stopped).
`vian serve` is a service: told to stop, it did what it was told, and ends with 0.
"""

import os
import sys
from collections.abc import Iterator, MutableMapping
from importlib import import_module
from typing import Annotated, Any

import typer
import typer.main
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

from vian import logs
from vian.entry import INTERRUPTED
from vian.errors import exit_code, expected, told
from vian.version import VERSION

MODULES = {
    "demo": "demo",
    "query": "query",
    "find": "find",
    "shell": "shell",
    "streams": "log",
    "tail": "log",
    "project": "project",
    "psql": "log",
    "init": "proof",
    "sign": "proof",
    "verify": "proof",
    "events": "events",
    "sync": "sync",
    "serve": "serve",
    "doctor": "doctor",
    "extract": "extract",
    "truth": "truth",
    "evaluate": "evaluate",
    "rules": "rules",
    "stages": "stages",
    "zones": "zones",
    "station": "station",
    "evidence": "evidence",
    "archive": "archive",
    "prune": "prune",
    "backup": "backup",
    "restore": "backup",
    "upgrade": "upgrade",
}
"""Each command or group of commands, in the order of the help, and the module of `vian.commands` that has it."""


class _Loaded(MutableMapping[str, Any]):
    """The commands by name, each imported when it is first looked up.

    `vian streams` shall not wait for OpenCV, and not pay for it.
    """

    def __init__(self) -> None:
        self._known: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._known:
            self._known.update(_commands_of(MODULES[name]))
        return self._known[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._known[name] = command

    def __delitem__(self, name: str) -> None:
        del self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(MODULES)

    def __len__(self) -> int:
        return len(MODULES)

    def __contains__(self, name: object) -> bool:
        return name in MODULES


def _commands_of(module_name: str) -> dict[str, Any]:
    """The commands of a module: those that it registers, or the group that it is."""
    module = import_module(f"vian.commands.{module_name}")
    collected = typer.Typer()
    if hasattr(module, "register"):
        module.register(collected)
    else:
        collected.add_typer(module.app, name=module_name)
    return dict(typer.main.get_group(collected).commands)


class Commands(TyperGroup):
    """The commands, whose expected errors become one line and an exit code.

    Here and not around `app()`, because Typer answers an interrupt and a broken pipe itself there.
    """

    def __init__(self, **given: Any) -> None:
        super().__init__(**{**given, "commands": _Loaded()})

    def list_commands(self, ctx: Any) -> list[str]:
        """The names in the order of the help."""
        return list(self.commands)

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was named."""
        try:
            return super().invoke(ctx)
        except expected() as error:
            _tell(told(error))
            raise typer.Exit(exit_code(error)) from error
        except BrokenPipeError as error:
            # The reader of our output has gone (`vian tail | head`): leave quietly.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit from error
        except KeyboardInterrupt as error:
            _tell("interrupted; what was stored stays, and the same command goes on where it stopped")
            raise typer.Exit(INTERRUPTED) from error


app = typer.Typer(
    name="vian",
    cls=Commands,
    help="ViAn: the event-sourced metadata store for video with an online situation-pattern engine.",
    epilog="Begin with: vian demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"vian {VERSION}\n")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and end.", callback=_version, is_eager=True)
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Tell more on standard error.")] = False,
) -> None:
    """ViAn: the event-sourced metadata store for video with an online situation-pattern engine."""
    logs.configure(as_json=False, level=10 if verbose else 30)


def _tell(text: str) -> None:
    Console(stderr=True, soft_wrap=True, highlight=False).print(Text.assemble(("error: ", "bold red"), text))
