"""What the log is measured against: each the plain or the usual way to do the same."""

import json
import threading
from collections.abc import Callable, Sequence
from typing import Any
from uuid import UUID, uuid4

import pgpq
import psycopg
import pyarrow as pa
from psycopg.types.json import Jsonb

from benchmarks.points import points, row_batch
from events import EventBatch

_TYPES: dict[pa.DataType, str] = {
    pa.string(): "text",
    pa.int32(): "integer",
    pa.int64(): "bigint",
    pa.float32(): "real",
    pa.timestamp("us", tz="UTC"): "timestamptz",
}


class TypedTable:
    """A table with a column for each field and no index, filled by binary COPY."""

    def __init__(self, dsn: str, name: str = "reference_typed", schema: pa.Schema | None = None) -> None:
        self.connection = psycopg.connect(dsn, autocommit=True)
        self.name = name
        schema = schema or row_batch(points(1, 0), 0, 1).schema
        columns = ", ".join(f"{field.name} {_TYPES[field.type]} not null" for field in schema)
        self.connection.execute(f"drop table if exists {name}")
        self.connection.execute(f"create table {name} ({columns})")
        self._copy = f"copy {name} ({', '.join(schema.names)}) from stdin (format binary)"

    def copy(self, rows: pa.RecordBatch) -> None:
        """Encode the rows and COPY them, durably."""
        encoder = pgpq.ArrowToPostgresBinaryEncoder(rows.schema)
        with self.connection.cursor().copy(self._copy) as copy:
            copy.write(encoder.write_header())
            copy.write(encoder.write_batch(rows))
            copy.write(encoder.finish())

    def bytes(self) -> int:
        """Bytes on disk."""
        return _size(self.connection, self.name)


class JsonTable:
    """What most event stores on PostgreSQL have: one table, JSONB payload, two indexes."""

    def __init__(self, dsn: str) -> None:
        self.connection = psycopg.connect(dsn, autocommit=True)
        self.connection.execute("drop table if exists reference_jsonb")
        self.connection.execute(
            "create table reference_jsonb (position bigint generated always as identity primary key, "
            "stream text not null, sequence bigint not null, type text not null, time timestamptz not null, "
            "data jsonb not null, unique (stream, sequence))"
        )

    def copy(self, batch: EventBatch, stream: str, first_sequence: int) -> None:
        """COPY the events as JSON."""
        with self.connection.cursor().copy(
            "copy reference_jsonb (stream, sequence, type, time, data) from stdin (format binary)"
        ) as copy:
            copy.set_types(["text", "int8", "text", "timestamptz", "jsonb"])
            for number, row in enumerate(batch.data.to_pylist()):
                time = row.pop("time")
                copy.write_row((stream, first_sequence + number, "track_point", time, Jsonb(row)))

    def bytes(self) -> int:
        """Bytes on disk, indexes included."""
        return _size(self.connection, "reference_jsonb")


class EventSourcing:
    """pyeventsourcing's recorder on PostgreSQL: a row an event, JSON in bytes, gapless by a table lock."""

    def __init__(self, dsn: str, threads: int) -> None:
        from eventsourcing.persistence import StoredEvent
        from eventsourcing.postgres import PostgresApplicationRecorder, PostgresDatastore

        info = psycopg.conninfo.conninfo_to_dict(dsn)
        self._datastore = PostgresDatastore(
            dbname=str(info["dbname"]),
            host=str(info["host"]),
            port=str(info.get("port", 5432)),
            user=str(info["user"]),
            password="",
            pool_size=threads,
        )
        self._recorder: Any = PostgresApplicationRecorder(self._datastore, events_table_name="reference_events")
        self._recorder.create_table()
        self._stored: Any = StoredEvent

    def prepared(self, calls: int, per_call: int) -> list[list[Any]]:
        """Calls of so many events each, of one aggregate of its own, encoded as JSON beforehand."""
        originator: UUID = uuid4()
        rows = points(per_call, 1).data.to_pylist()
        states = [json.dumps(row, default=str).encode() for row in rows]
        return [
            [
                self._stored(originator, call * per_call + number + 1, "track_point", state)
                for number, state in enumerate(states)
            ]
            for call in range(calls)
        ]

    def insert(self, calls: Sequence[list[Any]]) -> None:
        """Insert call by call; each is durable when it returns."""
        for call in calls:
            self._recorder.insert_events(call)

    def close(self) -> None:
        """Give the connections back."""
        self._datastore.close()


def in_threads(work: Sequence[Callable[[], None]]) -> None:
    """All at once, each in a thread of its own."""
    threads = [threading.Thread(target=each) for each in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def adbc_table(dsn: str, table: str) -> int:
    """Rows of a table fetched to Arrow through ADBC."""
    from adbc_driver_postgresql import dbapi

    with dbapi.connect(dsn) as connection, connection.cursor() as cursor:
        cursor.execute(f"select * from {table}")
        return int(cursor.fetch_arrow_table().num_rows)


def _size(connection: psycopg.Connection[Any], table: str) -> int:
    row = connection.execute("select pg_total_relation_size(%s::regclass)", (table,)).fetchone()
    assert row is not None
    return int(row[0])
