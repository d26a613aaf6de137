"""`vian project`: the row tables for psql and other SQL tools, and how they stand."""

from datetime import UTC, datetime
from typing import Annotated

import typer

from store import Projector, RowTable, maintain, row_tables
from vian import options
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.rows import row_policy

app = typer.Typer(
    help="Bring the row tables for psql and other SQL tools up to the log.",
    invoke_without_command=True,
    epilog="Example: vian project",
)


@app.callback()
def project(
    context: typer.Context,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Bring the row tables for psql and other SQL tools up to the log."""
    if context.invoked_subcommand is not None:
        if data_dir is not None or dsn is not None or as_json:
            raise WrongUsage(
                f"options stand behind the command's whole name. Next: vian project {context.invoked_subcommand} --help"
            )
        return
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        projector = Projector(log)
        before = projector.position
        with output.progress("positions", log.head()) as bar:
            while not projector.step().is_caught_up:
                bar.at(projector.position)
        projector.close()
    output.result(
        {
            "position": projector.position,
            "segments": projector.position - before,
            "skipped": projector.segments_skipped,
        },
        f"row tables up to position {projector.position}: {projector.position - before} segments now"
        + (f", {projector.segments_skipped} of unknown types without rows" if projector.segments_skipped else ""),
    )


@app.command(epilog="Example: vian project status --json")
def status(data_dir: options.DataDir = None, dsn: options.Dsn = None, as_json: options.Json = False) -> None:
    """Show each row table: how far it is behind the log, its days, its rows (estimated) and bytes on disk."""
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        head, tables = log.head(), row_tables(log)
    columns = ("type", "state", "position", "lag_segments", "lag_s", "partitions", "closed", "first_day", "last_day")
    rows = [
        (
            table.type,
            _state(table),
            table.position,
            table.lag_segments,
            round(table.lag_s, 3),
            table.partitions,
            table.closed,
            str(table.first_day or ""),
            str(table.last_day or ""),
            str(table.retained_from or ""),
            table.rows_estimate,
            table.bytes,
        )
        for table in tables
    ]
    output = Output(is_json=as_json)
    output.table(f"head of the log: {head}", (*columns, "retained_from", "rows_estimate", "bytes"), rows)


@app.command(epilog="Example: vian project rebuild track_ended")
def rebuild(
    type_name: Annotated[str, typer.Argument(metavar="TYPE", help="The event type whose rows are made anew.")],
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Empty a type's row table and fill it from the log again; other types go on meanwhile.

    Interrupted, it goes on where it stopped, by the same command, by vian project or by vian serve. Rows that
    retention would drop are not made.
    """
    settings = settings_for(data_dir, dsn)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        if type_name not in log.catalogue:
            known = ", ".join(sorted(event_type.type_name for event_type in log.catalogue))
            raise WrongUsage(f"no event type {type_name!r}; known: {known}")
        retained_from = row_policy(log, settings).retained_from(type_name, datetime.now(UTC))
        projector = Projector(log)
        is_resumed = type_name in projector.behind
        if not is_resumed:
            projector.rebuild(type_name, retained_from)
        with output.progress("positions", log.head()) as bar:
            while type_name in projector.behind and not projector.step_behind(type_name):
                bar.at(projector.behind.get(type_name, 0))
        projector.close()
        rows = next(table.rows_estimate for table in row_tables(log) if table.type == type_name)
    output.result(
        {"type": type_name, "resumed": is_resumed, "rows_estimate": rows, "skipped": projector.segments_skipped},
        f"row table {type_name}: made anew, about {rows} rows"
        + (f", {projector.segments_skipped} segments without rows" if projector.segments_skipped else ""),
    )


@app.command(name="maintain", epilog="Example: vian project maintain")
def maintain_rows(data_dir: options.DataDir = None, dsn: options.Dsn = None, as_json: options.Json = False) -> None:
    """Drop days beyond their retention, make partitions ahead, index closed days; vian serve does it by itself."""
    settings = settings_for(data_dir, dsn)
    output = Output(is_json=as_json)
    counts = dict.fromkeys(("dropped", "made", "closed", "postponed"), 0)
    with opened(settings, data_dir=data_dir) as log:
        for done in maintain(log, row_policy(log, settings), datetime.now(UTC)):
            counts[done.action] += done.partitions
            output.note(f"{done.type}: {done.action} {_days_of(done.action, done.partitions, str(done.day))}")
    output.result(
        counts,
        f"partitions: {counts['dropped']} dropped, {counts['made']} made ahead, {counts['closed']} closed"
        + (f"; {counts['postponed']} types postponed while queries read them" if counts["postponed"] else ""),
    )


def _state(table: RowTable) -> str:
    if table.is_behind:
        return "being built"
    return "complete" if table.lag_segments == 0 else "behind"


def _days_of(action: str, partitions: int, day: str) -> str:
    return f"{partitions} days before {day}" if action in ("dropped", "postponed") else day
