"""Rules that read the same rows with the same clock, run together by the kernel.

A lane does for its rules what `patterns.engine.running` and `patterns.engine.engine` do for one: it holds
rows until they are final, groups them by partition in the total order, asks each question about a row once
for all rules, and makes situations of what the kernel finds. Rules join a lane before its first row.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from events import EventType
from patterns.binding.bound import BoundRule
from patterns.binding.columns import Rows as RowsOfTable
from patterns.binding.expressions import Column, Expr, Kind, Shift, column_names, walk
from patterns.binding.inputs import Input, rows_of
from patterns.binding.rows import SEQUENCE, STREAM, TIME, StreamNumbers, Units, encoded, normalised
from patterns.durations import microseconds
from patterns.engine import kernel as k
from patterns.engine.clock import Clock
from patterns.engine.emitter import Emitter
from patterns.engine.finds import Events, Finds
from patterns.engine.interning import Keys, Texts, as_values
from patterns.engine.kernel import Integers
from patterns.engine.packed import Assembly, Packed
from patterns.engine.pools import (
    Shape,
    grown,
    new_scratch,
    new_state,
    rules_of_threads,
    with_partitions,
    with_partitions_kept,
)
from patterns.engine.records import ROW_COLUMNS, STREAM_COLUMNS, Arrived, Layout, Recorder, RowEvaluator, moved
from patterns.engine.running import Counts, GivenUp, Outcome, needs
from patterns.engine.situations import EventRef, Match, Narrator, as_python, event_ref, nearest_time
from patterns.engine.skipping import rule_skip_error
from patterns.engine.tails import Tails
from patterns.errors import FrameSizeUnknown, LimitError, MatchError, PatternError
from patterns.limits import Limits
from patterns.scene.places import Places
from patterns.scene.site import Site

SLOTS_MOST = 62
_PARTITIONS_LEAST = 1 << 15
"""Partitions below which forgetting them is not worth while."""
_TEXTS_LEAST = 1 << 10
"""Texts below which forgetting them is not worth while."""
_WAITING_TABLES_MOST = 32
"""Tables of rows that wait, each of which is looked at in each step."""
_BEFORE_ALL_US = -(2**63)
_IMPLIED = frozenset((*STREAM_COLUMNS, *ROW_COLUMNS))


@dataclass(frozen=True, slots=True)
class LaneInput:
    """What rules of one lane share.

    Attributes:
        type: The event type; None: rows are computed, or come from several arms.
        where: The filter of FROM, where it is of one type.
        arms: The arms of FROM, where they are more than that.
        keys: The partition columns.
        kinds: Their types.
        lateness_us: How late a row may be.
        idle_us: After how long a silent source holds nothing; None: never.
        limits: What the rules may use.
    """

    type: str | None
    where: Expr | None
    arms: tuple[Input, ...]
    keys: tuple[str, ...]
    kinds: tuple[Kind, ...]
    lateness_us: int
    idle_us: int | None
    limits: Limits

    @classmethod
    def of(cls, packed: Packed) -> "LaneInput":
        """That of a rule."""
        bound, plain = packed.bound, packed.bound.plain_input
        time = bound.rule.time
        return cls(
            type=None if plain is None else plain.type,
            where=packed.where,
            arms=() if plain is not None else bound.inputs,
            keys=bound.keys,
            kinds=tuple(bound.columns[name] for name in bound.keys),
            lateness_us=microseconds(time.lateness),
            idle_us=None if time.idle is None else microseconds(time.idle),
            limits=bound.limits,
        )


@dataclass(slots=True)
class Member:
    """One rule of a lane.

    Attributes:
        name: What the set knows it by.
        packed: The rule.
        wanted: The conditions and values that it asks for.
        narrator: Makes its situations.
        emitter: Holds back what is to be held back.
        matches: How many situations it gave.
        failure: Why it was set aside.
        spent_s: What the step took for this rule alone, by the lane's clock.
        readers: How to read its registers: the type of each; None: a number of rows.
        begins_us: Where it came from the general matcher: a match that a row before this time could begin it has begun.
    """

    name: str
    packed: Packed
    wanted: frozenset[Expr]
    narrator: Narrator
    emitter: Emitter
    readers: tuple[Kind | None, ...]
    matches: int = 0
    failure: Exception | None = None
    given_up: list[GivenUp] = field(default_factory=list)
    spent_s: float = 0.0
    begins_us: int | None = None

    @property
    def bound(self) -> BoundRule:
        """The rule."""
        return self.packed.bound


@dataclass(slots=True)
class _Grouped:
    """Rows by partition: their numbers group after group, in the total order.

    Attributes:
        partitions: The partition of each group.
        bounds: Where each group begins in `order`, and the end.
        order: Numbers of rows.
    """

    partitions: Integers
    bounds: Integers
    order: Integers


@dataclass(frozen=True, slots=True)
class _Found:
    """What was found of one rule, the kernel's records of it, and where that stands which it found last."""

    finds: Finds
    newest: int
    records: Integers


