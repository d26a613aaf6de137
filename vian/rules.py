"""Rules from files into service."""

from collections.abc import Sequence
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Literal

from patterns.binding.binder import bind
from patterns.binding.strata import with_situations
from patterns.errors import RuleError
from patterns.files.expanding import expand
from patterns.files.loading import load_rule, load_rules, rule_files, yaml_files
from patterns.files.rule import Rule
from patterns.language.parser import parse
from patterns.limits import Limits
from patterns.processor import OpenMatches, ProcessorLimits, deploy, readable_by, rules_in_service, schemas
from patterns.tools.cases import run_tests
from store import Log
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.settings import Settings
from vian.zoning import undefined


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


def files_of(paths: Sequence[Path], *, with_stages: bool = False) -> list[Path]:
    """The rule files of files and folders, in order, each once; those of stages too, where they are wanted.

    Raises:
        WrongUsage: There are none, or a folder cannot be read.
    """
    try:
        files_in = yaml_files if with_stages else rule_files
        files = list(dict.fromkeys(file for path in paths for file in files_in(path)))
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


def doubts(log: Log, rules: Sequence[Rule]) -> list[str]:
    """What speaks against putting the rules into service, though they fit: places without events, failing tests."""
    return misplaced(log, rules) + _failing(log, rules)


def _failing(log: Log, rules: Sequence[Rule]) -> list[str]:
    """A remark for each rule whose own tests do not pass."""
    remarks = []
    others = [*rules_in_service(log), *rules]
    for rule in rules:
        known = readable_by(log, rule, others)
        try:
            failed = [result.name for result in run_tests(rule, known) if not result.passed]
        except RuleError as error:
            remarks.append(f"{rule.rule}: its own tests do not run: {error}")
            continue
        if failed:
            remarks.append(
                f"{rule.rule}: {len(failed)} of its own {len(rule.tests)} tests fail: {', '.join(failed)}. "
                f"Next: vian rules test {rule.path or 'FILE'}"
            )
    return remarks


def misplaced(log: Log, rules: Sequence[Rule]) -> list[str]:
    """A remark for each zone and line of a source without events in the log, and each shared one not drawn."""
    heads = log.streams()
    remarks = [f"{rule.rule}: {each}" for rule in rules if rule.shared for each in undefined(log, rule.shared)]
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


def deploy_all(
    log: Log,
    station: str,
    rules: Sequence[Rule],
    *,
    after: int | Literal["default", "head"] = "default",
    open_matches: OpenMatches = "finished",
    is_shadow: bool | None = None,
) -> list[Rule]:
    """Record the rules as deployed now, where that changes anything; those for which it did. See `deploy`."""
    texts = {rule.rule: file_text(rule) for rule in rules}
    now = utc_now()
    return deploy(log, station, rules, texts, now, after=after, open_matches=open_matches, is_shadow=is_shadow)


def check_fit(log: Log, rules: Sequence[Rule]) -> None:
    """Nothing, if the rules fit the log's event types.

    Raises:
        RuleError: One does not.
    """
    known = with_situations(schemas(log.catalogue), rules)
    for rule in rules:
        bind(rule, known)


def limits_of(settings: Settings) -> ProcessorLimits:
    """The processor's limits, as the settings say them."""
    return ProcessorLimits(
        save_every_s=settings.rules_save_s,
        save_every_events=settings.rules_save_events,
        ahead=timedelta(seconds=settings.rules_ahead_s) if settings.rules_ahead_s else None,
        event_us=settings.rules_event_us or None,
        slow_windows=settings.rules_slow_windows,
        finish=timedelta(hours=settings.rules_finish_h),
        rules=Limits(
            threads=settings.rules_partial_matches_max,
            partitions=settings.rules_partitions_max,
            expiry=timedelta(hours=settings.rules_expiry_h) if settings.rules_expiry_h else None,
        ),
    )
