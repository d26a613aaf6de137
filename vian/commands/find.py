"""`vian find`: where a plate was read, which situations there were, here and at central."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from sync.protocol.questions import ROWS_MAX, FindQuestion
from vian import options
from vian.asking import Found, find_at_central, find_here, person
from vian.clock import utc_now
from vian.desk import central_desk, enrolment
from vian.errors import WrongUsage
from vian.options import opened, settings_for, time_of
from vian.output import Output

app = typer.Typer(
    help="Find plates and situations, the newest first: in this station's log, or at central.", no_args_is_help=True
)

AtCentral = Annotated[
    bool, typer.Option("--central", help="Ask central; what this station holds, marked PARTIAL, where it is away.")
]
OfStation = Annotated[
    str | None,
    typer.Option("--station", help="Only what this station recorded, whichever asks."),
]
OfSource = Annotated[str | None, typer.Option("--source", help="Only of this camera or sensor.")]
Since = Annotated[str | None, typer.Option("--since", "--from", help="At or after this time (ISO 8601, UTC).")]
Until = Annotated[str | None, typer.Option("--until", "--to", help="Before this time (ISO 8601, UTC).")]
Limit = Annotated[int, typer.Option("--limit", "-n", min=1, max=ROWS_MAX, help="Most rows, or rows of a page.")]
All = Annotated[bool, typer.Option("--all", help="All there are, page by page.")]
Page = Annotated[str | None, typer.Option("--page", help="Go on where an answer ended: its `next` in --json.")]


@app.command(epilog="Example: vian find plate '1AB*' --central --since 2026-05-01")
def plate(
    text: Annotated[
        str, typer.Argument(help="The plate, in any spelling; * stands for any letters, ? for one.", metavar="PLATE")
    ],
    at_central: AtCentral = False,
    since: Since = None,
    until: Until = None,
    station: OfStation = None,
    source: OfSource = None,
    limit: Limit = 100,
    is_all: All = False,
    page: Page = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Find where a number plate was read."""
    wanted: dict[str, Any] = {"kind": "plate", "plate": text, "station": station, "source": source}
    wanted |= {"limit": limit, "page": page}
    _find(wanted, (since, until), _Where(at_central, is_all, data_dir, dsn), Output(is_json=as_json))


@app.command(epilog="Example: vian find situation 'speeding*' --severity alarm --central")
def situation(
    rule: Annotated[
        str | None, typer.Argument(help="The rule; * stands for any letters, ? for one.", show_default="all")
    ] = None,
    severity: Annotated[str | None, typer.Option("--severity", help="info, warning or alarm.")] = None,
    at_central: AtCentral = False,
    since: Since = None,
    until: Until = None,
    station: OfStation = None,
    source: OfSource = None,
    limit: Limit = 100,
    is_all: All = False,
    page: Page = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Find situations that rules detected."""
    wanted: dict[str, Any] = {"kind": "situation", "rule": rule, "severity": severity}
    wanted |= {"station": station, "source": source, "limit": limit, "page": page}
    _find(wanted, (since, until), _Where(at_central, is_all, data_dir, dsn), Output(is_json=as_json))


@dataclass(frozen=True, slots=True)
class _Where:
    """Who is asked, and for how much."""

    at_central: bool
    is_all: bool
    data_dir: Path | None
    dsn: str | None


def _find(wanted: dict[str, Any], span: tuple[str | None, str | None], where: _Where, output: Output) -> None:
    since, until = time_of("--since", span[0]), time_of("--until", span[1])
    question = _question({**wanted, "since": since, "until": until, "person": person()})
    if question.page is not None and not where.at_central:
        raise WrongUsage("--page goes on with an answer of central. Next: add --central, or ask with --all")
    settings = settings_for(where.data_dir, where.dsn)
    membership = enrolment(settings) if where.at_central else None
    with opened(settings, data_dir=where.data_dir) as log:
        if membership is not None:
            with central_desk(log, settings, membership) as desk:
                found = find_at_central(desk, log, membership.station, question, is_all=where.is_all)
        else:
            found = find_here(log, settings.station, question, is_all=where.is_all)
    _show(found, output)


def _question(wanted: dict[str, Any]) -> FindQuestion:
    try:
        return FindQuestion(**wanted)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(map(str, first["loc"])) or "question"
        raise WrongUsage(f"{name}: {first['msg']}, got {first['input']!r}") from error


def _show(found: Found, output: Output) -> None:
    now = utc_now()
    output.table("", found.columns, found.rows)
    if output.is_json:
        output.result(found.source.summary(len(found.rows), now))
    for remark in found.source.remarks(now):
        output.note(remark)
    if not found.rows and not output.is_json:
        output.note("nothing found")