class Lane:
    """Rules that read the same rows. Not for several threads at once."""

    def __init__(self, input_: LaneInput, site: Site, clock: Callable[[], float], *, is_strict: bool) -> None:
        self.input = input_
        self.seconds = clock
        self.is_strict = is_strict
        self.members: list[Member] = []
        self.clock = Clock(input_.lateness_us, input_.idle_us)
        self.streams = StreamNumbers()
        self.counts = Counts()
        self.site = site
        self.waiting: list[pa.Table] = []
        self.waiting_saved: tuple[list[pa.Table], list[str], bytes] = ([], [], b"")
        """The rows that waited when a rule was saved last, the columns, and how they were encoded."""
        self.layout = Layout()
        self.zones: dict[str, Any] = {}
        self.lines: dict[str, Any] = {}
        self.texts = Texts()
        self.keys = Keys(input_.kinds)
        self.places = Places(self.zones, self.lines, site)
        self.recorder = Recorder(self.layout, self.places, self.texts, clock)
        self.columns: dict[str, Kind] = {}
        self._kept: list[str] = []
        self.tails = Tails(0, {})
        self._shape = Shape(0, 0, 0, 0)
        self.state = new_state(self._shape)
        self._place = np.empty(0, dtype=np.int64)
        self._partitions_least = _PARTITIONS_LEAST
        self._texts_least = _TEXTS_LEAST
        self._is_stale = False

    # Rules.

    @property
    def is_fresh(self) -> bool:
        """Whether a rule that joins misses nothing."""
        return not self.clock.sources and self.counts == Counts() and not self.keys.count

    def has_room(self, packed: Packed) -> bool:
        """Whether the rule's values fit beside those of the others."""
        return len({*self.layout.slots, *packed.slots}) <= SLOTS_MOST

    def join(self, name: str, packed: Packed) -> None:
        """The rule is one of the lane's, which has seen no row yet."""
        assert self.is_fresh, "a rule joins a lane before its first row"
        self._add_member(name, packed)
        self._is_stale = True

    def admit(self, name: str, packed: Packed) -> None:
        """The rule is one of the lane's, and what it remembers of the rows before now is put in afterwards."""
        assert not self._is_stale, "the lane is prepared: each rule has its place in the state"
        words, slots = self.layout.words, len(self.layout.slots)
        self._add_member(name, packed)
        self._begin_columns()
        rows, failures = self.state.last_rows, self.state.failures
        wider = np.zeros((len(rows), k.R_BITS + self.layout.words + len(self.layout.slots)), dtype=np.int64)
        wider[:, : k.R_BITS + words] = rows[:, : k.R_BITS + words]
        first = k.R_BITS + self.layout.words
        wider[:, first : first + slots] = rows[:, k.R_BITS + words :]
        # What no rule said of these rows is NULL, not a value.
        wider[:, k.R_NULLS] |= (1 << len(self.layout.slots)) - (1 << slots)
        more = max(len(packed.bound.registers) - self.state.registers.shape[1], 0)
        registers = np.pad(self.state.registers, ((0, 0), (0, more)))
        self.state = self.state._replace(last_rows=wider, failures=np.append(failures, 0), registers=registers)
        self.rebuild()

    def drop(self, name: str) -> None:
        """The rule is no longer the lane's, and what it remembered is forgotten."""
        self.prepare()
        at = self.place_of(name)
        del self.members[at]
        if not self.members:
            return
        k.drop_rule(self.state, at)
        self.state = self.state._replace(failures=np.delete(self.state.failures, at))
        rules = self.state.cells[:, k.C_RULE]
        rules[rules > at] -= 1
        self._shrink()
        self.rebuild()

    def _shrink(self) -> None:
        """Keeps of rows only what the rules ask that are left: nothing is read or drawn for those that went."""
        before, packed = self.layout, [member.packed for member in self.members]
        # Who asks about places holds these two.
        self.zones.clear()
        self.lines.clear()
        self.layout = self.recorder.layout = Layout()
        for each in packed:
            self._lay_out(each)
        self.layout.take_rasters(before)
        rows = moved(self.state.last_rows, before, self.layout, self.layout.bits, self.layout.slots)
        self.state = self.state._replace(last_rows=rows)
        self._begin_columns()
        self.waiting = [rows.select([STREAM, TIME, SEQUENCE, *self._kept]) for rows in self.waiting]
        self.tails.narrow(*self._looked_back())

    @property
    def types(self) -> frozenset[str]:
        """The event types that the rules read."""
        return frozenset().union(*(member.bound.types for member in self.members))

    def place_if_any(self, rule_hash: str) -> int | None:
        """Where a rule of this content stands among the lane's; None: there is none."""
        hashes = [member.bound.rule.hash for member in self.members]
        return hashes.index(rule_hash) if rule_hash in hashes else None

    def place_of(self, name: str) -> int:
        """Where the rule stands among the lane's."""
        return [member.name for member in self.members].index(name)

    def _add_member(self, name: str, packed: Packed) -> Member:
        bound = packed.bound
        self._lay_out(packed)
        places = Places(bound.rule.zones, bound.rule.lines, self.site)
        member = Member(
            name=name,
            packed=packed,
            wanted=frozenset((*packed.predicates, *packed.slots)),
            narrator=Narrator(bound, places, self.streams.names),
            emitter=Emitter(bound.rule.emit),
            readers=tuple(_reader(bound, at) for at in range(len(bound.registers))),
        )
        self.members.append(member)
        return member

    def _lay_out(self, packed: Packed) -> None:
        self.zones.update(packed.zones)
        self.lines.update(packed.lines)
        self.layout.add(packed.predicates, packed.slots, self.zones)

    def prepare(self) -> None:
        """Makes the tables anew, if rules have come since they were made: once, however many came."""
        if self._is_stale:
            self.rebuild()

    def rebuild(self) -> None:
        """Makes the tables anew, after rules came or went."""
        self._is_stale = False
        packed = [member.packed for member in self.members]
        layout = self.layout
        registers = max((len(each.bound.registers) for each in packed), default=0)
        self._shape = Shape(layout.words, len(layout.slots), registers, len(packed))
        assembly = Assembly(layout.bits, layout.slots, layout.words)
        self.tables = assembly.tables(packed, is_strict=self.is_strict)
        self._wanted = frozenset(expr for member in self.members for expr in member.wanted)
        if self.is_fresh:
            self._begin_anew()
        self._scratch = new_scratch(self.tables, self._shape)

    def _begin_anew(self) -> None:
        self._begin_columns()
        self.state = new_state(self._shape)
        self.tails = Tails(*self._looked_back())

    def _looked_back(self) -> tuple[int, dict[str, Kind]]:
        """How many earlier rows the rules read, and which columns of them."""
        reach = max((each.bound.reach for each in self.members), default=0)
        return reach, {name: kind for each in self.members for name, kind in self.looked_back_at(each.packed).items()}

    def _begin_columns(self) -> None:
        """Says which columns are to be kept of rows; with rows waiting, these have them all."""
        columns = {name: kind for each in self.members for name, kind in self._columns_of(each.packed).items()}
        self.columns = dict(sorted(columns.items()))
        kept = {name for each in self.members for name in self._columns_behind_filter(each.packed)}
        self._kept = [name for name in self.columns if name in kept]

    def _columns_of(self, packed: Packed) -> dict[str, Kind]:
        kinds = self._columns_behind_filter(packed)
        return kinds if packed.where is None else {**_reads(packed), **kinds}

    def _columns_behind_filter(self, packed: Packed) -> dict[str, Kind]:
        names = (column_names((*packed.predicates, *packed.slots)) | set(packed.bound.keys)) - _IMPLIED
        return {name: kind for name, kind in packed.bound.columns.items() if name in names}

    def looked_back_at(self, packed: Packed) -> dict[str, Kind]:
        """The columns that the rule reads of earlier rows."""
        read = (*packed.predicates, *packed.slots)
        shifts = tuple(part for expr in read for part in walk(expr) if isinstance(part, Shift))
        return {name: kind for name, kind in self._columns_of(packed).items() if name in column_names(shifts)}

    # Rows and time.

    def set_frame_size(self, source: str, width: int, height: int) -> None:
        """The source's frames have this size in pixels, from the next step on."""
        self.site.frame_sizes[source] = (width, height)
        self.recorder.forget_rasters()

    def learn(self, event: EventType, stream: str, sequence: int, *, epoch: int = 1) -> dict[str, Outcome]:
        """Takes in what an event says of a camera; a rule that cannot use it is set aside."""
        self.prepare()
        needing = [
            at for at, member in enumerate(self.members)
            if needs(member.bound, event, needs_calibration=member.narrator.needs_calibration)
        ]  # fmt: skip
        if needing:
            try:
                self.site.learn(event, stream, sequence, self.clock.watermark_us, epoch=epoch)
            except MatchError as error:
                for at in needing:
                    self._fail(at, error)
            self.recorder.forget_rasters()
        return {}

    def push_units(
        self, arrived: Sequence[Units], newest: Sequence[Sequence[tuple[str, int]]]
    ) -> list[dict[str, Outcome]]:
        """Takes units of arrival in order: for each of them what it led to.

        Each unit is judged against the watermark as those before left it, then moves it. Rows that are final by
        the end are run together: what decided a match says which unit made that final.

        Args:
            arrived: The units, whose envelope is whole.
            newest: For each unit, for each source its newest time.
        """
        self.prepare()
        outcomes: list[dict[str, Outcome]] = []
        held: list[pa.Table] = []
        late: list[tuple[EventRef, ...]] = []
        reached: list[int | None] = []
        before_us, rows_before = self.clock.watermark_us, self.counts.rows
        parts = [rows for units in arrived for rows in self._rows_of_units(units)]
        for rows, newest_by_source in zip(parts, newest, strict=True):
            late.append(self._judged(rows, held))
            for source, newest_us in newest_by_source:
                self.clock.observe(source, newest_us)
            reached.append(self.clock.advance())
            if self._is_limit_near(before_us, self.counts.rows - rows_before):
                # What is given up must not depend on which units came together.
                self._hold(held)
                outcomes += self._advanced(late, reached, before_us)
                held, late, reached, before_us = [], [], [], self.clock.watermark_us
                rows_before = self.counts.rows
        if late:
            self._hold(held)
            outcomes += self._advanced(late, reached, before_us)
        return outcomes

    def _is_limit_near(self, before_us: int | None, held: int) -> bool:
        """Whether so many rows that are held, or the time that has come, may lead to something being given up."""
        limits, watermark_us = self.input.limits, self.clock.watermark_us
        if watermark_us is None:
            return False
        is_time = limits.expired_before_us(before_us, watermark_us) is not None
        return is_time or self.keys.count + self.rows_waiting + held > limits.partitions

    def source_ended(self, source: str) -> dict[str, Outcome]:
        """The source will send no more."""
        self.prepare()
        if self.clock.end(source):
            return self.finish()
        return self._advance()

    def advance_idle(self, now_us: int) -> dict[str, Outcome]:
        """Looks for sources that have been silent for the idle time."""
        self.prepare()
        self.clock.look_for_idle(now_us)
        return self._advance()

    def finish(self) -> dict[str, Outcome]:
        """The input has ended: everything is decided."""
        self.prepare()
        self._run(self._released(None))
        self._expire(0, is_end=True)
        (outcomes,) = self._outcomes([()], [None])
        self._forget_all()
        self.clock.reset()
        for member in self.members:
            member.emitter.reset()
            member.begins_us = None
        return outcomes

    def _advance(self) -> dict[str, Outcome]:
        before_us = self.clock.watermark_us
        (outcomes,) = self._advanced([()], [self.clock.advance()], before_us)
        return outcomes

    def _advanced(
        self, late: Sequence[tuple[EventRef, ...]], reached: Sequence[int | None], before_us: int | None
    ) -> list[dict[str, Outcome]]:
        """What units led to, after which the watermark stood there, before it here, and whose late rows these are."""
        watermark_us = reached[-1]
        if watermark_us is None:
            return self._outcomes(late, reached)
        self._run(self._released(watermark_us))
        self._expire(watermark_us, is_end=False)
        found = self._found()
        self._limit(before_us, watermark_us)
        self._forget_texts()
        outcomes = self._outcomes(late, reached, found)
        for member in self.members:
            member.emitter.forget(watermark_us)
        return outcomes

    def _rows_of_units(self, units: Units) -> Sequence[pa.Table | None]:
        """The rows for the rules, unit by unit."""
        if len(units) > 1 and self.input.type is not None and self.input.where is None:
            rows = self._rows_of(units.table)
            if rows is None or rows.num_rows == units.table.num_rows:
                return [None] * len(units) if rows is None else units.of(rows)
        return [self._rows_of(table) for table in units.of(units.table)]

    def _judged(self, rows: pa.Table | None, held: list[pa.Table]) -> tuple[EventRef, ...]:
        """Adds the rows that are in time to those held; the others."""
        if rows is None or rows.num_rows == 0:
            return ()
        late: tuple[EventRef, ...] = ()
        watermark_us = self.clock.watermark_us
        if watermark_us is not None:
            is_late = rows.column(TIME).to_numpy() < watermark_us
            if is_late.any():
                late = tuple(dict.fromkeys(self._refs(rows.filter(pa.array(is_late)))))  # of several arms, once
                rows = rows.filter(pa.array(~is_late))
        self.counts.late += len(late)
        self.counts.rows += rows.num_rows
        held.append(rows)
        return late

    def _hold(self, held: list[pa.Table]) -> None:
        """The rows wait, by time. Where that makes many tables, the smallest become one."""
        held = [rows for rows in held if rows.num_rows]
        if not held:
            return
        self.waiting.append(_by_time(held))
        if len(self.waiting) > _WAITING_TABLES_MOST:
            self.waiting.sort(key=lambda rows: -rows.num_rows)
            few = _WAITING_TABLES_MOST // 4
            self.waiting[few:] = [_by_time(self.waiting[few:])]

    def _rows_of(self, table: pa.Table) -> pa.Table | None:
        """The rows that these events, of any types, are for the rules."""
        if not self.members:
            return None
        if self.input.type is None:
            rows = rows_of(self.input.arms, table, self.streams, self.places)
            return None if rows is None else rows.select([STREAM, TIME, SEQUENCE, *self.columns])
        table = _of_type(table, self.input.type)
        if table.num_rows == 0:
            return None
        rows = normalised(table, self.columns, self.streams)
        return rows if self.input.where is None else self._filtered(rows)

    def _released(self, before_us: int | None) -> pa.Table | None:
        """The rows that are final, in any order; they wait no longer. None: there are none."""
        released, waiting = [], []
        for rows in self.waiting:
            count = rows.num_rows
            if before_us is not None:
                count = int(np.searchsorted(rows.column(TIME).to_numpy(), before_us))
            if count:
                released.append(rows.slice(0, count))
            if count < rows.num_rows:
                waiting.append(rows.slice(count))
        self.waiting = waiting
        return pa.concat_tables(released).combine_chunks() if released else None

    def _refs(self, rows: pa.Table) -> list[EventRef]:
        columns = [rows.column(name).to_pylist() for name in (STREAM, SEQUENCE, TIME)]
        return [event_ref(each, self.streams.names) for each in zip(*columns, strict=True)]

    # From rows to matches.

    def _run(self, rows: pa.Table | None) -> None:
        if rows is None or rows.num_rows == 0 or not self.members:
            return
        grouped = self._grouped(rows)
        arrived = self.tails.before(rows, grouped.partitions, grouped.bounds, grouped.order, self.streams.names)
        records = self.recorder.records(arrived, self._wanted)
        self._fail_where_unknown()
        began = self.seconds()
        cursor = np.array([0, -1], dtype=np.int64)
        while k.run(
            self.tables, self.state, self._scratch, records, grouped.order, grouped.partitions, grouped.bounds, cursor,
            self._shape.words,
        ):  # fmt: skip
            self.state = grown(self.state)
        self._share_out(self.seconds() - began, rows.num_rows)
        self.tails.keep(arrived, grouped.partitions, grouped.bounds, grouped.order)

    def _filtered(self, rows: pa.Table) -> pa.Table | None:
        assert self.input.where is not None
        arrived = Arrived(rows, 0, None, rows.column(STREAM).to_numpy(), self.streams.names)
        evaluator = RowEvaluator(RowsOfTable(rows, np.empty(0, dtype=np.int64)), self.places, arrived=arrived)
        try:
            holds = evaluator.truth(self.input.where)
        except PatternError as error:
            for at in range(len(self.members)):
                self._fail(at, error)
            return None
        # What the filter alone has read is not kept: rows that waited over a restart do not have it either.
        rows = rows.select([STREAM, TIME, SEQUENCE, *self._kept])
        return rows if holds.all() else rows.filter(pa.array(holds))

    def _grouped(self, rows: pa.Table) -> _Grouped:
        count = rows.num_rows
        streams = rows.column(STREAM).to_numpy()
        columns = [self._key_column(rows, name, streams) for name in self.input.keys]
        numbers = self.keys.numbers(columns, count)
        self.make_room()
        bounds, partitions, order = (np.empty(length, dtype=np.int64) for length in (count + 1, count, count))
        time, sequence = rows.column(TIME).to_numpy(), rows.column(SEQUENCE).to_numpy()
        rank = self.streams.ranks()[streams]
        groups = k.group(numbers, time, rank, sequence, self._place, partitions, bounds, order)
        return _Grouped(partitions[:groups], bounds[: groups + 1], order)

    def _key_column(self, rows: pa.Table, name: str, streams: Integers) -> Any:
        if name in ROW_COLUMNS:
            return rows.column(ROW_COLUMNS[name]).combine_chunks()
        if name not in STREAM_COLUMNS:
            return rows.column(name).combine_chunks()
        parts = [stream.split("/")[STREAM_COLUMNS[name]] for stream in self.streams.names]
        return np.array([self.keys.texts.number(part) for part in parts], dtype=np.int64)[streams]

    def make_room(self) -> None:
        """Makes room for all partitions that have a number."""
        self.state = with_partitions(self.state, self.keys.count)
        room = len(self.state.first_cells)
        self.tails.make_room(room)
        if len(self._place) < room:
            self._place = np.full(room, -1, dtype=np.int64)

    def _expire(self, until_us: int, *, is_end: bool) -> None:
        cursor = np.zeros(1, dtype=np.int64)
        while k.expire(self.tables, self.state, until_us, is_end, cursor):
            self.state = grown(self.state)

    # Costs.

    def _share_out(self, kernel_s: float, rows: int) -> None:
        """Says what the step took for each rule: its part of the kernel's time, and of what its conditions took."""
        work = self._scratch.work + rows  # each rule is asked of each row whether it may begin there
        for member, part in zip(self.members, (work / work.sum()).tolist(), strict=True):
            member.spent_s += kernel_s * part
        self._scratch.work[:] = 0
        for expr, spent_s in self.recorder.spent_s.items():
            askers = [member for member in self.members if expr in member.wanted]
            for member in askers:
                member.spent_s += spent_s / len(askers)

    # Failures.

    def _fail_where_unknown(self) -> None:
        for expr, error in self.recorder.failures.items():
            for at, member in enumerate(self.members):
                if expr in member.wanted:
                    self._fail(at, error)

    def _fail(self, at: int, error: Exception) -> None:
        """The rule is set aside from this step on; the set takes it out after it."""
        member = self.members[at]
        member.failure = member.failure or _in_own_names(member, error)
        self.state.failures[at] = -1

    def _note_failures(self, found: dict[int, _Found]) -> None:
        for at in np.flatnonzero(self.state.failures).tolist():
            member, failure = self.members[at], int(self.state.failures[at])
            if failure > 0 and member.failure is None:
                member.failure = _error_of(member.bound, failure, found.get(at))

    # From what was found to situations.

    def _outcomes(
        self,
        late: Sequence[tuple[EventRef, ...]],
        reached: Sequence[int | None],
        found: dict[int, _Found] | None = None,
    ) -> list[dict[str, Outcome]]:
        """What units led to for each rule, see `_advanced`; what was found is taken from the kernel unless it was."""
        found = self._found() if found is None else found
        self._note_failures(found)
        outcomes: list[dict[str, Outcome]] = [{} for _ in late]
        marks = [_BEFORE_ALL_US if each is None else each for each in reached]
        for at, member in enumerate(self.members):
            if member.failure is not None:
                continue
            given_up, member.given_up = tuple(member.given_up), []
            matches: list[list[Match]] = [[] for _ in late]
            began = self.seconds()
            try:
                for unit, match in self._emitted(member, found[at], marks) if at in found else ():
                    matches[unit].append(match)
            except Exception as error:  # Whatever a rule's situations raise, the other rules of the lane go on.
                self._fail(at, error)
                continue
            member.spent_s += self.seconds() - began
            for unit, outcome in enumerate(outcomes):
                is_last = unit == len(outcomes) - 1
                if matches[unit] or late[unit] or (given_up and is_last):
                    outcome[member.name] = Outcome(tuple(matches[unit]), late[unit], given_up if is_last else ())
        return outcomes

    def _found(self) -> dict[int, _Found]:
        """By rule what was found."""
        state = self.state
        count = int(state.controls[k.FOUND])
        if count == 0:
            return {}
        ends, runs = np.empty(count, dtype=np.int64), np.empty((4 * count, 6), dtype=np.int64)
        total = k.runs_of(state, count, runs, ends)
        if total > len(runs):
            runs = np.empty((total, 6), dtype=np.int64)
            k.runs_of(state, count, runs, ends)
        records, threads = state.found[:count].copy(), state.found[:count, k.F_THREAD]
        words, nulls = state.registers[threads], state.threads[threads, k.T_NULLS]
        k.clear_found(state)
        is_match = records[:, k.F_HOW] != k.GIVEN_UP
        for at in np.flatnonzero(~is_match).tolist():
            member, record = self.members[records[at, k.F_RULE]], records[at].tolist()
            key = self.keys.key(record[k.F_PARTITION])
            self._note_given_up(member, key, record[k.F_END_ORDINAL], record[k.F_TIME])
        begins, ranks = np.concatenate(([0], ends[:-1])), self.streams.ranks()
        found: dict[int, _Found] = {}
        for rule in np.unique(records[is_match, k.F_RULE]).tolist():
            own = np.flatnonzero(is_match & (records[:, k.F_RULE] == rule))
            order = _decided_order(records[own], ranks)
            newest, own = int(np.argmax(order)), own[order]
            registers = self._registers(self.members[rule], words[own], nulls[own])
            keys = self.keys.columns(records[own, k.F_PARTITION])
            found[rule] = _Found(
                _finds(records[own], keys, registers, runs, begins[own], ends[own]), newest, records[own]
            )
        return found

    def _registers(self, member: Member, words: Integers, nulls: Integers) -> list[list[Any]]:
        """What matches of the rule remember, by register."""
        return [
            words[:, at].tolist() if kind is None else as_values(words[:, at], nulls >> at & 1 != 0, kind, self.texts)
            for at, kind in enumerate(member.readers)
        ]

    def _note_given_up(self, member: Member, key: tuple[Any, ...], threads: int, since_us: int) -> None:
        partition = self._partition_of(key)
        why = f"a partition has {threads} partial matches; the limit `threads` is {member.bound.limits.threads}"
        member.given_up.append(GivenUp(partition, threads, why, nearest_time(since_us)))

    def _partition_of(self, key: tuple[Any, ...]) -> dict[str, Any]:
        parts = zip(self.input.keys, key, self.input.kinds, strict=True)
        return {name: as_python(value, kind) for name, value, kind in parts}

    def _emitted(self, member: Member, found: _Found, marks: Sequence[int]) -> list[tuple[int, Match]]:
        """The matches that become situations, in the order in which they were decided, with the unit that did it."""
        newest_us, finds = self.clock.newest_us(), found.finds
        made = zip(_units_of(found.records, marks), member.narrator.matches(finds), finds.decided_us, strict=True)
        lets_through = member.emitter.lets_through
        matches = [
            (unit, match) for unit, match, at_us in made
            if lets_through(match, newest_us if at_us is None else at_us)
        ]  # fmt: skip
        member.matches += len(matches)
        return matches

    # Forgetting.

    def _forget_all(self) -> None:
        self.keys = Keys(self.input.kinds)
        self.texts.clear()
        failures = self.state.failures
        self.state = new_state(self._shape)._replace(failures=failures)
        self.tails.clear()
        self._place = np.empty(0, dtype=np.int64)

    def _limit(self, before_us: int | None, watermark_us: int) -> None:
        """Forgets partitions: those that nothing has to be remembered of, and what is too much or too old."""
        limits, count = self.input.limits, self.keys.count
        silent_us = None if self.is_strict else limits.expired_before_us(before_us, watermark_us)
        if silent_us is None and count <= limits.partitions and count < 2 * self._partitions_least:
            return
        kept = np.flatnonzero(self._is_wanted(watermark_us))
        if silent_us is not None:
            is_silent = self.state.last_rows[kept, k.R_TIME] < silent_us
            self._give_up(kept[is_silent], f"a partition had no row for {limits.expiry}, which is the limit `expiry`")
            kept = kept[~is_silent]
        if len(kept) > limits.partitions:
            kept = self._limited(kept)
        self._keep(kept)
        self._partitions_least = max(_PARTITIONS_LEAST, len(kept))

    def _keep(self, kept: Integers) -> None:
        self.keys = self.keys.kept(kept)
        self.state = with_partitions_kept(self.state, kept)
        self.tails.keep_partitions(kept)
        self._place = np.full(len(kept), -1, dtype=np.int64)

    def _forget_texts(self) -> None:
        """Forgets the texts that no last row and no match remembers, once these may be half of them."""
        known = self.texts.known
        if len(known) < 2 * self._texts_least:
            return
        places = self._places_of_texts()
        used = np.unique(np.concatenate([table[rows, column] for table, rows, column in places]))
        used = used[(used >= 0) & (used < len(known))]
        # Where it is NULL there may be any number: those that are none become the last of these.
        numbers = np.zeros(len(known) + 1, dtype=np.int64)
        numbers[used] = np.arange(len(used))
        for table, rows, column in places:
            held = table[rows, column]
            table[rows, column] = numbers[np.where((held >= 0) & (held < len(known)), held, -1)]
        self.texts = self.recorder.texts = Texts([known[number] for number in used.tolist()])
        self._texts_least = max(_TEXTS_LEAST, len(used))

    def _places_of_texts(self) -> list[tuple[Integers, Integers, int]]:
        """Where numbers of texts stand that are remembered: a table, and in it rows and a column."""
        state, first = self.state, k.R_BITS + self.layout.words
        kept = np.flatnonzero(state.last_ordinals[: self.keys.count] >= 0)
        is_text = np.zeros((len(self.members) + 1, state.registers.shape[1]), dtype=np.bool_)
        for at, member in enumerate(self.members):
            is_text[at, : len(member.readers)] = [kind is Kind.STRING for kind in member.readers]
        slots = [number for slot, number in self.layout.slots.items() if slot.kind is Kind.STRING]
        rules = rules_of_threads(state)  # The last rule is none: that of records that are free.
        return [
            *((state.last_rows, kept, first + at) for at in slots),
            *((state.registers, np.flatnonzero(is_text[rules, at]), at) for at in range(is_text.shape[1])),
        ]

    def _is_wanted(self, watermark_us: int) -> Any:
        is_wanted = np.zeros(self.keys.count, dtype=np.bool_)
        k.wanted(self.tables, self.state, self.keys.count, watermark_us, self._shape.words, is_wanted)
        return is_wanted

    def _limited(self, kept: Integers) -> Integers:
        """Those that stay when the limit `partitions` is reached: where it is strict the rules fail instead."""
        most = self.input.limits.partitions
        why = f"{len(kept)} partitions are remembered; the limit `partitions` is {most}"
        if self.is_strict:
            for at, member in enumerate(self.members):
                self._fail(
                    at, LimitError(f"rule {member.bound.rule.rule}: {why}. A WITHIN lets partitions be forgotten")
                )
            return kept
        by_age = kept[np.argsort(self.state.last_rows[kept, k.R_TIME], kind="stable")]
        gone = by_age[: len(kept) - most // 2]
        self._give_up(gone, why)
        return np.sort(by_age[len(gone) :])

    def _give_up(self, gone: Integers, why: str) -> None:
        """Forgets partitions, and notes what that cost each rule."""
        if not len(gone):
            return
        is_gone = np.zeros(self.keys.count, dtype=np.bool_)
        is_gone[gone] = True
        for at, member in enumerate(self.members):
            lost = np.flatnonzero(self._is_wanted_by(at) & is_gone)
            if len(lost) and member.failure is None:
                member.given_up.append(self._cost_of(at, lost, is_gone, why))
        k.drop_partitions(self.state, gone)

    def _cost_of(self, rule: int, lost: Integers, is_gone: NDArray[np.bool_], why: str) -> GivenUp:
        """What it costs the rule that these partitions, of which it remembers anything, are forgotten."""
        state = self.state
        cells = state.cells[(state.cells[:, k.C_RULE] == rule) & (state.cells[:, k.C_FIRST] >= 0)]
        cells = cells[is_gone[cells[:, k.C_PARTITION]]]
        since = state.last_rows[: self.keys.count, k.R_TIME].copy()
        since[cells[:, k.C_PARTITION]] = state.attempts[cells[:, k.C_FIRST], k.A_TIME]
        oldest = int(lost[np.argmin(since[lost])])
        partition = self._partition_of(self.keys.key(oldest))
        threads = int(cells[:, k.C_THREADS].sum())
        return GivenUp(partition, threads, why, nearest_time(int(since[oldest])), len(lost))

    def _is_wanted_by(self, rule: int) -> NDArray[np.bool_]:
        """The partitions of which anything has to be remembered for the rule."""
        is_wanted = np.zeros(self.keys.count, dtype=np.bool_)
        watermark_us = self.clock.watermark_us
        until = int(k.NEVER) * -1 if watermark_us is None else watermark_us
        k.wanted_by(self.tables, self.state, self.keys.count, until, self._shape.words, rule, is_wanted)
        return is_wanted

    def compile_rest(self) -> None:
        """Runs what is seldom run: forgetting partitions, one by one and all that nothing is remembered of."""
        self._keep(np.flatnonzero(self._is_wanted(0)))
        k.drop_partitions(self.state, np.arange(self.keys.count))
        k.drop_rule(self.state, -2)

    # How it stands.

    @property
    def watermark(self) -> datetime | None:
        """No row before this time is still expected."""
        watermark_us = self.clock.watermark_us
        return None if watermark_us is None else nearest_time(watermark_us)

    @property
    def rows_waiting(self) -> int:
        """How many rows are not final yet."""
        return sum(table.num_rows for table in self.waiting)

    def partitions_open(self, name: str) -> int:
        """How many partitions anything is remembered of for this rule."""
        self.prepare()
        at = self.place_of(name)
        watermark_us = self.clock.watermark_us
        until = int(k.NEVER) * -1 if watermark_us is None else watermark_us
        return int(k.open_partitions(self.tables, self.state, self.keys.count, until, self._shape.words, at))

    def partial_matches(self, name: str) -> int:
        """How many partial matches of this rule are open, of all partitions."""
        at, cells, total = self.place_of(name), self.state.first_cells[: self.keys.count], 0
        while len(cells := cells[cells >= 0]):
            rows = self.state.cells[cells]
            is_open = (rows[:, k.C_RULE] == at) & (rows[:, k.C_FIRST] >= 0)
            total += int(rows[is_open, k.C_THREADS].sum())
            cells = rows[:, k.C_NEXT]
        return total


def _finds(
    records: Integers,
    keys: list[list[Any]],
    registers: list[list[Any]],
    runs: Integers,
    begins: Integers,
    ends: Integers,
) -> Finds:
    """The matches of these records, by column."""

    def events(stream: int, sequence: int, time: int) -> Events:
        return Events(records[:, stream].tolist(), records[:, sequence].tolist(), records[:, time].tolist())

    decided_us: list[int | None] = records[:, k.F_DECIDED_TIME].tolist()
    for at in np.flatnonzero(records[:, k.F_HOW] == k.BY_END).tolist():
        decided_us[at] = None
    return Finds(
        keys=keys,
        first=events(k.F_STREAM, k.F_SEQUENCE, k.F_TIME),
        last=events(k.F_END_STREAM, k.F_END_SEQUENCE, k.F_END_TIME),
        decided_us=decided_us,
        numbers=[0] * len(records),
        registers=registers,
        runs=runs,
        begins=begins,
        ends=ends,
    )


def _decided_order(records: Integers, ranks: Integers) -> Integers:
    """The order of `patterns.engine.running.decided_order`, in which rows decide what no time does."""
    by_row, by_end = records[:, k.F_HOW] == k.BY_ROW, records[:, k.F_HOW] == k.BY_END
    decided = [
        np.where(by_end, 0, records[:, k.F_DECIDED_TIME]),
        by_row,
        ranks[np.where(by_row, records[:, k.F_DECIDED_STREAM], 0)] * by_row,
        np.where(by_row, records[:, k.F_DECIDED_SEQUENCE], 0),
    ]
    first = [records[:, k.F_TIME], ranks[records[:, k.F_STREAM]], records[:, k.F_SEQUENCE]]
    return np.lexsort([by_end, *decided, *first][::-1])


def _units_of(records: Integers, marks: Sequence[int]) -> list[int]:
    """The units that made matches final: a row is once the watermark lies behind it, a time once it is reached."""
    decided_us = records[:, k.F_DECIDED_TIME]
    reached, passed = (np.searchsorted(marks, decided_us, side=side) for side in ("left", "right"))
    units = np.where(records[:, k.F_HOW] == k.BY_ROW, passed, reached)
    units[records[:, k.F_HOW] == k.BY_END] = 0
    return units.tolist() if len(marks) > 1 else [0] * len(units)


def _by_time(tables: Sequence[pa.Table]) -> pa.Table:
    """The rows of the tables in the order of their times."""
    rows = pa.concat_tables(tables).combine_chunks()
    times = rows.column(TIME).to_numpy()
    is_sorted = not np.any(times[1:] < times[:-1])
    return rows if is_sorted else rows.take(pa.array(np.argsort(times, kind="stable"))).combine_chunks()


def _reads(packed: Packed) -> dict[str, Kind]:
    """The columns that the filter of FROM reads."""
    where = () if packed.where is None else tuple(walk(packed.where))
    return {part.name: part.kind for part in where if isinstance(part, Column) and part.name not in _IMPLIED}


def _reader(bound: BoundRule, at: int) -> Kind | None:
    register = bound.registers[at]
    if register.how in ("rows", "values") or register.slot is None:
        return None
    return bound.slots[register.slot].kind


def _error_of(bound: BoundRule, failure: int, found: _Found | None) -> PatternError:
    """What the kernel means by this; of what it found, the match at which it went no further is the last."""
    if failure in (k.SKIP_NOWHERE, k.SKIP_FOR_EVER):
        assert found is not None, "a skip is that of a match"
        first, last = (events.event(found.newest) for events in (found.finds.first, found.finds.last))
        return rule_skip_error(bound, first, last, failure == k.SKIP_FOR_EVER)
    return LimitError(
        f"a partition has more partial matches than the limit `threads`, {bound.limits.threads}. "
        "Begin the pattern with a rarer row, or shorten WITHIN"
    )


def _in_own_names(member: Member, error: Exception) -> Exception:
    """The error with the rule's own name for the zone or line that it is about."""
    rule = member.bound.rule
    names = {shape.model_dump_json(): name for name, shape in (*rule.zones.items(), *rule.lines.items())}
    if isinstance(error, FrameSizeUnknown) and error.shape in names:
        return FrameSizeUnknown(names[error.shape], error.source)
    return error


def _of_type(table: pa.Table, wanted: str) -> pa.Table:
    """The rows of this type; the types are encoded."""
    types = encoded(table.column("type"))
    names = types.dictionary.to_pylist()
    if names == [wanted]:
        return table
    number = names.index(wanted) if wanted in names else -1
    return table.filter(pa.array(types.indices.to_numpy() == number))
