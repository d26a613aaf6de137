"""From a type's definition to columns and back.

Contract: `schema_of` is a pure function of the type; `events_of(batch_of(events))` is the identity.
A batch's columns are the type's fields in the order of their definition, `time` first. The hot road
uses batches only; `batch_of` and `events_of` are for single events, tests and people.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from operator import attrgetter
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Self, TypeVar, Union, get_args, get_origin

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pydantic import AwareDatetime, ValidationError
from pydantic.fields import FieldInfo

from events.errors import InvalidEvent
from events.model import EventType, Part, stored
from events.names import StreamName

E = TypeVar("E", bound=EventType)

TIMESTAMP = pa.timestamp("us", tz="UTC")

_PLAIN: dict[Any, pa.DataType] = {
    bool: pa.bool_(),
    int: pa.int64(),
    float: pa.float64(),
    str: pa.string(),
    bytes: pa.binary(),
    datetime: TIMESTAMP,
    AwareDatetime: TIMESTAMP,
}


@dataclass(frozen=True, slots=True)
class EventBatch:
    """Events of one type in columns, as an extractor yields them and a segment holds them."""

    type: type[EventType]
    data: pa.RecordBatch

    def __post_init__(self) -> None:
        if not isinstance(self.data, pa.RecordBatch):
            raise InvalidEvent(
                f"{self.type.type_name}: data must be a pyarrow.RecordBatch, got {type(self.data).__name__}"
            )
        wanted = schema_of(self.type)
        if not self.data.schema.equals(wanted, check_metadata=False):
            raise InvalidEvent(f"{self.type.type_name}: {_difference(self.data.schema, wanted)}")
        for field, path, column in zip(*_checked_for_nulls(self.type), self.data.columns, strict=True):
            if field is not None:
                _check_nulls(path, field, column)

    def __len__(self) -> int:
        return int(self.data.num_rows)

    def slice(self, start: int, stop: int | None = None) -> Self:
        """The events from `start` up to but not including `stop`, as Python slices a list."""
        kept = range(len(self))[start:stop]
        return type(self)(self.type, self.data.slice(kept.start, len(kept)))


@cache
def schema_of(event_type: type[EventType]) -> pa.Schema:
    """The Arrow schema of a type: its fields in order, descriptions as metadata."""
    return pa.schema([_arrow_field(name, info) for name, info in event_type.model_fields.items()])


@cache
def _checked_for_nulls(event_type: type[EventType]) -> tuple[tuple[pa.Field | None, ...], tuple[str, ...]]:
    """Of each column its field, or None where nulls are allowed and none can be inside; and its path for messages."""
    schema = schema_of(event_type)
    fields = tuple(None if field.nullable and not pa.types.is_list(field.type) else field for field in schema)
    return fields, tuple(f"{event_type.type_name}.{field.name}" for field in schema)


def batch_of(events: Sequence[E]) -> EventBatch:
    """The events, one or more of one type, as a batch.

    Raises:
        InvalidEvent: There are none, they are of several types, or a value does not fit its column.
    """
    kinds = {type(event) for event in events}
    if len(kinds) != 1:
        raise InvalidEvent(f"a batch holds one or more events of one type, got {len(events)} of {len(kinds)} types")
    return batch_of_type(kinds.pop(), events)


def batch_of_type(event_type: type[E], events: Sequence[E]) -> EventBatch:
    """The events, perhaps none, as a batch of this type.

    Raises:
        InvalidEvent: One is of another type, or a value does not fit its column.
    """
    strangers = {type(event) for event in events} - {event_type}
    if strangers:
        names = ", ".join(sorted(kind.__name__ for kind in strangers))
        raise InvalidEvent(f"a batch of {event_type.__name__} holds nothing else, got {names}")
    schema = schema_of(event_type)
    columns = [_column(event_type, field, _values(events, field)) for field in schema]
    return EventBatch(event_type, pa.RecordBatch.from_arrays(columns, schema=schema))


def events_of(batch: EventBatch) -> list[EventType]:
    """The batch's events as models, validated.

    Raises:
        InvalidEvent: A value is one that the type's definition does not allow.
    """
    try:
        return [batch.type.model_validate(row) for row in batch.data.to_pylist()]
    except (ValidationError, ValueError, OverflowError) as error:
        raise InvalidEvent(f"{batch.type.type_name}: {error}") from error


def with_envelope(stream: StreamName, first_sequence: int, batch: EventBatch) -> pa.RecordBatch:
    """The batch with the envelope's columns station, source, type, subject, sequence in front."""
    count = len(batch)
    front = {
        "station": _repeated(stream.station, count),
        "source": _repeated(stream.source, count),
        "type": _repeated(stream.type, count),
        "subject": subject_of(batch),
        "sequence": pa.array(np.arange(first_sequence, first_sequence + count, dtype=np.int64)),
    }
    return pa.RecordBatch.from_arrays([*front.values(), *batch.data.columns], names=[*front, *batch.data.schema.names])


