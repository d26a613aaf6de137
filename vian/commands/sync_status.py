"""`vian sync status`: where a station stands with central, or all stations with this central server."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Event as Pause
from typing import Annotated, Any

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from events import station_name
from store import Log
from sync.central.registry import Registry
from sync.keeping.gone import told_at_central
from vian import options
from vian.central_view import CentralView, StationRow, central_view, is_central
from vian.clock import utc_now
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output, laid_out, printable, to_json
from vian.replication import load_plan
from vian.settings import Settings
from vian.spans import size_text, span
from vian.sync_view import StationView, StreamView, station_view

_WATCH_SECONDS = 2.0
_LATE_S = 3600.0


@dataclass(frozen=True, slots=True)
class _Shown:
    """A picture of how replication stands."""

    lines: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    after: tuple[str, ...]
    data: tuple[dict[str, Any], ...]
    late: tuple[str, ...]
    """what is late, each in a few words"""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="status", epilog="Example: vian sync status --check --late-s 900")(status)


def status(
    station: Annotated[
        str | None,
        typer.Option("--station", help="At a station: its name. On central: show this station, stream by stream."),
    ] = None,
    is_watched: Annotated[bool, typer.Option("--watch", help="Show it anew every 2 seconds, until Ctrl-C.")] = False,
    is_checked: Annotated[
        bool, typer.Option("--check", help="End with 1 if something is stopped, or later than --late-s.")
    ] = False,
    late_s: Annotated[
        float, typer.Option("--late-s", min=0, help="Lag, or age of the last contact, that is too much, in seconds.")
    ] = _LATE_S,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Show where replication stands: at a station what waits and for how long, on central every station."""
    if is_watched and is_checked:
        raise WrongUsage("--watch goes on until Ctrl-C, --check ends at once: give one of them")
    settings = settings_for(data_dir, dsn)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        look = _looks(log, settings, station, late_s)
        if is_watched:
            _watch(look, output)
            return
        shown = look()
        _print(shown, output)
    if is_checked and shown.late:
        raise WorldFailed(f"late: {'; '.join(shown.late[:5])}. Next: vian sync doctor")


def _looks(log: Log, settings: Settings, wanted: str | None, late_s: float) -> Callable[[], _Shown]:
    """What looks at the log again and again."""
    registry = Registry(log, station_name(settings.station), utc_now)
    if is_central(log, registry):
        name = None if wanted is None else station_name(wanted)
        return lambda: _central(central_view(log, registry, utc_now()), name, late_s)
    own = station_name(settings.station if wanted is None else wanted)
    stations = sorted({head.stream.station for head in log.streams()})
    if stations and own not in stations:
        raise WorldFailed(
            f"this log has no streams of station {own}, but of {', '.join(stations[:5])}. "
            f"Next: give --station {stations[0]}"
        )
    default = load_plan(settings.plan)
    return lambda: _station(station_view(log, own, utc_now(), default), late_s)


def _print(shown: _Shown, output: Output) -> None:
    if output.is_json:
        for each in shown.data:
            output.line(to_json(each))
        return
    for line in shown.lines:
        output.line(printable(line))
    if shown.rows:
        output.table("", shown.columns, shown.rows)
    for line in shown.after:
        output.line(printable(line))


def _watch(look: Callable[[], _Shown], output: Output) -> None:
    """Show it again and again; Ctrl-C ends it well."""
    pause = Pause()
    try:
        if output.is_json:
            while True:
                _print(look(), output)
                pause.wait(_WATCH_SECONDS)
        with Live(_drawn(look()), console=output.out, auto_refresh=False, screen=output.out.is_terminal) as live:
            while True:
                pause.wait(_WATCH_SECONDS)
                live.update(_drawn(look()), refresh=True)
    except KeyboardInterrupt:
        return


def _drawn(shown: _Shown) -> RenderableType:
    lines = [Text(printable(line)) for line in shown.lines]
    after = [Text(printable(line)) for line in shown.after]
    return Group(*lines, laid_out("", shown.columns, shown.rows), *after)


