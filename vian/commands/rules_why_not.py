"""`vian rules why-not`: why a rule did not fire for a track at a time, in words and drawn."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import timedelta
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import typer

from events import StreamName
from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.durations import parse_duration
from patterns.engine.situations import EventRef
from patterns.processor import readable_by
from patterns.tools.whynot import Answer, Past, Question, SubjectUnclear, TriedRow, default_window, why_not
from store import Log
from vian import options
from vian.chosen_rule import chosen_rule
from vian.commands.rules_backtest import RuleName
from vian.errors import WrongUsage
from vian.options import check_known, opened, settings_for, time_of
from vian.output import Output
from vian.rules import limits_of
from vian.whynot import past_of, spans_of

Draw = Annotated[Path | None, typer.Option("--draw", metavar="FILE", help="Also draw it on the video's frame, as PNG.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        name="why-not", epilog="Example: vian rules why-not loitering.yaml --at 2026-01-01T10:00:16Z --subject 2"
    )(why_not_fired)


def why_not_fired(
    rule: RuleName,
    at: Annotated[str, typer.Option("--at", help="When it should have fired (ISO 8601, UTC).")],
    subject: Annotated[
        str,
        typer.Option(
            "--subject",
            help="For whom: the track, plate, ... that events are about; or the source, if the rule is about sources.",
        ),
    ],
    source: Annotated[str | None, typer.Option("--source", help="Only this source.", show_default="any")] = None,
    window: Annotated[
        str | None,
        typer.Option(
            "--window",
            help="How far before and after the time attempts are looked for.",
            show_default="WITHIN, or 1 min",
        ),
    ] = None,
    draw: Draw = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Say how far the best attempt of a rule came, which condition failed on which row, and by how much."""
    output = Output(is_json=as_json)
    time = time_of("--at", at)
    assert time is not None, "it was given"
    settings = settings_for(data_dir, dsn)
    with opened(settings, data_dir=data_dir) as log:
        check_known("source", None if source is None else [source], {head.stream.source for head in log.streams()})
        chosen = chosen_rule(log, rule)
        bound = bind(chosen, readable_by(log, chosen))
        question = Question(time, subject, source, _duration(window) or default_window(bound))
        past = past_of(log, bound, question, limits_of(settings))
        answer = _answered(log, bound, question, past)
        _show(bound, question, answer, output)
        if draw is not None:
            _draw(log, bound, past, answer, draw, output)


def _duration(text: str | None) -> timedelta | None:
    if text is None:
        return None
    try:
        duration = parse_duration(text)
    except ValueError as error:
        raise WrongUsage(f"--window: {error}") from error
    if not duration:
        raise WrongUsage("--window must be longer than nothing, got 0")
    return duration


def _answered(log: Log, bound: BoundRule, question: Question, past: Past) -> Answer:
    try:
        return why_not(bound, question, past)
    except SubjectUnclear as error:
        raise WrongUsage(f"{error}. Next: {_next(log, bound, question, past)}") from error


def _next(log: Log, bound: BoundRule, question: Question, past: Past) -> str:
    """What to ask instead."""
    sources = set(past.rows.column("source").to_pylist()) if past.rows.num_rows else set()
    if question.source is None and len(sources) > 1 and "source" in bound.keys:
        return f"say which by --source: {', '.join(sorted(sources))}"
    spans = spans_of(log, bound, question.subject)
    if spans:
        return f"{question.subject!r} has events of {'; '.join(spans)}: give --at in there, or a longer --window"
    return f"vian tail --type {min(bound.types)} shows what there is"


# In words.


def _show(bound: BoundRule, question: Question, answer: Answer, output: Output) -> None:
    if output.is_json:
        output.result(_as_json(bound, question, answer))
        return
    where = ", ".join(f"{name} {value}" for name, value in answer.partition.items()) or question.subject
    output.line(
        f"{bound.rule.rule} v{bound.rule.version}, {where}, at {question.at:%Y-%m-%d %H:%M:%S}: {answer.verdict}"
    )
    output.line(answer.headline)
    for line in _lines(answer):
        output.line(line)
    for note in answer.notes:
        output.line(f"note: {note}")


