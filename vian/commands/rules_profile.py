"""`vian rules profile`: what rules cost and remember over the log."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from events import Segment
from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.files.rule import Rule
from patterns.processor import schemas
from patterns.tools.backtest import CONTROL_TYPES
from patterns.tools.profiling import PARTS, Cost, measured, profiled, steps_of
from store import Log
from vian import options
from vian.chosen_rule import chosen_rule
from vian.errors import WrongUsage
from vian.options import opened, settings_for, time_of
from vian.output import Output
from vian.rules import load_all

_COLUMNS = (
    "rule", "events", "us/event", *PARTS, "situations", "partitions", "partial matches", "rows waiting", "state bytes",
)  # fmt: skip


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian rules profile rules/ --since 2026-01-01")(profile)


def profile(
    rules: Annotated[
        list[str], typer.Argument(help="Rule files, folders of them, or deployed rules: NAME or NAME@VERSION.")
    ],
    since: options.Since = None,
    until: options.Until = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Measure what rules cost (CPU time for an event, by part of the engine) and remember (most at any time)."""
    span = (time_of("--since", since), time_of("--until", until))
    if span[0] is not None and span[1] is not None and span[0] >= span[1]:
        raise WrongUsage(f"--since must be before --until, got {since} and {until}")
    output = Output(is_json=as_json)
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        chosen = [rule for each in rules for rule in _rules(log, each)]
        costs = [_cost(log, rule, span, output) for rule in chosen]
    if as_json:
        for each in costs:
            output.result(_as_json(each))
        return
    output.table("", _COLUMNS, [_row(each) for each in costs])
    if any(not each.events for each in costs):
        output.note("a rule that saw no event cost nothing. Next: vian streams")


def _rules(log: Log, wanted: str) -> list[Rule]:
    path = Path(wanted)
    return load_all([path]) if path.is_dir() else [chosen_rule(log, wanted)]


def _cost(log: Log, rule: Rule, span: tuple[datetime | None, datetime | None], output: Output) -> Cost:
    bound = bind(rule, schemas(log.catalogue))
    count = sum(1 for _ in _segments(log, bound, span))
    with _reading(log, bound, span, f"{rule.rule}: where the time goes", count, output) as segments:
        shares = profiled(bound, steps_of(segments, bound.types, log.catalogue))
    with _reading(log, bound, span, f"{rule.rule}: how much", count, output) as segments:
        return measured(bound, steps_of(segments, bound.types, log.catalogue), count, shares)


def _segments(log: Log, bound: BoundRule, span: tuple[datetime | None, datetime | None]) -> Iterator[Segment]:
    since, until = span
    types = [*sorted(bound.types), *CONTROL_TYPES]
    return (
        segment
        for segment in log.read_all(types=types, until=until)
        if since is None or segment.header.time_max >= since or segment.stream.type in CONTROL_TYPES
    )


@contextmanager
def _reading(
    log: Log, bound: BoundRule, span: tuple[datetime | None, datetime | None], what: str, count: int, output: Output
) -> Iterator[Iterator[Segment]]:
    """The segments, whose number is shown as they are read."""
    with output.progress(what, float(count)) as bar:

        def told() -> Iterator[Segment]:
            for number, segment in enumerate(_segments(log, bound, span), start=1):
                bar.at(number)
                yield segment

        yield told()


def _row(cost: Cost) -> tuple[Any, ...]:
    return (
        f"{cost.rule} v{cost.version}",
        cost.events,
        f"{cost.event_us:.1f}",
        *(f"{cost.shares[part]:.0%}" for part in PARTS),
        cost.matches,
        cost.partitions_most,
        cost.partial_matches_most,
        cost.rows_waiting_most,
        cost.state_bytes_most,
    )


def _as_json(cost: Cost) -> dict[str, Any]:
    return {
        "rule": cost.rule,
        "version": cost.version,
        "events": cost.events,
        "cpu_s": round(cost.cpu_s, 6),
        "event_us": round(cost.event_us, 3),
        "shares": {part: round(share, 3) for part, share in cost.shares.items()},
        "situations": cost.matches,
        "partitions_most": cost.partitions_most,
        "partial_matches_most": cost.partial_matches_most,
        "rows_waiting_most": cost.rows_waiting_most,
        "state_bytes_most": cost.state_bytes_most,
    }
