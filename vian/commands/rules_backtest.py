"""`vian rules backtest`: which historical situations a rule would have found, and how two versions differ."""

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.csv
import typer

from events import EventType, SituationDetected, SituationShadowed, decode, events_of
from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.engine.situations import Match
from patterns.files.rule import Rule
from patterns.processor import SOURCE, ProcessorLimits, readable_by, situation_of
from patterns.processor.writing import producer_of
from patterns.tools.backtest import Pair, paired
from store import Log
from vian import options
from vian.backtesting import Backtested, Span, backtested
from vian.chosen_rule import chosen_rule, other_version
from vian.commands.rules_service import position_behind
from vian.errors import WrongUsage
from vian.options import check_known, opened, settings_for, time_of
from vian.output import Output, counted
from vian.rules import limits_of, misplaced

RuleName = Annotated[str, typer.Argument(metavar="RULE", help="A rule file, or a deployed rule: NAME or NAME@VERSION.")]
_DERIVED = ("pair_distance", "occupancy", "group_seen", "tally")
"""Event types that stages derive."""
_COLUMNS = ("decided", "began", "partition", "measures", "title")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian rules backtest loitering.yaml --since 2026-01-01T10:00:00Z --against 1")(backtest)


def backtest(
    rule: RuleName,
    since: Annotated[
        str | None, typer.Option("--since", help="Only situations at or after this time (ISO 8601, UTC).")
    ] = None,
    until: Annotated[str | None, typer.Option("--until", help="Only situations before this time.")] = None,
    begin: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="beginning|TIME",
            help="As if deployed from there, as with vian rules deploy --from; faster on a long log.",
            show_default="beginning",
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option("--against", metavar="VERSION|FILE", help="Show the difference to this version of the rule."),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option("--source", help="As if only this source's events existed; may be repeated.", show_default="all"),
    ] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="CSV with a header, for spreadsheets.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Show which situations a rule would have found in the log: byte for byte what it emits online. Appends nothing."""
    settings = settings_for(data_dir, dsn, station=station)
    span = _span(since, until, source)
    if as_csv and as_json:
        raise WrongUsage("give either --csv or --json, got both")
    output = Output(is_json=as_json)
    limits = limits_of(settings)
    with opened(settings, data_dir=data_dir) as log:
        check_known("source", source, {head.stream.source for head in log.streams()})
        if begin is not None:
            span = replace(span, after=position_behind(log, begin))
        one = chosen_rule(log, rule)
        other = None if against is None else other_version(log, one, against)
        first = _events(_ran(log, one, span, limits, output))
        if other is None:
            recorded = {} if as_csv or as_json else _recorded(log, one)
            _show_all(first, settings.station, recorded, output, as_csv)
        else:
            second = _events(_ran(log, other, span, limits, output))
            names = (_label(one), _label(other))
            _show_difference(paired([e for _, e in first], [e for _, e in second]), names, output, as_csv)


def _span(since: str | None, until: str | None, sources: list[str] | None) -> Span:
    span = Span(time_of("--since", since), time_of("--until", until), sources=sources)
    if span.since is not None and span.until is not None and span.since >= span.until:
        raise WrongUsage(f"--since must be before --until, got {span.since.isoformat()} and {span.until.isoformat()}")
    return span


def _ran(log: Log, rule: Rule, span: Span, limits: ProcessorLimits, output: Output) -> Backtested:
    """What came of the rule, with remarks on what else is worth knowing on standard error."""
    bound = bind(rule, readable_by(log, rule), limits=limits.rules)
    for remark in misplaced(log, [rule]):
        output.note(f"warning: {remark}")
    with output.progress(_label(rule), float(log.head())) as bar:
        result = backtested(log, bound, span, limits, bar.at)
    _remark(bound, result, span, output)
    return result


