"""SQL over the log: DuckDB, each event type a table, straight from the segments.

Contract: an answer rests on what the log held when the query began; projections are not needed.
Only the types that a query names are decoded, in their newest version; what is stored in a version newer than this
program knows has no row in its type's table, and is counted. Tables bear the columns of the row tables in
PostgreSQL, so a query means the same at both doors; `events` has the envelope of all types, `streams`
the heads, and `track_ground` the track points in metres.
"""

import logging
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import duckdb
import pyarrow as pa
import pyarrow.compute as pc

from events import (
    CameraCalibrated,
    EventBatch,
    EventType,
    SceneChanged,
    Segment,
    TrackPoint,
    UnknownType,
    VideoAdded,
    decode,
    schema_of,
    with_envelope,
)
from store import Log
from vian.errors import WrongUsage
from vian.settings import station_option

logger = logging.getLogger(__name__)

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
        ("epoch", pa.int32()),
    ]
)
_EXAMPLE = 'vian query "SELECT type, count(*) FROM events GROUP BY ALL"'
_WRITES = (
    duckdb.StatementType.INSERT,
    duckdb.StatementType.UPDATE,
    duckdb.StatementType.DELETE,
    duckdb.StatementType.MERGE_INTO,
    duckdb.StatementType.ALTER,
    duckdb.StatementType.DROP,
)
GROUND = "track_ground"
"""The table of track points on the ground."""
_NAMED_MOST = 3
"""Sources that a note names; of more it says how many."""
_CLAUSE = "match_recognize"
_BY_TEXT = "query_table"
"""The function that takes the name of a table as text."""
_WORD = re.compile(rb"\w+|\"\w+\"|'\w+'")
"""What can name a table of ours."""
_GUESS = re.compile(r"\nDid you mean [^\n]*")


@dataclass(frozen=True, slots=True)
class Scope:
    """Which part of the log a query sees; None is all of it."""

    since: datetime | None = None
    until: datetime | None = None
    sources: Sequence[str] | None = None
    stations: Sequence[str] | None = None
    calibration: int | None = None
    """Position of the calibration through which `track_ground` reads all of its view; None: that of each time."""
    is_as_at_central: bool = False
    """Whether tables have the columns `id` and `type` too, as they have for questions to central."""


def query(log: Log, sql: str, scope: Scope = Scope()) -> pa.Table:
    """The answer to a DuckDB query over the log, in which MATCH_RECOGNIZE clauses may stand.

    Raises:
        WrongUsage: The SQL is not right; the message says what, and where.
    """
    if _CLAUSE in sql.lower():
        return _with_clauses(log, sql, scope)
    with connect(log, sql, scope) as connection:
        try:
            _check_reads(connection.extract_statements(sql))
            return connection.execute(sql).to_arrow_table()
        except duckdb.Error as error:
            raise _explained(str(error), log) from error


def _with_clauses(log: Log, sql: str, scope: Scope) -> pa.Table:
    from patterns.errors import RuleError  # half a second that queries without the clause need not wait for
    from patterns.querying.queries import answer, take_apart

    try:
        plan = take_apart(sql)
        with connect(log, sql, scope) as connection:
            _check_reads(connection.extract_statements(plan.rest.sql))
            return answer(plan, connection)
    except (RuleError, duckdb.Error) as error:
        raise _explained(str(error), log) from error


def connect(log: Log, sql: str, scope: Scope) -> duckdb.DuckDBPyConnection:
    """A DuckDB connection that has the tables that the query names."""
    # Nothing is downloaded at run time; what DuckDB's wheel has built in is enough.
    connection = duckdb.connect(config={"autoinstall_known_extensions": False, "python_enable_replacements": False})
    connection.execute("set timezone = 'UTC'")
    for name in _named(sql):
        if (table := _table(log, name, scope)) is not None:
            connection.register(name, table)
    return connection


def _named(sql: str) -> set[str]:
    """The names in the text, in lower case; its tables are among them."""
    octets = sql.encode()
    names = set()
    for start, kind in duckdb.tokenize(sql):
        word = _WORD.match(octets, start)
        if word is not None and (kind != duckdb.token_type.string_const or _BY_TEXT in sql.lower()):
            names.add(word[0].strip(b"'\"").decode().lower())
    return names


def _check_reads(statements: Sequence[duckdb.Statement]) -> None:
    if not statements:
        raise WrongUsage(f"the query is empty. Next: {_EXAMPLE}")
    if len(statements) > 1:
        raise WrongUsage(f"a query is one statement, got {len(statements)}. Next: ask one after the other")
    if statements[0].type in _WRITES:
        raise WrongUsage(
            f"the log is append-only, and query only reads: wanted SELECT, got {statements[0].type.name}. "
            f"Next: {_EXAMPLE}"
        )


def _table(log: Log, name: str, scope: Scope) -> pa.Table | None:
    if name == "streams":
        return _streams(log)
    if name == "events":
        return _in_scope(_events(log, scope), scope)
    if name == GROUND and name not in log.catalogue:
        return _ground(log, scope)
    if name in log.catalogue:
        return _in_scope(_rows(log, log.catalogue.newest(name), scope), scope)
    return None


def _rows(log: Log, event_type: type[EventType], scope: Scope) -> pa.Table:
    """The row table of a type: envelope columns, then the type's fields."""
    payload = [field.remove_metadata() for field in schema_of(event_type) if field.name != "time"]
    fields = [pa.field(field.name, field.type) for field in payload]
    epoch = pa.field("epoch", pa.int32())
    schema = pa.schema([*_EVENTS, *fields] if scope.is_as_at_central else [*_FRONT, *fields, epoch])
    batches, unknown = [], Counter[str]()
    for segment, events in _decoded(log, [event_type.type_name], scope):
        if isinstance(events, UnknownType):
            unknown[str(events)] += segment.header.event_count
        else:
            placed = _with_place(segment, events)
            batches.append(placed.append_column("id", _ids(segment, placed)).select(schema.names).cast(schema))
    for reason, count in unknown.items():
        logger.warning("the answer leaves out %d events: %s", count, reason)
    return pa.Table.from_batches(batches, schema=schema)


