"""What is said where AFTER MATCH SKIP has no row to go to: clause, variable, and the match's first and last row."""

from patterns.binding.bound import BoundRule
from patterns.engine.situations import nearest_time
from patterns.errors import SkipError
from patterns.language.parser import parse
from patterns.language.syntax import Clause

_Event = tuple[int, int, int]


def rule_skip_error(bound: BoundRule, first: _Event, last: _Event, is_there: bool) -> SkipError:
    """The error of a rule whose match from the first to the last event cannot be skipped from.

    Args:
        bound: The rule.
        first: The match's first event, as the matcher knows it: stream number, sequence, time in microseconds.
        last: Its last event.
        is_there: Whether the variable has a row in the match: then it is the match's first.
    """
    clause = parse(bound.rule.passage("match")).clause
    return skip_error(clause, f"{_told(first)} to {_told(last)}", is_there)


def skip_error(clause: Clause, span: str, is_there: bool) -> SkipError:
    """The error of the match that lies between these rows."""
    assert clause.skip.variable is not None, "only a skip to a variable fails"
    name = clause.skip.variable.name
    said = f"AFTER MATCH SKIP {clause.skip.mode.value} {name}"
    if is_there:
        return SkipError(f"{said}: {name} is the first row of the match from {span}, so the search would find it for "
                         "ever. Next: skip to a variable further on, or TO NEXT ROW")  # fmt: skip
    return SkipError(f"{said}: {name} is not in the match from {span}. Next: skip to a variable that every match has, "
                     "or PAST LAST ROW")  # fmt: skip


def _told(event: _Event) -> str:
    _, sequence, time_us = event
    return f"{nearest_time(time_us).isoformat().replace('+00:00', 'Z')} (sequence {sequence})"
