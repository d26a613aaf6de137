"""What a rule reads: one or several arms, each an event type, a filter and a projection.

FROM names an event type, or unites arms BY NAME: a row of the input has the columns of all arms, NULL
where its own arm has none. Numbers widen; otherwise a column has one type in all arms. The envelope's
columns are always there and always the event's own, so `type` tells the arms apart. Both halves are
pure: `bind_arms` knows names, `Input.rows` knows columns.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from patterns.binding.columns import ColumnEvaluator, Rows, arrow_type
from patterns.binding.expressions import Call, Column, Const, Expr, Kind, column_names, is_row_local, reach, walk
from patterns.binding.rows import SEQUENCE, STREAM, TIME, StreamNumbers, normalised
from patterns.binding.typing_rules import as_float
from patterns.durations import microseconds
from patterns.errors import MatchError
from patterns.language.syntax import Arm, Scalar
from patterns.language.text import Passage, did_you_mean
from patterns.scene.places import Places

ENVELOPE = {
    "time": Kind.TIME, "sequence": Kind.INT, "source": Kind.STRING, "station": Kind.STRING,
    "subject": Kind.STRING, "type": Kind.STRING,
}  # fmt: skip

SITUATION = "situation_detected"
SITUATION_FIELDS = {
    "situation": Kind.STRING, "rule": Kind.STRING, "rule_version": Kind.INT, "severity": Kind.STRING,
    "title": Kind.STRING, "began_at": Kind.TIME, "ended_at": Kind.TIME,
}  # fmt: skip
"""Columns that the situations of every rule have, whatever its partition columns and measures are called."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

Translate = Callable[[Scalar, str, "Readable"], Expr]
"""(expression, clause, columns) -> the expression over them."""


@dataclass(frozen=True, slots=True)
class Readable:
    """The columns that names may mean: those that rules can read, and the Arrow types of the others."""

    columns: Mapping[str, Kind]
    unreadable: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Input:
    """One arm: which events feed the rule, and as what rows.

    Attributes:
        type: The event type.
        situation_of: The rule whose situations these are, and whose partition columns and measures
            are columns; None: events of the type, with the type's fields.
        reads: The columns that are read of an event, with their types.
        where: The filter; None: every event.
        projected: For each column that the rule reads, its value.
    """

    type: str
    situation_of: str | None
    reads: Mapping[str, Kind]
    where: Expr | None
    projected: Mapping[str, Expr]

    @property
    def is_plain(self) -> bool:
        """Whether a row is the event itself: its columns by their own names, none computed."""
        return self.type != SITUATION and all(
            isinstance(value, Column) and value.name == name for name, value in self.projected.items()
        )

    def rows(self, table: pa.Table, streams: StreamNumbers, places: Places) -> pa.Table | None:
        """The rows that these events, of any types, are for the rule, in the engine's shape and their own order.

        None where no event is of the type.

        Raises:
            MatchError: A column that the rule reads is missing or of another type.
        """
        events = table.filter(pc.equal(table.column("type"), self.type))
        if events.num_rows == 0:
            return None
        if self.situation_of is not None:
            events = situation_columns(events, self.situation_of, self.reads)
        elif self.type == SITUATION:
            events = resting_on_none(events)
        events = normalised(events, self.reads, streams)
        if self.where is not None and events.num_rows:
            events = events.filter(pa.array(_evaluator(events, places).truth(self.where)))
        if events.num_rows == 0:
            return None
        if self.is_plain:
            return events.select([STREAM, TIME, SEQUENCE, *self.projected])
        evaluator = _evaluator(events, places)
        values = [evaluator.column(value) for value in self.projected.values()]
        kept = [events.column(name) for name in (STREAM, TIME, SEQUENCE)]
        return pa.table([*kept, *values], names=[STREAM, TIME, SEQUENCE, *self.projected])


@dataclass(frozen=True, slots=True)
class BoundArms:
    """The arms of FROM with their names resolved, before it is known what the rule reads.

    Attributes:
        readable: What a row of the input may be asked for.
        arms: For each arm its type, the rule of its situations, its filter, and its columns.
    """

    readable: Readable
    arms: tuple[tuple[str, str | None, Expr | None, Mapping[str, Expr]], ...]

    def inputs(self, names: Sequence[str]) -> tuple[Input, ...]:
        """The arms as inputs of a rule that reads these columns."""
        return tuple(self._input(arm, names) for arm in self.arms)

    def _input(self, arm: tuple[str, str | None, Expr | None, Mapping[str, Expr]], names: Sequence[str]) -> Input:
        event_type, rule, where, columns = arm
        projected = {}
        for name in names:
            kind = self.readable.columns[name]
            value = columns.get(name, Const(None, kind))
            projected[name] = as_float(value) if kind is Kind.FLOAT and value.kind is Kind.INT else value
            if value.kind is Kind.NULL:
                projected[name] = Const(None, kind)
        read = (*projected.values(), *(() if where is None else (where,)))
        kinds = {part.name: part.kind for expr in read for part in walk(expr) if isinstance(part, Column)}
        return Input(event_type, rule, {name: kinds[name] for name in sorted(column_names(read))}, where, projected)


