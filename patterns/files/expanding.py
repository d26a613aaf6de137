"""A rule written out: its template filled in, its lists of files in place, one file that needs no other.

What comes out is a rule file that a person would have written; loaded again, it is the same rule,
with the same hash.
"""

import re
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import yaml

from patterns.durations import microseconds
from patterns.files.rule import Rule
from patterns.files.template import templates
from patterns.scene.quantities import Quantity

_KEYS = (
    "rule", "version", "title", "severity", "zones", "lines", "shared", "params", "time", "emit", "profile",
)  # fmt: skip
_WRITTEN_TIME = re.compile(r"\d{4}-\d\d-\d\dT[0-9:.]+Z")
_UNITS = (("d", 86_400_000_000), ("h", 3_600_000_000), ("min", 60_000_000), ("s", 1_000_000), ("ms", 1_000), ("us", 1))


def expand(rule: Rule) -> str:
    """The text of a rule file that says the rule without a template and without files beside it, its tests aside."""
    said = rule.model_dump(mode="python", exclude_defaults=True)
    parts = [_heading(rule)]
    keys = [*_KEYS, *sorted(set(said) - {*_KEYS, "match", "tests", "template", "given"})]
    parts += [_key(key, _plain(said[key])) for key in keys if key in said]
    parts.append("match: |\n" + "".join(f"  {line}".rstrip() + "\n" for line in rule.match.rstrip("\n").split("\n")))
    if rule.tests:
        tests = [_plain(case.model_dump(mode="python", exclude_defaults=True)) for case in rule.tests]
        parts.append(_dump({"tests": tests}, None))
    return "".join(parts)


def _heading(rule: Rule) -> str:
    template = templates().get(rule.template) if rule.template is not None else None
    if template is None:
        return ""
    about = "".join(f"# {line}".rstrip() + "\n" for line in template.about.strip().split("\n"))
    return f"# Expanded from the template {template.template}, version {template.version}.\n{about}"


def _key(key: str, value: Any) -> str:
    """One key of the file and its value; each zone, line and test on lines of its own."""
    if key in ("zones", "lines"):
        return f"{key}:\n" + "".join(f"  {name}: {_flow(shape)}\n" for name, shape in value.items())
    if isinstance(value, Mapping | list):
        return f"{key}: {_flow(value)}\n"
    return _dump({key: value}, False)


def _flow(value: Any) -> str:
    return _dump(value, True).rstrip("\n")


def _dump(value: Any, flow: bool | None) -> str:
    """YAML; `flow` None: lists and mappings of plain values on one line, others on lines of their own."""
    text: str = yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=10_000, default_flow_style=flow
    )
    return text


def value_text(value: Any) -> str:
    """The value as a rule file writes it, on one line."""
    return _flow(_plain(value))


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

    def analyze_scalar(self, scalar: str) -> Any:
        analysis = super().analyze_scalar(scalar)
        if _WRITTEN_TIME.fullmatch(scalar):
            analysis.allow_flow_plain = True  # PyYAML fears the colons of a time, which it reads all the same.
        return analysis


def _time(dumper: yaml.SafeDumper, time: datetime) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:timestamp", time.isoformat().replace("+00:00", "Z"))


_Dumper.add_representer(datetime, _time)
