"""`vian sync`: replicate this station's chosen streams to a central log."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from sync.daemon import Daemon
from vian import options
from vian.commands import sync_plan, sync_repair
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.parts import Parts
from vian.pruning import disk_part
from vian.replication import plan_at_start, station_daemon, sync_part
from vian.stations import read_token

app = typer.Typer(help="Replicate this station's chosen streams to central, and choose them.")
app.add_typer(sync_plan.app, name="plan")
app.command(epilog="Example: vian sync repair")(sync_repair.repair)


@app.callback(
    invoke_without_command=True,
    epilog="Example: vian sync --central http://central.example:8470 --token-file brno-2.token --once",
)
def sync(
    context: typer.Context,
    central: Annotated[str | None, typer.Option("--central", help="Address of the central server.")] = None,
    token_file: Annotated[Path | None, typer.Option("--token-file", help="File with this station's token.")] = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan", help="YAML or TOML file: which streams, in which order.", show_default="the plan that was set"
        ),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="End when central has everything.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Send this station's chosen streams to central, segment by segment, until Ctrl-C."""
    if context.invoked_subcommand is not None:
        _check_alone(context)
        return
    settings = settings_for(data_dir, dsn, station=station, central=central, token_file=token_file, plan=plan)
    if settings.central is None or settings.token_file is None:
        raise WrongUsage("where to, and as whom? Next: give --central URL and --token-file FILE")
    output = Output(is_json=as_json)
    token = read_token(settings.token_file)
    with ExitStack() as stack:
        log = stack.enter_context(opened(settings, data_dir=data_dir, is_made=not once))
        chosen = plan_at_start(log, settings.station, settings.plan)
        daemon = stack.enter_context(station_daemon(log, settings.station, settings.central, token, chosen))
        if once:
            daemon.catch_up()
        else:
            output.note(f"station {settings.station} replicates to {settings.central}; Ctrl-C ends it")
            with Parts([sync_part(daemon), disk_part(log, settings)]) as parts:
                while parts.wait(1.0):
                    pass
        report(output, daemon)


def _check_alone(context: typer.Context) -> None:
    """Refuse options before the name of a command of this group: they would be lost."""
    if any(value not in (None, False) for value in context.params.values()):
        name = context.invoked_subcommand
        raise WrongUsage(f"options stand behind the command's whole name. Next: vian sync {name} --help")


def report(output: Output, daemon: Daemon) -> None:
    """Print where each planned stream stands at central."""
    rows = [
        (str(stream.stream), stream.sequence, stream.cursor, stream.backlog, stream.error)
        for stream in daemon.status().streams
    ]
    output.table("", ("stream", "sequence", "at_central", "backlog", "error"), rows)