def _station(view: StationView, late_s: float) -> _Shown:
    columns = ("stream", "priority", "here", "at_central", "waiting", "bytes", "lag", "done_in", "state")
    rows = tuple(
        (
            str(each.stream) if each.epoch == 1 else f"{each.stream} (epoch {each.epoch})",
            each.priority,
            each.sequence,
            each.at_central,
            each.events,
            size_text(each.bytes) if each.is_exact else f"about {size_text(each.bytes)}",
            span(each.lag_s) if each.events else "",
            "" if not each.events else "unknown" if each.eta_s is None else span(each.eta_s),
            _stream_state(each),
        )
        for each in view.streams
    )
    stopped = [f"stopped: {each.stream}: {each.why_stopped}" for each in view.streams if each.why_stopped]
    notes = [f"note: {note}" for note in view.notes]
    return _Shown(
        tuple(_station_lines(view)), columns, rows, (*stopped, *notes), tuple(_station_data(view)),
        tuple(_station_late(view, late_s)),
    )  # fmt: skip


def _stream_state(stream: StreamView) -> str:
    if stream.why_stopped:
        return "stopped"
    return "stays here" if stream.is_apart else "behind" if stream.events else "caught up"


def _station_lines(view: StationView) -> Iterator[str]:
    yield f"station {view.station} to central at {view.central or '(none yet)'}: {_state(view)}"
    if view.last_contact_at is None:
        yield "last contact: never"
    else:
        offset = view.clock_offset_s
        clock = "" if offset is None else f"; central's clock {_offset(offset)}"
        yield f"last contact: {span(view.last_contact_age_s or 0.0)} ago ({_time(view.last_contact_at)}){clock}"
    if view.last_error and view.failures:  # where streams are stopped, lines of their own say why
        yield f"last error, {view.failures} in a row: {view.last_error}"
    rate = "not measured yet" if view.rate_bps is None else f"{view.rate_bps / 1000:.0f} kbit/s"
    done = "unknown" if view.eta_s is None else span(view.eta_s)
    yield f"waiting: {view.events} events, {size_text(view.bytes)}; done in: {done}; rate: {rate}"
    signed = f"{view.signed} signed here, newest that central countersigned: {view.countersigned or 'none'}"
    yield f"checkpoints: {signed}" if view.signed else "checkpoints: none signed here. Next, if it shall be: vian sign"
    if view.days_left is not None:
        yield f"disk: full in {view.days_left:.0f} days at the present rate"
    else:
        yield "disk: days left cannot be told yet"
    if view.other_daemons:
        yield (
            f"{view.other_daemons} other daemon runs for this station too, which does no harm and is of no use. "
            "Next: stop all vian sync and vian serve of it but one"
        )


def _state(view: StationView) -> str:
    said = "" if view.said_age_s is None else f", as its daemon said {span(view.said_age_s)} ago"
    if view.state == "no daemon yet":
        return "no daemon ran yet. Next: vian sync"
    if view.state == "silent":
        return f"its daemon is silent{said}. Next: start vian sync or vian serve"
    paused = " (the plan is paused. Next: vian sync plan resume)" if view.is_paused else ""
    count = sum(each.why_stopped is not None for each in view.streams)
    if count and view.state == "caught_up":
        return f"stopped in {count} of {len(view.streams)} streams, the others caught up{said}{paused}"
    return f"{view.state.replace('_', ' ')}{said}{paused}"


def _station_data(view: StationView) -> Iterator[dict[str, Any]]:
    whole = {
        name: getattr(view, name)
        for name in StationView.__dataclass_fields__
        if name not in ("streams", "station", "notes")
    }
    totals = {"events": view.events, "bytes": view.bytes, "lag_s": view.lag_s, "eta_s": view.eta_s}
    yield {"kind": "station", "station": view.station, **whole, **totals, "notes": list(view.notes)}
    for each in view.streams:
        yield {"kind": "stream"} | {name: getattr(each, name) for name in type(each).__dataclass_fields__}


def _station_late(view: StationView, late_s: float) -> Iterator[str]:
    if view.last_contact_age_s is None:
        yield "central was never reached"
    elif view.last_contact_age_s > late_s:
        yield f"last contact with central {span(view.last_contact_age_s)} ago"
    for each in view.streams:
        if each.why_stopped:
            yield f"{each.stream} is stopped"
        elif each.lag_s > late_s:
            yield f"{each.stream} lags {span(each.lag_s)}"