def rows_of(inputs: Sequence[Input], table: pa.Table, streams: StreamNumbers, places: Places) -> pa.Table | None:
    """The rows that these events, of any types, are for a rule of these inputs; None if there are none.

    Rows of several arms come arm by arm; of one event in the order of the arms, which the total order keeps.

    Raises:
        MatchError: A column that the rule reads is missing or of another type.
    """
    arms = [each.rows(table, streams, places) for each in inputs]
    kept = [rows for rows in arms if rows is not None and rows.num_rows]
    return pa.concat_tables(kept) if kept else None


def _evaluator(events: pa.Table, places: Places) -> ColumnEvaluator:
    return ColumnEvaluator(Rows(events, np.zeros(events.num_rows, dtype=np.int64)), places)


def situation_key(rule: str) -> str:
    """The name under which a rule's situations stand among the event types that rules may read."""
    return f"situation('{rule}')"


def bind_arms(
    arms: Sequence[Arm], schemas: Mapping[str, pa.Schema], own: str, passage: Passage, translate: Translate
) -> BoundArms:
    """The arms with their names resolved.

    Args:
        arms: FROM, as parsed.
        schemas: The event types there are; situations of a rule under `situation_key`.
        own: The rule that reads: it never reads its own situations.
        passage: The SQL, for errors.
        translate: Resolves the names of an expression.

    Raises:
        RuleError: An unknown type or column, a column of two types, a filter that is no condition.
    """
    kinds: dict[str, Kind] = {}
    unreadable: dict[str, str] = {}
    bound = []
    for arm in arms:
        read = _readable(arm, schemas, own, passage)
        where = None if arm.where is None else _checked(arm.where, "WHERE", read, passage, translate)
        if where is not None and where.kind not in (Kind.BOOL, Kind.NULL):
            assert arm.where is not None, "a filter was translated"
            raise passage.error(f"WHERE: wanted a condition, got {where.kind.value}", arm.where.at)
        columns, places = _projection(arm, read, passage, translate)
        for name, value in columns.items():
            kinds[name] = _united(name, kinds.get(name), value.kind, passage, places.get(name, arm.source_type.at))
        unreadable |= read.unreadable if arm.has_star else {}
        if arm.source_type.name == SITUATION and arm.situation_of is None:
            where = _and(where, Call("<>", (Column("rule", Kind.STRING), Const(own, Kind.STRING)), Kind.BOOL))
        bound.append((arm.source_type.name, arm.situation_of, where, columns))
    kinds = {name: Kind.STRING if kind is Kind.NULL else kind for name, kind in kinds.items()}
    unreadable = {name: why for name, why in unreadable.items() if name not in kinds}
    return BoundArms(Readable(kinds, unreadable), tuple(bound))


def resting_on_none(events: pa.Table) -> pa.Table:
    """The situations among these that rest on no situation themselves, so that no rule can feed on its own.

    Events without lineage, as a test may give them, rest on none.
    """
    if "lineage" not in events.column_names:
        return events
    ending = f"/{SITUATION}"
    rests = [
        any(matched["stream"].endswith(ending) for matched in lineage)
        for lineage in events.column("lineage").to_pylist()
    ]  # fmt: skip
    return events.filter(pa.array([not each for each in rests], pa.bool_()))


def situation_columns(events: pa.Table, rule: str, reads: Mapping[str, Kind]) -> pa.Table:
    """The rule's situations among these, with its partition columns and measures as columns.

    These are read from the events' JSON; events without it, as a test may give them, have the columns already.
    """
    events = events.filter(pc.equal(events.column("rule"), rule))
    if "measures" not in events.column_names:
        return events
    texts = [events.column(name).to_pylist() for name in ("partition", "measures")]
    said = [json.loads(partition) | json.loads(measures) for partition, measures in zip(*texts, strict=True)]
    for name, kind in reads.items():
        if name in ENVELOPE or name in SITUATION_FIELDS:
            continue
        column = pa.array([_from_json(each.get(name), kind, name) for each in said], arrow_type(kind))
        at = events.schema.get_field_index(name)
        events = events.append_column(name, column) if at < 0 else events.set_column(at, name, column)
    return events


