"""`vian sync`: replicate this station's chosen streams to a central log."""

from pathlib import Path
from typing import Annotated

import typer

from sync.daemon import Daemon
from vian import options
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.parts import Parts
from vian.replication import load_plan, station_daemon, sync_part
from vian.stations import read_token


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian sync --central http://central.example:8470 --token-file brno-2.token --once")(
        sync
    )


def sync(
    central: Annotated[str | None, typer.Option("--central", help="Address of the central server.")] = None,
    token_file: Annotated[Path | None, typer.Option("--token-file", help="File with this station's token.")] = None,
    plan: Annotated[
        Path | None,
        typer.Option("--plan", help="YAML file: which streams, in which order.", show_default="all, situations first"),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="End when central has everything.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Send this station's chosen streams to central, segment by segment, until Ctrl-C."""
    settings = settings_for(data_dir, dsn, station=station, central=central, token_file=token_file, plan=plan)
    if settings.central is None or settings.token_file is None:
        raise WrongUsage("where to, and as whom? Next: give --central URL and --token-file FILE")
    output = Output(is_json=as_json)
    token = read_token(settings.token_file)
    chosen = load_plan(settings.plan)
    with (
        opened(settings, data_dir=data_dir, is_made=not once) as log,
        station_daemon(log, settings.station, settings.central, token, chosen) as daemon,
    ):
        if once:
            daemon.catch_up()
        else:
            output.note(f"station {settings.station} replicates to {settings.central}; Ctrl-C ends it")
            with Parts([sync_part(daemon)]) as parts:
                while parts.wait(1.0):
                    pass
        report(output, daemon)


def report(output: Output, daemon: Daemon) -> None:
    """Print where each planned stream stands at central."""
    rows = [
        (str(stream.stream), stream.sequence, stream.cursor, stream.backlog, stream.error)
        for stream in daemon.status().streams
    ]
    output.table("", ("stream", "sequence", "at_central", "backlog", "error"), rows)
