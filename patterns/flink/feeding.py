"""What feeds a pattern: a table for each event type, and a view with the rows as the rule reads them.

Each arm of FROM becomes a query over its table, several are united column by column; rows of several arms
keep the total order by the stream's name, and rows of one event by the number of the arm.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pyarrow as pa

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Column, Kind, reach
from patterns.binding.inputs import Input
from patterns.durations import microseconds
from patterns.flink.names import TYPES, later_sql, quoted, text
from patterns.flink.options import Options
from patterns.flink.refusing import Refuse
from patterns.flink.scalars import Place, operand_sql, sql
from patterns.flink.shapes import Shapes
from patterns.flink.tables import ROWTIME, create_table, kafka, table_columns
from patterns.flink.timers import TIMER, Timer, moved_by
from patterns.language.syntax import Query

STREAM, ARM = "stream", "arm"
_MOST_OFTEN_READ = ("time", "sequence")


@dataclass(frozen=True, slots=True)
class Feed:
    """The tables and the input of one rule."""

    bound: BoundRule
    query: Query
    schemas: Mapping[str, pa.Schema]
    options: Options
    shapes: Shapes
    refuse: Refuse
    timer: Timer | None = None

    def tables(self) -> Iterator[tuple[str, str]]:
        """For each event type without a table its CREATE TABLE."""
        for number, arm in enumerate(self.bound.inputs):
            if arm.situation_of is not None:
                self.refuse("situations as input", self._at(number))
        for name in dict.fromkeys(each.type for each in self.bound.inputs):
            if name not in self.options.source_tables:
                yield name, self._table(name)
            elif self.timer is not None:
                self.refuse("TIMER over a given table", self.query.clause.pattern_at)
            if self.timer is not None:
                yield name, self._table(name, self.timer)

    def view(self) -> str:
        """The query for the rows that the rule reads: filtered, widened, and asked for their zones."""
        taken = sorted({ROWTIME, STREAM, ARM, TIMER} & set(self.bound.columns))
        if taken:
            self.refuse("column of a name of the script's", self._at(0), f"; here {taken[0]!r}")
        sources = self.options.source_tables
        arms = [self._arm(at, arm, sources.get(arm.type, arm.type)) for at, arm in enumerate(self.bound.inputs)]
        if self.timer is not None:
            arms += [self._virtual(number, arm, self.timer) for number, arm in enumerate(self.bound.inputs)]
        place = Place(0, self.refuse, self.shapes)
        asked = [f"{sql(expr, place)} AS {quoted(name)}" for expr, name in self.shapes.columns.items()]
        united = "\nUNION ALL\n".join(arms)
        return f"SELECT {', '.join(['*', *asked])}\nFROM (\n{_indented(united)}\n)" if asked else united

    @property
    def order(self) -> list[str]:
        """The columns of the total order: event time first."""
        order = [ROWTIME] if self.options.whole_milliseconds else [ROWTIME, "time"]
        order += [] if self.timer is None else [TIMER]
        return [*order, *self.place, *([ARM] if self._has_arms_of_one_type else [])]

    @property
    def place(self) -> list[str]:
        """The columns that name an event among those of its partition."""
        return ["sequence"] if self.has_one_stream else [STREAM, "sequence"]

    @property
    def has_one_stream(self) -> bool:
        """Whether all rows of a partition are of one stream, so that `sequence` orders those of one time."""
        has_one_type = len(self.bound.types) == 1
        return self.options.one_station and has_one_type and "source" in self.bound.keys

    @property
    def _has_arms_of_one_type(self) -> bool:
        return len(self.bound.types) < len(self.bound.inputs)

    def _table(self, name: str, timer: Timer | None = None) -> str:
        reads: dict[str, object] = {}
        for arm in self.bound.inputs:
            if arm.type == name:
                reads |= arm.reads
        columns = table_columns(reads, self.schemas[name], has_stations=not self.options.one_station)
        given = {key: value.replace("{type}", name) for key, value in self.options.connector.items()}
        lateness_us = microseconds(self.bound.rule.time.lateness)
        later_us = 0 if timer is None else timer.duration_us
        made = name if timer is None else name + moved_by(timer)
        return create_table(made, columns, given or kafka(name), lateness_us, later_us)

    def _arm(self, number: int, arm: Input, table: str) -> str:
        """The query for the rows of one arm, over this table."""
        at = self._at(number)
        place = Place(at, self.refuse, self.shapes)
        events = f"SELECT {', '.join(self._events(arm, at))}\nFROM {quoted(table)}"
        if self._is_alone(arm) and arm.where is None:
            return events
        columns = ["*"]
        if not self._is_alone(arm):
            columns = [quoted(name) for name in (ROWTIME, *_MOST_OFTEN_READ)]
            columns += [] if self.has_one_stream else [quoted(STREAM)]
            columns += [f"{number} AS {quoted(ARM)}"] if self._has_arms_of_one_type else []
            columns += [
                quoted(name) if value == Column(name, value.kind) else
                f"CAST({operand_sql(value, place)} AS {TYPES[self.bound.columns[name]]}) AS {quoted(name)}"
                for name, value in arm.projected.items() if name not in _MOST_OFTEN_READ
            ]  # fmt: skip
            columns += [] if self.timer is None else [f"0 AS {quoted(TIMER)}"]
        filtered = "" if arm.where is None else f"\nWHERE {sql(arm.where, place)}"
        return f"SELECT {', '.join(columns)}\nFROM (\n{_indented(events)}\n){filtered}"

    def _virtual(self, number: int, arm: Input, timer: Timer) -> str:
        """The query for the virtual rows that the arm's events set."""
        place = Place(self._at(number), self.refuse, self.shapes)
        setters = self._arm(number, arm, arm.type + moved_by(timer))
        columns = [quoted(ROWTIME), f"{later_sql('`time`', timer.duration_us)} AS `time`", "`sequence`"]
        columns += [] if self.has_one_stream else [quoted(STREAM)]
        columns += [quoted(ARM)] if self._has_arms_of_one_type else []
        for name, kind in self.bound.columns.items():
            if name in self.bound.keys:
                columns.append(quoted(name))
            elif name not in _MOST_OFTEN_READ:
                value = text("timer") if name == "type" else "NULL"
                columns.append(f"CAST({value} AS {TYPES[kind]}) AS {quoted(name)}")
        condition = self.bound.conditions[self.bound.variables.index(timer.setter)]
        local = [self.bound.predicates[at] for at in condition.predicates]
        asked = [operand_sql(each, place) for each in local if not reach(each)]
        filtered = f"\nWHERE {' AND '.join(asked)}" if asked else ""
        return f"SELECT {', '.join([*columns, f'1 AS {quoted(TIMER)}'])}\nFROM (\n{_indented(setters)}\n){filtered}"

    def _is_alone(self, arm: Input) -> bool:
        """Whether the rows are the arm's events and nothing else."""
        return arm.is_plain and len(self.bound.inputs) == 1 and self.timer is None

    def _events(self, arm: Input, at: int) -> list[str]:
        """The columns that the arm reads of an event, integers and numbers as wide as they are here."""
        columns = [quoted(name) for name in (ROWTIME, *_MOST_OFTEN_READ)]
        if not self.has_one_stream:
            station = "" if self.options.one_station else "`station` || '/' || "
            columns.append(f"{station}`source` || {text('/' + arm.type)} AS {quoted(STREAM)}")
        for name, kind in arm.reads.items():
            if name == "type":
                columns.append(f"{text(arm.type)} AS `type`")
            elif name == "station" and self.options.one_station:
                self.refuse("one station", at)
            elif kind in (Kind.INT, Kind.FLOAT) and name not in _MOST_OFTEN_READ:
                columns.append(f"CAST({quoted(name)} AS {TYPES[kind]}) AS {quoted(name)}")
            elif name not in _MOST_OFTEN_READ:
                columns.append(quoted(name))
        return columns

    def _at(self, number: int) -> int:
        where = self.query.arms[number].where
        return self.query.arms[number].source_type.at if where is None else where.at


def _indented(block: str) -> str:
    return "\n".join(f"    {line}" for line in block.splitlines())
