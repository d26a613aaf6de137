"""`vian sync doctor`: what stands in the way of replication, and the next command."""

import typer

from vian import options
from vian.clock import utc_now
from vian.errors import WorldFailed
from vian.findings import Verdict
from vian.options import opened, settings_for
from vian.output import Output, counted, printable
from vian.sync_doctor import examine


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="doctor", epilog="Example: vian sync doctor --station brno-2")(doctor)


def doctor(
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """At a station: examine the way to central, by asking it; exit code 1 if something stands in the way."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    bad = 0
    with opened(settings, data_dir=data_dir) as log:
        for finding in examine(log, settings, utc_now):
            bad += finding.verdict is Verdict.BAD
            output.result(
                {"check": finding.check, "verdict": finding.verdict, "text": finding.text},
                printable(f"{finding.verdict.value:4}  {finding.check}: {finding.text}"),
            )
    if bad:
        raise WorldFailed(f"{counted(bad, 'check')} came out bad; each says what to do next")
