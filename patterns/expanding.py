"""A rule written out: its template filled in, its lists of files in place, one file that needs no other.

What comes out is a rule file that a person would have written; loaded again, it is the same rule,
with the same hash.
"""

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import yaml

from patterns.durations import microseconds
from patterns.quantities import Quantity
from patterns.rule import Rule
from patterns.template import templates

_KEYS = (
    "rule", "version", "title", "severity", "zones", "lines", "shared", "params", "time", "emit", "profile",
)  # fmt: skip
_UNITS = (("d", 86_400_000_000), ("h", 3_600_000_000), ("min", 60_000_000), ("s", 1_000_000), ("ms", 1_000), ("us", 1))


def expand(rule: Rule) -> str:
    """The text of a rule file that says the rule without a template and without files beside it, its tests aside."""
    said = rule.model_dump(mode="python", exclude_defaults=True)
    parts = [_heading(rule)]
    keys = [*_KEYS, *sorted(set(said) - {*_KEYS, "match", "tests", "template", "given"})]
    parts += [_yaml({key: _plain(said[key])}) for key in keys if key in said]
    parts.append("match: |\n" + "".join(f"  {line}".rstrip() + "\n" for line in rule.match.rstrip("\n").split("\n")))
    if rule.tests:
        tests = [_plain(case.model_dump(mode="python", exclude_defaults=True)) for case in rule.tests]
        parts.append(_yaml({"tests": tests}))
    return "".join(parts)


def _heading(rule: Rule) -> str:
    template = templates().get(rule.template) if rule.template is not None else None
    if template is None:
        return ""
    about = "".join(f"# {line}".rstrip() + "\n" for line in template.about.strip().split("\n"))
    return f"# Expanded from the template {template.template}, version {template.version}.\n{about}"


def _yaml(value: Any) -> str:
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None)


def duration_text(duration: timedelta) -> str:
    """The duration as a rule file writes it, in the largest unit that makes it a whole number.

    >>> duration_text(timedelta(seconds=90))
    '90 s'
    """
    whole = microseconds(duration)
    unit, length = next(each for each in _UNITS if whole % each[1] == 0)
    return f"{whole // length} {unit}" if whole else "0 s"


def _plain(value: Any) -> Any:
    """The value as YAML has it."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, timedelta):
        return duration_text(value)
    return str(value) if isinstance(value, Quantity) else value


class _Dumper(yaml.SafeDumper):
    """Writes times as rule files have them, and no aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _time(dumper: yaml.SafeDumper, time: datetime) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:timestamp", time.isoformat().replace("+00:00", "Z"))


_Dumper.add_representer(datetime, _time)
