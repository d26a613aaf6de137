"""Numbers and intervals as SQL writes them, as constants."""

from fractions import Fraction

from patterns.binding.expressions import Const, Kind
from patterns.binding.typing_rules import TypeMismatch

UNITS_US = {
    "MICROSECOND": 1, "MILLISECOND": 1_000, "SECOND": 1_000_000, "MINUTE": 60_000_000,
    "HOUR": 3_600_000_000, "DAY": 86_400_000_000,
}  # fmt: skip
VARIABLE_UNITS = ("MONTH", "YEAR", "QUARTER", "WEEK")


def number(text: str) -> Const:
    """The constant that a numeric literal writes.

    Raises:
        TypeMismatch: Not a number, or an integer beyond 64 bits.
    """
    if not text.isdigit():
        try:
            return Const(float(text), Kind.FLOAT)
        except ValueError:
            raise TypeMismatch(f"not a number: {text}") from None
    if int(text) >= 2**63:
        raise TypeMismatch(f"an integer is below 2^63, got {text}")
    return Const(int(text), Kind.INT)


def interval(length: str, unit: str) -> Const:
    """The duration of `INTERVAL 'length' unit`; `unit` in upper case, singular.

    Raises:
        TypeMismatch: Not a number, an unknown unit, or not a whole number of microseconds.
    """
    if unit not in UNITS_US:
        raise TypeMismatch(f"unknown unit {unit}; there are: {', '.join(UNITS_US)}")
    try:
        microseconds = Fraction(length) * UNITS_US[unit]
    except (ValueError, ZeroDivisionError):
        raise TypeMismatch(f"an interval is a number, got {length!r}") from None
    if microseconds.denominator != 1 or abs(microseconds) >= 2**63:
        raise TypeMismatch("an interval is a whole number of microseconds, of at most 64 bits")
    return Const(int(microseconds), Kind.DURATION)
