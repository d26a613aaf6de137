"""`vian station`: which stations may speak to this central server, and which central this station belongs to."""

from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from events import station_name
from store import make_key
from store.epochs import begin_epoch
from sync.central.access import EVERY_STATION, FIND, OPERATIONS, REPLICATE
from sync.protocol.enrolment import parse_code
from vian import options
from vian.admission import invited, registry_for
from vian.clock import utc_now
from vian.enrolling import enrol_at
from vian.epochs import compare, settle_epoch
from vian.errors import WrongUsage
from vian.membership import check_address, load_membership, membership_path, save_membership
from vian.options import bare_database, opened, settings_for
from vian.output import Output, counted
from vian.peers import peer_of
from vian.signatures import key_path
from vian.stations import add_station, read_grants, remove_station
from vian.tls import fetched_certificate

app = typer.Typer(
    help="Stations that may speak to this central server; this station's enrolment.", no_args_is_help=True
)

Name = Annotated[str, typer.Argument(help="Name of the station.")]
StationsFile = Annotated[
    Path | None, typer.Option("--stations-file", help="The central server's list of stations with tokens.")
]


@app.command(epilog="Example: vian station invite brno-2 --operations replicate,find --reads brno-2,brno-3")
def invite(
    name: Name,
    operations: Annotated[
        str, typer.Option("--operations", help="What it may do: replicate, find, query; by commas.")
    ] = f"{REPLICATE},{FIND}",
    reads: Annotated[
        str | None,
        typer.Option(
            "--reads", help="Stations whose events it may find and query, by commas; * for all.", show_default="its own"
        ),
    ] = None,
    hours: Annotated[
        float | None, typer.Option("--hours", help="How long the code can be used.", show_default="24")
    ] = None,
    central_station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """On central: make a one-time code by which a station is taken in; the code is shown once."""
    settings = settings_for(data_dir, dsn, station=central_station, invite_hours=hours)
    station, granted = station_name(name), _operations(operations)
    readable = _reads(name if reads is None else reads)
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        make_key(key_path(settings))
        code, expires_at = invited(registry_for(log, settings), settings, station, granted, readable)
    Output(is_json=as_json).result(
        {
            "station": station,
            "code": code,
            "expires_at": expires_at.isoformat(),
            "operations": granted,
            "reads": readable,
        },
        f"station {station} may enrol until {expires_at:%Y-%m-%d %H:%M} UTC. On the station:\n"
        f"vian station enrol {code} --station {station} --central https://CENTRAL:{settings.port}",
    )


@app.command(name="list", epilog="Example: vian station list --json")
def list_stations(
    stations_file: StationsFile = None,
    central_station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """On central: show which stations may speak, what each may do, who was shut out, and which codes are open."""
    settings = settings_for(data_dir, dsn, station=central_station, stations_file=stations_file)
    with opened(settings, data_dir=data_dir) as log:
        registry = registry_for(log, settings)
        rows: list[tuple[Any, ...]] = [
            (
                each.name,
                "enrolled" if each.revoked_at is None else "revoked",
                _time(each.revoked_at or each.enrolled_at),
                ", ".join(each.operations),
                ", ".join(each.reads),
                each.key_id,
            )
            for each in registry.stations()
        ]
        rows += [
            (each.station, "invited", _time(each.expires_at), ", ".join(each.operations), ", ".join(each.reads), None)
            for each in registry.invitations()
        ]
    if settings.stations_file is not None:
        names = read_grants(settings.stations_file).stations()
        rows += [(name, "has a token", None, REPLICATE, None, None) for name in names]
    Output(is_json=as_json).table("", ("station", "state", "since_or_until", "may", "reads", "key_id"), rows)


@app.command(epilog="Example: vian station revoke brno-2 --reason stolen")
def revoke(
    name: Name,
    reason: Annotated[str | None, typer.Option("--reason", help="Why; it is recorded.")] = None,
    stations_file: StationsFile = None,
    central_station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """On central: shut a station out at once; when this ends, nothing more of it is stored. What it sent stays."""
    settings = settings_for(data_dir, dsn, station=central_station, stations_file=stations_file)
    station = station_name(name)
    had_token = settings.stations_file is not None and remove_station(settings.stations_file, station)
    with opened(settings, data_dir=data_dir) as log:
        registry = registry_for(log, settings)
        codes = registry.withdraw(station)
        found = registry.station(station)
        if (found is not None and found.revoked_at is None) or not (had_token or codes):
            registry.revoke(station, reason)
    Output(is_json=as_json).result(
        {"station": station, "revoked": True, "had_token": had_token, "codes_ended": codes},
        f"station {station} is shut out. It is let in again by vian station invite {station}",
    )


@app.command(epilog="Example: vian station enrol CODE --central https://central.example:8470")
def enrol(
    code: Annotated[str, typer.Argument(help="The one-time code that vian station invite showed on central.")],
    central: Annotated[str | None, typer.Option("--central", help="Address of the central server.")] = None,
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """On a station: join a central server by its one-time code; vian sync and vian serve then use it.

    An empty log of a station of which central holds events begins a new epoch.
    """
    settings = settings_for(data_dir, dsn, station=station, central=central, key_file=key_file)
    if settings.central is None:
        raise WrongUsage("which central? Next: give --central https://CENTRAL:8470")
    parsed, url = parse_code(code), check_address(settings.central)
    pinned = None
    if parsed.pin is not None and url.scheme == "https":
        pinned = fetched_certificate(url.host, url.port or 443, parsed.pin)
    taken_in = enrol_at(url, pinned, parsed.secret, station_name(settings.station), make_key(key_path(settings)))
    joined = taken_in.membership
    path = save_membership(settings, joined)
    epoch, said = settle_epoch(
        partial(bare_database, settings, data_dir=data_dir), station_name(settings.station), taken_in.epoch
    )
    Output(is_json=as_json).result(
        {
            "station": joined.station,
            "central": joined.central,
            "address": joined.address,
            "operations": list(joined.operations),
            "reads": list(joined.reads),
            "file": str(path),
            "epoch": epoch,
        },
        f"station {joined.station} belongs to central {joined.central} at {joined.address}. {said}"
        f"Next: vian sync --station {joined.station}",
    )


@app.command(epilog="Example: vian station new-epoch")
def new_epoch(
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """On a station: go on in a new epoch, where central holds events that this log never had; both histories stay."""
    settings = settings_for(data_dir, dsn, station=station, key_file=key_file)
    name = station_name(settings.station)
    peer = peer_of(settings)
    if peer is None:
        raise WrongUsage(
            "this station belongs to no central. Next: vian station enrol CODE --central https://CENTRAL:8470"
        )
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        before = log.epoch
        answer, found = compare(log, name, peer, utc_now())
    if all(each.is_past for each in found):
        raise WrongUsage(
            f"what central holds of {name} is of this log, which is in epoch {before}: it needs no new epoch. "
            "Next: vian sync doctor"
        )
    epoch = 1 + max(before, *(cursor.epoch for cursor in answer.cursors))
    with bare_database(settings, data_dir=data_dir) as (address, _):
        begin_epoch(address, epoch)
    Output(is_json=as_json).result(
        {"station": name, "epoch": epoch, "before": before, "streams": [str(each.stream) for each in found]},
        f"station {name} goes on in epoch {epoch}; nothing of epoch {before} is lost here or at central. Where the two "
        f"differ, {counted(len(found), 'stream')}, each keeps its own. "
        f"Next: vian sync doctor, then vian serve or vian sync --station {name}",
    )


@app.command(epilog="Example: vian station leave")
def leave(
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    as_json: options.Json = False,
) -> None:
    """On a station: forget the central server; the log stays, and central keeps what it has."""
    settings = settings_for(data_dir, station=station, key_file=key_file)
    joined = load_membership(settings)
    if joined is None:
        raise WrongUsage(f"this station belongs to no central: there is no {membership_path(settings)}")
    membership_path(settings).unlink()
    Output(is_json=as_json).result(
        {"station": joined.station, "central": joined.central, "left": True},
        f"station {joined.station} has left central {joined.central}. "
        f"Next, on central: vian station revoke {joined.station}",
    )


@app.command(epilog="Example: vian station add brno-2 --stations-file stations.toml --token-file brno-2.token")
def add(
    name: Name,
    stations_file: StationsFile = None,
    token_file: Annotated[
        Path | None, typer.Option("--token-file", help="Write the token here, readable to you alone; carry it over.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """On central: let a station of the release before replicate by a token; newer ones are invited."""
    path = settings_for(stations_file=stations_file).stations_file
    if path is None:
        raise WrongUsage("which list of stations? Next: give --stations-file FILE, or set stations_file in vian.toml")
    token = add_station(path, name, token_file)
    output = Output(is_json=as_json)
    output.note(f"a token is for protocol 1 alone; for signed requests and questions: vian station invite {name}")
    if token_file is not None:
        output.result({"station": name, "token_file": str(token_file)}, f"station {name}: token in {token_file}")
    else:
        output.result({"station": name, "token": token}, f"station {name}: token {token} (shown once)")


def _operations(text: str) -> list[str]:
    wanted = [each.strip() for each in text.split(",") if each.strip()]
    unknown = [each for each in wanted if each not in OPERATIONS]
    if unknown or not wanted:
        raise WrongUsage(f"--operations takes {', '.join(OPERATIONS)}; got {', '.join(unknown) or 'none'}")
    return [each for each in OPERATIONS if each in wanted]


def _reads(text: str) -> list[str]:
    wanted = [each.strip() for each in text.split(",") if each.strip()]
    if not wanted:
        raise WrongUsage("--reads takes names of stations by commas, or * for all; got none. Without it: its own")
    return [each if each == EVERY_STATION else station_name(each) for each in dict.fromkeys(wanted)]


def _time(time: datetime | None) -> str | None:
    return None if time is None else f"{time:%Y-%m-%d %H:%M}"
