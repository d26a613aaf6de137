"""Which of DuckDB's expressions Python computes alike, so that a condition on a match need not ask for every row.

An expression is known by its node and by the types that DuckDB gives it and its operands. What is not known here, or
cannot be computed for the values at hand, DuckDB is asked. Numbers become what the result is (DOUBLE, FLOAT, a
decimal, a whole number) before they are computed with, as DuckDB does it.
"""

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from typing import Any

from sqlglot import exp

from patterns.language.navigation import function_name
from patterns.querying.values import Span

WHOLE = frozenset(("TINYINT", "SMALLINT", "INTEGER", "BIGINT", "UTINYINT", "USMALLINT", "UINTEGER", "UBIGINT",
                   "HUGEINT", "UHUGEINT"))  # fmt: skip
TIMES = ("TIMESTAMP", "TIMESTAMP WITH TIME ZONE")
_BITS = {"TINYINT": 8, "SMALLINT": 16, "INTEGER": 32, "BIGINT": 64, "HUGEINT": 128}
_WIDE = ("HUGEINT", "UHUGEINT")
_DOUBLE_WHOLE_MOST = 2**53
"""Up to this, a DOUBLE holds every whole number."""
_DIGITS_MOST = {"DOUBLE": 15, "FLOAT": 7}
"""Digits of a decimal up to which it becomes such a number by one rounding."""
_DECIMAL_DIGITS_MOST = 28
"""Digits up to which Python's decimals are exact."""
_UNITS_US = {"microsecond": 1, "millisecond": 1_000, "second": 1_000_000, "minute": 60_000_000,
             "hour": 3_600_000_000, "day": 86_400_000_000}  # fmt: skip
_SIMPLE = (exp.Neg, exp.Add, exp.Sub, exp.Mul, exp.Div, exp.IntDiv, exp.Mod, exp.Pow, exp.DPipe)
_FUNCTIONS = frozenset(("ABS", "SQRT", "POW", "POWER", "FLOOR", "CEIL", "CEILING", "EPOCH", "GREATEST", "LEAST",
                        "COALESCE", "IFNULL"))  # fmt: skip
_DIFFERENCES = ("DATE_DIFF", "DATEDIFF")
STRICT_FUNCTIONS = frozenset(("LOWER", "UPPER", "LENGTH", "FLOOR", "CEIL", "CEILING", "ROUND", "EPOCH", "EPOCH_MS",
                              "EPOCH_US", "YEAR", "MONTH", "DAY", "HOUR", "MINUTE", "SECOND"))  # fmt: skip
"""Functions that give NULL for NULL and fail for no value."""

_FLOAT = struct.Struct("f")

Operator = Callable[..., Any]


class NotAlike(Exception):
    """Python does not compute these values as DuckDB does."""


@dataclass(frozen=True, slots=True)
class Plain:
    """How Python computes an expression.

    Attributes:
        operator: From the operands' values to the expression's. Raises NotAlike, ValueError or ArithmeticError where
            only DuckDB knows.
        takes_null: Whether it is called where an operand is NULL, too.
    """

    operator: Operator
    takes_null: bool = False


def operands(node: exp.Expr) -> list[exp.Expr] | None:
    """The parts whose values decide the node's; None: nothing is known of it."""
    if isinstance(node, exp.Neg):
        return [node.this]
    if isinstance(node, _SIMPLE):
        return [node.this, node.expression]
    name = function_name(node)
    if name in _FUNCTIONS:
        return list(node.expressions)
    if name in _DIFFERENCES and len(node.expressions) == 3 and _unit(node) is not None:
        return list(node.expressions[1:])
    if isinstance(node, exp.Extract) and node.this.name.upper() == "EPOCH":
        return [node.expression]
    return [node.this] if isinstance(node, exp.Cast) and node.to.this is exp.DType.DOUBLE else None


