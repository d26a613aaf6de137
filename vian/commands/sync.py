"""`vian sync`: replicate this station's chosen streams to a central log."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from events import station_name
from sync.keeping.gone import gone_in, told_at_station
from sync.plans.planning import planned_in
from sync.station.daemon import Daemon
from sync.station.unreachable import GOES_ON
from vian import options
from vian.commands import sync_doctor, sync_plan, sync_repair, sync_status
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.parts import Parts
from vian.peers import peer_of
from vian.pruning import disk_part
from vian.replication import pace_of, plan_at_start, station_daemon, sync_part
from vian.tls import AGAIN

app = typer.Typer(help="Replicate this station's chosen streams to central, and choose them.")
app.add_typer(sync_plan.app, name="plan")
sync_status.register(app)
sync_doctor.register(app)
app.command(epilog="Example: vian sync repair")(sync_repair.repair)


@app.callback(
    invoke_without_command=True,
    epilog="Example: vian sync --station brno-2 --once",
)
def sync(
    context: typer.Context,
    central: Annotated[
        str | None,
        typer.Option("--central", help="Address of the central server, if not where it took this station in."),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            "--token-file",
            help="Token of a stations file, where this station is not enrolled.",
            callback=options.existing,
        ),
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan",
            help="YAML or TOML file: which streams, in which order.",
            show_default="the plan that was set",
            callback=options.existing,
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
    peer = peer_of(settings)
    if peer is None:
        raise WrongUsage(
            "where to? Next: vian station enrol CODE --central URL, with the code that vian station invite "
            f"{settings.station} shows on central"
        )
    output = Output(is_json=as_json)
    with ExitStack() as stack:
        log = stack.enter_context(opened(settings, data_dir=data_dir, is_made=not once))
        chosen = plan_at_start(log, settings.station, settings.plan)
        daemon = stack.enter_context(
            station_daemon(
                log,
                settings.station,
                peer,
                chosen,
                pace=pace_of(settings),
                afterwards=AGAIN if once else GOES_ON,
            )
        )
        name = station_name(settings.station)
        if once:
            before = gone_in(log, name, name)
            daemon.catch_up()
        else:
            output.note(f"station {settings.station} replicates to {peer.address}; Ctrl-C ends it")
            with Parts([sync_part(daemon), disk_part(log, settings)]) as parts:
                while parts.wait(1.0):
                    pass
        report(output, daemon)
        if once and (planned := planned_in(log, name)) and planned.plan.paused:
            output.note("the plan is paused: nothing was sent. Next: vian sync plan resume")
        if once and (gone := [each for each in gone_in(log, name, name) if each not in before]):
            raise WorldFailed("; ".join(map(told_at_station, gone[:5])))


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
