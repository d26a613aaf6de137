"""SQL over the log: DuckDB, each event type a table, straight from the segments.

Contract: an answer rests on what the log held when the query began; projections are not needed.
Only the types that a query names are decoded. Tables bear the columns of the row tables in
PostgreSQL, so a query means the same at both doors; `events` has the envelope of all types, and
`streams` the heads.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

import duckdb
import pyarrow as pa
import pyarrow.compute as pc

from events import EventType, Segment, UnknownType, decode, schema_of, with_envelope
from store import Log
from vian.errors import WrongUsage

_TIMESTAMP = pa.timestamp("us", tz="UTC")
_FRONT = pa.schema(
    [
        ("station", pa.string()),
        ("source", pa.string()),
        ("subject", pa.string()),
        ("time", _TIMESTAMP),
        ("sequence", pa.int64()),
        ("position", pa.int64()),
        ("recorded_at", _TIMESTAMP),
    ]
)
_EVENTS = pa.schema(
    [
        ("id", pa.string()),
        ("station", pa.string()),
        ("source", pa.string()),
        ("type", pa.string()),
        ("subject", pa.string()),
        ("time", _TIMESTAMP),
        ("sequence", pa.int64()),
        ("position", pa.int64()),
        ("recorded_at", _TIMESTAMP),
    ]
)


@dataclass(frozen=True, slots=True)
class Scope:
    """Which part of the log a query sees; None is all of it."""

    since: datetime | None = None
    until: datetime | None = None
    sources: Sequence[str] | None = None
    stations: Sequence[str] | None = None


def query(log: Log, sql: str, scope: Scope = Scope()) -> pa.Table:
    """The answer to a DuckDB query over the log.

    Raises:
        WrongUsage: The SQL is not right; the message is DuckDB's, with the place.
    """
    with connect(log, sql, scope) as connection:
        try:
            return connection.execute(sql).to_arrow_table()
        except duckdb.Error as error:
            raise _explained(error, log) from error


def connect(log: Log, sql: str, scope: Scope) -> duckdb.DuckDBPyConnection:
    """A DuckDB connection that has the tables that the query names."""
    # Nothing is downloaded at run time; what DuckDB's wheel has built in is enough.
    connection = duckdb.connect(config={"autoinstall_known_extensions": False, "python_enable_replacements": False})
    connection.execute("set timezone = 'UTC'")
    try:
        names = connection.get_table_names(sql)
    except duckdb.Error as error:
        connection.close()
        raise _explained(error, log) from error
    for name in {name.lower() for name in names}:
        if (table := _table(log, name, scope)) is not None:
            connection.register(name, table)
    return connection


def _table(log: Log, name: str, scope: Scope) -> pa.Table | None:
    if name == "streams":
        return _streams(log)
    if name == "events":
        return _in_scope(_events(log, scope), scope)
    if name in log.catalogue:
        return _in_scope(_rows(log, log.catalogue.newest(name), scope), scope)
    return None


def _rows(log: Log, event_type: type[EventType], scope: Scope) -> pa.Table:
    """The row table of a type: envelope columns, then the type's fields."""
    payload = [field.remove_metadata() for field in schema_of(event_type) if field.name != "time"]
    schema = pa.schema([*_FRONT, *(pa.field(field.name, field.type) for field in payload)])
    batches = (
        _with_place(segment, log).select(schema.names).cast(schema)
        for segment in _segments(log, [event_type.type_name], scope)
    )
    return pa.Table.from_batches(list(batches), schema=schema)


def _events(log: Log, scope: Scope) -> pa.Table:
    """The envelope of all events, those of unknown types included."""
    batches = [_envelope(segment, log) for segment in _segments(log, None, scope)]
    return pa.Table.from_batches(batches, schema=_EVENTS)


def _envelope(segment: Segment, log: Log) -> pa.RecordBatch:
    try:
        whole = _with_place(segment, log)
    except UnknownType:
        whole = _without_payload(segment)
    prefix = pa.scalar(f"{segment.stream}/", pa.string())
    ids = pc.binary_join_element_wise(prefix, whole.column("sequence").cast(pa.string()), "")
    return pa.RecordBatch.from_arrays([ids, *(whole.column(name) for name in _EVENTS.names[1:])], schema=_EVENTS)


def _with_place(segment: Segment, log: Log) -> pa.RecordBatch:
    batch = decode(segment, log.catalogue)
    whole = with_envelope(segment.stream, segment.header.first_sequence, batch)
    return _placed(whole, segment)


def _without_payload(segment: Segment) -> pa.RecordBatch:
    """What can be said of a segment whose type this program does not know: its times are the segment's earliest."""
    count = segment.header.event_count
    first = segment.header.first_sequence
    columns = {
        "station": pa.repeat(segment.stream.station, count),
        "source": pa.repeat(segment.stream.source, count),
        "type": pa.repeat(segment.stream.type, count),
        "subject": pa.nulls(count, pa.string()),
        "time": pa.repeat(pa.scalar(segment.header.time_min, _TIMESTAMP), count),
        "sequence": pa.array(range(first, first + count), pa.int64()),
    }
    return _placed(pa.RecordBatch.from_pydict(columns), segment)


def _placed(batch: pa.RecordBatch, segment: Segment) -> pa.RecordBatch:
    count = batch.num_rows
    position = pa.repeat(pa.scalar(segment.position, pa.int64()), count)
    recorded_at = pa.repeat(pa.scalar(segment.recorded_at, _TIMESTAMP), count)
    return batch.append_column("position", position).append_column("recorded_at", recorded_at)


def _segments(log: Log, types: Sequence[str] | None, scope: Scope) -> Iterator[Segment]:
    return log.read_all(
        types=types, since=scope.since, until=scope.until, sources=scope.sources, stations=scope.stations
    )


def _in_scope(table: pa.Table, scope: Scope) -> pa.Table:
    """The rows in the scope's span of time; segments were chosen whole."""
    time = table.column("time")
    if scope.since is not None:
        table = table.filter(pc.greater_equal(time, pa.scalar(scope.since, _TIMESTAMP)))
        time = table.column("time")
    return table if scope.until is None else table.filter(pc.less(time, pa.scalar(scope.until, _TIMESTAMP)))


def _streams(log: Log) -> pa.Table:
    heads = log.streams()
    return pa.table(
        {
            "station": pa.array([head.stream.station for head in heads], pa.string()),
            "epoch": pa.array([head.epoch for head in heads], pa.int64()),
            "source": pa.array([head.stream.source for head in heads], pa.string()),
            "type": pa.array([head.stream.type for head in heads], pa.string()),
            "sequence": pa.array([head.sequence for head in heads], pa.int64()),
            "chain_hash": pa.array([head.chain_hash.hex() for head in heads], pa.string()),
        }
    )


def _explained(error: duckdb.Error, log: Log) -> WrongUsage:
    known = ", ".join(["events", "streams", *sorted(_names(log.catalogue))])
    text = str(error)
    hint = f"\nTables: {known}." if isinstance(error, duckdb.CatalogException) else ""
    if "match_recognize" in text.lower():
        hint = "\nMATCH_RECOGNIZE in queries is not supported yet; rules have it: vian rules run."
    return WrongUsage(f"the query is not right: {text}{hint}")


def _names(types: Iterable[type[EventType]]) -> list[str]:
    return [event_type.type_name for event_type in types]