def plain(node: exp.Expr, kinds: Sequence[str], given: str) -> Plain | None:
    """How Python computes the node; `kinds` are its operands' types, `given` is its own. None: DuckDB is asked."""
    name = function_name(node)
    if name in _DIFFERENCES:
        unit = _unit(node)
        assert unit is not None, "looked at"
        return Plain(_difference(unit)) if kinds[0] == kinds[1] and kinds[0] in TIMES else None
    if name == "EPOCH" or isinstance(node, exp.Extract):
        return {"INTERVAL": Plain(_seconds)}.get(kinds[0])
    if name in ("GREATEST", "LEAST", "COALESCE", "IFNULL"):
        return _lenient(name, kinds, given)
    if isinstance(node, exp.DPipe):
        return Plain(lambda left, right: left + right) if set(kinds) == {"VARCHAR"} else None
    return _of_times(node, kinds) or _of_numbers(node, name, kinds, given)


def number_as(kind: str, given: str) -> Operator | None:
    """How a number of this type becomes one of another, as DuckDB makes it; None: only DuckDB knows."""
    if kind == given:
        return _same
    digits = _digits(kind)
    if kind in WHOLE and given in _DIGITS_MOST:
        return _whole_as_single if given == "FLOAT" else _wide_as_double if kind in _WIDE else float
    if given in _DIGITS_MOST and digits is not None and digits <= _DIGITS_MOST[given]:
        return float if given == "DOUBLE" else _single
    if given == "DOUBLE" and kind == "FLOAT":
        return _same
    return _same if (kind in WHOLE or digits is not None) and (_digits(given) or 99) <= _DECIMAL_DIGITS_MOST else None


def common_number(kinds: Sequence[str]) -> str | None:
    """What DuckDB makes of numbers of these types before it compares them, if one of them is a binary fraction."""
    return next((each for each in ("DOUBLE", "FLOAT") if each in kinds), None)


# Numbers.


def _of_numbers(node: exp.Expr, name: str, kinds: Sequence[str], given: str) -> Plain | None:
    key = name or type(node)
    if given in WHOLE:
        exact = _EXACT.get(key) or _WHOLE.get(key)
        return Plain(_within(exact, given)) if exact and all(kind in WHOLE for kind in kinds) else None
    operator = _EXACT.get(key) or (_BINARY.get(key) if given in _DIGITS_MOST else None)
    becomes = [number_as(kind, given) for kind in kinds]
    if operator is None or None in becomes or not (given in _DIGITS_MOST or _digits(given)):
        return None
    return Plain(_converting(operator, [each for each in becomes if each], _single if given == "FLOAT" else _same))


def _within(operator: Operator, given: str) -> Operator:
    """The operator where the whole number that it gives is one of this type; else DuckDB raises, or turns it over."""
    bits = _BITS[given.removeprefix("U")]
    least, most = (0, 2**bits - 1) if given.startswith("U") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)

    def checked(*values: Any) -> Any:
        found = operator(*values)
        if found is not None and not least <= found <= most:
            raise NotAlike
        return found

    return checked


def _converting(operator: Operator, becomes: Sequence[Operator], after: Operator) -> Operator:
    if all(each is _same for each in (*becomes, after)):
        return operator
    if len(becomes) == 2:
        first, second = becomes
        return lambda left, right: _rounded(after, operator(first(left), second(right)))
    (only,) = becomes
    return lambda value: _rounded(after, operator(only(value)))


def _rounded(after: Operator, value: Any) -> Any:
    return None if value is None else after(value)


def _same(value: Any) -> Any:
    return value


def _single(value: Any) -> float:
    """The nearest number of 32 bits; one beyond them is an OverflowError."""
    (nearest,) = _FLOAT.unpack(_FLOAT.pack(value))
    return float(nearest)


def _whole_as_single(value: Any) -> float:
    """The nearest number of 32 bits; of a number that takes two roundings only DuckDB knows it."""
    if abs(value) > _DOUBLE_WHOLE_MOST:
        raise NotAlike
    return _single(value)


def _wide_as_double(value: Any) -> float:
    """The number as DuckDB makes it of one of 128 bits, from its halves."""
    if not -_DOUBLE_WHOLE_MOST <= value < 2**63:
        raise NotAlike
    return float(value)


def _digits(kind: str) -> int | None:
    """The digits of a decimal type; None: it is none."""
    return int(kind[len("DECIMAL(") :].split(",")[0]) if kind.startswith("DECIMAL(") else None


def _divide(left: Any, right: Any) -> Any:
    return None if right == 0 else left / right


