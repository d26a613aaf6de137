"""Rows as records of integers: what rules ask of a row, each question once for all of them.

Row-local conditions become bits. Those that ask whether a point lies in a zone are answered for all
zones of a picture at once; those that only the row's stream decides, once for each stream; the others
over whole columns. What guards and registers read becomes a word.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from patterns.binding.columns import ColumnEvaluator, Rows
from patterns.binding.expressions import Call, Column, Crosses, Expr, InZone, Kind, Shift, walk
from patterns.binding.rows import SEQUENCE, TIME
from patterns.engine import kernel as k
from patterns.engine.interning import Texts, as_words
from patterns.engine.kernel import Integers
from patterns.engine.raster import Raster
from patterns.errors import PatternError
from patterns.scene.geometry import Zone
from patterns.scene.places import Places

STREAM_COLUMNS = {"station": 0, "source": 1, "type": 2}
"""columns that a row's stream decides, and where they stand in its name"""
ROW_COLUMNS = {"time": TIME, "sequence": SEQUENCE}
"""columns that every row has"""
_BITS = 64
_ALL_BITS = -1


@dataclass(slots=True)
class _Picture:
    """The zones over one pair of coordinates of one source, in the order of their bits."""

    source: str
    units: str
    operands: tuple[Expr, ...]
    zones: list[str] = field(default_factory=list)
    inside: int = -1
    outside: int = -1
    raster: Raster | None = None


class Layout:
    """Where each condition and each value stands in a row's record. It only grows; fewer need another layout."""

    def __init__(self) -> None:
        self.bits: dict[Expr, tuple[int, int]] = {}
        self.slots: dict[Expr, int] = {}
        self.words = 0
        self.plain: dict[Expr, tuple[int, int]] = {}
        self.pictures: list[_Picture] = []
        self._open = (0, _BITS)

    def add(self, predicates: Iterable[Expr], slots: Iterable[Expr], zones: Mapping[str, Zone]) -> None:
        """Gives each of these a place, if it has none."""
        for predicate in predicates:
            if predicate not in self.bits:
                asked = _zone_of(predicate)
                if asked is None or asked.zone not in zones or zones[asked.zone].units == "metres":
                    self.bits[predicate] = self.plain[predicate] = self._next_bit()
                else:
                    self._add_zone(asked, zones[asked.zone])
        for slot in slots:
            self.slots.setdefault(slot, len(self.slots))

    def _next_bit(self) -> tuple[int, int]:
        word, bit = self._open
        if bit == _BITS:
            word, bit = self.words, 0
            self.words += 1
        self._open = (word, bit + 1)
        return word, bit

    def _add_zone(self, asked: InZone, zone: Zone) -> None:
        """Gives the zone a bit among those of its picture: one word says inside, one outside."""
        wanted = (zone.source, zone.units, asked.operands)
        for picture in self.pictures:
            if (picture.source, picture.units, picture.operands) == wanted and len(picture.zones) < _BITS:
                break
        else:
            picture = _Picture(*wanted, inside=self.words, outside=self.words + 1)
            self.words += 2
            self.pictures.append(picture)
        bit = len(picture.zones)
        picture.zones.append(asked.zone)
        picture.raster = None
        self.bits[asked] = (picture.inside, bit)
        self.bits[Call("not", (asked,), Kind.BOOL)] = (picture.outside, bit)

    def take_rasters(self, other: "Layout") -> None:
        """Takes over from another layout the rasters of pictures of the same zones."""
        drawn = {(each.source, each.units, each.operands, *each.zones): each.raster for each in other.pictures}
        for picture in self.pictures:
            picture.raster = drawn.get((picture.source, picture.units, picture.operands, *picture.zones))


def moved(
    rows: Integers, source: Layout, target: Layout, predicates: Iterable[Expr], slots: Iterable[Expr]
) -> Integers:
    """Records of rows with these bits and values in the places of another layout, and nothing else."""
    records = np.zeros((len(rows), k.R_BITS + target.words + len(target.slots)), dtype=np.int64)
    records[:, : k.R_NULLS] = rows[:, : k.R_NULLS]
    words, target_words = rows.view(np.uint64), records.view(np.uint64)
    for (word, target_word, shift), mask in _shifted_bits(source, target, predicates).items():
        bits = words[:, k.R_BITS + word] & np.uint64(mask)
        there = bits << np.uint64(shift) if shift >= 0 else bits >> np.uint64(-shift)
        target_words[:, k.R_BITS + target_word] |= there
    for slot in slots:
        number, other = source.slots[slot], target.slots[slot]
        records[:, k.R_BITS + target.words + other] = rows[:, k.R_BITS + source.words + number]
        records[:, k.R_NULLS] |= ((rows[:, k.R_NULLS] >> number) & 1) << other
    return records


