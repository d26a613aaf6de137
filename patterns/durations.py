"""Durations as rule files write them: `10 s`, `500 ms`, `2 min`, `1 h`, `1 d`.

Inside the package a duration is a whole number of microseconds.
"""

import re
from datetime import timedelta
from fractions import Fraction

MICROSECOND = timedelta(microseconds=1)
UNITS_US = {"us": 1, "ms": 1_000, "s": 1_000_000, "min": 60_000_000, "h": 3_600_000_000, "d": 86_400_000_000}
_WRITTEN = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([a-z]+)\s*")


def parse_duration(text: str) -> timedelta:
    """The duration that the text writes.

    >>> parse_duration("1.5 min")
    datetime.timedelta(seconds=90)

    Raises:
        ValueError: Not a number and one of the units, or finer than a microsecond.
    """
    written = _WRITTEN.fullmatch(text)
    if written is None or written[2] not in UNITS_US:
        raise ValueError(f"a duration is a number and one of {', '.join(UNITS_US)}, as in '10 s'; got {text!r}")
    microseconds = Fraction(written[1]) * UNITS_US[written[2]]
    if microseconds.denominator != 1:
        raise ValueError(f"a duration is a whole number of microseconds; got {text!r}")
    try:
        return timedelta(microseconds=int(microseconds))
    except OverflowError:
        raise ValueError(f"a duration is at most 999999999 d; got {text!r}") from None


def is_duration(text: str) -> bool:
    """Whether the text writes a duration."""
    try:
        parse_duration(text)
    except ValueError:
        return False
    return True


def microseconds(duration: timedelta) -> int:
    """The duration in microseconds."""
    return duration // MICROSECOND