def _divide_whole(left: int, right: int) -> int | None:
    if right == 0:
        return None
    found = abs(left) // abs(right)
    return found if (left < 0) == (right < 0) else -found


def _remainder_whole(left: int, right: int) -> int | None:
    if right == -1:  # DuckDB divides, and the least number has no quotient.
        raise NotAlike
    return None if right == 0 else (abs(left) % abs(right)) * (1 if left >= 0 else -1)


_EXACT: dict[str | type[exp.Expr], Operator] = {
    exp.Neg: lambda value: -value, exp.Add: lambda left, right: left + right,
    exp.Sub: lambda left, right: left - right, exp.Mul: lambda left, right: left * right, "ABS": abs,
}  # fmt: skip
"""For numbers of every kind."""
_WHOLE: dict[str | type[exp.Expr], Operator] = {
    exp.Div: _divide_whole, exp.IntDiv: _divide_whole, exp.Mod: _remainder_whole,
}  # fmt: skip
_BINARY: dict[str | type[exp.Expr], Operator] = {
    exp.Div: _divide, exp.Mod: math.fmod, exp.Pow: math.pow, "POW": math.pow, "POWER": math.pow, "SQRT": math.sqrt,
    exp.Cast: lambda value: value, "FLOOR": lambda value: float(math.floor(value)),
    "CEIL": lambda value: float(math.ceil(value)), "CEILING": lambda value: float(math.ceil(value)),
}  # fmt: skip
"""For DOUBLE and FLOAT."""


# Times.


def _of_times(node: exp.Expr, kinds: Sequence[str]) -> Plain | None:
    if isinstance(node, exp.Sub) and kinds[0] == kinds[1]:
        return {**dict.fromkeys(TIMES, Plain(_between)), "DATE": Plain(_days)}.get(kinds[0])
    if isinstance(node, exp.Add | exp.Sub) and kinds[0] in TIMES and kinds[1] == "INTERVAL":
        sign = 1 if isinstance(node, exp.Add) else -1
        return Plain(lambda time, span: time + sign * _fixed(span))
    return None


def _between(left: datetime, right: datetime) -> Span:
    return Span.between((left - right) // timedelta(microseconds=1))


def _days(left: date, right: date) -> int:
    return (left - right).days


def _fixed(span: Span) -> timedelta:
    if span.months:
        raise NotAlike
    return timedelta(days=span.days, microseconds=span.microseconds)


def _seconds(span: Span) -> float:
    if span.months:
        raise NotAlike
    return span.length_us / 1_000_000


def _unit(node: exp.Expr) -> int | None:
    """The length, in microseconds, of the unit that a difference of times is counted in."""
    unit = node.expressions[0]
    name = unit.name.lower() if isinstance(unit, exp.Literal) and unit.is_string else ""
    return _UNITS_US.get(name) or _UNITS_US.get(name.removesuffix("s"))


def _difference(unit_us: int) -> Operator:
    """How many bounds of the unit lie between two times."""

    def between(first: datetime, second: datetime) -> int:
        start, end = _since_1970_us(first), _since_1970_us(second)
        if start < 0 or end < 0:
            raise NotAlike
        return end // unit_us - start // unit_us

    return between


def _since_1970_us(time: datetime) -> int:
    return (time - datetime(1970, 1, 1, tzinfo=time.tzinfo)) // timedelta(microseconds=1)


# What is computed with NULL, too.


def _lenient(name: str, kinds: Sequence[str], given: str) -> Plain | None:
    becomes = [_same if kind in ('"NULL"', given) else number_as(kind, given) for kind in kinds]
    if None in becomes or given.startswith(("STRUCT", "MAP", "INTERVAL", "ENUM")) or given.endswith("]"):
        return None
    known = [each for each in becomes if each]

    def values(given_values: Sequence[Any]) -> list[Any]:
        return [make(value) for make, value in zip(known, given_values, strict=True) if value is not None]

    def first(*all_values: Any) -> Any:
        return next(iter(values(all_values)), None)

    def extreme(*all_values: Any) -> Any:
        there = values(all_values)
        if any(value != value for value in there):
            raise NotAlike
        choose = max if name == "GREATEST" else min
        return choose(there, default=None)

    return Plain(extreme if name in ("GREATEST", "LEAST") else first, takes_null=True)
