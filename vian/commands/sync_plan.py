"""`vian sync plan`: which streams this station sends to central; what a change would mean, and the change itself."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer

from events import Station, StreamName, station_name
from store import Log
from sync.plans.awaiting import awaited_by, missing
from sync.plans.checking import check_filters, unmatched, warnings_of
from sync.plans.plan import Plan
from sync.plans.plan_values import rate, time_text
from sync.plans.planning import Planned, planned_in, set_plan
from sync.plans.preview import EntryPreview, Preview, held_by, preview
from sync.protocol.reports import saved_status
from vian import options
from vian.clock import utc_now
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.replication import load_plan
from vian.settings import Settings

app = typer.Typer(help="Choose which streams go to central, from when on, in which order.", no_args_is_help=True)

_SHOWN = 3
"""Streams named in a line."""

PlanFile = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="The plan, YAML; TOML if its name ends in .toml.", callback=options.existing),
]


@app.command(epilog="Example: vian sync plan show")
def show(
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Show the plan that counts: the one that was set last, or the default one while none was."""
    with _at(data_dir, dsn, station) as (_, log, name):
        planned = planned_in(log, name)
    output = Output(is_json=as_json)
    plan = load_plan(None) if planned is None else planned.plan
    if output.is_json:
        output.result(_said(planned, plan))
        return
    output.note("no plan was set yet: this is the default one" if planned is None else f"set at {planned.time}")
    output.table("", ("", "stream", "what", "from", "priority", "order", "rate", "where", "leave out"), _rows(plan))
    for line in _whole(plan):
        output.line(line)


