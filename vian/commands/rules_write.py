"""`vian rules new`, `lint`, `test`, `expand`: write rules, and see what is wrong with them before they run."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import typer
import yaml
from rich.text import Text

from events import load_catalogue
from patterns.binding.strata import with_situations
from patterns.errors import PatternError, Place, RuleError
from patterns.files.expanding import expand
from patterns.files.loading import is_stage_file, load_rule, parse_rule
from patterns.files.rule import Rule
from patterns.files.template import Template, new_rule, templates
from patterns.linting.findings import Finding, finding_of
from patterns.linting.lint import lint as lint_rules
from patterns.processor import schemas
from patterns.stages.cases import run_stage_tests
from patterns.stages.files import load_stage
from patterns.tools.cases import TestResult, run_tests
from vian import options
from vian.errors import WorldFailed, WrongUsage
from vian.output import Output, counted, printable
from vian.rules import files_of, readable_rules

Paths = Annotated[list[Path], typer.Argument(help="Rule files, or folders of them.", callback=options.existing)]
_TESTS = re.compile(r"^tests:\n(?:[ #].*\n|\n)*", re.MULTILINE)
_REMARKS = re.compile(r"\A(?:#.*\n)+")
_NO_TESTS = "# The template's own tests are for its own place; write one here, and run it: vian rules test\n"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(epilog="Example: vian rules new yard-loitering --template loitering -o yard-loitering.yaml")(new)
    app.command(epilog="Example: vian rules lint rules/")(lint)
    app.command(name="test", epilog="Example: vian rules test yard-loitering.yaml")(run_rule_tests)
    app.command(name="expand", epilog="Example: vian rules expand yard-loitering.yaml")(expand_rule)


def new(
    name: Annotated[str | None, typer.Argument(help="Name of the new rule.", show_default=False)] = None,
    template: Annotated[
        str | None, typer.Option("--template", "-t", help="The template that it uses.", show_default="list them")
    ] = None,
    zone: Annotated[
        str | None,
        typer.Option(
            "--zone", metavar="SOURCE:X,Y,X,Y,...", help="Where its zone lies: shares of the picture, or pixels."
        ),
    ] = None,
    line: Annotated[
        str | None, typer.Option("--line", metavar="SOURCE:X,Y,X,Y", help="Where its line lies, likewise.")
    ] = None,
    given: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="NAME=VALUE", help="A parameter of the template; may be repeated."),
    ] = None,
    output_file: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write it to this file.", show_default="print it")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Write a new rule from a template, tests included; without --template, list the templates."""
    output = Output(is_json=as_json)
    if template is None:
        _list_templates(output)
        return
    if name is None:
        raise WrongUsage("a new rule needs a name. Next: vian rules new NAME --template " + template)
    text = _placed(new_rule(_template(template), name), zone, line, given or [])
    rule = parse_rule(text, str(output_file or "<new rule>"))
    if output_file is None:
        output.line(text.rstrip("\n"))
        return
    _write(text, output_file)
    output.result({"rule": rule.rule, "file": str(output_file)}, f"written: {output_file}")
    output.note(f"Next: vian rules test {output_file}, then vian rules backtest {output_file}")


def _list_templates(output: Output) -> None:
    known = templates()
    rows = [(each.template, each.title, _parameters(each), each.onvif or "") for each in known.values()]
    output.table("", ("template", "finds", "parameters", "ONVIF"), rows)
    output.note("Next: vian rules new NAME --template TEMPLATE -o FILE")


def _parameters(template: Template) -> str:
    return ", ".join(
        name if each.default is None else f"{name}: {each.default}" for name, each in template.parameters.items()
    )


def _template(name: str) -> Template:
    known = templates()
    if name not in known:
        raise WrongUsage(f"there is no template {name!r}; there are: {', '.join(known)}. Next: vian rules new")
    return known[name]


def _placed(text: str, zone: str | None, line: str | None, given: Sequence[str]) -> str:
    """The rule's text with its place and parameters; in another place the tests of the template hold no longer."""
    for option, kind, key, where in (("--zone", "zones", "polygon", zone), ("--line", "lines", "points", line)):
        if where is not None:
            text = _replaced(text, kind, option, _shape(option, where, key))
    if given:
        text = _with(text, dict(_pair(each) for each in given))
    if zone is None and line is None and not given:
        return text
    return _TESTS.sub(_NO_TESTS, _REMARKS.sub("", text))


def _shape(option: str, where: str, key: str) -> dict[str, Any]:
    source, _, numbers = where.rpartition(":")
    try:
        values = [float(each) for each in numbers.split(",")]
    except ValueError:
        values = []
    if not source or len(values) < 4 or len(values) % 2:
        raise WrongUsage(f"{option} must be SOURCE:X,Y,X,Y..., such as cam-01:0.1,0.5,0.6,0.5,0.6,0.9; got {where!r}")
    is_share = all(0 <= value <= 1 for value in values)
    if not is_share and all(abs(value) <= 2 for value in values):
        raise WrongUsage(
            f"{option}: shares of the picture lie in 0 to 1, and this is too small for pixels; got {where!r}"
        )
    units = {} if is_share else {"units": "pixels"}
    points = [list(map(_number, values[at : at + 2])) for at in range(0, len(values), 2)]
    return {"source": source, **units, key: points}


def _number(value: float) -> int | float:
    return int(value) if value.is_integer() and abs(value) > 1 else value


