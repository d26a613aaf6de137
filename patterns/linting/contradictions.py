"""Conditions that no row can meet: found without rows, by what their parts say of the same value.

Sound, not complete: what is named can never be true; what is not named may still be.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import COMPARISONS, Call, Column, Expr, Kind, Reference, conjuncts, is_constant
from patterns.binding.guards import constant_value

_TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "=": "=", "<>": "<>"}


@dataclass(slots=True)
class _Range:
    """What comparisons leave of one value: bounds, with whether they are strict, and what it must or must not equal."""

    low: Any = None
    low_is_strict: bool = False
    high: Any = None
    high_is_strict: bool = False
    equal: Any = None
    unequal: set[Any] = field(default_factory=set)

    def narrow(self, op: str, value: Any) -> bool:
        """Takes in one comparison; whether any value is left."""
        if op == "=" and self.equal is not None and self.equal != value:
            return False
        if op == "=":
            self.equal = value
        elif op == "<>":
            self.unequal.add(value)
        elif op in (">", ">="):
            self._raise(value, op == ">")
        else:
            self._lower(value, op == "<")
        return self._is_possible()

    def _raise(self, value: Any, is_strict: bool) -> None:
        if self.low is None or (value, is_strict) > (self.low, self.low_is_strict):
            self.low, self.low_is_strict = value, is_strict

    def _lower(self, value: Any, is_strict: bool) -> None:
        if self.high is None or (value, not is_strict) < (self.high, not self.high_is_strict):
            self.high, self.high_is_strict = value, is_strict

    def _is_possible(self) -> bool:
        if self.equal is not None:
            too_low = self.low is not None and (
                self.equal < self.low or (self.low_is_strict and self.equal == self.low)
            )
            too_high = self.high is not None and (
                self.equal > self.high or (self.high_is_strict and self.equal == self.high)
            )
            return not (too_low or too_high or self.equal in self.unequal)
        if self.low is None or self.high is None:
            return True
        return bool(self.low < self.high or (self.low == self.high and not (self.low_is_strict or self.high_is_strict)))


def never_true(bound: BoundRule, variable: int) -> str:
    """Why the variable's condition can never be true; empty if nothing says so."""
    condition = bound.conditions[variable]
    parts = [bound.predicates[index] for index in condition.predicates]
    parts += conjuncts(condition.guard) if condition.guard is not None else ()
    return contradiction(parts) or _outside_within(bound, parts)


def contradiction(parts: Sequence[Expr]) -> str:
    """Why the parts can never be true together; empty if nothing says so."""
    ranges: dict[tuple[Expr, ...], _Range] = {}
    seen = set(parts)
    for part in parts:
        if isinstance(part, Call) and part.op == "not" and part.operands[0] in seen:
            return "a condition and its opposite are wanted together"
        if is_constant(part) and constant_value(part) is not True:
            return "a part of it is never true by itself"
        for subject, op, value in _comparisons(part):
            if value is None:
                return "it compares with NULL, which is never true; write IS NULL"
            if not ranges.setdefault(subject, _Range()).narrow(op, value):
                return "its comparisons contradict each other"
    return ""


def _comparisons(part: Expr) -> Iterator[tuple[tuple[Expr, ...], str, Any]]:
    """What a comparison says: of which value, the operator, and the constant; of two values, of their difference."""
    if not isinstance(part, Call) or part.op not in COMPARISONS:
        return
    left, right = part.operands
    if is_constant(left) and is_constant(right):
        return
    if is_constant(right):
        yield (left,), part.op, constant_value(right)
    elif is_constant(left):
        yield (right,), _TURNED[part.op], constant_value(left)
    else:
        yield (left, right), part.op, 0
        yield (right, left), _TURNED[part.op], 0


def _outside_within(bound: BoundRule, parts: Sequence[Expr]) -> str:
    """Why a condition wants more time since an earlier row than WITHIN gives a whole match."""
    if bound.within_us is None:
        return ""
    for part in parts:
        waited = _waited_us(part)
        if waited is not None and waited >= bound.within_us:
            return "it waits for as long as WITHIN or longer, and WITHIN is exclusive; lengthen WITHIN"
    return ""


def _waited_us(part: Expr) -> int | None:
    """How long after a row of the match the row at hand must come at least: `v.time >= w.time + d`."""
    if not isinstance(part, Call) or part.op not in (">=", ">"):
        return None
    left, right = part.operands
    if _is_time(left) and isinstance(right, Reference) and isinstance(right.operand, Call) and right.operand.op == "+":
        time, duration = right.operand.operands
        if _is_time(time) and duration.kind is Kind.DURATION and is_constant(duration):
            return _whole(constant_value(duration))
    if isinstance(left, Call) and left.op == "-" and is_constant(right) and right.kind is Kind.DURATION:
        now, then = left.operands
        if _is_time(now) and isinstance(then, Reference) and _is_time(then.operand):
            return _whole(constant_value(right))
    return None


def _is_time(expr: Expr) -> bool:
    return isinstance(expr, Column) and expr.name == "time"


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) else None