@app.command(name="set", epilog="Example: vian sync plan set plan.yaml")
def set_(
    file: PlanFile,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Set the plan; a daemon that runs takes it up at once, also while a request is on its way."""
    plan = Plan.load(file)
    output = Output(is_json=as_json)
    with _at(data_dir, dsn, station) as (settings, log, name):
        check_filters(plan.resolved(utc_now()), log.catalogue)
        planned = _set(log, settings, name, plan)
        in_vain = unmatched(plan, [head.stream for head in log.streams()], log.catalogue)
        gone = [str(each) for each in missing(log, awaited_by(log, name, planned.plan))]
    for warning in warnings_of(plan):
        output.note(f"warning: {warning}")
    for gap in gone:
        output.note(f"warning: {gap}")
    for note in in_vain:
        output.note(note)
    if settings.plan is not None and settings.plan.resolve() != file.resolve():
        output.note(f"vian sync and vian serve set {settings.plan} at their next start, for the settings name it")
    if planned.plan.paused:
        output.note("the plan is paused: nothing is sent. Next: vian sync plan resume")
    output.result(_said(planned, planned.plan), f"set, as {planned.plan_hash[:16]}")


@app.command(name="preview", epilog="Example: vian sync plan preview plan.yaml --rate '1 Mbit/s'")
def preview_(
    file: PlanFile,
    rate_given: Annotated[
        str | None,
        typer.Option("--rate", help="What the link carries, such as '1 Mbit/s'.", show_default="as it was measured"),
    ] = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Say what a plan would mean, before anything is sent: events, bytes and time of each entry, and what changes.

    It asks nobody: what central holds is what it said last. Nothing is set.
    """
    plan = Plan.load(file)
    with _at(data_dir, dsn, station) as (_, log, name):
        present = planned_in(log, name)
        before = None if present is None else present.plan
        plan = plan.resolved(utc_now(), before)
        check_filters(plan, log.catalogue)
        status = saved_status(log)
        measured = status.rate_bps if status is not None else None
        found = preview(log, name, plan, before, held_by(status, before), _rate_of(rate_given) or measured)
    output = Output(is_json=as_json)
    if output.is_json:
        output.result(_as_data(found))
    else:
        _show(output, found)


def _rate_of(given: str | None) -> float | None:
    try:
        return rate(given)
    except ValueError as error:
        raise WrongUsage(f"--rate {error}, got {given!r}") from error


def _show(output: Output, found: Preview) -> None:
    columns = ("", "stream", "what", "streams", "segments", "events", "bytes", "time")
    output.table("", columns, [_row(each) for each in found.entries])
    for each in found.entries:
        for problem in each.problems:
            output.note(f"entries[{each.number}]: {problem}")
    output.line(f"all: {_about(found.seconds)}; streams that stay at the station: {found.staying}")
    for change in found.changes:
        output.line(f"{_named(change.streams)}{change.what}")
    for warning in found.warnings:
        output.note(f"warning: {warning}")


def _row(each: EntryPreview) -> tuple[object, ...]:
    if not each.entry.sends:
        return each.number, each.entry.stream, "stays", *[None] * 5
    what = f"filtered ~{each.entry.filter_hash}" if each.entry.is_derived else "sent"
    about = "" if each.is_exact else "about "
    numbers = (f"{about}{number}" for number in (each.segments, each.events, each.bytes))
    return each.number, each.entry.stream, what, each.streams, *numbers, _about(each.seconds)


def _about(seconds: float | None) -> str:
    return "unknown: not measured yet" if seconds is None else str(timedelta(seconds=math.ceil(seconds)))


def _named(streams: Sequence[StreamName]) -> str:
    if not streams:
        return ""
    more = f" and {len(streams) - _SHOWN} more" if len(streams) > _SHOWN else ""
    return f"{', '.join(map(str, streams[:_SHOWN]))}{more}: "


def _as_data(found: Preview) -> dict[str, object]:
    entries = [
        {
            "entry": each.number,
            "stream": each.entry.stream,
            "sends": each.entry.sends,
            "filter": each.entry.filter_hash if each.entry.is_derived else None,
            "streams": each.streams,
            "segments": each.segments,
            "events": each.events,
            "bytes": each.bytes,
            "is_exact": each.is_exact,
            "seconds": each.seconds,
            "problems": each.problems,
        }
        for each in found.entries
    ]
    changes = [{"what": change.what, "streams": list(map(str, change.streams))} for change in found.changes]
    return {
        "entries": entries,
        "rate_bps": found.rate_bps,
        "seconds": found.seconds,
        "streams_staying": found.staying,
        "changes": changes,
        "warnings": found.warnings,
    }


@app.command(epilog="Example: vian sync plan pause")
def pause(
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Send nothing until `vian sync plan resume`; the plan stays as it is otherwise."""
    _set_paused(True, data_dir, dsn, station, Output(is_json=as_json))


@app.command(epilog="Example: vian sync plan resume")
def resume(
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Go on sending, from where central stands."""
    _set_paused(False, data_dir, dsn, station, Output(is_json=as_json))


def _set_paused(is_paused: bool, data_dir: Path | None, dsn: str | None, station: str | None, output: Output) -> None:
    with _at(data_dir, dsn, station) as (settings, log, name):
        present = planned_in(log, name)
        plan = load_plan(None) if present is None else present.plan
        planned = _set(log, settings, name, plan.model_copy(update={"paused": is_paused}))
    output.result(_said(planned, planned.plan), "paused" if is_paused else "goes on")


@contextmanager
def _at(data_dir: Path | None, dsn: str | None, station: str | None) -> Iterator[tuple[Settings, Log, Station]]:
    """Settings, log and name of this station, for the length of the block.

    Raises:
        WorldFailed: The log is another station's.
    """
    settings = settings_for(data_dir, dsn, station=station)
    name = station_name(settings.station)
    with opened(settings, data_dir=data_dir) as log:
        stations = sorted({head.stream.station for head in log.streams()})
        if stations and name not in stations:
            raise WorldFailed(
                f"this log has no streams of station {name}, but of {', '.join(stations[:5])}. "
                f"Next: give --station {stations[0]}"
            )
        yield settings, log, name


def _set(log: Log, settings: Settings, station: Station, plan: Plan) -> Planned:
    present = planned_in(log, station)
    central = settings.central or (present.central if present else "")
    return set_plan(log, station, plan, central.rstrip("/"), utc_now())


def _said(planned: Planned | None, plan: Plan) -> dict[str, object]:
    data: dict[str, object] = plan.said()
    if planned is not None:
        data |= {"set_at": planned.time, "central": planned.central, "plan_hash": planned.plan_hash}
    return data


def _rows(plan: Plan) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for number, entry in enumerate(plan.entries):
        if not entry.sends:
            rows.append((number, entry.stream, "stays", *[None] * 6))
            continue
        begin = entry.begin if isinstance(entry.begin, str) else time_text(entry.begin)
        since = f"{begin} ({time_text(entry.now)})" if entry.now else begin
        what = f"filtered ~{entry.filter_hash}" if entry.is_derived and (entry.begin != "now" or entry.now) else "sent"
        rate = None if entry.rate_bps is None else f"{entry.rate_bps} bit/s"
        left_out = ", ".join(entry.leave_out)
        rows.append((number, entry.stream, what, since, entry.priority, entry.order, rate, entry.where, left_out))
    return rows


def _whole(plan: Plan) -> Iterator[str]:
    """What the plan says of all its entries together."""
    if plan.paused:
        yield "paused: nothing is sent. Next: vian sync plan resume"
    yield "rate: " + ("no limit" if plan.rate_bps is None else f"{plan.rate_bps} bit/s")
    yield f"backlog gets at least {plan.backlog_share:.0%} while live traffic goes on"
    for entry in plan.give_up:
        yield f"when the disk is full: {entry.stream} older than {entry.older_than}"
    if not plan.give_up:
        yield "when the disk is full: recording stops, nothing may be given up"
