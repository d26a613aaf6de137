"""`vian rules`: check and run here; each further command in a module of its own, `rules_...`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import pyarrow as pa
import typer

from events import load_catalogue
from patterns.binding.strata import with_situations
from patterns.engine.compiling import compiling_beside
from patterns.errors import RuleError
from patterns.files.loading import load_rule
from patterns.files.rule import Rule
from patterns.linting.findings import Finding, finding_of
from patterns.linting.lint import check
from patterns.processor import Processor, schemas
from patterns.tools.cases import TestResult, run_tests
from store import Projector
from vian import options
from vian.clock import utc_now
from vian.commands import (
    rules_backtest,
    rules_explain,
    rules_flink,
    rules_profile,
    rules_service,
    rules_why_not,
    rules_write,
)
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output, counted
from vian.parts import Parts, stepping
from vian.rules import check_fit, deploy_all, doubts, files_of, limits_of, load_all, readable_rules

app = typer.Typer(help="Write rules, try them on what the log holds, and run them.", no_args_is_help=True)

Paths = Annotated[list[Path], typer.Argument(help="Rule files, or folders of them.", callback=options.existing)]
_STEP_SECONDS = 1.0


@app.command(name="check", epilog="Example: vian rules check rules/")
def check_rules(paths: Paths, as_json: options.Json = False) -> None:
    """Read rule files, bind them to the event types, and run the tests in them; all of them, whatever is wrong."""
    output = Output(is_json=as_json)
    known = schemas(load_catalogue())
    files = files_of(paths)
    names: dict[str, Rule] = {}
    try:
        known = with_situations(known, readable_rules(files))
    except RuleError as error:
        # The rules of the cycle fail one by one below, for what they read is not there; others need not.
        _print_finding(None, finding_of(error), output)
    bad = [str(file) for file in files if not _is_good(file, names, known, output)]
    if bad:
        raise WrongUsage(f"{len(bad)} of {len(files)} rule files did not pass: {', '.join(bad)}")


def _is_good(file: Path, names: dict[str, Rule], known: Mapping[str, pa.Schema], output: Output) -> bool:
    """Print what is found about the rule of the file; whether it can go into service."""
    try:
        rule = load_rule(file)
        if (other := names.setdefault(rule.rule, rule)) is not rule:
            raise rule.error(f"the rule {rule.rule!r} is also defined in {other.path}. Next: rename one", "rule")
        return _passes(rule, known, output)
    except RuleError as error:
        _print_finding(None, finding_of(error), output)
    except OSError as error:
        message = f"the rule file {file} cannot be read: {error.strerror}. Next: give a rule file or a folder of them"
        output.result({"file": str(file), "severity": "error", "message": message}, f"{file}: error: {message}")
    return False


def _passes(rule: Rule, known: Mapping[str, pa.Schema], output: Output) -> bool:
    """Print what is found about the rule, and how its tests went; whether it can go into service."""
    findings = check(rule, known)
    for finding in findings:
        _print_finding(rule.rule, finding, output)
    if any(finding.severity == "error" for finding in findings):
        return False
    results = run_tests(rule, known)
    for result in results:
        output.result(
            {"rule": rule.rule, "test": result.name, "passed": result.passed, "difference": result.difference},
            f"{rule.rule} v{rule.version}, {result.name}: passed" if result.passed else _failed(rule, result),
        )
    if not results:
        output.result({"rule": rule.rule, "tests": 0}, f"{rule.rule} v{rule.version}: fits, but has no tests")
    return all(result.passed for result in results)


def _failed(rule: Rule, result: TestResult) -> str:
    at = f"{result.place.file}:{result.place.line}:{result.place.column}"
    head = "" if result.difference.startswith("!") else "; wanted (-), got (+)"
    return f"{at}: error: {rule.rule} v{rule.version}, {result.name}: FAILED{head}\n{result.difference}"


def _print_finding(rule: str | None, finding: Finding, output: Output) -> None:
    place = {"file": finding.place.file, "line": finding.place.line, "column": finding.place.column}
    values = {"rule": rule, "severity": finding.severity, "message": finding.message, **place}
    output.result(values, str(finding))


@app.command(epilog="Example: vian rules run rules/ --once")
def run(
    paths: Paths,
    once: Annotated[bool, typer.Option("--once", help="End when the log's present end is reached.")] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Deploy rules and run them over the log from where they stopped; append the situations they find."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    rules = load_all(paths)
    with compiling_beside(), opened(settings, data_dir=data_dir, is_made=True) as log:
        check_fit(log, rules)
        for remark in doubts(log, rules):
            output.note(f"warning: {remark}")
        for rule in deploy_all(log, settings.station, rules):
            output.note(f"deployed {rule.rule} version {rule.version}")
        processor = Processor(log, settings.station, rules, now=None if once else utc_now, limits=limits_of(settings))
        found = 0
        if once:
            found = processor.catch_up()
            Projector(log).catch_up()
        else:
            output.note(f"{len(rules)} rules run; Ctrl-C ends them")

            def step() -> None:
                nonlocal found
                found += processor.step(_STEP_SECONDS).situations

            with Parts([stepping("rules", step, log)]) as parts:
                while parts.wait(_STEP_SECONDS):
                    pass
        processor.close()
    for name, late in processor.late.items():
        if late:
            output.note(f"rule {name}: {late} events came too late to take part")
    if processor.segments_skipped:
        output.note(f"{processor.segments_skipped} segments of versions unknown here took no part. Next: upgrade ViAn")
    output.result(
        {"rules": len(rules), "situations": found},
        f"{counted(found, 'situation')} found by {counted(len(rules), 'rule')}",
    )
    if processor.failures:
        reasons = "; ".join(f"{name}: {failure}" for name, failure in processor.failures.items())
        raise WorldFailed(f"rules were set aside: {reasons}")


for _module in (
    rules_write,
    rules_backtest,
    rules_explain,
    rules_why_not,
    rules_profile,
    rules_service,
    rules_flink,
):
    _module.register(app)
