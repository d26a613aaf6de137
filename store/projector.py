"""The row projector: segments in, typed rows out, for psql and every SQL tool.

Contract: a subscriber whose rows and checkpoint commit together, so each event has exactly one row
whatever is killed when. Rows appear in order of position. A segment of an unknown type or version
has no rows until a ViAn that knows it rebuilds the table; it is counted and named, never a reason
to stop the others.
"""

import logging
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import psycopg
import pyarrow as pa
from psycopg.types.json import Jsonb

from events import CorruptSegment, EventBatch, Segment, UnknownType, decode, with_envelope
from store.log import Log
from store.subscription import Delivery, Subscription
from store.tables import is_json

NAME = "projector"

logger = logging.getLogger(__name__)

_ENVELOPE = ("station", "source", "subject", "time", "sequence", "position", "recorded_at")
_COPY_TYPES: dict[pa.DataType, str] = {
    pa.bool_(): "bool",
    pa.int64(): "int8",
    pa.float64(): "float8",
    pa.float32(): "float4",
    pa.string(): "text",
    pa.binary(): "bytea",
    pa.timestamp("us", tz="UTC"): "timestamptz",
}


class Projector:
    """Keeps the row tables up with the log."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._subscription = Subscription(log, NAME)
        self.segments_skipped = 0
        """Segments that have no rows because their type or version is unknown here."""

    @property
    def position(self) -> int:
        """Position up to which the row tables are complete."""
        return self._subscription.position

    def step(self, timeout_s: float = 0.0) -> Delivery:
        """Project the next segments, waiting up to `timeout_s` seconds for some.

        Raises:
            LogUnavailable: The database is away; nothing is lost, step again later.
            CorruptSegment: A stored segment does not decode; `vian verify` tells more.
        """
        before = self._subscription.position
        delivery = self._subscription.poll(timeout_s)
        try:
            self._store(delivery, before)
        except BaseException:
            self._subscription.position = before
            raise
        return delivery

    def catch_up(self) -> int:
        """Project all that is there now; the position reached."""
        while not self.step().is_caught_up:
            pass
        return self.position

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()

    def _store(self, delivery: Delivery, before: int) -> None:
        if delivery.position == before:
            return
        by_type = self._decoded(delivery.segments)
        with self._log.transaction() as transaction:
            stored = transaction.checkpoint(NAME)
            if stored.position != before:
                # Another projector was faster; go on behind it.
                self._subscription.position = stored.position
                return
            for name, parts in by_type.items():
                _copy(transaction.connection, name, parts)
            transaction.save_checkpoint(NAME, delivery.position)

    def _decoded(self, segments: Iterable[Segment]) -> dict[str, list[tuple[Segment, EventBatch]]]:
        by_type: dict[str, list[tuple[Segment, EventBatch]]] = {}
        for segment in segments:
            try:
                batch = decode(segment, self._log.catalogue)
            except UnknownType as error:
                self.segments_skipped += 1
                logger.warning("no rows for the segment at position %d: %s", segment.position, error)
                continue
            except CorruptSegment as error:
                raise CorruptSegment(f"position {segment.position}: {error}. Next: vian verify") from error
            by_type.setdefault(segment.stream.type, []).append((segment, batch))
        return by_type


def _copy(connection: psycopg.Connection[Any], table: str, parts: Sequence[tuple[Segment, EventBatch]]) -> None:
    schema = parts[0][1].data.schema
    payload = [field for field in schema if field.name != "time"]
    for day in sorted({time.date() for segment, batch in parts for time in _days(segment, batch)}):
        connection.execute("select ensure_partition(%s, %s)", (table, day))
    names = [*_ENVELOPE, *(field.name for field in payload)]
    statement = psycopg.sql.SQL("copy {} ({}) from stdin (format binary)").format(
        psycopg.sql.Identifier(table), psycopg.sql.SQL(", ").join(map(psycopg.sql.Identifier, names))
    )
    types = ["text", "text", "text", "timestamptz", "int8", "int8", "timestamptz"]
    types += ["jsonb" if is_json(field) else _COPY_TYPES[field.type] for field in payload]
    with connection.cursor().copy(statement) as copy:
        copy.set_types(types)
        for segment, batch in parts:
            for row in _rows(segment, batch, payload):
                copy.write_row(row)


def _days(segment: Segment, batch: EventBatch) -> set[datetime]:
    if segment.header.time_min.date() == segment.header.time_max.date():
        return {segment.header.time_min}
    return {time.astimezone(UTC) for time in batch.data.column("time").to_pylist()}


def _rows(segment: Segment, batch: EventBatch, payload: Sequence[pa.Field]) -> Iterable[tuple[Any, ...]]:
    whole = with_envelope(segment.stream, segment.header.first_sequence, batch)
    count = len(batch)
    columns: list[Iterable[Any]] = [
        whole.column("station").to_pylist(),
        whole.column("source").to_pylist(),
        whole.column("subject").to_pylist(),
        whole.column("time").to_pylist(),
        whole.column("sequence").to_pylist(),
        [segment.position] * count,
        [segment.recorded_at] * count,
    ]
    for field in payload:
        values = whole.column(field.name).to_pylist()
        columns.append([_json(field, value) for value in values] if is_json(field) else values)
    return zip(*columns, strict=True)


def _json(field: pa.Field, value: Any) -> Any:
    """A value for a `jsonb` column: text that is JSON already, or a structure."""
    if value is None:
        return None
    return Jsonb(value) if pa.types.is_list(field.type) else Jsonb(value, dumps=str)
