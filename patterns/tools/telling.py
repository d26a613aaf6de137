"""Expressions and values as people read them: conditions as SQL, times and durations with units.

Parameters appear as their values, and a column of the row at hand under the name of the variable that
the row was tried as, so that a condition can be read without the rule beside it.
"""

from datetime import datetime
from typing import Any

from patterns.binding.expressions import (
    COMPARISONS,
    Call,
    Column,
    Const,
    Crosses,
    Expr,
    InZone,
    Kind,
    OneOf,
    OnGround,
    Reference,
    Shift,
    operands,
)
from patterns.engine.situations import nearest_time

_INFIX = {**{op: f" {op} " for op in (*COMPARISONS, "+", "-", "*", "/", "%")}, "and": " AND ", "or": " OR "}
_INFIX |= {"ratio": " / ", "scale": " * ", "shrink": " / "}
_VALUES_SHOWN = 4
_LOOSENESS = {"or": 6, "and": 5, "not": 4, **dict.fromkeys(COMPARISONS, 3), "is_null": 3, "+": 2, "-": 2}


def told(expr: Expr, variable: str) -> str:
    """The expression as SQL, for a row that is tried as the variable."""
    if isinstance(expr, Const):
        return told_value(expr.value, expr.kind)
    if isinstance(expr, Column):
        return f"{variable}.{expr.name}" if variable else expr.name
    if isinstance(expr, Shift):
        return _told_shift(expr, variable)
    if isinstance(expr, Reference):
        return _told_reference(expr)
    if isinstance(expr, InZone):
        return f"in_zone({_listed(expr.operands[1:], variable)}, '{expr.zone}')"
    if isinstance(expr, Crosses):
        return f"crosses({_listed(expr.operands[1:], variable)}, '{expr.line}', '{expr.direction}')"
    if isinstance(expr, OnGround):
        return f"ground_{expr.what}({_listed(expr.operands[1:], variable)})"
    if isinstance(expr, OneOf):
        return f"{told(expr.operands[0], variable)} IN {_told_values(expr)}"
    if isinstance(expr, Call):
        return _told_call(expr, variable)
    return _told_other(expr, variable)


def told_value(value: Any, kind: Kind) -> str:
    """The value as people read it: times in UTC, durations in seconds, texts in quotes."""
    if value is None:
        return "NULL"
    if kind is Kind.TIME:
        return told_time(nearest_time(value))
    if kind is Kind.DURATION:
        return told_duration(value)
    if kind is Kind.STRING:
        return "'" + str(value).replace("'", "''") + "'"
    if isinstance(value, bool):
        return "true" if value else "false"
    return told_number(value)


def told_time(time: datetime) -> str:
    """The time in UTC with as many digits as it has.

    >>> from datetime import UTC
    >>> told_time(datetime(2026, 1, 1, 10, 0, 9, 200_000, tzinfo=UTC))
    '2026-01-01T10:00:09.2Z'
    """
    text = time.isoformat().removesuffix("+00:00")
    return f"{text.rstrip('0') if '.' in text else text}Z"


def told_number(value: float) -> str:
    """The number with as many digits as are worth reading.

    >>> told_number(12.300000190734863), told_number(1234567)
    ('12.3', '1234567')
    """
    return str(value) if isinstance(value, int) else f"{value:.7g}"


def told_duration(microseconds: float) -> str:
    """The duration in seconds, or in the larger unit that it is a whole number of.

    >>> told_duration(8_400_000), told_duration(120_000_000), told_duration(-1_500_000)
    ('8.4 s', '2 min', '-1.5 s')
    """
    for unit, size in (("d", 86_400_000_000), ("h", 3_600_000_000), ("min", 60_000_000)):
        if microseconds and microseconds % size == 0:
            return f"{microseconds // size:g} {unit}"
    return f"{round(microseconds / 1e6, 6):.10g} s"


def _told_shift(expr: Shift, variable: str) -> str:
    offset = abs(expr.rows)
    name = "PREV" if expr.rows >= 0 else "NEXT"
    return f"{name}({told(expr.operand, variable)}{'' if offset == 1 else f', {offset}'})"


def _told_reference(expr: Reference) -> str:
    """`entry.time + 10 s` where one value of one row is meant as the bare column would mean it."""
    names = expr.variables or ("",)
    inner = told(expr.operand, names[0] if len(names) == 1 else "|".join(names))
    if expr.which == "last" and not expr.offset:
        return inner
    return f"{expr.which.upper()}({inner}{f', {expr.offset}' if expr.offset else ''})"


def _told_call(expr: Call, variable: str) -> str:
    looseness = _LOOSENESS.get(expr.op, 1)
    parts = [_bracketed(part, variable, looseness) for part in expr.operands]
    if expr.op in _INFIX and len(parts) > 1:
        return _INFIX[expr.op].join(parts)
    if expr.op == "not":
        return f"NOT {parts[0]}"
    if expr.op == "timer":
        return f"TIMER({told(expr.operands[1], variable).replace(' + ', ', ')})"
    if expr.op == "neg":
        return f"-{parts[0]}"
    if expr.op == "is_null":
        return f"{parts[0]} IS NULL"
    if expr.op == "float":
        return parts[0]
    return f"{expr.op.upper()}({_listed(expr.operands, variable)})"


def _bracketed(expr: Expr, variable: str, outside: int) -> str:
    text = told(expr, variable)
    is_looser = isinstance(expr, Call) and _LOOSENESS.get(expr.op, 1) > outside
    return f"({text})" if is_looser else text


def _told_values(expr: OneOf) -> str:
    """The list, its beginning only where it is long."""
    shown = sorted(expr.values, key=str)
    listed = ", ".join(told_value(value, expr.operands[0].kind) for value in shown[:_VALUES_SHOWN])
    return f"({listed}{f', ... {len(shown)} in all' if len(shown) > _VALUES_SHOWN else ''})"


def _told_other(expr: Expr, variable: str) -> str:
    """An aggregate or a function that has no sign of its own."""
    name = str(getattr(expr, "how", type(expr).__name__)).upper()
    names = getattr(expr, "variables", None)
    where = "|".join(names) if names else ""
    inner = ", ".join(told(part, where or variable) for part in operands(expr)) or (f"{where}.*" if where else "")
    return f"{ {'ROWS': 'COUNT', 'VALUES': 'COUNT'}.get(name, name) }({inner})"


def _listed(parts: tuple[Expr, ...], variable: str) -> str:
    return ", ".join(told(part, variable) for part in parts)
