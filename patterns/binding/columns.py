"""Row-local expressions over whole columns: what the matcher never has to ask row by row.

Rows come sorted by partition and, within one, in their total order. Evaluation
is Arrow's, so NULL follows SQL's three values. Division by zero, the root of a
negative number, a point that is not finite and metres of a source that is not
calibrated give NULL: a condition over them is not true, and no row can stop a rule.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from patterns.binding.expressions import Call, Column, Const, Crosses, Expr, InZone, Kind, OneOf, OnGround, Shift
from patterns.scene.geometry import Line, Zone
from patterns.scene.places import Places

ROW_TIME = "@time"
"""The column of rows with their time, in microseconds, whatever else is read of them."""

_TYPES = {
    Kind.BOOL: pa.bool_(), Kind.INT: pa.int64(), Kind.FLOAT: pa.float64(), Kind.STRING: pa.string(),
    Kind.TIME: pa.int64(), Kind.DURATION: pa.int64(), Kind.NULL: pa.bool_(),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows sorted by partition.

    Attributes:
        table: The columns that expressions read, of the types that `arrow_type` says.
        ordinals: For each row, how many rows of its partition stand before it here.
    """

    table: pa.Table
    ordinals: NDArray[np.int64]


@dataclass(slots=True)
class ColumnEvaluator:
    """Evaluates expressions over one set of rows, each distinct part once."""

    rows: Rows
    places: Places
    _known: dict[Expr, Any] = field(default_factory=dict)

    def truth(self, expr: Expr) -> NDArray[np.bool_]:
        """Which rows the condition is true for; neither false nor NULL."""
        return np.asarray(pc.fill_null(self.column(expr), False))

    def column(self, expr: Expr) -> Any:
        """The expression's values, an Arrow array of one value a row."""
        known = self._known.get(expr)
        if known is None:
            known = self._known[expr] = self._evaluated(expr)
        return known

    def _evaluated(self, expr: Expr) -> Any:
        if isinstance(expr, Column):
            return self.rows.table.column(expr.name).combine_chunks()
        if isinstance(expr, Const):
            return pa.repeat(pa.scalar(expr.value, arrow_type(expr.kind)), self.rows.table.num_rows)
        if isinstance(expr, Shift):
            return self._shifted(expr)
        if isinstance(expr, InZone):
            return self._in_zone(expr)
        if isinstance(expr, Crosses):
            return self._crosses(expr)
        if isinstance(expr, OnGround):
            return self._on_ground(expr)
        if isinstance(expr, OneOf):
            return self._one_of(expr)
        assert isinstance(expr, Call), f"not a row-local expression: {expr}"
        return _OPERATORS[expr.op](*[self.column(operand) for operand in expr.operands])

    def _shifted(self, expr: Shift) -> Any:
        count = self.rows.table.num_rows
        indices = np.arange(count, dtype=np.int64) - expr.rows
        ordinals = self.rows.ordinals - expr.rows
        has_none = (ordinals < 0) | (indices >= count)
        # A row of the next partition would have a smaller number than the row looked for.
        has_none[~has_none] = self.rows.ordinals[indices[~has_none]] != ordinals[~has_none]
        return self.column(expr.operand).take(pa.array(indices, mask=has_none))

    def _in_zone(self, expr: InZone) -> Any:
        answers = self._answers(expr.operands)
        for zone in self.places.zones_named(expr.zone):
            if not self.places.is_known(zone):
                answers.leave_open(zone.source)
                continue

            def inside(x: Any, y: Any, zone: Zone = zone) -> NDArray[np.bool_]:
                return self.places.inside(zone, expr.zone, x, y)

            answers.ask(zone.source, inside)
            if zone.units == "metres":
                answers.leave_open(zone.source, self.before_move(zone.source))
        return answers.column(pa.bool_())

    def _crosses(self, expr: Crosses) -> Any:
        answers = self._answers(expr.operands)
        for line in self.places.lines_named(expr.line):
            if not self.places.is_known(line):
                answers.leave_open(line.source)
                continue

            def crossed(x0: Any, y0: Any, x1: Any, y1: Any, line: Line = line) -> NDArray[np.bool_]:
                return self.places.crossed(line, expr.line, (x0, y0, x1, y1), expr.direction)

            answers.ask(line.source, crossed)
            if line.units == "metres":
                answers.leave_open(line.source, self.before_move(line.source))
        return answers.column(pa.bool_())

    def _on_ground(self, expr: OnGround) -> Any:
        answers = self._answers(expr.operands)
        answers.is_unknown |= np.asarray(pc.is_null(answers.source))
        for source in pc.unique(pc.drop_null(answers.source)).to_pylist():

            def ground(*values: Any, source: str = source) -> NDArray[np.float64]:
                return self.places.on_ground(source, expr.what, list(values))

            answers.ask(source, ground)
            answers.leave_open(source, self.before_move(source))
        column = answers.column(pa.float64())
        return pc.if_else(pc.is_finite(column), column, pa.scalar(None, pa.float64()))

    def before_move(self, source: str) -> NDArray[np.bool_]:
        """Which rows are from before the source's camera was moved: what is known of it now is of another view."""
        moved_us = self.places.site.moved_us.get(source)
        if moved_us is None:
            return np.zeros(self.rows.table.num_rows, dtype=bool)
        return np.asarray(self.rows.table.column(ROW_TIME).to_numpy()) < moved_us

    def _one_of(self, expr: OneOf) -> Any:
        column = self.column(expr.operands[0])
        values = pa.array(list(expr.values), column.type)
        return pc.if_else(pc.is_valid(column), pc.is_in(column, value_set=values), pa.scalar(None, pa.bool_()))

    def _answers(self, operands: tuple[Expr, ...]) -> "_Answers":
        source, *numbers = (self.column(operand) for operand in operands)
        values = [_floats(number) for number in numbers]
        is_finite = np.logical_and.reduce([np.isfinite(value) for value in values])
        return _Answers(source, values, is_finite, np.zeros(len(is_finite)), np.zeros(len(is_finite), dtype=bool))


