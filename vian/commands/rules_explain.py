"""`vian rules explain`: what a situation rests on, row by row, and drawn."""

import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import typer

from patterns.binding.binder import bind
from patterns.errors import PatternError
from patterns.processor import readable_by
from patterns.tools.telling import told_time
from store import Log
from vian import options
from vian.commands.rules_why_not import Draw
from vian.errors import WrongUsage
from vian.explaining import Explained, Matched, Row, explained
from vian.options import opened, settings_for
from vian.output import Output

ROWS_SHOWN = 3
"""Rows at each end of a variable's rows that are shown without --all."""
_ENVELOPE = ("station", "source", "type", "subject", "sequence", "time")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian rules explain 3f9c2a71 --draw situation.png")(explain)


def explain(
    situation: Annotated[str, typer.Argument(help="Identity of the situation, or how it begins.")],
    draw: Draw = None,
    all_rows: Annotated[
        bool, typer.Option("--all", help=f"All rows, not the first and last {ROWS_SHOWN} of each variable.")
    ] = False,
    text: Annotated[bool, typer.Option("--text", help="The rule file that was deployed, too.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Show what a situation rests on: its rows by variable, measures, rule and extractor, and draw it on the video."""
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        found = explained(log, situation)
        columns = _columns(log, found)
        if as_json:
            output.result(_as_json(found))
        else:
            _tell(found, columns, all_rows, text, output)
        for each in found.missing:
            output.note(f"not found: {each}")
        if draw is not None:
            _draw(log, found, draw, output)


def _columns(log: Log, found: Explained) -> list[str]:
    """The columns that are worth showing: those that the rule reads, else all of the rows' own."""
    names = list(
        dict.fromkeys(name for each in found.matched if not each.is_place for row in each.rows for name in row)
    )
    read = set(names) - set(_ENVELOPE)
    if found.rule is not None:
        with suppress(PatternError):  # it is told among what was not found
            read &= set(bind(found.rule, readable_by(log, found.rule)).columns)
    keys = set(json.loads(found.event.partition))
    return [name for name in names if name in read and name not in keys]


def _as_json(found: Explained) -> dict[str, Any]:
    event = found.event.model_dump(mode="json")
    opened_up = {name: json.loads(event[name]) for name in ("partition", "measures")}
    return {
        **event,
        **opened_up,
        "place": found.place,
        "position": found.position,
        "shadow": found.is_shadow,
        "text": found.text,
        "rows": [{"variable": each.variable, **row} for each in found.matched for row in each.rows],
        "producers": {each.stream: each.producers for each in found.matched},
        "missing": found.missing,
    }


# In words.


def _tell(found: Explained, columns: Sequence[str], all_rows: bool, with_text: bool, output: Output) -> None:
    event = found.event
    shadow = " (in shadow: nobody was alerted)" if found.is_shadow else ""
    output.line(f"{event.title}{shadow}")
    output.line(f"situation {event.situation}, {found.place}")
    output.line(f"rule      {event.rule} version {event.rule_version}, {event.severity}, hash {event.rule_hash[:12]}")
    output.line(
        f"decided   {told_time(event.time)}; rows from {told_time(event.began_at)} to {told_time(event.ended_at)}"
    )
    for name in ("partition", "measures"):
        values = json.loads(getattr(event, name))
        if values:
            output.line(f"{name:9} {', '.join(f'{key}: {value}' for key, value in values.items())}")
    for each in found.matched:
        if each.is_place:
            output.line(f"judged by {each.variable}: {', '.join(_place(row) for row in each.rows)}")
    for stream, producers in _producers(found.matched).items():
        output.line(f"said by   {'; '.join(producers)} ({stream})")
    rows = [row for variable, rows in _by_variable(found.matched) for row in _shown(variable, rows, columns, all_rows)]
    output.table("", ("variable", "time", "event", *columns), rows)
    if with_text and found.text is not None:
        output.line(found.text.rstrip())


def _producers(matched: Sequence[Matched]) -> dict[str, list[str]]:
    by_stream: dict[str, dict[str, None]] = {}
    for each in matched:
        by_stream.setdefault(each.stream, {}).update(dict.fromkeys(each.producers))
    return {stream: list(producers) for stream, producers in by_stream.items()}


def _by_variable(matched: Sequence[Matched]) -> list[tuple[str, list[Row]]]:
    """The rows in order of time, in runs of one variable."""
    rows = [(each.variable, row) for each in matched if not each.is_place for row in each.rows]
    rows.sort(
        key=lambda pair: (pair[1]["time"], _place(pair[1])[: -len(str(pair[1]["sequence"]))], pair[1]["sequence"])
    )
    return [(variable, [row for _, row in run]) for variable, run in groupby(rows, key=lambda pair: pair[0])]


def _shown(variable: str, rows: list[Row], columns: Sequence[str], all_rows: bool) -> list[tuple[Any, ...]]:
    told = [
        (variable, told_time(row["time"]), _place(row), *(_cell(row.get(name)) for name in columns)) for row in rows
    ]
    if all_rows or len(rows) <= 2 * ROWS_SHOWN + 1:
        return told
    gap = (variable, f"... {len(rows) - 2 * ROWS_SHOWN} more", "", *("" for _ in columns))
    return [*told[:ROWS_SHOWN], gap, *told[-ROWS_SHOWN:]]


def _cell(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def _place(row: Row) -> str:
    return f"{_stream(row)}/{row['sequence']}"


def _stream(row: Row) -> str:
    return f"{row['station']}/{row['source']}/{row['type']}"


# Drawn.


def _draw(log: Log, found: Explained, file: Path, output: Output) -> None:
    from vian.drawings import drawn, write_png  # OpenCV is loaded by those that draw
    from vian.tracing import Scene, place_of, traced

    rows = [(variable, row) for variable, own in _by_variable(found.matched) for row in own]
    placed = [row for _, row in rows if place_of(row) is not None]
    if not placed:
        raise WrongUsage("nothing to draw: no row of this situation says where it is in the picture (x, y or a box)")
    event = found.event
    captions = [
        f"{event.title}",
        f"{event.rule} version {event.rule_version}, situation {event.situation[:12]}, {told_time(event.time)}",
    ]
    drawing, missing = traced(log, found.rule, found.site, Scene(rows, placed[-1], captions=captions))
    write_png(drawn(drawing), file)
    if missing:
        output.note(f"drawn without a picture: {missing}")
    output.note(f"drawn: {file}")
