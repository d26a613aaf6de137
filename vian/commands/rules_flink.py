"""`vian rules flink`: a rule as Flink SQL, for a cluster that reads the log."""

import re
from collections.abc import Sequence
from typing import Annotated

import typer

from events import decode, events_of, load_catalogue
from patterns.files.rule import Rule
from patterns.flink import Options, translate
from patterns.processor import schemas
from patterns.scene.geometry import FrameSize
from patterns.scene.site import SITE_TYPES, Site
from store import Log
from vian import options
from vian.chosen_rule import chosen_rule, rule_file
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output

RuleName = Annotated[str, typer.Argument(metavar="RULE", help="A rule file, or a deployed rule: NAME or NAME@VERSION.")]
_FRAME_SIZE = re.compile(r"(?P<source>.+)=(?P<width>[1-9][0-9]{0,5})x(?P<height>[1-9][0-9]{0,5})")
_EXAMPLE = (
    "Example: vian rules flink zone.yaml --frame-size cam-01=1920x1080 --with connector=filesystem --with path=/d"
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog=_EXAMPLE)(flink)


def flink(
    rule: RuleName,
    frame_size: Annotated[
        list[str] | None,
        typer.Option("--frame-size", metavar="SOURCE=WxH", help="Size of a source's frames in pixels; repeatable."),
    ] = None,
    connector: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="KEY=VALUE",
            help="An option of a table that is made, {type} in it stands for the event type; repeatable.",
            show_default="a Kafka topic to be filled in",
        ),
    ] = None,
    source_table: Annotated[
        list[str] | None,
        typer.Option(
            "--source-table",
            metavar="TYPE=TABLE",
            help="A table that the cluster has, in place of one that is made for the event type; repeatable.",
        ),
    ] = None,
    whole_milliseconds: Annotated[
        bool, typer.Option("--whole-milliseconds", help="All times are whole milliseconds: a simpler script.")
    ] = False,
    one_station: Annotated[
        bool, typer.Option("--one-station", help="All events are of one station: a simpler script.")
    ] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Print a rule as Flink SQL that finds the same situations, or say what Flink cannot say and why.

    With --data-dir or --dsn, frame sizes and shared zones are what the log says of them now.
    """
    settings = settings_for(data_dir, dsn)
    wanted, site = rule_file(rule), Site()
    if wanted is None or data_dir is not None or settings.dsn is not None:
        with opened(settings, data_dir=data_dir) as log:
            wanted, site = chosen_rule(log, rule), _site(log)
    tables = _pairs("--source-table", source_table, "track_point=points")
    chosen = Options(tables, _pairs("--with", connector, "connector=filesystem"), whole_milliseconds, one_station)
    script = translate(wanted, schemas(load_catalogue()), _frame_sizes(frame_size), chosen, site)
    statements = [{"why": why, "sql": statement} for why, statement in script.statements]
    output = Output(is_json=as_json)
    output.result(_said(wanted) | {"statements": statements, "result": script.result}, script.text.rstrip("\n"))


def _said(rule: Rule) -> dict[str, object]:
    return {"rule": rule.rule, "version": rule.version, "rule_hash": rule.hash}


def _site(log: Log) -> Site:
    """What the log says of the cameras, up to its present end."""
    site = Site()
    names = [each.type_name for each in SITE_TYPES]
    for segment in log.read_all(types=names):
        for sequence, event in enumerate(events_of(decode(segment, log.catalogue)), segment.header.first_sequence):
            site.learn(event, str(segment.stream), sequence, epoch=segment.header.epoch)
    return site


def _frame_sizes(given: Sequence[str] | None) -> dict[str, FrameSize]:
    sizes = {}
    for each in given or ():
        found = _FRAME_SIZE.fullmatch(each)
        if found is None:
            raise WrongUsage(f"--frame-size is SOURCE=WIDTHxHEIGHT, as in cam-01=1920x1080; got {each!r}")
        sizes[found["source"]] = (int(found["width"]), int(found["height"]))
    return sizes


def _pairs(option: str, given: Sequence[str] | None, example: str) -> dict[str, str]:
    pairs = {}
    for each in given or ():
        key, equals, value = each.partition("=")
        if not (key and equals):
            raise WrongUsage(f"{option} wants a name, = and a value, as in {example}; got {each!r}")
        pairs[key] = value
    return pairs