def _central(view: CentralView, wanted: str | None, late_s: float) -> _Shown:
    if wanted is not None:
        found = next((each for each in view.stations if each.station == wanted), None)
        if found is None:
            known = ", ".join(str(each.station) for each in view.stations) or "none"
            raise WorldFailed(
                f"central knows no station {wanted}; known: {known}. Next: vian sync status without --station for all"
            )
        return _one(found, late_s)
    columns = ("station", "state", "last_contact", "streams", "behind", "in_gaps", "lag", "refused_today")
    rows = tuple(
        (
            each.station,
            each.state,
            "never" if each.last_contact_age_s is None else f"{span(each.last_contact_age_s)} ago",
            len(each.streams),
            each.behind,
            each.missing,
            span(each.lag_s) if each.behind else "",
            _refused(each),
        )
        for each in view.stations
    )
    line = f"central {view.central}: {view.position} segments, {view.invitations} open codes"
    after = tuple(told_at_central(gone) for each in view.stations for gone in each.gone)
    after = after if rows else ("no station is known. Next: vian station invite NAME",)
    data = ({"kind": "central", "central": view.central, "position": view.position, "invitations": view.invitations},)
    data += tuple(map(_row_data, view.stations))
    late = tuple(text for each in view.stations for text in _row_late(each, late_s))
    return _Shown((line,), columns, rows, after, data, late)


def _one(row: StationRow, late_s: float) -> _Shown:
    """One station, stream by stream."""
    columns = ("stream", "at_station", "here", "behind", "gaps", "in_gaps", "lag")
    rows = tuple(
        (
            str(each.stream) if each.epoch == 1 else f"{each.stream} (epoch {each.epoch})",
            each.at_station,
            each.sequence,
            each.behind,
            each.gaps,
            each.missing,
            span(each.lag_s) if each.behind else "",
        )
        for each in row.streams
    )
    contact = "never" if row.last_contact_at is None else f"{span(row.last_contact_age_s or 0.0)} ago"
    at = "" if row.last_contact_at is None else f" ({_time(row.last_contact_at)})"
    lines = [f"station {row.station}: {row.state}", f"last contact: {contact}{at}"]
    if row.clock_offset_s is not None:
        lines.append(f"central's clock {_offset(row.clock_offset_s)}; {row.program}, protocol {row.protocol}")
    if row.refusals:
        lines.append(f"refused over the last day: {_refused(row)}")
    data = (
        _row_data(row),
        *({"kind": "stream"} | {name: getattr(s, name) for name in type(s).__dataclass_fields__} for s in row.streams),
    )
    after = (*_unnamed(row), *map(told_at_central, row.gone))
    return _Shown(tuple(lines), columns, rows, after, data, tuple(_row_late(row, late_s)))


def _unnamed(row: StationRow) -> Iterator[str]:
    """Why nothing is shown of a stream at its station."""
    if any(each.at_station is None for each in row.streams):
        yield (
            "at_station is empty where the station's newest hello names no such stream: it is younger than that hello "
            "(an idle station says the next after `sync_hello_s`), or the station sends it no more"
        )


def _row_data(row: StationRow) -> dict[str, Any]:
    names = [name for name in StationRow.__dataclass_fields__ if name not in ("streams", "refusals", "gone")]
    totals = {"streams": len(row.streams), "behind": row.behind, "missing": row.missing, "lag_s": row.lag_s}
    return (
        {"kind": "station"}
        | {name: getattr(row, name) for name in names}
        | totals
        | {"refusals": dict(row.refusals), "gone": list(map(str, row.gone))}
    )


def _row_late(row: StationRow, late_s: float) -> Iterator[str]:
    if row.gone:
        yield f"payloads of {row.station} are gone here and there"
    if row.state not in ("enrolled", "has a token"):
        return
    if row.last_contact_age_s is None:
        yield f"{row.station} was never heard of"
    elif row.last_contact_age_s > late_s:
        yield f"{row.station} was heard of {span(row.last_contact_age_s)} ago"
    elif row.lag_s > late_s:
        yield f"{row.station} lags {span(row.lag_s)}"


def _refused(row: StationRow) -> str:
    return ", ".join(f"{count} {code}" for code, count in sorted(row.refusals.items()))


def _time(time: Any) -> str:
    return f"{time:%Y-%m-%d %H:%M:%S} UTC"


def _offset(seconds: float) -> str:
    if abs(seconds) < 1.0:
        return "agrees within a second"
    return f"is {span(abs(seconds))} {'ahead' if seconds > 0 else 'behind'}"
