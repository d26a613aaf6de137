"""TIMER in Flink: a second source, shifted by the duration, whose rows only their own match sees.

Flink has no clock in a pattern. Each event that may be what the timer counts from comes once more, that much
later, as a virtual row: after real rows of its time, with the setter's stream and sequence, and NULL for what
an event says. A match takes the virtual row that its own row has set; all others are taken by elements put
between those of the pattern, or by loops, so that they stand between no two rows that follow each other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Call, Column, Const, Expr, Kind, Reference, conjuncts
from patterns.binding.guards import constant_value
from patterns.flink.elements import Element, Elements
from patterns.flink.refusing import Refuse

TIMER = "timer"
"""The column that tells virtual rows (1) from events (0)."""

_IS_VIRTUAL = Call("=", (Column(TIMER, Kind.INT), Const(1, Kind.INT)), Kind.BOOL)
_IS_REAL = Call("=", (Column(TIMER, Kind.INT), Const(0, Kind.INT)), Kind.BOOL)


@dataclass(frozen=True, slots=True)
class Timer:
    """A rule's only TIMER.

    Attributes:
        setter: The variable that it counts from.
        taker: The variable that has it.
        duration_us: How long it counts, in microseconds.
    """

    setter: str
    taker: str
    duration_us: int


@dataclass(frozen=True, slots=True)
class Timed:
    """A pattern in which virtual rows that are not the match's own are passed over.

    Attributes:
        elements: With elements for what is passed over.
        conditions: Of these.
        loops: Variables that pass over virtual rows themselves.
    """

    elements: Elements
    conditions: Mapping[str, Sequence[Expr]]
    loops: frozenset[str]


def timer_of(bound: BoundRule, at: int, refuse: Refuse) -> Timer | None:
    """The rule's TIMER, if it has one.

    Raises:
        RuleError: It has several.
    """
    found = [
        Timer(_only(due), bound.variables[index], _duration_us(due))
        for index, condition in enumerate(bound.conditions)
        for part in (() if condition.guard is None else conjuncts(condition.guard))
        if isinstance(part, Call) and part.op == TIMER and isinstance(due := part.operands[1], Reference)
    ]
    if len(found) > 1:
        refuse("several timers", at)
    return found[0] if found else None


def timed(
    elements: Elements, conditions: Mapping[str, Sequence[Expr]], timer: Timer, place: Sequence[str], refuse: Refuse
) -> Timed:
    """The pattern as it goes over real and virtual rows.

    Args:
        elements: The pattern.
        conditions: For each variable the conditions that must all hold, TIMER among them.
        timer: Its timer.
        place: The columns that name the event that set a virtual row.
        refuse: Raises.
    """
    is_own, is_other = _own(timer, place)
    setter_at = elements.index(timer.setter)
    parts: list[Element] = []
    passed: dict[str, Sequence[Expr]] = {}
    loops: set[str] = set()
    for at, part in enumerate(elements.parts):
        is_set = at > setter_at
        over = (_IS_VIRTUAL, is_other) if is_set else (_IS_VIRTUAL,)
        real = [each for each in conditions[part.variable] if not (isinstance(each, Call) and each.op == TIMER)]
        if at and all(each.least == 0 for each in elements.parts[:at]):
            refuse("optional first variable beside a TIMER", part.at)
        if part.variable in (timer.setter, timer.taker) and (part.least, part.most) != (1, 1):
            refuse("TIMER from or in a loop", part.at)
        if (part.is_fixed and part.least == 1) or (part.least, part.most) == (0, 1):
            if at and parts[-1].variable not in loops:
                name = f"passed_{at}"
                parts.append(Element(name, 0, None, True, part.at))
                passed[name] = over
            own = [_IS_VIRTUAL, is_own] if part.variable == timer.taker else [_IS_REAL]
            passed[part.variable] = [*own, *real]
        elif (part.least, part.most) == (0, None) and at and parts[-1].variable not in loops:
            loops.add(part.variable)
            passed[part.variable] = [_either(_all([_IS_REAL, *real]), _all(over))]
        else:
            refuse("counted loop beside a TIMER", part.at)
        parts.append(part)
    return Timed(Elements(tuple(parts)), passed, frozenset(loops))


def moved_by(timer: Timer) -> str:
    """What the table of virtual rows is called, behind its type."""
    return f"_in_{timer.duration_us // 1000}_ms"


def _own(timer: Timer, place: Sequence[str]) -> tuple[Expr, Expr]:
    """Whether a virtual row was set by the match's own row, and whether by another."""
    kinds = {"sequence": Kind.INT}
    columns = [Column(name, kinds.get(name, Kind.STRING)) for name in place]
    setters = [Reference((timer.setter,), "last", column) for column in columns]
    pairs = list(zip(columns, setters, strict=True))
    same = [Call("=", pair, Kind.BOOL) for pair in pairs]
    other: list[Expr] = [Call("<>", pair, Kind.BOOL) for pair in pairs]
    return _all(same), other[0] if len(other) == 1 else Call("or", tuple(other), Kind.BOOL)


def _all(parts: Sequence[Expr]) -> Expr:
    return parts[0] if len(parts) == 1 else Call("and", tuple(parts), Kind.BOOL)


def _either(one: Expr, other: Expr) -> Expr:
    return Call("or", (one, other), Kind.BOOL)


def _only(due: Reference) -> str:
    assert due.variables is not None, "a timer counts from a variable's row"
    return due.variables[0]


def _duration_us(due: Reference) -> int:
    assert isinstance(due.operand, Call), "a timer counts from a time"
    (duration,) = (part for part in due.operand.operands if part.kind is Kind.DURATION)
    value = constant_value(duration)
    assert isinstance(value, int), "a duration is whole microseconds"
    return value
