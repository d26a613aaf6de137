"""Checking a rule without running it: everything that is wrong or looks wrong, with its place."""

import re
from collections.abc import Iterator, Mapping, Sequence

import pyarrow as pa

from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Crosses, Expr, InZone, walk
from patterns.binding.strata import with_situations
from patterns.durations import UNITS_US as DURATION_UNITS
from patterns.errors import RuleError
from patterns.files.rule import Rule
from patterns.flink import check as check_flink
from patterns.flink.portable import refusals
from patterns.language.parser import parse
from patterns.language.text import did_you_mean
from patterns.linting.findings import Finding, finding_of, warning
from patterns.linting.overlaps import overlaps
from patterns.linting.pattern_findings import pattern_findings
from patterns.linting.skips import skip_findings
from patterns.scene.geometry import Zone
from patterns.scene.quantities import FACTORS
from patterns.scene.units import mismatches, units_of

_SPOKEN = {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("day", "days"), "d"),
    **dict.fromkeys(("kph", "kmh"), "km/h"),
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("pixel", "pixels"), "px"),
}
"""What people write for a unit that is written otherwise here."""
_SPECK_PX = 2
_NUMBER_AND_WORD = re.compile(r"\s*[0-9.]+\s*([a-zA-Z]+(?:/[a-zA-Z]+)?)\s*")


def lint(rules: Sequence[Rule], schemas: Mapping[str, pa.Schema]) -> list[Finding]:
    """What is wrong with the rules and what looks wrong, each by itself and beside the others."""
    findings = [*_same_names(rules)]
    bounds = []
    try:
        schemas = with_situations(schemas, rules)
    except RuleError as error:
        findings.append(finding_of(error))
    for rule in rules:
        found = check(rule, schemas)
        findings += [*(each for each in found if each not in findings), *_untested(rule)]
        if not any(each.severity == "error" for each in found):
            bounds.append(bind(rule, schemas))
    return [*findings, *_overlapping(bounds)]


def check(rule: Rule, schemas: Mapping[str, pa.Schema]) -> list[Finding]:
    """What is wrong with the rule; an error keeps it from running, and hides what could be found after it."""
    try:
        bound = bind(rule, schemas)
    except RuleError as error:
        # A slip in a unit is told too: it is often why the rest does not fit.
        return [finding_of(error), *_slips(rule)]
    return [
        *_unused(bound),
        *_slips(rule),
        *_mixed_units(rule, schemas),
        *pattern_findings(bound),
        *skip_findings(bound),
        *_hidden(bound),
        *_not_portable(rule, schemas),
    ]


# Beside other rules.


def _same_names(rules: Sequence[Rule]) -> list[Finding]:
    first: dict[str, Rule] = {}
    findings = []
    for rule in rules:
        other = first.setdefault(rule.rule, rule)
        if other is not rule:
            message = f"the rule {rule.rule!r} is also defined in {other.path}. Next: rename one"
            findings.append(Finding("error", message, rule.passage("rule").place(0), "same-name"))
    return findings


def _untested(rule: Rule) -> list[Finding]:
    if rule.tests:
        return []
    message = "the rule has no tests. Next: add `tests:` with rows, and the situations wanted of them"
    return [Finding("warning", message, rule.passage("rule").place(0), "no-tests")]


def _overlapping(bounds: Sequence[BoundRule]) -> list[Finding]:
    findings = []
    for each in overlaps(bounds):
        narrow, wide = each.narrow.rule, each.wide.rule
        what = "the same rows as" if each.relation == "same" else "only rows that are also taken by"
        message = f"{narrow.rule} takes {what} {wide.rule}. Next: drop one, or let their conditions differ"
        place = narrow.passage("match").place(parse(narrow.passage("match")).clause.pattern_at)
        findings.append(Finding("warning", message, place, "overlap"))
    return findings


# Each rule by itself.


def _unused(bound: BoundRule) -> list[Finding]:
    """Zones, lines and parameters that the SQL never names."""
    rule = bound.rule
    used: set[str] = set()
    for expr in _expressions(bound):
        for part in walk(expr):
            if isinstance(part, InZone):
                used.add(part.zone)
            elif isinstance(part, Crosses):
                used.add(part.line)
    findings = []
    for kind, field, names in (("zone", "zones", rule.zones), ("line", "lines", rule.lines)):
        findings += [
            warning(rule, f"{kind} {name!r} is never used. Next: take it out", f"unused-{field[:-1]}", field, name)
            for name in names
            if name not in used
        ]
    findings += [
        warning(rule, f"shared {name!r} is never used. Next: take it out", "unused-shared", "shared", index)
        for index, name in enumerate(rule.shared)
        if name not in used
    ]
    query = parse(rule.passage("match"))
    text = query.passage.text
    findings += [
        warning(rule, f"parameter {name!r} is never used. Next: take it out", "unused-parameter", "params", name)
        for name in rule.params if f":{name}" not in text
    ]  # fmt: skip
    return findings


