"""Hypothesis strategies for events, derived from the types' definitions: a new type needs no line here.

`events` and `batches` give whatever a model or a stored segment can hold; `lawful_batches` what the door lets in.
Each is made once: Hypothesis checks a new strategy for longer than it draws from it.
"""

import json
from datetime import UTC, datetime, timedelta
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
import pyarrow as pa
from annotated_types import Ge, Gt
from hypothesis import strategies as st
from pydantic import AwareDatetime, BaseModel
from pydantic.fields import FieldInfo

from events import EventBatch, EventType, Header, Part, Producer, Sequence, StreamName, batch_of_type
from events.door import TIME_END, TIME_MIN
from events.model import AtDoor, stored

INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1

times = st.one_of(
    st.sampled_from(
        [datetime(1, 1, 1, 0, 0, 0, 1, tzinfo=UTC), datetime(9999, 12, 31, 23, 59, 59, 999_999, tzinfo=UTC)]
    ),
    st.datetimes(timezones=st.just(UTC)),
)
lawful_times = st.sampled_from([TIME_MIN, TIME_END - timedelta(microseconds=1)]) | st.datetimes(
    TIME_MIN.replace(tzinfo=None), (TIME_END - timedelta(microseconds=1)).replace(tzinfo=None), timezones=st.just(UTC)
)
json_texts = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
).map(json.dumps)


@cache
def events(event_type: type[EventType]) -> st.SearchStrategy[EventType]:
    """Any event of the type."""
    return _models(event_type)


@cache
def batches(event_type: type[EventType], min_size: int = 0) -> st.SearchStrategy[EventBatch]:
    """Any batch of the type whose floats are any bits at all, signalling NaN included."""
    rows = st.lists(events(event_type), min_size=min_size, max_size=4)
    return st.tuples(rows, st.randoms(use_true_random=False)).map(
        lambda drawn: _with_any_float_bits(batch_of_type(event_type, drawn[0]), drawn[1].randbytes)
    )


@cache
def lawful_batches(event_type: type[EventType]) -> st.SearchStrategy[EventBatch]:
    """Any batch of the type that may be appended."""
    rows = st.lists(_models(event_type, is_lawful=True), min_size=1, max_size=4)
    return rows.map(lambda said: batch_of_type(event_type, said))


def bits(column: pa.Array) -> list[Any]:
    """The column's values such that equal lists mean equal bits: floats as the integers of their bits."""
    if pa.types.is_list(column.type):
        parts = [bits(values) for values in column.flatten().flatten()]
        return [column.is_valid().to_pylist(), column.value_lengths().to_pylist(), *parts]
    if pa.types.is_floating(column.type):
        column = column.view(pa.int32() if column.type == pa.float32() else pa.int64())
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.int64())
    return list(column.to_pylist())


names = st.from_regex(r"\A[A-Za-z0-9]([A-Za-z0-9._-]{0,62}[A-Za-z0-9])?\Z")
type_names = st.from_regex(r"\A[a-z][a-z0-9_]{0,47}\Z")
streams = st.builds(StreamName.of, names, names, type_names)
producers = st.builds(
    Producer,
    st.text().filter(str.isprintable),
    st.text().filter(str.isprintable),
    st.binary(min_size=32, max_size=32),
)


@st.composite
def headers(draw: st.DrawFn) -> Header:
    """Any header that a log can hold."""
    int32 = st.integers(1, 2**31 - 1)
    count = draw(int32)
    time_min, time_max = sorted((draw(times), draw(times)))
    return Header(
        stream=draw(streams),
        epoch=draw(st.integers(0, 2**31 - 1)),
        first_sequence=Sequence(draw(st.integers(0, 2**63 - count))),
        event_count=count,
        schema_version=draw(int32),
        time_min=time_min,
        time_max=time_max,
        producer=draw(producers),
    )


def _models(model: type[BaseModel], is_lawful: bool = False) -> st.SearchStrategy[Any]:
    fields = model.model_fields.items()
    return st.builds(model, **{name: _of(info.annotation, list(info.metadata), is_lawful) for name, info in fields})


def _of(annotation: Any, metadata: list[Any], is_lawful: bool) -> st.SearchStrategy[Any]:
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        more = [each for m in more for each in (m.metadata if isinstance(m, FieldInfo) else [m])]
        return _of(inner, metadata + more, is_lawful)
    if NoneType in get_args(annotation):
        (inner,) = (a for a in get_args(annotation) if a is not NoneType)
        return st.none() | _of(inner, metadata, is_lawful)
    if get_origin(annotation) is Literal:
        return st.sampled_from(get_args(annotation))
    if get_origin(annotation) is tuple:
        return st.lists(_of(get_args(annotation)[0], [], is_lawful), max_size=3).map(tuple)
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return _models(annotation, is_lawful)
    marker = stored(metadata)
    door = next((m for m in metadata if isinstance(m, AtDoor)), None) if is_lawful else None
    if annotation is int:
        least = int(door.least) if door and door.least is not None else _least(metadata)
        return st.integers(least, INT64_MAX) | st.just(INT64_MAX)
    if annotation is float:
        width = 32 if marker and marker.arrow == pa.float32() else 64
        if door:
            return st.floats(door.least, door.most, width=width, allow_nan=False, allow_infinity=False)
        return st.floats(width=width)
    if annotation is str:
        return json_texts if marker and marker.is_json else st.text()
    moments = lawful_times if is_lawful else times
    plain = {bool: st.booleans(), bytes: st.binary(), datetime: moments, AwareDatetime: moments}
    return plain[annotation]


def _least(metadata: list[Any]) -> int:
    least = [int(m.ge) for m in metadata if isinstance(m, Ge)]  # type: ignore[call-overload]
    least += [int(m.gt) + 1 for m in metadata if isinstance(m, Gt)]  # type: ignore[call-overload]
    return max(least, default=INT64_MIN)


def _with_any_float_bits(batch: EventBatch, random_bytes: Any) -> EventBatch:
    columns = []
    for column in batch.data.columns:
        if pa.types.is_floating(column.type):
            width = column.type.bit_width // 8
            noise = np.frombuffer(random_bytes(width * len(batch)), f"u{width}")
            values = pa.array(noise.view(f"f{width}"), column.type, from_pandas=False)
            column = pa.compute.if_else(column.is_valid(), values, None)
        columns.append(column)
    return EventBatch(batch.type, pa.RecordBatch.from_arrays(columns, schema=batch.data.schema))