def _shifted_bits(source: Layout, target: Layout, predicates: Iterable[Expr]) -> dict[tuple[int, int, int], int]:
    """The bits that move alike, as a mask: by word from, word to, and by how many places."""
    masks: dict[tuple[int, int, int], int] = {}
    for predicate in predicates:
        (word, bit), (target_word, target_bit) = source.bits[predicate], target.bits[predicate]
        move = (word, target_word, target_bit - bit)
        masks[move] = masks.get(move, 0) | 1 << bit
    return masks


def _zone_of(predicate: Expr) -> InZone | None:
    """The zone that the condition asks for, or asks not to be in; None: it asks something else."""
    if isinstance(predicate, Call) and predicate.op == "not":
        (predicate,) = predicate.operands
    return predicate if isinstance(predicate, InZone) and predicate.operands[0] == _SOURCE else None


_SOURCE = Column("source", Kind.STRING)


@dataclass(frozen=True, slots=True)
class Arrived:
    """Rows in any order, after those that their partitions remember.

    Attributes:
        table: The rows.
        fresh: Where the rows begin that are new.
        before: For each row the row before it in its partition; -1: none. None: nobody asks.
        streams: For each row its stream's number.
        names: The streams' names.
    """

    table: pa.Table
    fresh: int
    before: Integers | None
    streams: Integers
    names: Sequence[str]


@dataclass(slots=True)
class RowEvaluator(ColumnEvaluator):
    """Evaluates expressions over rows in any order."""

    arrived: Arrived | None = None

    def _evaluated(self, expr: Expr) -> Any:
        assert self.arrived is not None
        if not isinstance(expr, Column | Shift) and is_of_stream(expr):
            return self._of_stream(expr)
        if isinstance(expr, Column) and expr.name in STREAM_COLUMNS:
            return self._of_stream(expr)
        if isinstance(expr, Column) and expr.name in ROW_COLUMNS:
            return self.rows.table.column(ROW_COLUMNS[expr.name]).combine_chunks()
        return ColumnEvaluator._evaluated(self, expr)

    def _of_stream(self, expr: Expr) -> Any:
        """Evaluated once for each stream."""
        assert self.arrived is not None
        streams = stream_table(self.arrived.names)
        values = ColumnEvaluator(Rows(streams, np.zeros(len(streams), dtype=np.int64)), self.places).column(expr)
        return values.take(pa.array(self.arrived.streams))

    def _shifted(self, expr: Shift) -> Any:
        assert self.arrived is not None
        assert self.arrived.before is not None, "nothing of the rule looks back"
        before = self.arrived.before
        rows = before
        for _ in range(expr.rows - 1):
            rows = np.where(rows < 0, -1, before[rows])
        if expr.rows == 0:
            return self.column(expr.operand)
        return self.column(expr.operand).take(pa.array(rows, mask=rows < 0))

    def _crosses(self, expr: Crosses) -> Any:
        if expr.operands[0] != _SOURCE:
            return ColumnEvaluator._crosses(self, expr)
        values = [floats_of(self.column(operand)) for operand in expr.operands[1:]]
        is_finite = np.logical_and.reduce([np.isfinite(value) for value in values])
        crossed, is_unknown = np.zeros(len(is_finite), dtype=bool), np.zeros(len(is_finite), dtype=bool)
        for line in self.places.lines_named(expr.line):
            is_here = self.is_from(line.source)
            asked = is_here & is_finite if self.places.is_known(line) else np.zeros_like(is_here)
            if line.units == "metres":
                asked &= ~self.before_move(line.source)
            is_unknown |= is_here & ~asked
            if not asked.any():
                continue
            x0, y0, x1, y1 = values if asked.all() else [value[asked] for value in values]
            crossed[asked] = self.places.crossed(line, expr.line, (x0, y0, x1, y1), expr.direction)
        return pa.array(crossed, mask=is_unknown)

    def is_from(self, source: str) -> NDArray[np.bool_]:
        """Which rows are of this source."""
        assert self.arrived is not None
        sources = [name.split("/")[STREAM_COLUMNS["source"]] == source for name in self.arrived.names]
        is_here: NDArray[np.bool_] = np.array(sources, dtype=bool)[self.arrived.streams]
        return is_here


def is_of_stream(expr: Expr) -> bool:
    """Whether a row's stream alone decides the value."""
    columns = [part.name for part in walk(expr) if isinstance(part, Column)]
    return bool(columns) and all(name in STREAM_COLUMNS for name in columns) and not _shifts(expr)


def _shifts(expr: Expr) -> bool:
    return any(isinstance(part, Shift) for part in walk(expr))


def stream_table(names: Sequence[str]) -> pa.Table:
    """One row a stream: what its name says."""
    parts = [name.split("/") for name in names]
    return pa.table(
        {column: pa.array([part[at] for part in parts], pa.string()) for column, at in STREAM_COLUMNS.items()}
    )