def _lines(answer: Answer) -> Iterator[str]:
    if answer.taken:
        yield "taken:"
    for variable, rows in _runs(answer.taken):
        first, last = rows[0].event, rows[-1].event
        until = f" to {last.time:%H:%M:%S.%f}"[:-3] + f", {len(rows)} rows" if len(rows) > 1 else ""
        yield f"  {variable}: {_moment(first)}{until}, {_place(first, last)}"
    if answer.nearest is not None:
        yield from _refused("nearest", answer.nearest)
    for each in answer.ended:
        if answer.nearest is not None and (each.event, each.variable) == (
            answer.nearest.event,
            answer.nearest.variable,
        ):
            yield "  and there the attempt ended"
            continue
        yield from _refused("ended", each)


def _refused(what: str, row: TriedRow) -> Iterator[str]:
    yield f"{what}: {_moment(row.event)}, {_place(row.event)}, tried as {row.variable}"
    yield from (f"  x {each}" for each in row.shortfalls)


def _runs(rows: Sequence[TriedRow]) -> list[tuple[str, list[TriedRow]]]:
    return [(variable, list(group)) for variable, group in groupby(rows, key=lambda row: row.variable)]


def _moment(event: EventRef) -> str:
    return f"{event.time:%H:%M:%S.%f}"[:-3]


def _place(first: EventRef, last: EventRef | None = None) -> str:
    until = f" to {last.sequence}" if last is not None and last.sequence != first.sequence else ""
    return f"{first.stream}/{first.sequence}{until}"


def _as_json(bound: BoundRule, question: Question, answer: Answer) -> dict[str, Any]:
    return {
        "rule": bound.rule.rule,
        "version": bound.rule.version,
        "at": question.at,
        "subject": question.subject,
        "verdict": str(answer.verdict),
        "headline": answer.headline,
        "partition": dict(answer.partition),
        "taken": [_row_json(each) for each in answer.taken],
        "missing": answer.missing,
        "nearest": None if answer.nearest is None else _row_json(answer.nearest),
        "ended": [_row_json(each) for each in answer.ended],
        "situation": None if answer.match is None else answer.match.situation_id,
        "notes": list(answer.notes),
    }


def _row_json(row: TriedRow) -> dict[str, Any]:
    return {"variable": row.variable, **asdict(row.event), "shortfalls": list(row.shortfalls)}


# Drawn.


def _draw(log: Log, bound: BoundRule, past: Past, answer: Answer, file: Path, output: Output) -> None:
    from vian.drawings import drawn, write_png  # OpenCV is loaded by those that draw
    from vian.tracing import Scene, traced

    rows = _rows_by_event(past)
    tried = [*answer.taken, *((answer.nearest,) if answer.nearest else ()), *answer.ended]
    if not tried:
        output.note(f"nothing to draw: {answer.verdict}")
        return
    key = answer.nearest or tried[-1]
    marked = [key, *answer.ended[:1]] if answer.nearest is not None else []
    scene = Scene(
        rows=[(each.variable, rows[_key(each.event)]) for each in answer.taken],
        key_row=rows[_key(key.event)],
        marked=[(rows[_key(each.event)], _short(each)) for each in marked],
        trail=_trail(past, rows[_key(key.event)], bound),
        captions=[
            f"{bound.rule.rule} v{bound.rule.version}: {answer.verdict}",
            answer.headline,
            *(answer.nearest.shortfalls if answer.nearest else ()),
        ],
    )
    drawing, missing = traced(log, bound.rule, past.site, scene)
    write_png(drawn(drawing), file)
    if missing:
        output.note(f"drawn without a picture: {missing}")
    output.note(f"drawn: {file}")


def _rows_by_event(past: Past) -> dict[tuple[str, int], dict[str, Any]]:
    rows = past.rows.to_pylist()
    return {(str(StreamName(row["station"], row["source"], row["type"])), row["sequence"]): row for row in rows}


def _key(event: EventRef) -> tuple[str, int]:
    return event.stream, event.sequence


def _trail(past: Past, key_row: dict[str, Any], bound: BoundRule) -> list[dict[str, Any]]:
    same = [row for row in past.rows.to_pylist() if all(row.get(name) == key_row.get(name) for name in bound.keys)]
    return sorted(same, key=lambda row: (row["time"], row["sequence"]))


def _short(row: TriedRow) -> str:
    """What is said at the row: why the first condition failed."""
    reason = row.shortfalls[0].split(": ", 1)[-1] if row.shortfalls else ""
    return f"not {row.variable}: {reason}"
