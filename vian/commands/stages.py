"""`vian stages`: derive relations between objects (pairs, occupancy, groups, tallies) as events for rules."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from events import load_catalogue
from patterns.errors import RuleError
from patterns.stages import run_stage_tests
from store import Projector
from vian import options
from vian.clock import utc_now
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.parts import Parts, stepping
from vian.staging import StageFollower, check_fits, deploy_stages, stages_of

app = typer.Typer(help="Derive relations between objects, and counts over time, as events for rules.",
                  no_args_is_help=True)  # fmt: skip

Paths = Annotated[list[Path], typer.Argument(help="Stage files, or folders that hold some.", callback=options.existing)]
_STEP_SECONDS = 1.0


@app.command(name="check", epilog="Example: vian stages check rules/")
def check_stages(paths: Paths, as_json: options.Json = False) -> None:
    """Read stage files and run the tests in them."""
    output = Output(is_json=as_json)
    try:
        stages = stages_of(paths)
        for stage in stages:
            check_fits(stage, load_catalogue())
    except RuleError as error:
        raise WrongUsage(str(error)) from error
    if not stages:
        raise WrongUsage(f"no stage files (*.yaml with `stage:`) in {', '.join(map(str, paths))}")
    failed = 0
    for stage in stages:
        results = run_stage_tests(stage)
        failed += sum(not result.passed for result in results)
        for result in results:
            values = {"stage": stage.stage, "test": result.name, "passed": result.passed}
            said = f"{stage.stage} v{stage.version}, {result.name}: {'passed' if result.passed else 'FAILED'}"
            place = f"{result.place.file}:{result.place.line}:{result.place.column}: error: "
            text = said if result.passed else f"{place}{said}; wanted (-), got (+)\n{result.difference}"
            output.result(values | {"difference": result.difference}, text)
        if not results:
            output.result({"stage": stage.stage, "tests": 0}, f"{stage.stage} v{stage.version}: fits, but has no tests")
    if failed:
        raise WrongUsage(f"{failed} tests failed")


@app.command(epilog="Example: vian stages run rules/ --once")
def run(
    paths: Paths,
    once: Annotated[bool, typer.Option("--once", help="End when the log's present end is reached.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Deploy stages and run them over the log from where they stopped; append the events that they derive."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    stages = stages_of(paths)
    if not stages:
        raise WrongUsage(f"no stage files (*.yaml with `stage:`) in {', '.join(map(str, paths))}")
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        now = None if once else utc_now
        followers = [StageFollower(log, settings.station, stage, now) for stage in stages]
        for stage in deploy_stages(log, settings.station, stages):
            output.note(f"deployed stage {stage.stage} version {stage.version}")
        if once:
            for follower in followers:
                follower.catch_up()
            Projector(log).catch_up()
        else:
            output.note(f"{len(stages)} stages run; Ctrl-C ends them")
            parts = [stepping(each.stage.stage, partial(each.step, _STEP_SECONDS), log) for each in followers]
            with Parts(parts) as running:
                while running.wait(_STEP_SECONDS):
                    pass
        for follower in followers:
            follower.close()
    for follower in followers:
        for count, what in ((follower.run.late, "events came too late"), (follower.run.given_up, "were over a limit")):
            if count:
                output.note(f"stage {follower.stage.stage}: {count} {what} and took no part")
    output.result({"stages": len(stages)}, f"{len(stages)} stages have seen the log to its end")
    failures = [f"{each.stage.stage}: {each.failure}" for each in followers if each.failure is not None]
    if failures:
        raise WorldFailed(f"stages were set aside: {'; '.join(failures)}")