def _ground(log: Log, scope: Scope) -> pa.Table:
    """The track points in scope on the ground; calibrations of all times, since one holds until the next.

    Raises:
        WrongUsage: There is no calibration at the position that the scope names.
    """
    from vian.grounding import track_ground  # the numbers' libraries, which other queries need not wait for

    always = replace(scope, since=None, until=None, is_as_at_central=False)
    points = _in_scope(_rows(log, TrackPoint, replace(scope, is_as_at_central=False)), scope)
    calibrations = _rows(log, CameraCalibrated, always)
    known = sorted(set(calibrations.column("position").to_pylist()))
    if scope.calibration is not None and scope.calibration not in known:
        have = ", ".join(map(str, known)) or "none"
        raise WrongUsage(
            f"there is no calibration at position {scope.calibration}; there are: {have}. "
            'Next: vian query "SELECT position, source, time, method FROM camera_calibrated"'
        )
    videos, changes = (_rows(log, each, always) for each in (VideoAdded, SceneChanged))
    table = track_ground(points, calibrations, videos, changes, scope.calibration)
    if (note := _without_metres(table, calibrations, scope.calibration)) is not None:
        logger.warning(note)
    return table


def _without_metres(table: pa.Table, calibrations: pa.Table, named: int | None) -> str | None:
    """What is to be said of sources whose points no calibration holds for; None: nothing.

    Args:
        table: Rows of `track_ground`.
        calibrations: Rows of `camera_calibrated`.
        named: Position of the calibration that the query names, if it names one.
    """
    counts = table.group_by(["station", "source"]).aggregate([([], "count_all"), ("calibration_position", "count")])
    lacking = [
        (row["station"], row["source"], row["count_all"] - row["calibration_position_count"], row["count_all"])
        for row in counts.sort_by([("station", "ascending"), ("source", "ascending")]).to_pylist()
        if row["count_all"] > row["calibration_position_count"]
    ]
    if not lacking:
        return None
    station, source, _, _ = lacking[0]
    which = ", ".join(f"{lacks} of {count} points of {source}" for _, source, lacks, count in lacking[:_NAMED_MOST])
    which += f" and points of {len(lacking) - _NAMED_MOST} more sources" if len(lacking) > _NAMED_MOST else ""
    if named is not None:
        there = calibrations.filter(pc.equal(calibrations.column("position"), named))
        of, views = there.column("source")[0], "one view" if len(there) == 1 else f"up to {len(there)} views"
        return (
            f"{GROUND}: calibration {named} is of {views} of {of}, between two moves, so {which} have no metres. "
            f"Next: add --source {of}, or leave --calibration out: then each point is read through that of its time"
        )
    station = station_option(station)
    return (
        f"{GROUND}: no calibration holds for {which}, which have no metres. Next: vian extract calibration --source "
        f"{source}{station} finds one or says what is missing; vian zones calibrate {source} POINTS.yaml{station}"
    )


def _events(log: Log, scope: Scope) -> pa.Table:
    """The envelope of all events, those of unknown types included."""
    batches = [_envelope(segment, events) for segment, events in _decoded(log, None, scope)]
    return pa.Table.from_batches(batches, schema=_EVENTS)


def _envelope(segment: Segment, events: EventBatch | UnknownType) -> pa.RecordBatch:
    whole = _without_payload(segment) if isinstance(events, UnknownType) else _with_place(segment, events)
    columns = (whole.column(name) for name in _EVENTS.names[1:])
    return pa.RecordBatch.from_arrays([_ids(segment, whole), *columns], schema=_EVENTS)


def _ids(segment: Segment, events: pa.RecordBatch) -> pa.Array:
    """The id of each event."""
    life = f"{segment.header.epoch}:" if segment.header.epoch > 1 else ""
    prefix = pa.scalar(f"{segment.stream}/{life}", pa.string())
    return pc.binary_join_element_wise(prefix, events.column("sequence").cast(pa.string()), "")


def _with_place(segment: Segment, events: EventBatch) -> pa.RecordBatch:
    return _placed(with_envelope(segment.stream, segment.header.first_sequence, events), segment)


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
    epoch = pa.repeat(pa.scalar(segment.header.epoch, pa.int32()), count)
    placed = batch.append_column("position", position).append_column("recorded_at", recorded_at)
    return placed.append_column("epoch", epoch)


def _decoded(log: Log, types: Sequence[str] | None, scope: Scope) -> Iterator[tuple[Segment, EventBatch | UnknownType]]:
    """The segments in scope, each with its events, or with why this program does not know them."""
    for segment in _segments(log, types, scope):
        try:
            yield segment, decode(segment, log.catalogue)
        except UnknownType as error:
            yield segment, error


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


def _explained(text: str, log: Log) -> WrongUsage:
    known, hint = ", ".join(tables(log)), ""
    if "Table with name" in text:
        # DuckDB guesses among its own tables only: ours are there when the query names them.
        text, hint = _GUESS.sub("", text), f"\nTables: {known}."
    return WrongUsage(f"the query is not right: {text}{hint}")


def tables(log: Log) -> list[str]:
    """The tables that a query may name."""
    return ["events", "streams", GROUND, *sorted(event_type.type_name for event_type in log.catalogue)]