def _slips(rule: Rule) -> list[Finding]:
    """Texts that look like a number with a unit, and are none; shares of the picture that are said to be pixels."""
    findings = list(_specks(rule))
    for name, value in rule.params.items():
        written = _NUMBER_AND_WORD.fullmatch(value) if isinstance(value, str) else None
        if written is None:
            continue
        spoken = _SPOKEN.get(written[1].lower(), written[1])
        like = did_you_mean(spoken, (*DURATION_UNITS, *FACTORS))
        if like:
            message = f"parameter {name!r} is the text {value!r}, no duration, length or speed{like}"
            findings.append(warning(rule, message, "unit", "params", name))
    return findings


def _specks(rule: Rule) -> Iterator[Finding]:
    """Zones and lines in pixels that lie in the picture's first two: their coordinates are shares."""
    for kind, shapes in (("zone", rule.zones), ("line", rule.lines)):
        for name, shape in shapes.items():
            points = shape.polygon if isinstance(shape, Zone) else shape.points
            if shape.units == "pixels" and all(-_SPECK_PX <= value <= _SPECK_PX for point in points for value in point):
                message = (
                    f"{kind} {name!r} is smaller than {_SPECK_PX} pixels. Next: leave `units: pixels` out, if its "
                    "coordinates are shares of the picture, 0 to 1"
                )
                yield warning(rule, message, "unit", f"{kind}s", name)


def _mixed_units(rule: Rule, schemas: Mapping[str, pa.Schema]) -> list[Finding]:
    """Comparisons, sums and differences of values with different units."""
    passage = rule.passage("match")
    query = parse(passage)
    # Where a column may be computed, or come from several types, its unit is not known here.
    is_plain = len(query.arms) == 1 and query.arms[0].situation_of is None and not query.arms[0].items
    known = units_of(schemas[query.arms[0].source_type.name]) if is_plain else {}
    scalars = [each.value for each in (*query.clause.measures, *query.clause.defines)]
    scalars += [arm.where for arm in query.arms if arm.where is not None]
    findings = []
    for scalar in scalars:
        for node, one, other in mismatches(scalar.node, known, rule.params):
            at = min((part.meta["start"] for part in node.walk() if "start" in part.meta), default=scalar.at)
            message = f"{one} and {other} do not go together. Next: give the parameter the unit that is meant"
            findings.append(Finding("error", message, passage.place(at), "unit"))
    return findings


def _not_portable(rule: Rule, schemas: Mapping[str, pa.Schema]) -> list[Finding]:
    """What a rule that claims to be portable says that Flink SQL cannot, or understands in another way."""
    if rule.profile != "portable":
        return []
    refused = refusals(rule, parse(rule.passage("match")))
    if refused:
        return [Finding("error", each.message, each.place, "portable") for each in refused]
    try:
        check_flink(rule, schemas)
    except RuleError as error:
        return [finding_of(error)]
    return []


def _hidden(bound: BoundRule) -> list[Finding]:
    """Measures named like a partition column, which nobody who asks for that name sees then."""
    passage = bound.rule.passage("match")
    keys = {name.casefold() for name in bound.keys}
    return [
        Finding(
            "warning",
            f"the measure {each.name.name!r} has the name of a partition column, which titles, tests and rules over "
            "its situations cannot ask for then. Next: leave it out (every situation has its partition) or rename it",
            passage.place(each.name.at),
            "same-column",
        )
        for each in parse(passage).clause.measures
        if each.name.name.casefold() in keys
    ]


def _expressions(bound: BoundRule) -> tuple[Expr, ...]:
    guards = tuple(each.guard for each in bound.conditions if each.guard is not None)
    read = [expr for each in bound.inputs for expr in (*each.projected.values(), each.where) if expr is not None]
    return (*bound.predicates, *bound.slots, *guards, *read, *(measure.value for measure in bound.measures))
