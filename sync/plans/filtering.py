"""What an entry's filter leaves of events: those from its time on for which its condition is true, fields left out.

Contract: columns in, columns out, in the same order; a `Sieve` is of one entry and one event type. Equal for any
split of its input, because each event is judged by itself.
"""

from collections.abc import Sequence
from datetime import datetime

import duckdb
import pyarrow as pa
import pyarrow.compute as pc

from events import EventBatch, EventType, schema_of
from sync.errors import FilterFailed, PlanError
from sync.plans.entries import Entry
from sync.plans.filters import Bound, bind
from sync.plans.where import WhereError, parse

_ROW = "row number"
"""Name of the column that numbers the rows; no field can bear it."""
_SETTINGS: dict[str, str | bool | int | float | list[str]] = {
    "threads": 1,
    "enable_external_access": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "python_enable_replacements": False,
}


def database() -> duckdb.DuckDBPyConnection:
    """What runs conditions: a DuckDB of its own, in memory, that reaches no file and no network. Close it."""
    return duckdb.connect(config=_SETTINGS)


class Sieve:
    """Filters events of one type as one entry says.

    Args:
        entry: Says how.
        event_type: The type, in its newest version.
        runs: Runs the condition, as `database` makes it; one at a time.

    Raises:
        PlanError: The condition does not fit the type, or a field that is to be left out must be there.
    """

    def __init__(self, entry: Entry, event_type: type[EventType], runs: duckdb.DuckDBPyConnection) -> None:
        self._type = event_type
        self._since = entry.since
        self._left_out = _left_out(entry, event_type)
        self._condition = None if entry.where is None else _bound(entry, entry.where, event_type)
        self._database = runs
        if self._condition is not None:
            self._try_out(entry)

    def passed(self, batch: EventBatch) -> EventBatch | None:
        """What is left of the events; None where nothing is.

        Raises:
            FilterFailed: The condition cannot be worked out for one of them.
        """
        data = batch.data
        if self._since is not None:
            data = data.filter(pc.greater_equal(data.column("time"), _scalar(self._since)))
        if self._condition is not None and data.num_rows:
            data = data.take(self._rows(data, self._condition))
        if not data.num_rows:
            return None
        columns = [
            pa.nulls(data.num_rows, field.type) if field.name in self._left_out else column
            for field, column in zip(data.schema, data.columns, strict=True)
        ]
        return EventBatch(self._type, pa.RecordBatch.from_arrays(columns, schema=data.schema))

    def _rows(self, data: pa.RecordBatch, condition: Bound) -> pa.Array:
        """Numbers of the rows for which the condition is true, ascending."""
        numbers = pa.array(range(data.num_rows), pa.int64())
        names = [*condition.columns, _ROW]
        table = pa.table([*(data.column(name) for name in condition.columns), numbers], names=names)
        try:
            self._database.register("events", table)
            found = self._database.execute(f'select "{_ROW}" from events where {condition.sql} order by 1')
            return found.to_arrow_table().column(0).combine_chunks()
        except duckdb.Error as error:
            raise FilterFailed(f"the condition fails: {' '.join(str(error).split())[:300]}") from error
        finally:
            self._database.unregister("events")

    def _try_out(self, entry: Entry) -> None:
        """Run the condition over no rows: what DuckDB will not have, it says at once."""
        assert self._condition is not None
        empty = pa.RecordBatch.from_pylist([], schema=schema_of(self._type))
        try:
            self._rows(empty, self._condition)
        except FilterFailed as error:
            raise PlanError(f"{entry.stream}: where, for {self._type.type_name}: {error}") from error


def _left_out(entry: Entry, event_type: type[EventType]) -> frozenset[str]:
    schema = schema_of(event_type)
    nullable = [field.name for field in schema if field.nullable]
    for name in entry.leave_out:
        if name not in nullable:
            what = "must always be there" if name in schema.names else "is no field of it"
            can_be = f"can be left out: {', '.join(nullable)}" if nullable else "no field of it can be left out"
            raise PlanError(
                f"{entry.stream}: {event_type.type_name} cannot go without {name[:60]!r}, which {what}; {can_be}"
            )
    return frozenset(entry.leave_out)


def _bound(entry: Entry, where: str, event_type: type[EventType]) -> Bound:
    try:
        return bind(parse(where), event_type)
    except WhereError as error:
        raise PlanError(f"{entry.stream}: where, for {event_type.type_name}: {error}") from error


def _scalar(time: datetime) -> pa.Scalar:
    return pa.scalar(time, pa.timestamp("us", tz="UTC"))


def joined(batches: Sequence[EventBatch]) -> EventBatch:
    """The events of one type in one batch, in order."""
    if len(batches) == 1:
        return batches[0]
    data = pa.Table.from_batches([batch.data for batch in batches]).combine_chunks()
    return EventBatch(batches[0].type, data.to_batches()[0])