@dataclass(slots=True)
class _Answers:
    """What is asked of each source's rows: 0 where nothing is asked, NULL where a number is not finite."""

    source: Any
    values: list[NDArray[np.float64]]
    is_finite: NDArray[np.bool_]
    answers: NDArray[np.float64]
    is_unknown: NDArray[np.bool_]

    def leave_open(self, source: str, rows: NDArray[np.bool_] | bool = True) -> None:
        """Nothing is known of the rows of this source, or of those of them that are named."""
        self.is_unknown |= np.asarray(pc.fill_null(pc.equal(self.source, source), False)) & rows

    def ask(self, source: str, question: Callable[..., NDArray[Any]]) -> None:
        """Asks about the rows of this source."""
        is_here = np.asarray(pc.fill_null(pc.equal(self.source, source), False))
        self.is_unknown |= is_here & ~self.is_finite
        asked = is_here & self.is_finite
        if asked.any():
            self.answers[asked] = question(*[value[asked] for value in self.values])

    def column(self, kind: Any) -> Any:
        """The answers as a column of this Arrow type."""
        return pa.array(self.answers, mask=self.is_unknown, from_pandas=False).cast(kind)


def arrow_type(kind: Kind) -> Any:
    """The Arrow type that values of this kind have inside the engine."""
    return _TYPES[kind]


def _floats(column: Any) -> NDArray[np.float64]:
    """The numbers, NaN where NULL."""
    floats: NDArray[np.float64] = pc.fill_null(column, np.nan).to_numpy(zero_copy_only=False)
    return floats


def _divided(left: Any, right: Any) -> Any:
    """Quotient; of integers truncated, NULL for a divisor of zero."""
    return pc.divide(left, _nonzero(right))


def _remainder(left: Any, right: Any) -> Any:
    """What truncated division leaves: it has the sign of the dividend."""
    divisor = _nonzero(right)
    return pc.subtract(left, pc.multiply(pc.divide(left, divisor), divisor))


def _quotient_of_durations(left: Any, right: Any) -> Any:
    return _divided(left.cast(pa.float64()), right.cast(pa.float64()))


def _scaled(duration: Any, factor: Any) -> Any:
    return _rounded(pc.multiply(duration.cast(pa.float64()), factor))


def _shrunk(duration: Any, divisor: Any) -> Any:
    return _rounded(_divided(duration.cast(pa.float64()), divisor))


def _rounded(microseconds: Any) -> Any:
    """Whole microseconds, halves to even; NULL where they do not fit in 64 bits."""
    fits = pc.less(pc.abs(microseconds), 2.0**63)
    kept = pc.if_else(fits, microseconds, pa.scalar(None, pa.float64()))
    return pc.round(kept, round_mode="half_to_even").cast(pa.int64())


def _nonzero(divisor: Any) -> Any:
    return pc.if_else(pc.equal(divisor, pa.scalar(0, divisor.type)), pa.scalar(None, divisor.type), divisor)


def _root(value: Any) -> Any:
    return pc.sqrt(pc.if_else(pc.less(value, 0.0), pa.scalar(None, pa.float64()), value))


def _extreme(choose: Callable[..., Any]) -> Callable[..., Any]:
    def extreme(*columns: Any) -> Any:
        result = columns[0]
        for column in columns[1:]:
            is_either_null = pc.or_(pc.is_null(result), pc.is_null(column))
            result = pc.if_else(is_either_null, pa.scalar(None, result.type), pc.if_else(
                choose(result, column), result, column
            ))  # fmt: skip
        return result

    return extreme


def _case(*columns: Any) -> Any:
    """Of condition, value, condition, value, ..., default: the value of the first true condition."""
    result = columns[-1]
    for condition, value in reversed(list(zip(columns[:-1:2], columns[1:-1:2], strict=True))):
        result = pc.if_else(pc.fill_null(condition, False), value, result)
    return result


def _folded(combine: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    def folded(*columns: Any) -> Any:
        result = columns[0]
        for column in columns[1:]:
            result = combine(result, column)
        return result

    return folded


_OPERATORS: dict[str, Callable[..., Any]] = {
    "+": pc.add, "-": pc.subtract, "*": pc.multiply, "/": _divided, "%": _remainder,
    "ratio": _quotient_of_durations, "scale": _scaled, "shrink": _shrunk, "float": lambda x: x.cast(pa.float64()),
    "neg": pc.negate, "abs": pc.abs, "sqrt": _root,
    "=": pc.equal, "<>": pc.not_equal, "<": pc.less, "<=": pc.less_equal, ">": pc.greater, ">=": pc.greater_equal,
    "and": _folded(pc.and_kleene), "or": _folded(pc.or_kleene), "not": pc.invert,
    "is_null": pc.is_null, "coalesce": pc.coalesce, "case": _case,
    "least": _extreme(pc.less_equal), "greatest": _extreme(pc.greater_equal),
}  # fmt: skip
