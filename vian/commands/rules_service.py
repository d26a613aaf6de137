"""`vian rules deploy`, `retire` and `status`: which rules run, and how they stand."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from patterns.processor import OpenMatches, Report, reports, retire
from store import Log
from vian import options
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.options import opened, settings_for, time_of
from vian.output import Output
from vian.rules import check_fit, deploy_all, doubts, load_all
from vian.settings import station_option

_COLUMNS = (
    "rule",
    "version",
    "state",
    "lag",
    "watermark",
    "events",
    "situations",
    "held back",
    "late",
    "open",
    "us/event",
)


class Retire(StrEnum):
    """What becomes of the matches that a version has begun when it leaves."""

    NOW = "now"
    FINISH = "finish"

    @property
    def open_matches(self) -> OpenMatches:
        """The same, as events say it."""
        return "dropped" if self is Retire.NOW else "finished"


Retiring = Annotated[
    Retire, typer.Option("--retire", help="finish: what the old version has begun is still found; now: it is dropped.")
]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(name="deploy", epilog="Example: vian rules deploy loitering.yaml --from head")(deploy_rules)
    app.command(name="retire", epilog="Example: vian rules retire loitering --retire now")(retire_rule)
    app.command(name="status", epilog="Example: vian rules status --json")(status)


def deploy_rules(
    paths: Annotated[list[Path], typer.Argument(help="Rule files, or folders of them.", callback=options.existing)],
    begin: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="head|beginning|TIME",
            help="Where in the log they begin: at its end, at its beginning, or where its first event at or after "
            "TIME (ISO 8601) stands.",
            show_default="beginning for a rule's first version, head for a further one, "
            "the retirement for one that comes back",
        ),
    ] = None,
    retiring: Retiring = Retire.FINISH,
    shadow: Annotated[
        bool | None,
        typer.Option("--shadow/--no-shadow", help="Record, alert nobody.", show_default="as the file says"),
    ] = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Put rules into service, while others run; a running `vian serve` follows at once.

    Another version of a rule replaces the one in service; deploying a version again brings it back, or out of shadow.
    """
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    rules = load_all(paths)
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        check_fit(log, rules)
        for remark in doubts(log, rules):
            output.note(f"warning: {remark}")
        deployed = deploy_all(
            log,
            settings.station,
            rules,
            after="default" if begin is None else position_behind(log, begin),
            open_matches=retiring.open_matches,
            is_shadow=shadow,
        )
        for rule in rules:
            is_new = rule in deployed
            text = f"{rule.rule} version {rule.version}: {'deployed' if is_new else 'in service already'}"
            output.result({"rule": rule.rule, "version": rule.version, "deployed": is_new}, text)
    output.note("A running vian serve runs them at once. Next: vian rules status")


def retire_rule(
    name: Annotated[str, typer.Argument(metavar="RULE", help="Name of the rule.")],
    retiring: Retiring = Retire.FINISH,
    reason: Annotated[str, typer.Option("--reason", help="Why, for the record.")] = "told to",
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Take a rule out of service; deploying it again brings it back."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        for rule, version in retire(
            log, settings.station, name, utc_now(), open_matches=retiring.open_matches, reason=reason
        ):
            output.result({"rule": rule, "version": version}, f"{rule} version {version}: retired")


def status(
    everything: Annotated[bool, typer.Option("--all", help="Versions out of service, too.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """How the deployed rules stand: lag, open state, what they missed, what they cost, and why one was set aside.

    The numbers are those of when a rule was saved last; the lag is from where it last found something or was saved.
    """
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        found = [each for each in reports(log, settings.station) if everything or each.state != "retired"]
        stations = {str(head.stream.source): str(head.stream.station) for head in log.streams()}
    if as_json:
        for each in found:
            output.result(_values(each))
        return
    if not found:
        output.note("No rule is deployed here. Next: vian rules deploy FILES")
        return
    output.table("Rules", _COLUMNS, [_row(each) for each in found])
    output.note(f"Counted when each was saved last: every {settings.rules_save_s:g} s while events come (rules_save_s)")
    for each in found:
        for source, events in each.uncalibrated.items():
            output.line(f"{each.service.rule} version {each.service.version} found no metres in {events} events of "
                        f"{source}, which is not calibrated")  # fmt: skip
            of = station_option(stations.get(source, settings.station))
            output.note(
                f"Next: vian extract calibration --source {source}{of} says what is missing; "
                f"vian zones calibrate {source} POINTS.yaml{of}, or leave the source out in the rule's FROM"
            )
        gone = each.service.retirement
        if gone is not None and each.state in ("failed", "too_slow"):
            output.line(f"{each.service.rule} version {each.service.version} was set aside {gone.reason}")
            output.note(f"Next: vian rules deploy FILE brings it back, behind position {gone.position}")


def position_behind(log: Log, begin: str) -> int:
    """The position behind which rules begin."""
    if begin == "beginning":
        return 0
    if begin == "head":
        return log.head()
    since = time_of("--from", begin)
    first = next(iter(log.read_all(since=since)), None)
    if first is None:
        raise WrongUsage(f"--from: the log has no event at or after {begin}. Next: --from head begins at its end")
    return first.position - 1


def _values(each: Report) -> dict[str, object]:
    service, gone = each.service, each.service.retirement
    return {
        "rule": service.rule,
        "version": service.version,
        "state": each.state,
        "reason": None if gone is None else gone.reason,
        "deployed_at": service.deployed_at,
        "after_position": service.after,
        "position": each.position,
        "lag_segments": each.lag,
        "watermark": each.watermark,
        **each.counts,
        "missed": each.missed,
        "uncalibrated": each.uncalibrated,
    }


def _row(each: Report) -> tuple[object, ...]:
    counts = each.counts
    return (
        each.service.rule,
        each.service.version,
        each.state,
        each.lag,
        each.watermark or "",
        counts.get("rows", 0),
        counts.get("matches", 0),
        counts.get("held_back", 0),
        each.missed.get("late_events", 0),
        counts.get("partitions_open", 0),
        counts.get("event_us", 0.0),
    )
