"""Which rule a command means: a rule file, or one that was deployed in the log."""

import re
from pathlib import Path

from events import RuleDeployed, decode, events_of
from patterns.files.loading import load_rule, parse_rule
from patterns.files.rule import Rule
from store import Log
from vian.errors import WrongUsage

_NAME = re.compile(r"(?P<name>[A-Za-z0-9._-]+?)(?:@(?P<version>[0-9]+))?")


def chosen_rule(log: Log, wanted: str) -> Rule:
    """The rule of a file, or the deployed rule of a name, `NAME` (its newest version) or `NAME@VERSION`.

    Raises:
        WrongUsage: There is no such file and no such rule.
        PatternError: The file is not a rule.
    """
    rule = rule_file(wanted)
    if rule is not None:
        return rule
    named = _NAME.fullmatch(wanted)
    versions = deployed_versions(log, named["name"]) if named else {}
    if named is None or not versions:
        raise WrongUsage(
            f"{wanted!r} is neither a rule file nor a rule deployed in this log; deployed: {_known(log)}. "
            "Next: give a rule file, or a name of these"
        )
    return _of_version(versions, named["name"], int(named["version"] or max(versions)))


def rule_file(wanted: str) -> Rule | None:
    """The rule of a file; None if what is wanted is no file's name.

    Raises:
        WrongUsage: There is no such file.
        PatternError: The file is not a rule.
    """
    path = Path(wanted)
    return _of_file(path) if path.is_file() or path.suffix in (".yaml", ".yml") else None


def other_version(log: Log, rule: Rule, wanted: str) -> Rule:
    """What a rule is compared with: a rule file, or the number of a version of it that was deployed.

    Raises:
        WrongUsage: There is no such file and no such version.
        PatternError: The file is not a rule.
    """
    if not wanted.isdecimal():
        return chosen_rule(log, wanted)
    versions = deployed_versions(log, rule.rule)
    if not versions:
        raise WrongUsage(f"no version of rule {rule.rule} is deployed in this log; deployed: {_known(log)}")
    return _of_version(versions, rule.rule, int(wanted))


def deployed_versions(log: Log, name: str) -> dict[int, str]:
    """The texts of the rule's versions that were ever deployed, by version; as deployed last."""
    return {each.rule_version: each.text for each in _deployed(log) if each.rule == name}


def _of_file(path: Path) -> Rule:
    try:
        return load_rule(path)
    except OSError as error:
        raise WrongUsage(
            f"the rule file {path} cannot be read: {error.strerror}. Next: give a rule file, or a deployed rule's name"
        ) from error


def _of_version(versions: dict[int, str], name: str, version: int) -> Rule:
    if version not in versions:
        have = ", ".join(map(str, sorted(versions)))
        raise WrongUsage(f"version {version} of rule {name} is not deployed in this log; deployed versions: {have}")
    return parse_rule(versions[version], f"{name}@{version}")


def _deployed(log: Log) -> list[RuleDeployed]:
    return [
        event
        for segment in log.read_all(types=[RuleDeployed.type_name])
        for event in events_of(decode(segment, log.catalogue))
        if isinstance(event, RuleDeployed)
    ]


def _known(log: Log) -> str:
    return ", ".join(sorted({f"{each.rule}@{each.rule_version}" for each in _deployed(log)})) or "none yet"