def _from_json(value: Any, kind: Kind, name: str) -> Any:
    """The value that a situation says, as the engine has it."""
    if value is None:
        return None
    try:
        if kind is Kind.TIME:
            return microseconds(datetime.fromisoformat(value) - _EPOCH)
        if kind is Kind.DURATION:
            return microseconds(timedelta(seconds=value))
    except (TypeError, ValueError) as error:
        raise MatchError(f"{name} of a situation is not a {kind.value}: {value!r}") from error
    return float(value) if kind is Kind.FLOAT else value


def _and(left: Expr | None, right: Expr) -> Expr:
    return right if left is None else Call("and", (left, right), Kind.BOOL)


def _readable(arm: Arm, schemas: Mapping[str, pa.Schema], own: str, passage: Passage) -> Readable:
    name = arm.source_type.name if arm.situation_of is None else situation_key(arm.situation_of)
    if arm.situation_of == own:
        raise passage.error(f"FROM: a rule cannot feed on its own situations: {own} reads {own}", arm.source_type.at)
    if name not in schemas:
        is_type = arm.situation_of is None
        known = sorted(each for each in schemas if each.startswith("situation(") is not is_type)
        what = (
            f"unknown event type {name!r}" if is_type else f"no rule {arm.situation_of!r} whose situations can be read"
        )
        have = ", ".join(known) or "none"
        following = "" if is_type else ". Next: give its file too, or deploy it"
        raise passage.error(
            f"FROM: {what}; there are: {have}{did_you_mean(name, known)}{following}", arm.source_type.at
        )
    readable, unreadable = dict(ENVELOPE), {}
    for column in schemas[name]:
        kind = kind_of(column.type)
        if kind is None:
            unreadable[column.name] = str(column.type)
        elif column.name not in ENVELOPE:
            readable[column.name] = kind
    return Readable(readable, unreadable)


def _projection(
    arm: Arm, read: Readable, passage: Passage, translate: Translate
) -> tuple[dict[str, Expr], dict[str, int]]:
    """The arm's columns, and where each is written; the envelope's are always among them."""
    named = ENVELOPE if not arm.has_star else read.columns
    columns: dict[str, Expr] = {name: Column(name, kind) for name, kind in named.items()}
    places: dict[str, int] = {}
    for item in arm.items:
        name = item.column
        if name in places:
            raise passage.error(f"SELECT: {name!r} is named twice", item.at)
        places[name] = item.at
        value = _checked(item.value, "SELECT", read, passage, translate)
        if name in ENVELOPE and value != columns[name]:
            message = f"SELECT: {name} is the event's own and cannot be another value. Next: choose another name"
            raise passage.error(message, item.at)
        if arm.has_star and name in read.columns and value != columns[name]:
            message = (
                f"SELECT: {name!r} is ambiguous: * has it already, of {arm.source_type.name}. Next: choose another name"
            )
            raise passage.error(message, item.at)
        columns[name] = value
    return columns, places


def _checked(scalar: Scalar, clause: str, read: Readable, passage: Passage, translate: Translate) -> Expr:
    expr = translate(scalar, clause, read)
    if not is_row_local(expr) or reach(expr):
        raise passage.error(f"{clause}: an arm of FROM reads one event at a time", scalar.at)
    return expr


def _united(name: str, known: Kind | None, kind: Kind, passage: Passage, at: int) -> Kind:
    if known is None or known is Kind.NULL or known is kind:
        return kind
    if kind is Kind.NULL:
        return known
    if {known, kind} == {Kind.INT, Kind.FLOAT}:
        return Kind.FLOAT
    raise passage.error(
        f"UNION ALL BY NAME: column {name} is a {known.value} in one arm and a {kind.value} in another", at
    )


def kind_of(arrow: pa.DataType) -> Kind | None:
    """The language's type of an Arrow column; None: rules cannot read it."""
    types = pa.types
    if types.is_dictionary(arrow):
        return kind_of(arrow.value_type)
    checks = (
        (types.is_boolean, Kind.BOOL), (types.is_integer, Kind.INT), (types.is_floating, Kind.FLOAT),
        (types.is_string, Kind.STRING), (types.is_large_string, Kind.STRING),
        (types.is_timestamp, Kind.TIME), (types.is_duration, Kind.DURATION),
    )  # fmt: skip
    return next((kind for check, kind in checks if check(arrow)), None)