def subject_of(batch: EventBatch) -> pa.Array:
    """What each event is about, as text; nulls where the type has no subject."""
    if batch.type.subject_field is None:
        return pa.nulls(len(batch), pa.string())
    return batch.data.column(batch.type.subject_field).cast(pa.string())


def _values(events: Sequence[EventType], field: pa.Field) -> list[Any]:
    """The field's value of each event, structures as mappings."""
    values = list(map(attrgetter(field.name), events))
    if not pa.types.is_list(field.type):
        return values
    return [None if parts is None else [part.model_dump() for part in parts] for parts in values]


def numbers(column: pa.Array) -> npt.NDArray[Any]:
    """The column's values without nulls; times as microseconds since 1970."""
    if column.null_count:
        column = column.drop_null()
    if isinstance(column, pa.TimestampArray):
        column = column.view(pa.int64())
    values: npt.NDArray[Any] = column.to_numpy()
    return values


def _column(event_type: type[EventType], field: pa.Field, values: list[Any]) -> pa.Array:
    try:
        return pa.array(values, field.type)
    except (pa.ArrowException, OverflowError, UnicodeEncodeError) as error:
        raise InvalidEvent(
            f"{event_type.type_name}.{field.name}: a value does not fit a column of {field.type}: {error}"
        ) from error


def _check_nulls(path: str, field: pa.Field, column: pa.Array) -> None:
    if column.null_count and not field.nullable:
        raise InvalidEvent(f"{path} must not be null, got {column.null_count} nulls")
    if isinstance(column, pa.ListArray):
        parts = column.flatten()
        for part, values in zip(field.type.value_type, parts.flatten(), strict=True):
            _check_nulls(f"{path}.{part.name}", part, values)


def _repeated(text: str, count: int) -> pa.Array:
    return pa.repeat(pa.scalar(text, pa.string()), count)


def _arrow_field(name: str, info: FieldInfo) -> pa.Field:
    plain, is_optional = _without_none(info.annotation)
    metadata_of = list(info.metadata)
    if get_origin(plain) is Annotated:
        plain, *inner = get_args(plain)
        metadata_of += inner
    marker = stored(metadata_of)
    arrow = marker.arrow if marker else _arrow_type(name, plain)
    metadata = {"description": info.description or ""}
    if marker and marker.is_json:
        metadata["json"] = "true"
    if marker and marker.is_personal:
        metadata["personal"] = "true"
    return pa.field(name, arrow, nullable=is_optional, metadata=metadata)


def _arrow_type(name: str, annotation: Any) -> pa.DataType:
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal and all(isinstance(value, str) for value in arguments):
        return pa.string()
    if origin is tuple and len(arguments) == 2 and arguments[1] is ... and _is_part(arguments[0]):
        return pa.list_(pa.struct([_arrow_field(n, i) for n, i in arguments[0].model_fields.items()]))
    raise InvalidEvent(f"field {name}: no column type for {annotation}; wanted bool, int, float, str, bytes, datetime")


def _is_part(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Part)


def _without_none(annotation: Any) -> tuple[Any, bool]:
    if get_origin(annotation) not in (Union, UnionType):
        return annotation, False
    rest = [a for a in get_args(annotation) if a is not NoneType]
    return (rest[0] if len(rest) == 1 else annotation), len(rest) < len(get_args(annotation))


def _difference(got: pa.Schema, wanted: pa.Schema) -> str:
    if len(set(got.names)) < len(got.names):
        return f"each column must be there once, got {', '.join(got.names)}"
    missing = [f.name for f in wanted if f.name not in got.names]
    unknown = [n for n in got.names if n not in wanted.names]
    if missing or unknown:
        return f"columns missing: {', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}"
    wrong = [
        f"{f.name} is {_kind(got.field(f.name))}, wanted {_kind(f)}"
        for f in wanted
        if _kind(got.field(f.name)) != _kind(f)
    ]
    return "; ".join(wrong) or f"columns must be in the order {', '.join(wanted.names)}; got {', '.join(got.names)}"


def _kind(field: pa.Field) -> str:
    return f"{field.type}{'' if field.nullable else ' not null'}"
