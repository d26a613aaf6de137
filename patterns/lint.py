"""Checking a rule without running it: everything that is wrong or looks wrong, with its place."""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

import pyarrow as pa

from patterns.binder import bind
from patterns.bound import BoundRule
from patterns.errors import Place, RuleError
from patterns.expressions import Call, Crosses, Expr, InZone, walk
from patterns.flink import check as check_flink
from patterns.guards import constant_value
from patterns.parser import parse
from patterns.pattern_variables import pattern_variables
from patterns.portable import refusals
from patterns.rule import Rule


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong (`error`: the rule cannot run) or looks wrong (`warning`)."""

    severity: Literal["error", "warning"]
    message: str
    place: Place

    def __str__(self) -> str:
        place = self.place
        return f"{place.file}:{place.line}:{place.column}: {self.severity}: {self.message}\n{place.excerpt}"


def check(rule: Rule, schemas: Mapping[str, pa.Schema]) -> list[Finding]:
    """What is wrong with the rule; an error keeps it from running, and hides what could be found after it."""
    try:
        bound = bind(rule, schemas)
    except RuleError as error:
        return [finding_of(error)]
    return [
        *_unused(bound),
        *_undefined(bound),
        *_empty(bound),
        *_unbounded(bound),
        *_timed_out(bound),
        *_not_portable(rule, schemas),
    ]


def finding_of(error: RuleError) -> Finding:
    """The error as a finding."""
    return Finding("error", error.message, Place(error.file, error.line, error.column, error.excerpt))


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
    for field, names in (("zones", rule.zones), ("lines", rule.lines)):
        findings += [
            _warning(rule, f"{field[:-1]} {name!r} is never used", field, name) for name in names if name not in used
        ]
    query = parse(rule.passage("match"))
    text = query.passage.text
    findings += [
        _warning(rule, f"parameter {name!r} is never used", "params", name)
        for name in rule.params if f":{name}" not in text
    ]  # fmt: skip
    return findings


def _undefined(bound: BoundRule) -> list[Finding]:
    """Variables without DEFINE that may be slips of the pen: their names are like that of one that has it.

    Others are left alone: a variable that any row fits is standard SQL, and usual.
    """
    passage = bound.rule.passage("match")
    query = parse(passage)
    defined = {define.name.key: define.name.name for define in query.clause.defines}
    findings: dict[str, Finding] = {}
    for variable in pattern_variables(query.clause.pattern):
        like = get_close_matches(variable.key, defined, n=1)
        if variable.key not in defined and like:
            message = (
                f"{variable.name} has no DEFINE: it is true for every row. Next: define it, "
                f"or write {defined[like[0]]} if that is meant"
            )
            findings.setdefault(variable.key, Finding("warning", message, passage.place(variable.at)))
    return list(findings.values())


def _empty(bound: BoundRule) -> list[Finding]:
    """A pattern that no row at all matches too."""
    if not bound.tables.accepts[bound.tables.start]:
        return []
    passage = bound.rule.passage("match")
    message = (
        "PATTERN can match no row at all, and such an empty match is no situation. "
        "Next: ask for one row or more, with + for * or without ?"
    )
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at))]


def _unbounded(bound: BoundRule) -> list[Finding]:
    """Rules that may remember a partition for ever."""
    findings = []
    emit = bound.rule.emit
    if emit.once_per is not None and emit.cooldown is None:
        message = "once_per without cooldown remembers every key for good"
        findings.append(_warning(bound.rule, message, "emit", "once_per"))
    at = parse(bound.rule.passage("match")).clause.pattern_at
    place = bound.rule.passage("match").place(at)
    if bound.looks_back:
        message = "PREV looks at rows before the match, so a row of every partition is remembered for good"
        findings.append(Finding("warning", message, place))
    elif bound.within_us is None:
        message = "without WITHIN, a partial match of a partition that falls silent is remembered for good"
        findings.append(Finding("warning", message, place))
    return findings


def _timed_out(bound: BoundRule) -> list[Finding]:
    """Timers that are due only when WITHIN is over, so that no match ever sees them."""
    passage = bound.rule.passage("match")
    longest = max((_duration_of(bound, register) for register in bound.timers), default=0)
    if bound.within_us is None or longest < bound.within_us:
        return []
    message = "WITHIN is not longer than TIMER's duration, so the virtual row comes too late. Next: lengthen WITHIN"
    return [Finding("warning", message, passage.place(parse(passage).clause.pattern_at))]


def _duration_of(bound: BoundRule, register: int) -> int:
    """How long after its variable's row the timer of this register is due, in microseconds."""
    slot = bound.registers[register].slot
    assert slot is not None, "it holds a time"
    due = bound.slots[slot]
    assert isinstance(due, Call), "it is the time and a duration"
    value = constant_value(due.operands[1])
    assert isinstance(value, int), "durations are whole microseconds"
    return value


def _not_portable(rule: Rule, schemas: Mapping[str, pa.Schema]) -> list[Finding]:
    """What a rule that claims to be portable says that Flink SQL cannot, or understands in another way."""
    if rule.profile != "portable":
        return []
    refused = refusals(rule, parse(rule.passage("match")))
    if refused:
        return [Finding("error", each.message, each.place) for each in refused]
    try:
        check_flink(rule, schemas)
    except RuleError as error:
        return [finding_of(error)]
    return []


def _expressions(bound: BoundRule) -> tuple[Expr, ...]:
    guards = tuple(each.guard for each in bound.conditions if each.guard is not None)
    read = [expr for each in bound.inputs for expr in (*each.projected.values(), each.where) if expr is not None]
    return (*bound.predicates, *bound.slots, *guards, *read, *(measure.value for measure in bound.measures))


def _warning(rule: Rule, message: str, *path: str) -> Finding:
    return Finding("warning", message, rule.passage(*path).place(0))