def _replaced(text: str, kind: str, option: str, shape: Mapping[str, Any]) -> str:
    """The text with this shape in place of the first of its kind."""
    found = re.search(rf"^{kind}:\n  ([^:\n]+): .*$", text, re.MULTILINE)
    if found is None:
        raise WrongUsage(f"this template has no {kind[:-1]} for {option} to place")
    flow = yaml.safe_dump(shape, default_flow_style=True, sort_keys=False, width=1000).strip()
    return f"{text[: found.start()]}{kind}:\n  {found[1]}: {flow}{text[found.end() :]}"


def _with(text: str, values: Mapping[str, Any]) -> str:
    found = re.search(r"^with: (\{.*\})$", text, re.MULTILINE)
    known = {} if found is None else yaml.safe_load(found[1])
    flow = yaml.safe_dump({**known, **values}, default_flow_style=True, sort_keys=False, width=1000).strip()
    if found is None:
        return re.sub(r"^(template: .*)$", rf"\1\nwith: {flow}", text, count=1, flags=re.MULTILINE)
    return f"{text[: found.start()]}with: {flow}{text[found.end() :]}"


def _pair(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise WrongUsage(f"--with must be NAME=VALUE, such as min_duration='30 s'; got {text!r}")
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise WrongUsage(f"--with {name}: {value!r} is no value of a rule file") from error


def _write(text: str, file: Path) -> None:
    try:
        with file.open("x", encoding="utf-8") as out:
            out.write(text)
    except FileExistsError as error:
        raise WrongUsage(f"{file} is there already, and a rule file is never overwritten. Next: -o ANOTHER") from error
    except OSError as error:
        wanted = "" if file.parent.is_dir() else f". Next: mkdir -p {file.parent}"
        raise WorldFailed(f"{file} cannot be written: {error.strerror}{wanted}") from error


def lint(paths: Paths, as_json: options.Json = False) -> None:
    """Say what is wrong, or looks wrong, with rules, each at its place; nothing is run."""
    output = Output(is_json=as_json)
    rules, findings = _loaded(files_of(paths))
    findings += lint_rules(rules, schemas(load_catalogue()))
    for each in findings:
        place = {"file": each.place.file, "line": each.place.line, "column": each.place.column}
        output.result({"severity": each.severity, "code": each.code, "message": each.message, **place}, str(each))
    errors = sum(each.severity == "error" for each in findings)
    warnings = len(findings) - errors
    if errors:
        raise WrongUsage(f"{counted(errors, 'error')}, {counted(warnings, 'warning')}")
    output.note(f"no errors, {counted(warnings, 'warning')}")


def _loaded(files: Sequence[Path]) -> tuple[list[Rule], list[Finding]]:
    """The rules of the files, and what is to be said of files that hold none."""
    rules, findings = [], []
    for file in files:
        try:
            rules.append(load_rule(file))
        except RuleError as error:
            findings.append(finding_of(error))
        except OSError as error:
            place = Place(str(file), 1, 1, "")
            findings.append(Finding("error", str(_unreadable(file, error)), place))
    return rules, findings


def _unreadable(file: Path, error: OSError) -> WrongUsage:
    return WrongUsage(f"the rule file {file} cannot be read: {error.strerror}. Next: give a rule file")


def run_rule_tests(paths: Paths, as_json: options.Json = False) -> None:
    """Run the tests in files of rules and stages, and show what was wanted beside what was found."""
    output = Output(is_json=as_json)
    files = files_of(paths, with_stages=True)
    known = with_situations(schemas(load_catalogue()), readable_rules(files))
    failed: list[str] = []
    count = 0
    for file in files:
        try:
            results = _tests_of(file, known)
        except (PatternError, OSError) as error:
            message = str(error) if isinstance(error, PatternError) else str(_unreadable(file, error))
            output.result({"file": str(file), "error": message}, message)
            failed.append(str(file))
            continue
        count += len(results)
        failed += [str(file) for result in results if not result.passed][:1]
        for result in results:
            _show_result(result, output)
        if not results:
            output.note(f"{file}: has no tests")
    if failed:
        raise WrongUsage(f"tests failed in {len(failed)} of {len(files)} files: {', '.join(failed)}")
    output.note(f"{counted(count, 'test')} passed")


def _tests_of(file: Path, known: Mapping[str, pa.Schema]) -> list[TestResult]:
    if is_stage_file(file):
        return run_stage_tests(load_stage(file))
    return run_tests(load_rule(file), known)


def _show_result(result: TestResult, output: Output) -> None:
    values = {"rule": result.rule, "test": result.name, "passed": result.passed, "difference": result.difference}
    if output.is_json:
        output.result(values)
        return
    if result.passed:
        output.out.print(Text.assemble((" passed ", "green"), printable(f"{result.rule}: {result.name}")))
        return
    at = f"{result.place.file}:{result.place.line}:{result.place.column}"
    output.out.print(Text.assemble((" FAILED ", "bold red"), printable(f"{result.rule}: {result.name}  ({at})")))
    if not result.difference.startswith("!"):
        output.out.print(Text.assemble("        ", ("- wanted", "red"), "  ", ("+ found", "green")))
    for line in result.difference.splitlines():
        output.out.print(Text(printable(f"        {line}"), style=_STYLES.get(line[:1], "")))


_STYLES = {"-": "red", "+": "green", "?": "yellow", "!": "red"}


def expand_rule(
    file: Annotated[Path, typer.Argument(help="The rule file.", callback=options.existing)],
    output_file: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write it to this file.", show_default="print it")
    ] = None,
) -> None:
    """Write a rule out: its template as SQL, its lists from files in place; the same rule, that needs nothing else."""
    output = Output()
    try:
        text = expand(load_rule(file))
    except OSError as error:
        raise _unreadable(file, error) from error
    if output_file is None:
        output.line(text.rstrip("\n"))
    else:
        _write(text, output_file)
        output.note(f"written: {output_file}")
