"""`vian station`: which stations may replicate to this central server."""

from pathlib import Path
from typing import Annotated

import typer

from vian.errors import WrongUsage
from vian.options import settings_for
from vian.output import Output
from vian.stations import add_station

app = typer.Typer(help="Stations that may replicate to this central server.", no_args_is_help=True)


@app.command(epilog="Example: vian station add brno-2 --stations-file stations.toml --token-file brno-2.token")
def add(
    name: Annotated[str, typer.Argument(help="Name of the station.")],
    stations_file: Annotated[
        Path | None, typer.Option("--stations-file", help="The central server's list of stations.")
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option("--token-file", help="Write the token here, readable to you alone; carry it over.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line, for machines.")] = False,
) -> None:
    """Let a station replicate here: make its token, and note the token's hash."""
    path = settings_for(stations_file=stations_file).stations_file
    if path is None:
        raise WrongUsage("which list of stations? Next: give --stations-file FILE, or set stations_file in vian.toml")
    token = add_station(path, name, token_file)
    output = Output(is_json=as_json)
    if token_file is not None:
        output.result({"station": name, "token_file": str(token_file)}, f"station {name}: token in {token_file}")
    else:
        output.result({"station": name, "token": token}, f"station {name}: token {token} (shown once)")
