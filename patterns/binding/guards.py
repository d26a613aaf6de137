"""Match-dependent expressions over single values: conditions on what a match has seen so far.

An expression becomes a closure over two sequences: `row`, the values of
columns at the row at hand, and `registers`, what the match remembers. It must
agree with `patterns.binding.columns`, value by value.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from patterns.binding.expressions import (
    Call,
    Const,
    Crosses,
    Expr,
    InZone,
    MatchNumber,
    OneOf,
    OnGround,
    Reference,
    Value,
)
from patterns.binding.registers import UNSET, at_offset, wrapped
from patterns.scene.places import Places, of_source

Guard = Callable[[Sequence[Any], Sequence[Any]], Any]
"""(values of the row at hand, registers) -> the value; None is NULL."""


def compile_guard(expr: Expr, slots: dict[Expr, int], registers: dict[Expr, int], places: Places) -> Guard:
    """The expression as a closure; the match's number, where it asks for it, comes after the registers.

    Args:
        expr: Its row-local and remembered parts must all be in `slots` or `registers`.
        slots: Where in the row's values each row-local part stands.
        registers: Which register holds each remembered part.
        places: The zones and lines.
    """
    if expr in registers:
        how, offset = (expr.which, expr.offset) if isinstance(expr, Reference) else ("", 0)
        return register(how, offset, registers[expr])
    if expr in slots:
        return _slot(slots[expr])
    if isinstance(expr, Const):
        return constant(expr.value)
    if isinstance(expr, MatchNumber):
        return lambda row, registers: registers[-1]
    below = [compile_guard(part, slots, registers, places) for part in _operands(expr)]
    if isinstance(expr, InZone):
        return _in_zone(expr, below, places)
    if isinstance(expr, Crosses):
        return _crosses(expr, below, places)
    if isinstance(expr, OnGround):
        return _on_ground(expr, below, places)
    if isinstance(expr, OneOf):
        return _strict(expr.values.__contains__, below)
    assert isinstance(expr, Call), f"nothing holds {expr}"
    if expr.op in _LENIENT:
        return _LENIENT[expr.op](below)
    return _strict(_OPERATORS[expr.op], below)


def _operands(expr: Expr) -> tuple[Expr, ...]:
    assert isinstance(expr, Call | InZone | Crosses | OnGround | OneOf), f"nothing holds {expr}"
    return expr.operands


def register(how: str, offset: int, index: int) -> Guard:
    """What a match remembers; NULL where nothing was written to it yet."""
    if offset:
        at = at_offset(how, offset)
        return lambda row, registers: at(registers[index])

    def read(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        value = registers[index]
        return None if value is UNSET else value

    return read


def _slot(index: int) -> Guard:
    return lambda row, registers: row[index]


def constant(value: Any) -> Guard:
    """The same value whatever the row."""
    return lambda row, registers: value


def _strict(operator: Callable[..., Any], below: list[Guard]) -> Guard:
    if len(below) == 2:
        first, second = below

        def binary(row: Sequence[Any], registers: Sequence[Any]) -> Any:
            left = first(row, registers)
            if left is None:
                return None
            right = second(row, registers)
            return None if right is None else operator(left, right)

        return binary

    def call(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        values = [part(row, registers) for part in below]
        return None if None in values else operator(*values)

    return call


def every(below: list[Guard]) -> Guard:
    """AND with SQL's three values."""
    if len(below) == 1:
        return below[0]

    def is_every(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        result: bool | None = True
        for part in below:
            value = part(row, registers)
            if value is False:
                return False
            if value is None:
                result = None
        return result

    return is_every


def some(below: list[Guard]) -> Guard:
    """OR with SQL's three values."""

    def is_some(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        result: bool | None = False
        for part in below:
            value = part(row, registers)
            if value is True:
                return True
            if value is None:
                result = None
        return result

    return is_some


def is_null(operand: Guard) -> Guard:
    """IS NULL, which is itself never NULL."""
    return lambda row, registers: operand(row, registers) is None


def _coalesce(below: list[Guard]) -> Guard:
    def coalesce(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        values = (part(row, registers) for part in below)
        return next((value for value in values if value is not None), None)

    return coalesce


def _case(below: list[Guard]) -> Guard:
    branches = list(zip(below[:-1:2], below[1:-1:2], strict=True))

    def case(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        for condition, value in branches:
            if condition(row, registers) is True:
                return value(row, registers)
        return below[-1](row, registers)

    return case


def _in_zone(expr: InZone, below: list[Guard], places: Places) -> Guard:
    def in_zone(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        source, *point = [part(row, registers) for part in below]
        zone = of_source(places.zones_named(expr.zone), source)
        if zone is None:
            return False
        if not _all_finite(point) or not places.is_known(zone):
            return None
        return bool(places.inside(zone, expr.zone, *_arrays(point))[0])

    return in_zone


def _crosses(expr: Crosses, below: list[Guard], places: Places) -> Guard:
    def crosses(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        source, *step = [part(row, registers) for part in below]
        line = of_source(places.lines_named(expr.line), source)
        if line is None:
            return False
        if not _all_finite(step) or not places.is_known(line):
            return None
        x0, y0, x1, y1 = _arrays(step)
        return bool(places.crossed(line, expr.line, (x0, y0, x1, y1), expr.direction)[0])

    return crosses


def _on_ground(expr: OnGround, below: list[Guard], places: Places) -> Guard:
    def on_ground(row: Sequence[Any], registers: Sequence[Any]) -> Any:
        source, *values = [part(row, registers) for part in below]
        if source is None or not _all_finite(values):
            return None
        answer = float(places.on_ground(source, expr.what, _arrays(values))[0])
        return answer if math.isfinite(answer) else None

    return on_ground


def _arrays(values: list[Any]) -> list[Any]:
    return [np.array([float(value)]) for value in values]


def _all_finite(values: list[Any]) -> bool:
    return all(value is not None and math.isfinite(value) for value in values)


def _add(left: Any, right: Any) -> Any:
    return wrapped(left + right) if isinstance(left, int) else left + right


def _subtract(left: Any, right: Any) -> Any:
    return wrapped(left - right) if isinstance(left, int) else left - right


def _multiply(left: Any, right: Any) -> Any:
    return wrapped(left * right) if isinstance(left, int) else left * right


def _divide(left: Any, right: Any) -> Any:
    if right == 0:
        return None
    if isinstance(left, int):
        return wrapped(abs(left) // abs(right) * (1 if (left < 0) == (right < 0) else -1))
    return left / right


def _remainder(left: int, right: int) -> int | None:
    return None if right == 0 else int(math.copysign(1, left)) * (abs(left) % abs(right))


def _scale(duration: int, factor: float) -> int | None:
    return _rounded(float(duration) * factor)


def _shrink(duration: int, divisor: float) -> int | None:
    return None if divisor == 0 else _rounded(float(duration) / divisor)


def _rounded(microseconds: float) -> int | None:
    return round(microseconds) if abs(microseconds) < 2.0**63 else None


def _negate(value: Any) -> Any:
    return wrapped(-value) if isinstance(value, int) else -value


def _absolute(value: Any) -> Any:
    return wrapped(abs(value)) if isinstance(value, int) else abs(value)


def _root(value: float) -> float | None:
    return None if value < 0 else math.sqrt(value)


def _least(*values: Any) -> Any:
    result = values[0]
    for value in values[1:]:
        result = result if result <= value else value
    return result


def _greatest(*values: Any) -> Any:
    result = values[0]
    for value in values[1:]:
        result = result if result >= value else value
    return result


_OPERATORS: dict[str, Callable[..., Any]] = {
    "+": _add, "-": _subtract, "*": _multiply, "/": _divide, "%": _remainder,
    "ratio": lambda left, right: _divide(float(left), float(right)), "scale": _scale, "shrink": _shrink,
    "float": float, "neg": _negate, "abs": _absolute, "sqrt": _root,
    "=": lambda left, right: left == right, "<>": lambda left, right: left != right,
    "<": lambda left, right: left < right, "<=": lambda left, right: left <= right,
    ">": lambda left, right: left > right, ">=": lambda left, right: left >= right,
    "timer": lambda now, due: now == due,
    "not": lambda value: not value, "least": _least, "greatest": _greatest,
}  # fmt: skip
_LENIENT: dict[str, Callable[[list[Guard]], Guard]] = {
    "and": every, "or": some, "is_null": lambda below: is_null(*below), "coalesce": _coalesce, "case": _case,
}  # fmt: skip


def constant_value(expr: Expr) -> Value:
    """The value of an expression that no row decides."""
    value: Value = compile_guard(expr, {}, {}, Places({}, {}))((), ())
    return value
