"""Names and constants as Flink SQL writes them."""

import math

from patterns.binding.expressions import Const, Kind

MILLISECOND_US = 1_000
_UNITS = (("DAY", 86_400_000_000), ("HOUR", 3_600_000_000), ("MINUTE", 60_000_000), ("SECOND", 1_000_000))
_DAYS_MOST = 1000
"""Flink refuses intervals with more digits of days than three (DAY_INTERVAL_TYPES precision is not supported)."""
TYPES = {
    Kind.BOOL: "BOOLEAN", Kind.INT: "BIGINT", Kind.FLOAT: "DOUBLE", Kind.STRING: "STRING",
    Kind.TIME: "TIMESTAMP_LTZ(6)", Kind.DURATION: "BIGINT", Kind.NULL: "BOOLEAN",
}  # fmt: skip
"""The Flink type of each type of the language; durations are whole microseconds."""


def quoted(name: str) -> str:
    """The name as an identifier, whatever is in it; Flink folds no case."""
    return "`" + name.replace("`", "``") + "`"


def text(value: str) -> str:
    """The text as a literal."""
    return "'" + value.replace("'", "''") + "'"


def number(value: float) -> str:
    """The number as a literal of type DOUBLE that is exactly this value.

    Raises:
        ValueError: It is not finite.
    """
    if not math.isfinite(value):
        raise ValueError(f"SQL has no literal for {value}")
    written = repr(float(value))
    return written.upper() if "e" in written else f"{written}E0"


def constant(const: Const) -> str:
    """The constant as a literal; a duration is its number of microseconds."""
    value = const.value
    if value is None:
        return f"CAST(NULL AS {TYPES[const.kind]})"
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    if isinstance(value, str):
        return text(value)
    return number(value) if isinstance(value, float) else str(value)


def interval(microseconds: int) -> str | None:
    """The duration as an INTERVAL literal; None if it is no whole number of milliseconds, below zero, or too long.

    Flink's intervals have milliseconds, and times to which they are added keep their microseconds.
    """
    if microseconds < 0 or microseconds % MILLISECOND_US or microseconds >= _DAYS_MOST * _UNITS[0][1]:
        return None
    for unit, length in _UNITS:
        if microseconds and microseconds % length == 0 and microseconds // length < 100:
            return f"INTERVAL '{microseconds // length}' {unit}"
    days, rest = divmod(microseconds, _UNITS[0][1])
    hours, rest = divmod(rest, _UNITS[1][1])
    minutes, rest = divmod(rest, _UNITS[2][1])
    seconds, rest = divmod(rest, _UNITS[3][1])
    clock = f"{hours:02d}:{minutes:02d}:{seconds:02d}.{rest // MILLISECOND_US:03d}"
    precision = len(str(days))
    return f"INTERVAL '{days} {clock}' DAY({precision}) TO SECOND(3)"


def microseconds_sql(time: str) -> str:
    """Microseconds since 1970 of a time."""
    return f"EXTRACT(EPOCH FROM {time}) * 1000000 + EXTRACT(MICROSECOND FROM {time})"


def later_sql(time: str, duration_us: int) -> str:
    """The time this much later, to the microsecond."""
    written = interval(duration_us)
    return f"{time} + {written}" if written else f"TO_TIMESTAMP_LTZ({microseconds_sql(time)} + {duration_us}, 6)"