def _remark(bound: BoundRule, result: Backtested, span: Span, output: Output) -> None:
    label = _label(bound.rule)
    if not result.rows:
        wanted = " or ".join(sorted(bound.types))
        is_derived = any(each in _DERIVED for each in bound.types)
        following = "vian stages run FILES derives them" if is_derived else "vian streams"
        where = " behind --from" if span.after else ""
        output.note(f"{label}: the log has no {wanted}{where} that the rule could see. Next: {following}")
    if result.elsewhen and not result.matches:
        times = f"{_time(min(result.elsewhen))} to {_time(max(result.elsewhen))}"
        found = counted(len(result.elsewhen), "situation")
        output.note(
            f"{label}: {found} outside --since and --until, from {times}; times are UTC unless they say otherwise"
        )
    if result.late:
        output.note(f"{label}: {result.late} events came too late to take part, as online")
    if result.waiting and span.until is None:
        output.note(f"{label}: {result.waiting} events are not final yet: their source may still send earlier ones")
    if result.held_back:
        output.note(f"{label}: {result.held_back} matches were held back by once_per and cooldown")
    if result.segments_skipped:
        output.note(f"{label}: {result.segments_skipped} segments of versions unknown here took no part")


def _events(result: Backtested) -> list[tuple[str, SituationDetected]]:
    """The situations, each with the source in whose stream it would stand."""
    return [(_source(each), situation_of(each)) for each in result.matches]


def _source(match: Match) -> str:
    return str(match.partition.get("source") or SOURCE)


def _recorded(log: Log, rule: Rule) -> dict[str, str]:
    """How the situations of the rule that the log has were recorded, by identity."""
    how: dict[type[EventType], str] = {SituationDetected: "yes", SituationShadowed: "in shadow"}
    return {
        event.situation: how[type(event)]
        for segment in log.read_all(types=[each.type_name for each in how])
        if segment.header.producer == producer_of(rule)
        for event in events_of(decode(segment, log.catalogue))
        if isinstance(event, SituationDetected | SituationShadowed)
    }


def _show_all(
    found: Sequence[tuple[str, SituationDetected]],
    station: str,
    recorded: Mapping[str, str],
    output: Output,
    as_csv: bool,
) -> None:
    place = {"station": station, "type": str(SituationDetected.type_name)}
    rows = [{**place, "source": source, **event.model_dump(mode="json")} for source, event in found]
    if as_csv:
        _write_csv(rows, list(SituationDetected.model_fields))
    elif output.is_json:
        for row in rows:
            output.result(row)
    else:
        rows_shown = [(*_cells(event), recorded.get(event.situation, "no")) for _, event in found]
        if rows_shown:
            output.table("", (*_COLUMNS, "in the log"), rows_shown)
        output.line(counted(len(found), "situation"))


def _show_difference(pairs: Sequence[Pair], names: tuple[str, str], output: Output, as_csv: bool) -> None:
    rows: list[dict[str, Any]] = [
        {
            "in": pair.sides,
            "differs": pair.differences,
            "A": None if pair.first is None else pair.first.model_dump(mode="json"),
            "B": None if pair.second is None else pair.second.model_dump(mode="json"),
        }
        for pair in pairs
    ]
    if as_csv:
        fields = list(SituationDetected.model_fields)
        _write_csv([{"in": row["in"], **(row["A"] or row["B"] or {})} for row in rows], ["in", *fields])
        return
    if output.is_json:
        for row in rows:
            output.result(row)
        return
    output.line(f"A is {names[0]}, B is {names[1]}")
    shown = [(pair.sides, *_cells(pair.one), ", ".join(pair.differences)) for pair in pairs]
    output.table("", ("in", *_COLUMNS, "differs in"), shown)
    counts = Counter(pair.sides for pair in pairs)
    output.line(", ".join(f"{counts[side]} {side}" for side in ("both", "only A", "only B")))


def _cells(event: SituationDetected) -> tuple[str, ...]:
    partition, measures = (_flat(json.loads(text)) for text in (event.partition, event.measures))
    return _time(event.time), _time(event.began_at), partition, measures, event.title


def _flat(values: dict[str, Any]) -> str:
    return ", ".join(f"{name}: {_short(value)}" for name, value in values.items())


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _time(time: datetime) -> str:
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _write_csv(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    columns = {name: [_csv_cell(row.get(name)) for row in rows] for name in names}
    sink = pa.BufferOutputStream()
    pa.csv.write_csv(pa.table({name: pa.array(values, pa.string()) for name, values in columns.items()}), sink)
    sys.stdout.write(sink.getvalue().to_pybytes().decode())


def _csv_cell(value: Any) -> str | None:
    return value if value is None or isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _label(rule: Rule) -> str:
    return f"{rule.rule} v{rule.version}"
