"""How events become rows: from decoded segments to the bytes of a binary COPY, column by column.

Contract: pure, and no Python for each event but in columns of structures (`lineage`), which become
JSON. A row has its event's values bit for bit, with one exception: U+0000, which PostgreSQL's text
cannot hold, becomes U+FFFD.
"""

import re
from collections.abc import Iterator, Sequence
from datetime import UTC, date, datetime, timedelta
from typing import Any, NamedTuple

import numpy as np
import pgpq
import psycopg
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic_core import to_json

from events import EventBatch, EventType, Segment, schema_of
from events.columns import subject_of
from store.tables import is_json

CHUNK_ROWS = 2_500
"""Rows encoded at a time: PostgreSQL takes in one chunk while the next is encoded."""

_TIMESTAMP = pa.timestamp("us", tz="UTC")
_ENVELOPE = (
    pa.field("station", pa.string(), nullable=False),
    pa.field("source", pa.string(), nullable=False),
    pa.field("subject", pa.string()),
    pa.field("time", _TIMESTAMP, nullable=False),
    pa.field("sequence", pa.int64(), nullable=False),
    pa.field("position", pa.int64(), nullable=False),
    pa.field("recorded_at", _TIMESTAMP, nullable=False),
    pa.field("epoch", pa.int32(), nullable=False),
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DAY_US = 86_400_000_000
_JSONB_VERSION = "\x01"
"""Begins every `jsonb` value in binary. Source: `jsonb_recv` of PostgreSQL."""
_JSON_NUL = re.compile(r"(?<!\\)((?:\\\\)*)\\u0000")


class Part(NamedTuple):
    """One segment and its events."""

    segment: Segment
    batch: EventBatch


class RowFormat:
    """How rows of one event type are written; keeps what is the same for each copy."""

    def __init__(self, event_type: type[EventType]) -> None:
        self.type = event_type
        self._payload = [field for field in schema_of(event_type) if field.name != "time"]
        fields = [pa.field(f.name, pa.string() if is_json(f) else f.type, f.nullable) for f in self._payload]
        self._schema = pa.schema([*_ENVELOPE, *fields])
        self.statement = psycopg.sql.SQL("copy {} ({}) from stdin (format binary)").format(
            psycopg.sql.Identifier(event_type.type_name),
            psycopg.sql.SQL(", ").join(map(psycopg.sql.Identifier, self._schema.names)),
        )

    def copy_data(self, parts: Sequence[Part], retained_from: date | None) -> Iterator[bytes]:
        """The parts' events from the day `retained_from` on, as the data of `statement`, piece by piece."""
        encoder = pgpq.ArrowToPostgresBinaryEncoder(self._schema)
        yield encoder.write_header()
        for chunk in _chunks(parts):
            rows = self.rows(chunk)
            if retained_from is not None:
                rows = rows.filter(pc.greater_equal(rows.column("time"), pa.scalar(_midnight(retained_from))))
            for start in range(0, rows.num_rows, CHUNK_ROWS):
                yield encoder.write_batch(rows.slice(start, CHUNK_ROWS))
        yield encoder.finish()

    def rows(self, parts: Sequence[Part]) -> pa.RecordBatch:
        """The parts' events as rows, in the order and types of the columns that are copied."""
        batch = parts[0].batch
        if len(parts) > 1:
            whole = pa.Table.from_batches([part.batch.data for part in parts]).combine_chunks()
            batch = EventBatch(self.type, whole.to_batches()[0])
        counts = np.array([part.segment.header.event_count for part in parts])
        segments = [part.segment for part in parts]
        columns = [
            _repeated([segment.stream.station for segment in segments], counts, pa.string()),
            _repeated([segment.stream.source for segment in segments], counts, pa.string()),
            _storable(subject_of(batch)),
            batch.data.column("time"),
            pa.array(_sequences([segment.header.first_sequence for segment in segments], counts)),
            _repeated([segment.position for segment in segments], counts, pa.int64()),
            _repeated([segment.recorded_at for segment in segments], counts, _TIMESTAMP),
            _repeated([segment.header.epoch for segment in segments], counts, pa.int32()),
        ]
        for field in self._payload:
            column = batch.data.column(field.name)
            columns.append(_json(column) if is_json(field) else _storable(column))
        return pa.RecordBatch.from_arrays(columns, schema=self._schema)


def days_of(part: Part) -> set[date]:
    """The days (UTC) on which the part's events happened."""
    header = part.segment.header
    first, last = header.time_min.astimezone(UTC).date(), header.time_max.astimezone(UTC).date()
    if last - first <= timedelta(days=1):
        return {first, last}
    days = np.unique(part.batch.data.column("time").cast(pa.int64()).to_numpy() // _DAY_US)
    return {(_EPOCH + timedelta(days=int(day))).date() for day in days}


def _chunks(parts: Sequence[Part]) -> Iterator[list[Part]]:
    """The parts in order, in groups of about `CHUNK_ROWS` rows."""
    group: list[Part] = []
    rows = 0
    for part in parts:
        group.append(part)
        rows += len(part.batch)
        if rows >= CHUNK_ROWS:
            yield group
            group, rows = [], 0
    if group:
        yield group


def _repeated(values: Sequence[Any], counts: NDArray[np.int64], kind: pa.DataType) -> pa.Array:
    """Each value as often as its count says."""
    if len(values) == 1:
        return pa.repeat(pa.scalar(values[0], kind), counts[0])
    return pa.array(values, kind).take(pa.array(np.repeat(np.arange(len(values)), counts)))


def _sequences(firsts: Sequence[int], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each part the sequences from its first one on."""
    before = np.cumsum(counts) - counts
    places: NDArray[np.int64] = np.arange(counts.sum()) + np.repeat(np.array(firsts) - before, counts)
    return places


def _midnight(day: date) -> datetime:
    return datetime(day.year, day.month, day.day, tzinfo=UTC)


def _storable(column: pa.Array) -> pa.Array:
    """The column with U+FFFD for U+0000, which PostgreSQL's text cannot hold."""
    if pa.types.is_string(column.type) and pc.any(pc.match_substring(column, "\0")).as_py():
        return pc.replace_substring(column, "\0", "\N{REPLACEMENT CHARACTER}")
    return column


def _json(column: pa.Array) -> pa.Array:
    """The column as `jsonb` in binary: it holds JSON as text already, or structures."""
    if pa.types.is_list(column.type):
        column = pa.array([_text_of(value) for value in column.to_pylist()], pa.string())
    if pc.any(pc.match_substring(column, r"\u0000")).as_py():
        texts = column.to_pylist()
        column = pa.array([None if text is None else _JSON_NUL.sub(r"\1\\ufffd", text) for text in texts], pa.string())
    return pc.binary_join_element_wise(_JSONB_VERSION, column, "")


def _text_of(value: Any) -> str | None:
    return None if value is None else to_json(value, inf_nan_mode="strings", bytes_mode="base64").decode()
