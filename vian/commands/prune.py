"""`vian prune`: take payloads off this station's disk that central holds, as its signature proves."""

from typing import Annotated

import typer

from store.payloads import log_bytes
from sync.keeping.pruning import Span
from vian import options
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.pruning import pruner_for

_MIB = 2**20


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian prune --after-days 30 --dry-run")(prune)


def prune(
    after_days: Annotated[
        float | None,
        typer.Option(
            "--after-days",
            min=0,
            help="Only what was recorded so many days ago or earlier.",
            show_default="setting prune_after_days",
        ),
    ] = None,
    is_dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would go, and take nothing off.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Take payloads off the disk that central countersigned; headers, hashes and order stay, and verify."""
    settings = settings_for(data_dir, dsn, station=station, prune_after_days=after_days)
    if settings.prune_after_days is None:
        raise WrongUsage("how old must it be? Next: give --after-days DAYS, or the setting prune_after_days")
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        now = utc_now()
        pruner = pruner_for(log, settings, settings.prune_after_days)
        spans = pruner.outlook(now)
        before = log_bytes(log)
        if not is_dry_run:
            while pruner.step(now):
                pass
        after = log_bytes(log)
    output.table(
        "",
        ("stream", "epoch", "from", "to", "segments", "mib"),
        [
            (str(s.stream), s.epoch, s.first_sequence, s.last_sequence, s.segments, round(s.payload_bytes / _MIB, 3))
            for s in spans
        ],
    )
    if not spans:
        output.note("nothing may go: central countersigned nothing that old. Next: vian sync status")
    elif is_dry_run:
        output.note(f"{_told(spans)} would go")
    else:
        output.note(
            f"{_told(spans)} went; the log's tables take {after / _MIB:.1f} MiB, before {before / _MIB:.1f} MiB"
        )


def _told(spans: list[Span]) -> str:
    segments, size = sum(each.segments for each in spans), sum(each.payload_bytes for each in spans)
    return f"payloads of {segments} segments, {size / _MIB:.1f} MiB,"
