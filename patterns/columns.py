"""Row-local expressions over whole columns: what the matcher never has to ask row by row.

Rows come sorted by partition and, within one, in their total order. Evaluation
is Arrow's, so NULL follows SQL's three values. Division by zero, the root of a
negative number and a point that is not finite give NULL: a condition over them
is not true, and no row can stop a rule.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from patterns.errors import FrameSizeUnknown
from patterns.expressions import Call, Column, Const, Crosses, Expr, InZone, Kind, Shift
from patterns.geometry import FrameSize, Line, Zone, crosses_line, in_polygon

_TYPES = {
    Kind.BOOL: pa.bool_(), Kind.INT: pa.int64(), Kind.FLOAT: pa.float64(), Kind.STRING: pa.string(),
    Kind.TIME: pa.int64(), Kind.DURATION: pa.int64(), Kind.NULL: pa.bool_(),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Places:
    """The zones and lines of a rule, and the frame sizes known so far, (width, height) in pixels."""

    zones: Mapping[str, Zone]
    lines: Mapping[str, Line]
    frame_sizes: Mapping[str, FrameSize]

    def frame_size(self, shape: Zone | Line, name: str) -> FrameSize | None:
        """The frame size that scales the shape; None for one in pixels.

        Raises:
            FrameSizeUnknown: It is normalised and its source's frame size is not known.
        """
        if shape.units == "pixels":
            return None
        if shape.source not in self.frame_sizes:
            raise FrameSizeUnknown(name, shape.source)
        return self.frame_sizes[shape.source]


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
        assert isinstance(expr, Call), f"not a row-local expression: {expr}"
        return _OPERATORS[expr.op](*[self.column(operand) for operand in expr.operands])

    def _shifted(self, expr: Shift) -> Any:
        count = self.rows.table.num_rows
        indices = np.arange(count, dtype=np.int64) - expr.rows
        has_none = self.rows.ordinals < expr.rows
        return self.column(expr.operand).take(pa.array(indices, mask=has_none))

    def _in_zone(self, expr: InZone) -> Any:
        zone = self.places.zones[expr.zone]

        def inside(x: Any, y: Any) -> NDArray[np.bool_]:
            return in_polygon(zone.polygon_px(self.places.frame_size(zone, expr.zone)), x, y)

        return self._of_source(zone.source, expr.operands, inside)

    def _crosses(self, expr: Crosses) -> Any:
        line = self.places.lines[expr.line]

        def crossed(x0: Any, y0: Any, x1: Any, y1: Any) -> NDArray[np.bool_]:
            points = line.points_px(self.places.frame_size(line, expr.line))
            return crosses_line(points, (x0, y0, x1, y1), expr.direction)

        return self._of_source(line.source, expr.operands, crossed)

    def _of_source(self, source: str, operands: tuple[Expr, ...], ask: Callable[..., NDArray[np.bool_]]) -> Any:
        """What `ask` says of the rows of this source; false elsewhere, NULL where a coordinate is not finite."""
        is_here = np.asarray(pc.fill_null(pc.equal(self.column(operands[0]), source), False))
        result = np.zeros(len(is_here), dtype=bool)
        if not is_here.any():
            return pa.array(result)
        values = [_floats(self.column(operand)) for operand in operands[1:]]
        is_unknown = ~np.logical_and.reduce([np.isfinite(value) for value in values])
        asked = is_here & ~is_unknown
        result[asked] = ask(*[value[asked] for value in values])
        return pa.array(result, mask=is_unknown & is_here)


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
