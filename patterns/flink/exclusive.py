"""Whether two conditions can hold of one row: a proof of no, or nothing known."""

from collections.abc import Sequence
from dataclasses import replace

from patterns.binding.expressions import (
    COMPARISONS,
    Aggregate,
    Call,
    Const,
    Expr,
    Kind,
    OneOf,
    Reference,
    is_strict,
    walk,
)

_OPPOSITE = {"=": "=", "<>": "<>", "<": ">", "<=": ">=", ">": "<", ">=": "<="}
_ORDERINGS = {"<": {"<"}, "<=": {"<", "="}, ">": {">"}, ">=": {">", "="}, "=": {"="}, "<>": {"<", ">"}}
"""For each comparison the orders of its operands in which it holds."""


def exclude_each_other(first: Sequence[Expr], second: Sequence[Expr], variables: set[str]) -> bool:
    """Whether no row can meet all conditions of both.

    Conditions that read rows of the two `variables` are left out: the same words mean
    different rows there, with and without the row at hand.
    """
    one, other = (_all([part for part in parts if not _reads(part, variables)]) for parts in (first, second))
    return one is not None and other is not None and _contradict(one, other)


def _all(parts: Sequence[Expr]) -> Expr | None:
    """All of these together; None for nothing."""
    return Call("and", tuple(parts), Kind.BOOL) if len(parts) > 1 else next(iter(parts), None)


def _reads(expr: Expr, variables: set[str]) -> bool:
    return any(
        not variables.isdisjoint(part.variables or ())
        for part in walk(expr) if isinstance(part, Reference | Aggregate)
    )  # fmt: skip


def _contradict(one: Expr, other: Expr) -> bool:
    """Whether the two cannot both be true."""
    for left, right in ((one, other), (other, one)):
        if isinstance(left, Call):
            if left.op == "not" and _implies(right, left.operands[0]):
                return True
            if left.op == "or" and all(_contradict(choice, right) for choice in left.operands):
                return True
            if left.op == "and" and any(_contradict(part, right) for part in left.operands):
                return True
            if left.op == "is_null" and _needs(right, left.operands[0]):
                return True
        if isinstance(left, OneOf) and _misses(left, right):
            return True
    return _compares_apart(one, other)


def _implies(one: Expr, other: Expr) -> bool:
    """Whether the other is true wherever the one is."""
    if one == other:
        return True
    if isinstance(other, Call) and other.op == "or" and any(_implies(one, choice) for choice in other.operands):
        return True
    if isinstance(other, Call) and other.op == "and" and all(_implies(one, part) for part in other.operands):
        return True
    if isinstance(one, Call) and one.op == "and" and any(_implies(part, other) for part in one.operands):
        return True
    if isinstance(one, Call) and one.op == "or" and all(_implies(choice, other) for choice in one.operands):
        return True
    return _comparison_implies(one, other)


def _needs(expr: Expr, operand: Expr) -> bool:
    """Whether the expression is NULL, so not true, where the operand is NULL."""
    return is_strict(expr) and any(part == operand for part in walk(expr))


def _misses(listed: OneOf, other: Expr) -> bool:
    """Whether no value of the list meets the other condition."""
    (operand,) = listed.operands
    if isinstance(other, OneOf):
        return other.operands == listed.operands and listed.values.isdisjoint(other.values)
    compared = _against_constant(other)
    if compared is None or compared[0] != operand:
        return False
    return not any(_overlap(("=", replace(compared[2], value=value)), compared[1:]) for value in listed.values)


def _compares_apart(one: Expr, other: Expr) -> bool:
    aligned = _aligned(one, other)
    if aligned is not None:
        return not _ORDERINGS[aligned[0]] & _ORDERINGS[aligned[1]]
    first, second = _against_constant(one), _against_constant(other)
    if first is None or second is None or first[0] != second[0]:
        return False
    return not _overlap((first[1], first[2]), (second[1], second[2]))


def _comparison_implies(one: Expr, other: Expr) -> bool:
    aligned = _aligned(one, other)
    return aligned is not None and _ORDERINGS[aligned[0]] <= _ORDERINGS[aligned[1]]


def _aligned(one: Expr, other: Expr) -> tuple[str, str] | None:
    """The operators of two comparisons of the same operands in the same order."""
    if not (isinstance(one, Call) and isinstance(other, Call) and {one.op, other.op} <= COMPARISONS):
        return None
    if one.operands == other.operands:
        return one.op, other.op
    if one.operands == other.operands[::-1]:
        return one.op, _OPPOSITE[other.op]
    return None


def _against_constant(expr: Expr) -> tuple[Expr, str, Const] | None:
    """The compared operand, the operator and the constant to its right."""
    if not isinstance(expr, Call) or expr.op not in COMPARISONS:
        return None
    left, right = expr.operands
    if isinstance(right, Const) and not isinstance(left, Const):
        return left, expr.op, right
    if isinstance(left, Const) and not isinstance(right, Const):
        return right, _OPPOSITE[expr.op], left
    return None


def _overlap(first: tuple[str, Const], second: tuple[str, Const]) -> bool:
    """Whether some value meets both comparisons with constants."""
    (op, low), (other_op, high) = first, second
    if low.value is None or high.value is None:
        return False
    order = "<" if low.value < high.value else ">" if low.value > high.value else "="  # type: ignore[operator]  # one column's constants
    # x op low and x other_op high: try x below, at, between, at and above.
    places = {
        "<": (("<", "<"), ("=", "<"), (">", "<"), (">", "="), (">", ">")),
        "=": (("<", "<"), ("=", "="), (">", ">")),
        ">": (("<", "<"), ("<", "="), ("<", ">"), ("=", ">"), (">", ">")),
    }[order]
    return any(one in _ORDERINGS[op] and two in _ORDERINGS[other_op] for one, two in places)
