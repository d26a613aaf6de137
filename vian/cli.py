"""The command `vian`: which commands there are, and what an error looks like.

Exit codes: 0 done; 1 the world failed; 2 wrong usage; 130 interrupted with Ctrl-C or SIGTERM (what
was stored stays; the same command goes on where it stopped).
"""

import os
import sys
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

from events import CorruptSegment
from vian import logs
from vian.commands import backup, demo, doctor, extract, log, query, rules, serve, station, sync, upgrade
from vian.entry import INTERRUPTED
from vian.errors import EXPECTED, exit_code
from vian.version import VERSION

_LOOK_CLOSER = ". Next: vian verify, which says what is wrong with which position"


class Commands(TyperGroup):
    """The commands, whose expected errors become one line and an exit code.

    Here and not around `app()`, because Typer answers an interrupt and a broken pipe itself there.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was named."""
        try:
            return super().invoke(ctx)
        except EXPECTED as error:
            is_unexplained = isinstance(error, CorruptSegment) and "Next: " not in str(error)
            _tell(str(error) + (_LOOK_CLOSER if is_unexplained else ""))
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
app.add_typer(extract.app, name="extract")
app.add_typer(rules.app, name="rules")
app.add_typer(station.app, name="station")
for module in (demo, query, log, sync, serve, doctor, backup, upgrade):
    module.register(app)


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
