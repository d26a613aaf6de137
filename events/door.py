"""The door: what a value must be to get into a log, checked column by column.

Contract: `check` refuses a batch before a byte of it is encoded, names the field and the first bad row,
and looks at whole columns: two passes of NumPy over a column of numbers. What it asks for follows from
the type's definition: the limits of its fields (`ge`, `gt`, `le`, `lt`, `Literal`, JSON), those of
`AtDoor`, times in a plausible span, and text and bytes of a bounded length.

Decoding does not ask: what is stored stays readable when a later version asks for more.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import from_json

from events.columns import TIMESTAMP, numbers, schema_of
from events.errors import InvalidEvent
from events.model import AtDoor, EventType, Part, stored

TIME_MIN = datetime(1970, 1, 1, tzinfo=UTC)
"""Earliest time of a new event: an older one comes from a clock that was never set."""
TIME_END = datetime(2200, 1, 1, tzinfo=UTC)
"""Times of new events lie before this."""
VALUE_MAX_BYTES = 4 * 1024 * 1024
"""Most bytes that one text or one binary value may have."""

_TIME_MIN_US, _TIME_END_US = (round(time.timestamp()) * 1_000_000 for time in (TIME_MIN, TIME_END))
_SHOWN = 40
"""Characters of a refused value that a message shows."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """Which values of one field are taken."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    is_finite: bool = False
    values: tuple[str, ...] | None = None
    is_json: bool = False

    @property
    def is_limited(self) -> bool:
        """Whether a number can be refused."""
        return self.is_finite or any(limit is not None for limit in (self.ge, self.gt, self.le, self.lt))

    def holds(self, number: float) -> bool:
        """Whether the number is taken; NaN is within no limit."""
        return (
            (self.ge is None or number >= self.ge)
            and (self.gt is None or number > self.gt)
            and (self.le is None or number <= self.le)
            and (self.lt is None or number < self.lt)
            and (not self.is_finite or math.isfinite(number))
        )

    def __str__(self) -> str:
        if self.values is not None:
            return ", ".join(self.values)
        if self.is_json:
            return "JSON"
        if self.ge is not None and self.le is not None:
            return f"{self.ge:g} to {self.le:g}"
        signs = (("≥", self.ge), (">", self.gt), ("≤", self.le), ("<", self.lt))
        limits = [f"{sign} {limit:g}" for sign, limit in signs if limit is not None]
        return ", ".join(["finite"] * self.is_finite + limits)


@cache
def allowed(event_type: type[EventType]) -> dict[str, Allowed]:
    """What the door asks of each field, by path: `lineage[].events` is a field of a part in a list."""
    return dict(_allowed("", event_type))


def check(event_type: type[EventType], columns: Sequence[pa.Array]) -> None:
    """Nothing, if every value of a batch's columns may enter a log.

    The columns' buffers must have been validated before.

    Raises:
        InvalidEvent: One may not; the message names its field and row.
    """
    for index, inspect in _inspections(event_type):
        inspect(columns[index])


# From a type's definition to what is asked.


def _allowed(prefix: str, model: type[BaseModel]) -> Iterator[tuple[str, Allowed]]:
    for name, info in model.model_fields.items():
        annotation, metadata = _plain(info.annotation, list(info.metadata))
        if get_origin(annotation) is tuple:
            part = get_args(annotation)[0]
            assert issubclass(part, Part), "columns.schema_of lets no other list through"
            yield from _allowed(f"{prefix}{name}[].", part)
            continue
        asked = _of_metadata(metadata)
        if get_origin(annotation) is Literal:
            asked = replace(asked, values=get_args(annotation))
        yield prefix + name, asked if annotation is float else replace(asked, is_finite=False)


def _plain(annotation: Any, metadata: list[Any]) -> tuple[Any, list[Any]]:
    """The annotation without `Annotated` and `None`, and all metadata on the way."""
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return _plain(inner, metadata + more)
    if NoneType in get_args(annotation):
        return _plain(next(a for a in get_args(annotation) if a is not NoneType), metadata)
    return annotation, [each for m in metadata for each in (m.metadata if isinstance(m, FieldInfo) else [m])]


def _of_metadata(metadata: Iterable[Any]) -> Allowed:
    marks = list(metadata)
    asked = Allowed(is_json=bool((marker := stored(marks)) and marker.is_json))
    for mark in marks:
        for kind, name in ((Ge, "ge"), (Gt, "gt"), (Le, "le"), (Lt, "lt")):
            if isinstance(mark, kind):
                asked = replace(asked, **{name: getattr(mark, name)})
        if isinstance(mark, AtDoor):
            ge = mark.least if mark.least is not None else asked.ge
            le = mark.most if mark.most is not None else asked.le
            asked = replace(asked, ge=ge, le=le, is_finite=True)
        if getattr(mark, "allow_inf_nan", None) is False:
            asked = replace(asked, is_finite=True)
    return asked