def floats_of(column: Any) -> NDArray[np.float64]:
    """The numbers, NaN where NULL."""
    if column.null_count:
        column = pc.fill_null(column, np.nan)
    floats: NDArray[np.float64] = column.to_numpy(zero_copy_only=False)
    return floats


class Recorder:
    """Makes the records of rows."""

    def __init__(self, layout: Layout, places: Places, texts: Texts, clock: Callable[[], float]) -> None:
        self.layout = layout
        self.clock = clock
        self.spent_s: dict[Expr, float] = {}
        """What conditions and values took in the last step, by the clock; what all zones share is not in it."""
        self.places = places
        self.texts = texts
        self.failures: dict[Expr, Exception] = {}

    def forget_rasters(self) -> None:
        """The frames have other sizes from now on."""
        for picture in self.layout.pictures:
            picture.raster = None

    def records(self, arrived: Arrived, wanted: frozenset[Expr]) -> Integers:
        """The records of the new rows; `failures` says which conditions and values could not be had.

        Args:
            arrived: The rows.
            wanted: The conditions and values that are asked for; the others' places hold anything.
        """
        layout, fresh = self.layout, arrived.fresh
        count = arrived.table.num_rows - fresh
        rows = np.empty((count, k.R_BITS + layout.words + len(layout.slots)), dtype=np.int64)
        rows[:, k.R_TIME] = arrived.table.column(TIME).to_numpy()[fresh:]
        rows[:, k.R_SEQUENCE] = arrived.table.column(SEQUENCE).to_numpy()[fresh:]
        rows[:, k.R_STREAM] = arrived.streams[fresh:]
        rows[:, k.R_NULLS] = 0
        self.failures, self.spent_s = {}, {}
        evaluator = RowEvaluator(Rows(arrived.table, np.empty(0, dtype=np.int64)), self.places, arrived=arrived)
        self._write_plain(evaluator, rows, fresh, wanted)
        for picture in layout.pictures:
            self._write_zones(evaluator, picture, rows, fresh)
        for slot, number in layout.slots.items():
            if slot in wanted:
                began = self.clock()
                self._write_slot(evaluator, slot, number, rows, fresh)
                self.spent_s[slot] = self.clock() - began
        return rows

    def _write_plain(self, evaluator: RowEvaluator, rows: Integers, fresh: int, wanted: frozenset[Expr]) -> None:
        written: set[int] = set()
        for predicate, (word, bit) in self.layout.plain.items():
            column = k.R_BITS + word
            if word not in written:
                rows[:, column] = 0
                written.add(word)
            if predicate not in wanted:
                continue
            began = self.clock()
            try:
                truth = evaluator.truth(predicate)[fresh:]
            except Exception as error:  # Whatever it is, only the rules that ask for it fail.
                self.failures[predicate] = error
                continue
            rows[:, column] |= truth.astype(np.int64) << bit
            self.spent_s[predicate] = self.clock() - began

    def _write_zones(self, evaluator: RowEvaluator, picture: _Picture, rows: Integers, fresh: int) -> None:
        inside, outside = k.R_BITS + picture.inside, k.R_BITS + picture.outside
        x, y = (floats_of(evaluator.column(operand))[fresh:] for operand in picture.operands[1:])
        is_here = evaluator.is_from(picture.source)[fresh:]
        if picture.raster is None and not (is_here & np.isfinite(x) & np.isfinite(y)).any():
            # Zones that no point is asked about need not be drawn: their frame's size may be unknown.
            rows[:, inside] = 0
            rows[:, outside] = np.where(is_here, 0, _ALL_BITS)
            return
        try:
            if picture.raster is None:
                picture.raster = Raster([self._polygon(name) for name in picture.zones])
        except PatternError as error:
            self._fail(picture, error)
            rows[:, [inside, outside]] = 0
            return
        picture.raster.mark(x, y, is_here, rows, inside, outside)

    def _polygon(self, name: str) -> Any:
        zone = self.places.zones[name]
        return zone.polygon_px(self.places.frame_size(zone, name))

    def _fail(self, picture: _Picture, error: PatternError) -> None:
        """All zones of a picture are scaled alike, so if one cannot be drawn, none can."""
        for name in picture.zones:
            asked = InZone(name, picture.operands)
            self.failures[asked] = self.failures[Call("not", (asked,), Kind.BOOL)] = error

    def _write_slot(self, evaluator: RowEvaluator, slot: Expr, number: int, rows: Integers, fresh: int) -> None:
        try:
            values = evaluator.column(slot)
            values = values.slice(fresh) if fresh else values
            rows[:, k.R_BITS + self.layout.words + number] = as_words(values, slot.kind, self.texts)
        except Exception as error:  # Whatever it is, only the rules that ask for it fail.
            self.failures[slot] = error
            return
        if values.null_count:
            rows[:, k.R_NULLS] |= np.asarray(values.is_null()).astype(np.int64) << number
