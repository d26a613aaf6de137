"""The command `vian`: which commands there are, and what an error looks like.

Exit codes: 0 done; 1 the world failed; 2 wrong usage; 130 interrupted with Ctrl-C (what was stored
stays; the same command goes on where it stopped).
"""

import os
import sys
from typing import Annotated

import typer
from rich.console import Console

from vian import logs
from vian.commands import demo, doctor, extract, log, query, rules, serve, station, sync
from vian.errors import EXPECTED, exit_code
from vian.version import VERSION

INTERRUPTED = 130

app = typer.Typer(
    name="vian",
    help="ViAn: the event-sourced metadata store for video with an online situation-pattern engine.",
    epilog="Begin with: vian demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(extract.app, name="extract")
app.add_typer(rules.app, name="rules")
app.add_typer(station.app, name="station")
for module in (demo, query, log, sync, serve, doctor):
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


def main() -> None:
    """Run the command line and leave with its exit code."""
    try:
        app(standalone_mode=True)
    except EXPECTED as error:
        _tell(str(error))
        sys.exit(exit_code(error))
    except BrokenPipeError:
        # The reader of our output has gone (`vian tail | head`): leave quietly.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except KeyboardInterrupt:
        _tell("interrupted; what was stored stays, and the same command goes on where it stopped")
        sys.exit(INTERRUPTED)


def _tell(text: str) -> None:
    Console(stderr=True, soft_wrap=True, highlight=False).print(f"[bold red]error:[/] {_literal(text)}")


def _literal(text: str) -> str:
    """The text with Rich's markup taken literally."""
    return text.replace("[", r"\[")
