"""Rules from files into service."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import structlog

from patterns.errors import RuleError
from patterns.expanding import expand
from patterns.loading import load_rule, load_rules, rule_files
from patterns.parser import parse
from patterns.processor import Processor, deploy
from patterns.rule import Rule
from store import Log
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part, stepping

logger = structlog.get_logger()

_STEP_SECONDS = 1.0


def load_all(paths: Sequence[Path]) -> list[Rule]:
    """The rules of files and folders, in order.

    Raises:
        WrongUsage: There are none, or two of one name, or a file cannot be read.
        PatternError: A file is not a rule.
    """
    try:
        rules = [rule for path in paths for rule in load_rules(path)]
    except OSError as error:
        raise WrongUsage(
            f"the rule file {error.filename} cannot be read: {error.strerror}. "
            "Next: give a rule file or a folder of them"
        ) from error
    if not rules:
        raise WrongUsage(f"no rule files (*.yaml) in {', '.join(map(str, paths))}")
    names = [rule.rule for rule in rules]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        places = ", ".join(str(rule.path) for rule in rules if rule.rule == twice[0])
        raise WrongUsage(f"two rules are named {twice[0]}: {places}. Next: rename one")
    return rules


def files_of(paths: Sequence[Path]) -> list[Path]:
    """The rule files of files and folders, in order, each once.

    Raises:
        WrongUsage: There are none, or a folder cannot be read.
    """
    try:
        files = list(dict.fromkeys(file for path in paths for file in rule_files(path)))
    except OSError as error:
        raise WrongUsage(f"the folder {error.filename} cannot be read: {error.strerror}") from error
    if not files:
        raise WrongUsage(f"no rule files (*.yaml) in {', '.join(map(str, paths))}")
    return files


def readable_rules(files: Sequence[Path]) -> list[Rule]:
    """The rules of those of the files that are rules, one of a name."""
    rules: dict[str, Rule] = {}
    for file in files:
        with suppress(RuleError, OSError):
            rule = load_rule(file)
            rules.setdefault(rule.rule, rule)
    return list(rules.values())


def misplaced(log: Log, rules: Sequence[Rule]) -> list[str]:
    """A remark for each zone and line of a source that the log has no events of, where it has those of others."""
    heads = log.streams()
    remarks = []
    for rule in rules:
        types = sorted({arm.source_type.name.lower() for arm in parse(rule.passage("match")).arms})
        wanted = " or ".join(types)
        sources = sorted({head.stream.source for head in heads if head.stream.type in types})
        for kind, shapes in (("zone", rule.zones), ("line", rule.lines)):
            remarks += [
                f"{rule.rule}: {kind} {name!r} is of source {shape.source}, of which this log has no {wanted}; it has: "
                f"{', '.join(sources)}. Next: change source in {rule.path or 'the rule'}, and its version"
                for name, shape in shapes.items()
                if sources and shape.source not in sources
            ]
    return remarks


def file_text(rule: Rule) -> str:
    """The rule as a rule file that needs no other: the file's own text, or the rule written out."""
    if rule.path is not None and rule.is_whole:
        return rule.path.read_text(encoding="utf-8")
    return expand(rule)


def deploy_all(log: Log, station: str, rules: Sequence[Rule]) -> list[Rule]:
    """Record the rules as deployed now, where they are new; those that were new."""
    return deploy(log, station, rules, {rule.rule: file_text(rule) for rule in rules}, utc_now())


def processor_part(log: Log, station: str, path: Path) -> Part:
    """The rules of a file or folder, deployed and run as a supervised part."""
    rules = load_all([path])
    for remark in misplaced(log, rules):
        logger.warning("rule may find nothing", remark=remark)
    processor = Processor(log, station, rules, now=utc_now)
    deploy_all(log, station, rules)  # only once it is known that they fit
    told: set[str] = set()

    def step() -> None:
        processor.step(_STEP_SECONDS)
        for name, failure in processor.failures.items():
            if name not in told:
                told.add(name)
                logger.error("rule set aside", rule=name, error=str(failure))

    return stepping("rules", step, log, processor.close)