# From what is asked to how a column is looked at.

Inspection = Callable[[pa.Array], None]


@cache
def _inspections(event_type: type[EventType]) -> tuple[tuple[int, Inspection], ...]:
    """How to look at each column of the type that can be wrong."""
    asked = allowed(event_type)
    found = (
        (index, _inspection(event_type.type_name, "", field, asked))
        for index, field in enumerate(schema_of(event_type))
    )
    return tuple((index, inspect) for index, inspect in found if inspect is not None)


def _inspection(type_name: str, prefix: str, field: pa.Field, asked: dict[str, Allowed]) -> Inspection | None:
    path = prefix + field.name
    if pa.types.is_list(field.type):
        parts = [_inspection(type_name, f"{path}[].", part, asked) for part in field.type.value_type]
        return lambda column: _inspect_parts(parts, column)
    place, wanted = f"{type_name}.{path}", asked[path]
    if field.type == TIMESTAMP:
        return lambda column: _inspect_times(place, column)
    if field.type in (pa.string(), pa.binary()):
        return lambda column: _inspect_texts(place, wanted, column)
    if wanted.is_limited:
        return lambda column: _inspect_numbers(place, wanted, column)
    return None


def _inspect_numbers(place: str, wanted: Allowed, column: pa.Array) -> None:
    values = numbers(column)
    # NaN anywhere makes both of them NaN.
    if len(values) and not (
        wanted.holds(np.minimum.reduce(values).item()) and wanted.holds(np.maximum.reduce(values).item())
    ):
        _refuse(place, str(wanted), column, wanted.holds)


def _inspect_times(place: str, column: pa.Array) -> None:
    values = numbers(column)
    if len(values) and not (np.minimum.reduce(values) >= _TIME_MIN_US and np.maximum.reduce(values) < _TIME_END_US):
        span = f"in {TIME_MIN:%Y-%m-%d} to {TIME_END:%Y-%m-%d}"
        _refuse(place, span, column.view(pa.int64()), lambda us: _TIME_MIN_US <= us < _TIME_END_US, _as_time)


def _inspect_texts(place: str, wanted: Allowed, column: pa.Array) -> None:
    if _bytes_of(column) > VALUE_MAX_BYTES:
        lengths = pc.binary_length(column)
        if (pc.max(lengths).as_py() or 0) > VALUE_MAX_BYTES:
            most = f"at most {VALUE_MAX_BYTES} bytes"
            _refuse(place, most, lengths, lambda length: length <= VALUE_MAX_BYTES, "{} bytes".format)
    if wanted.values is not None:
        if not pc.all(pc.is_in(column.drop_null(), pa.array(wanted.values, pa.string())), min_count=0).as_py():
            _refuse(place, f"one of {wanted}", column, wanted.values.__contains__)
    elif wanted.is_json and not all(map(_is_json, column.drop_null().to_pylist())):
        _refuse(place, "JSON (RFC 8259)", column, _is_json)


def _inspect_parts(parts: list[Inspection | None], column: pa.Array) -> None:
    for inspect, values in zip(parts, column.flatten().flatten(), strict=True):
        if inspect is not None:
            inspect(values)


def _bytes_of(column: pa.Array) -> int:
    """How many bytes all values have together, nulls perhaps included."""
    if not len(column):
        return 0
    offsets = np.frombuffer(column.buffers()[1], np.int32, len(column) + 1, 4 * column.offset)
    return int(offsets[-1] - offsets[0])


def _is_json(text: str) -> bool:
    try:
        from_json(text, allow_inf_nan=False)
    except ValueError:
        return False
    return True


def _as_time(microsecond: int) -> str:
    try:
        return np.datetime64(microsecond, "us").item().isoformat() + "Z"
    except AttributeError:  # beyond the years that Python knows, NumPy gives the number back
        return f"{microsecond} µs"


def _refuse(
    place: str,
    wanted: str,
    column: pa.Array,
    is_right: Callable[[Any], bool],
    shown: Callable[[Any], str] = str,
) -> None:
    """Raise for the first value of the column that is not right."""
    values = column.to_pylist()
    row = next(row for row, value in enumerate(values) if value is not None and not is_right(value))
    got = shown(values[row])
    got = got if len(got) <= _SHOWN else f"{got[:_SHOWN]}…"
    raise InvalidEvent(f"{place} must be {wanted}, got {got!r} in {'part' if '[]' in place else 'row'} {row}")
