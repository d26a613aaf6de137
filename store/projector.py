"""The row projector: segments in, typed rows out, for psql and every SQL tool.

Contract: a subscriber whose rows and checkpoint commit together, so each event has exactly one row
whatever is killed when. Rows appear in order of position. A segment of an unknown type or version
has no rows until a ViAn that knows it rebuilds the table, nor has one with a value that PostgreSQL
cannot hold; it is counted and named, never a reason to stop the others.
"""

import logging
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import psycopg
import pyarrow as pa
import pyarrow.compute as pc
from psycopg.types.json import Jsonb
from pydantic_core import to_json

from events import CorruptSegment, EventBatch, EventType, Segment, UnknownType, decode, schema_of, with_envelope
from store.log import Log
from store.subscription import Delivery, Subscription
from store.tables import is_json

Part = tuple[Segment, EventBatch]

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


_JSON_NUL = re.compile(r"(?<!\\)((?:\\\\)*)\\u0000")


class Projector:
    """Keeps the row tables up with the log."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._subscription = Subscription(log, NAME)
        self.segments_skipped = 0
        """Segments without rows: of a type or version unknown here, or with what PostgreSQL cannot hold."""

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
            return self._store(delivery, before)
        except BaseException:
            self._subscription.position = before
            raise

    def catch_up(self) -> int:
        """Project all that is there now; the position reached."""
        while not self.step().is_caught_up:
            pass
        return self.position

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()

    def _store(self, delivery: Delivery, before: int) -> Delivery:
        """What was projected: the delivery, or nothing if another projector was faster."""
        if delivery.position == before:
            return delivery
        by_type, skipped = self._decoded(delivery.segments)
        with self._log.transaction() as transaction:
            stored = transaction.checkpoint(NAME)
            if stored.position != before:
                self._subscription.position = stored.position
                return Delivery([], stored.position, is_caught_up=False)
            for parts in by_type.values():
                skipped += _copy_what_fits(transaction.connection, parts)
            transaction.save_checkpoint(NAME, delivery.position)
        self.segments_skipped += skipped
        return delivery

    def _decoded(self, segments: Iterable[Segment]) -> tuple[dict[type[EventType], list[Part]], int]:
        by_type: dict[type[EventType], list[Part]] = {}
        skipped = 0
        for segment in segments:
            try:
                batch = decode(segment, self._log.catalogue)
            except UnknownType as error:
                skipped += 1
                logger.warning("no rows for the segment at position %d: %s", segment.position, error)
                continue
            except CorruptSegment as error:
                raise CorruptSegment(f"position {segment.position}: {error}. Next: vian verify") from error
            by_type.setdefault(batch.type, []).append((segment, batch))
        return by_type, skipped


def _copy_what_fits(connection: psycopg.Connection[Any], parts: Sequence[Part]) -> int:
    """Copy the parts, and say how many of them PostgreSQL refuses.

    It holds less than a segment does: a number beyond `numeric` in JSON, a nesting too deep.
    """
    try:
        with connection.transaction():
            _copy(connection, parts)
    except psycopg.DataError as error:
        if len(parts) > 1:
            return sum(_copy_what_fits(connection, [part]) for part in parts)
        logger.warning("no rows for the segment at position %d: %s", parts[0][0].position, error)
        return 1
    return 0


def _copy(connection: psycopg.Connection[Any], parts: Sequence[Part]) -> None:
    event_type = parts[0][1].type
    table = event_type.type_name
    payload = [field for field in schema_of(event_type) if field.name != "time"]
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
        _storable(whole.column("subject")).to_pylist(),
        whole.column("time").to_pylist(),
        whole.column("sequence").to_pylist(),
        [segment.position] * count,
        [segment.recorded_at] * count,
    ]
    for field in payload:
        values = _storable(whole.column(field.name)).to_pylist()
        columns.append([_json(field, value) for value in values] if is_json(field) else values)
    return zip(*columns, strict=True)


def _storable(column: pa.Array) -> pa.Array:
    """The column with U+FFFD for U+0000, which PostgreSQL's text cannot hold."""
    if pa.types.is_string(column.type) and pc.any(pc.match_substring(column, "\0")).as_py():
        return pc.replace_substring(column, "\0", "\N{REPLACEMENT CHARACTER}")
    return column


def _json(field: pa.Field, value: Any) -> Any:
    """A value for a `jsonb` column: text that is JSON already, or a structure."""
    if value is None:
        return None
    text = value
    if pa.types.is_list(field.type):
        text = to_json(value, inf_nan_mode="strings", bytes_mode="base64").decode()
    if "\\u0000" in text:
        text = _JSON_NUL.sub(r"\1\\ufffd", text)
    return Jsonb(text, dumps=str)
