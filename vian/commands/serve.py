"""`vian serve`: the long-running program of a station or of the central server.

Told to stop (SIGINT, SIGTERM) it did what it was told and ends with 0, as service managers expect; the
other commands, which are interrupted before their end, end with 130.
"""

from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from time import monotonic
from typing import Annotated

import structlog
import typer
from fastapi import FastAPI

from events import station_name
from patterns.engine.compiling import compiling_beside
from store import Log, Projector
from sync.central.access import Access
from sync.central.refusals import Refusals
from sync.central.router import Limits
from sync.protocol.grants import Grantor
from vian import logs, options
from vian.admission import access_for, certificate_of, refusals_for, refusals_part
from vian.api import bind, create_app, serving
from vian.clock import utc_now
from vian.interrupts import stop_on_signals
from vian.metrics import Metrics, Watched
from vian.options import opened, settings_for
from vian.output import Output
from vian.parts import Part, Parts, stepping
from vian.peers import peer_of
from vian.precedence import Precedence
from vian.pruning import disk_part
from vian.questions import answering_for
from vian.replication import pace_of, plan_at_start, station_daemon, sync_part
from vian.rows import upkeep_part
from vian.rules import limits_of
from vian.settings import Settings
from vian.signatures import has_key, signing_part
from vian.staging import stages_beside_that_run, stages_part
from vian.stations import StationsFile
from vian.watching import check_there, processor_part

logger = structlog.get_logger()

STEP_SECONDS = 1.0


class Role(StrEnum):
    """What a server is for."""

    STATION = "station"
    CENTRAL = "central"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian serve --role central --tls generate --host 0.0.0.0")(serve)


def serve(
    role: Annotated[Role, typer.Option("--role", help="station: rules and sync; central: takes stations' streams.")],
    host: Annotated[str | None, typer.Option("--host", help="Address to listen on.", show_default="127.0.0.1")] = None,
    port: Annotated[
        int | None, typer.Option("--port", help="Port to listen on; 0 takes a free one.", show_default="8470")
    ] = None,
    rules: Annotated[
        Path | None,
        typer.Option("--rules", help="Folder or file of rules to deploy; also when one changes."),
    ] = None,
    stations_file: Annotated[
        Path | None, typer.Option("--stations-file", help="Central: the stations that may replicate.")
    ] = None,
    central: Annotated[str | None, typer.Option("--central", help="Station: address of the central server.")] = None,
    token_file: Annotated[Path | None, typer.Option("--token-file", help="Station: its token.")] = None,
    plan: Annotated[Path | None, typer.Option("--plan", help="Station: which streams, in which order.")] = None,
    tls: Annotated[
        str | None,
        typer.Option("--tls", help="Central: generate makes a certificate that stations pin.", show_default="off"),
    ] = None,
    tls_certificate: Annotated[
        Path | None, typer.Option("--tls-certificate", help="Central: an operator's certificate and chain, PEM.")
    ] = None,
    tls_key: Annotated[
        Path | None, typer.Option("--tls-key", help="Central: the certificate's key, PEM, without a password.")
    ] = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: Annotated[bool, typer.Option("--json", help="Logs as one JSON object a line.")] = False,
) -> None:
    """Run the HTTP interface, row projector and upkeep, rules and sync in one program, until told to stop: then 0."""
    given = {"host": host, "port": port, "rules": rules, "stations_file": stations_file, "central": central}
    given |= {"tls": tls, "tls_certificate": tls_certificate, "tls_key": tls_key}
    settings = settings_for(data_dir, dsn, station=station, token_file=token_file, plan=plan, **given)
    logs.configure(as_json=as_json)
    grants = StationsFile(settings.stations_file) if role is Role.CENTRAL and settings.stations_file else None
    certificate = certificate_of(settings)
    listening = bind(settings.host, settings.port)
    with ExitStack() as stack:
        stack.callback(listening.close)
        log = stack.enter_context(opened(settings, data_dir=data_dir, is_made=True))
        door = _door(log, settings) if role is Role.CENTRAL else None
        precedence = Precedence(settings.rows_wait_s)
        parts = stack.enter_context(Parts(_parts(stack, log, settings, role, door, precedence)))
        stopping = stop_on_signals()
        app = (
            create_app(log, metrics=_metrics(log, settings, None))
            if door is None
            else _central_app(log, settings, grants, door, precedence)
        )
        address = stack.enter_context(serving(app, listening, certificate))
        Output(is_json=as_json).result(
            {"role": role, "address": address, "station": settings.station}, f"vian {role} at {address}"
        )
        while not stopping.wait(0.2) and parts.wait(0.2):
            pass


@dataclass(frozen=True, slots=True)
class _Door:
    """Who may speak to this central server, and who was turned away."""

    access: Access
    refusals: Refusals


def _door(log: Log, settings: Settings) -> _Door:
    door = _Door(access_for(log, settings), refusals_for(log, settings))
    if settings.stations_file is None and not door.access.registry.stations():
        logger.info("no station is enrolled yet", next="vian station invite NAME")
    return door


def _metrics(log: Log, settings: Settings, door: _Door | None) -> Metrics:
    registry, refused = (None, dict) if door is None else (door.access.registry, door.refusals.counts)
    watched = Watched(log, station_name(settings.station), registry, refused)
    return Metrics(watched, utc_now, monotonic, is_public=settings.metrics_public)


def _central_app(log: Log, settings: Settings, grants: Grantor | None, door: _Door, precedence: Precedence) -> FastAPI:
    return create_app(
        log,
        grants,
        limits=Limits(bits_per_s_max=settings.station_rate_kbps and 1000 * settings.station_rate_kbps),
        access=door.access,
        answers=answering_for(log, settings, door.access),
        note=door.refusals.note,
        while_storing=precedence.urgent,
        metrics=_metrics(log, settings, door),
    )


def _parts(
    stack: ExitStack, log: Log, settings: Settings, role: Role, door: _Door | None, precedence: Precedence
) -> list[Part]:
    projector = Projector(log)
    parts = [
        stepping("projector", precedence.yielding(lambda: projector.step(STEP_SECONDS)), log, projector.close),
        upkeep_part(log, settings),
    ]
    if role is Role.STATION:
        parts.append(disk_part(log, settings))
    if door is not None:
        parts.append(refusals_part(log, door.refusals))
    if has_key(settings):
        parts.append(signing_part(log, settings))
    if settings.rules is not None or role is Role.STATION:
        stack.enter_context(compiling_beside())  # until it is done, rules run on the general matcher
        limits = limits_of(settings)
        check_there(settings.rules)
        stages = [] if settings.rules is None else stages_beside_that_run(log, settings.station, settings.rules)
        if stages:
            parts.append(stages_part(log, settings.station, stages))
        parts.append(processor_part(log, settings.station, settings.rules, limits, settings.rules_look_s))
    peer = peer_of(settings) if role is Role.STATION else None
    if peer is not None:
        plan = plan_at_start(log, settings.station, settings.plan)
        daemon = stack.enter_context(station_daemon(log, settings.station, peer, plan, pace=pace_of(settings)))
        parts.append(sync_part(daemon))
    return parts
