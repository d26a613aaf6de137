"""Values of a query's rows as Python holds them: compared and hashed, and given back to DuckDB.

Most are what Arrow makes of them. An interval is a `Span`, because DuckDB orders intervals by their length; a list, a
struct or a map is `Nested`; a time in nanoseconds is its text, of one width, since Python's times end at microseconds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

_DAYS_OF_MONTH = 30
_DAY_US = 86_400_000_000


@dataclass(frozen=True, slots=True)
class Nested:
    """A list, a struct or a map: compared and hashed by how it is written."""

    value: Any = field(compare=False)
    written: str


@dataclass(frozen=True, slots=True)
class Span:
    """An interval: months, days and microseconds, which are told apart where it is added to a time."""

    months: int
    days: int
    microseconds: int

    @classmethod
    def of(cls, interval: pa.MonthDayNano) -> "Span":
        """The interval as Arrow holds it."""
        months, days, nanoseconds = interval
        return cls(months, days, nanoseconds // 1_000)

    @classmethod
    def between(cls, length_us: int) -> "Span":
        """The interval between two times: whole days and the rest, both of the same sign."""
        sign = 1 if length_us >= 0 else -1
        days, rest = divmod(abs(length_us), _DAY_US)
        return cls(0, sign * days, sign * rest)

    @property
    def length_us(self) -> int:
        """What intervals are ordered by: a day has 24 hours, a month 30 days."""
        return (self.months * _DAYS_OF_MONTH + self.days) * _DAY_US + self.microseconds

    @property
    def written(self) -> str:
        """The interval as DuckDB reads it."""
        return f"{self.months} months {self.days} days {self.microseconds} microseconds"


def values_of(column: pa.ChunkedArray | pa.Array) -> list[Any]:
    """The column as Python values that can be compared and hashed."""
    kind = column.type
    if pa.types.is_timestamp(kind) and kind.unit == "ns":
        column = pc.strftime(column, "%Y-%m-%d %H:%M:%S")
    values: list[Any] = column.to_pylist()
    if pa.types.is_interval(kind):
        return [None if value is None else Span.of(value) for value in values]
    if pa.types.is_map(kind):
        return [None if value is None else Nested(_as_map(value), repr(value)) for value in values]
    if pa.types.is_nested(kind):
        return [None if value is None else Nested(value, repr(value)) for value in values]
    return values


def given_back(value: Any) -> Any:
    """The value as DuckDB takes it for a parameter that is cast to the value's type."""
    if isinstance(value, Nested):
        return value.value
    return value.written if isinstance(value, Span) else value


def written(value: Any) -> str | None:
    """The value as a text in SQL that is cast to the value's type; None: it has none."""
    if value is None:
        return "NULL"
    if isinstance(value, Nested | bytes):
        return None
    text = value.written if isinstance(value, Span) else str(value)
    return None if "\0" in text else "'" + text.replace("'", "''") + "'"


def compared(compare: Callable[[Any, Any], bool], first: Any, second: Any) -> bool | None:
    """Whether the comparison of two values that are not NULL holds; None: only DuckDB knows."""
    kind = type(first)
    if kind is not type(second):
        pair = (kind.__name__, type(second).__name__)
        return compare(first, second) if pair in _EQUAL_TYPES and first == first and second == second else None
    if kind is Span:
        return compare(first.length_us, second.length_us)
    return None if kind is Nested or first != first or second != second else compare(first, second)


_EQUAL_TYPES = {("int", "Decimal"), ("Decimal", "int")}


def _as_map(pairs: Sequence[tuple[Any, Any]]) -> dict[str, list[Any]]:
    """A map as DuckDB takes it."""
    return {"key": [key for key, _ in pairs], "value": [value for _, value in pairs]}
