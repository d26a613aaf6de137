"""Why a condition did not hold for a row, and by how much.

Contract: asked only about conditions that were not true, of one partition's rows in their total order.
Values are evaluated as the engine evaluates them, part by part; distances are those of the geometry
in pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from patterns.binding.bound import BoundRule, Condition
from patterns.binding.columns import ColumnEvaluator
from patterns.binding.expressions import (
    COMPARISONS,
    Call,
    Column,
    Const,
    Crosses,
    Expr,
    InZone,
    Kind,
    OneOf,
    OnGround,
    Reference,
    Shift,
    conjuncts,
    is_row_local,
    operands,
    walk,
)
from patterns.binding.guards import compile_guard
from patterns.scene.geometry import Line, Zone, crosses_line
from patterns.scene.places import of_source
from patterns.tools.telling import told, told_duration, told_number, told_value

NEAR = {"px": 100.0, "m": 5.0}
"""Distances that count half as far as can be, when near misses are put in order."""
_OPPOSITE = {"=": "<>", "<>": "=", "<": ">=", ">=": "<", ">": "<=", "<=": ">"}
_TURNED = {"=": "=", "<>": "<>", "<": ">", ">=": "<=", ">": "<", "<=": ">="}
_WANTED = {"=": "", "<>": "other than ", "<": "less than ", "<=": "at most ", ">": "more than ", ">=": "at least "}
_WANTED_TIME = {"=": "at ", "<>": "not at ", "<": "before ", "<=": "at or before ", ">": "after ", ">=": "at or after "}


@dataclass(frozen=True, slots=True)
class Shortfall:
    """One condition that was not true.

    Attributes:
        condition: The condition as SQL, parameters as their values.
        reason: What was got, what was wanted, and by how much it fell short.
        size: How far it was from true, to put near misses in order: 0 (as good as) to 1; more: it could not be.
    """

    condition: str
    reason: str
    size: float

    def __str__(self) -> str:
        return f"{self.condition}: {self.reason}"


@dataclass(slots=True)
class Judge:
    """Says of the rows of one partition which conditions fail, and by how much."""

    bound: BoundRule
    evaluator: ColumnEvaluator
    _slots: dict[Expr, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._slots = {slot: index for index, slot in enumerate(self.bound.slots)}

    def slot_values(self, row: int) -> tuple[Any, ...]:
        """What guards and registers read of the row."""
        return tuple(self.evaluator.column(slot)[row].as_py() for slot in self.bound.slots)

    def of_condition(self, condition: Condition, variable: str, row: int, registers: Sequence[Any]) -> list[Shortfall]:
        """What keeps the row from being taken as the variable; empty: nothing does."""
        parts = [self.bound.predicates[at] for at in condition.predicates]
        parts += [] if condition.guard is None else [condition.guard]
        return [each for part in parts for each in self.of(part, variable, row, registers)]

    def of(self, expr: Expr, variable: str, row: int, registers: Sequence[Any] = ()) -> list[Shortfall]:
        """What is not true of the condition, part by part."""
        asked = _Asked(self, variable, row, registers)
        return [
            asked.shortfall(part) for part in conjuncts(expr) if asked.value(part) is not True
        ]  # fmt: skip

    def value(self, expr: Expr, row: int, registers: Sequence[Any]) -> Any:
        """The value at the row, of a match that remembers this; None is NULL."""
        if is_row_local(expr):
            return self.evaluator.column(expr)[row].as_py()
        guard = compile_guard(expr, self._slots, dict(self.bound.register_of), self.evaluator.places)
        return guard(self.slot_values(row), registers)


@dataclass(frozen=True, slots=True)
class _Asked:
    """One row, tried as one variable."""

    judge: Judge
    variable: str
    row: int
    registers: Sequence[Any]

    def value(self, expr: Expr) -> Any:
        return self.judge.value(expr, self.row, self.registers)

    def told(self, expr: Expr) -> str:
        return told(expr, self.variable)

    def shortfall(self, expr: Expr) -> Shortfall:
        """Why the condition, which holds no AND at its top, is not true."""
        if self.value(expr) is None:
            return self.unknown(expr)
        reason, size = self.reason(expr, is_wanted=True)
        return Shortfall(self.told(expr), reason, size)

    def reason(self, expr: Expr, is_wanted: bool) -> tuple[str, float]:
        """Why the condition is not as wanted, true or false, and how far it is from that."""
        if isinstance(expr, InZone):
            return self.in_zone(expr, is_wanted)
        if isinstance(expr, Crosses):
            return self.crosses(expr, is_wanted)
        if isinstance(expr, Call) and expr.op == "not":
            return self.reason(expr.operands[0], not is_wanted)
        if isinstance(expr, Call) and expr.op in COMPARISONS:
            return self.comparison(expr.op if is_wanted else _OPPOSITE[expr.op], *expr.operands)
        if isinstance(expr, Call) and expr.op == ("or" if is_wanted else "and"):
            return self.none_of(expr.operands, is_wanted)
        if isinstance(expr, Call) and expr.op == ("and" if is_wanted else "or"):
            return self.not_all_of(expr.operands, is_wanted)
        if isinstance(expr, OneOf):
            return self.one_of(expr, is_wanted)
        if isinstance(expr, Call) and expr.op == "timer":
            due = told_value(self.value(expr.operands[1]), Kind.TIME)
            return f"it takes the virtual row of {due} alone", 1.0
        if isinstance(expr, Call) and expr.op == "is_null":
            shown = told_value(self.value(expr.operands[0]), expr.operands[0].kind)
            return f"{self.told(expr.operands[0])} is {shown}", 1.0
        return ("it is false" if is_wanted else "it is true"), 1.0

    def unknown(self, expr: Expr) -> Shortfall:
        """The condition is NULL: which of its parts make it so."""
        leaves = [
            each for each in walk(expr) if isinstance(each, Column | Shift | Reference) and self.value(each) is None
        ]
        outer = [each for each in leaves if not any(each in operands(other) for other in leaves)]
        names = list(dict.fromkeys(self.told(each) + self.why_null(each) for each in outer))
        what = f"unknown, for {', '.join(names)} is NULL" if names else self.why_nowhere(expr)
        return Shortfall(self.told(expr), what, 2.0)

    def why_nowhere(self, expr: Expr) -> str:
        """Why it is not known, where every column is."""
        asks = (part for part in walk(expr) if isinstance(part, InZone | Crosses | OnGround))
        sources = {self.value(part.operands[0]) for part in asks if self.value(part) is None}
        places = self.judge.evaluator.places
        uncalibrated = sorted(each for each in sources if each is not None and not places.is_calibrated(each))
        return f"unknown, for {_uncalibrated(uncalibrated[0])[0]}" if uncalibrated else "unknown (NULL)"

    def why_null(self, expr: Expr) -> str:
        if not isinstance(expr, Shift) or 0 <= self.row - expr.rows < self.judge.evaluator.rows.table.num_rows:
            return ""
        return f" (there is no such row {'before' if expr.rows > 0 else 'after'} it)"

    def none_of(self, parts: tuple[Expr, ...], is_wanted: bool) -> tuple[str, float]:
        """Why no part of a choice is as wanted."""
        listed = _one_of(parts) if is_wanted else None
        if listed is not None:
            got = told_value(self.value(listed[0]), listed[0].kind)
            return f"{got} got, wanted one of {', '.join(listed[1])}", 1.0
        return self.joined(parts, is_wanted)

    def one_of(self, expr: OneOf, is_wanted: bool) -> tuple[str, float]:
        got = told_value(self.value(expr.operands[0]), expr.operands[0].kind)
        return f"{got} got, {'not ' if is_wanted else ''}among the {len(expr.values)} values of the list", 1.0

    def not_all_of(self, parts: tuple[Expr, ...], is_wanted: bool) -> tuple[str, float]:
        """Why some parts, all of which were wanted, are not as wanted."""
        return self.joined([part for part in parts if self.value(part) is not is_wanted], is_wanted)

    def joined(self, parts: Sequence[Expr], is_wanted: bool) -> tuple[str, float]:
        reasons = []
        for part in parts:
            if self.value(part) is None:
                reasons.append((self.unknown(part).reason, 2.0))
            else:
                reasons.append(self.reason(part, is_wanted))
        texts = [f"{self.told(part)}: {reason}" for part, (reason, _) in zip(parts, reasons, strict=True)]
        return "; ".join(texts), min((size for _, size in reasons), default=1.0)

    # Comparisons.

    def comparison(self, op: str, left: Expr, right: Expr) -> tuple[str, float]:
        if isinstance(left, Const) and not isinstance(right, Const):
            op, left, right = _TURNED[op], right, left
        got, wanted = self.value(left), self.value(right)
        kind = left.kind
        if kind is Kind.TIME:
            return self.of_times(op, (left, got), (right, wanted))
        if kind is Kind.DURATION:
            return _measured(op, got, wanted, told_duration)
        if kind in (Kind.INT, Kind.FLOAT):
            return _measured(op, got, wanted, told_number)
        return f"{told_value(got, kind)} got, {_WANTED[op]}{told_value(wanted, right.kind)} wanted", 1.0

    def of_times(self, op: str, left: tuple[Expr, int], right: tuple[Expr, int]) -> tuple[str, float]:
        """Two times; `a.time >= b.time + 10 s` is told as the time from b to a."""
        waited = _added(right[0])
        if waited is not None:
            return _measured(op, left[1] - (right[1] - waited), waited, told_duration)
        waited = _added(left[0])
        if waited is not None:
            return _measured(_TURNED[op], right[1] - (left[1] - waited), waited, told_duration)
        got, wanted = (told_value(each, Kind.TIME) for each in (left[1], right[1]))
        apart = left[1] - right[1]
        how = f": {told_duration(abs(apart))} too {'late' if apart >= 0 else 'early'}" if op != "<>" else ""
        return f"{got} got, {_WANTED_TIME[op]}{wanted} wanted{how}", _share(abs(apart), 60e6)

    # Geometry.

    def in_zone(self, expr: InZone, is_wanted: bool) -> tuple[str, float]:
        places = self.judge.evaluator.places
        source, x, y = (self.value(part) for part in expr.operands)
        known = places.zones_named(expr.zone)
        zone = of_source(known, source)
        if zone is None:
            return _elsewhere("zone", expr.zone, known, source)
        if not places.is_known(zone):
            return _uncalibrated(zone.source)
        polygon = zone.polygon_px(places.frame_size(zone, expr.zone))
        unit = "px"
        if zone.units == "metres":
            x, y = self.on_ground(source, x, y)
            unit = "m"
            if not np.isfinite(x):
                return "the point is above the horizon", 1.0
        far = float(shapely.distance(polygon.exterior, shapely.Point(x, y)))
        side = "outside" if is_wanted else "inside"
        return f"({x:.1f}, {y:.1f}) is {far:.1f} {unit} {side}", _share(far, NEAR[unit])

    def crosses(self, expr: Crosses, is_wanted: bool) -> tuple[str, float]:
        places = self.judge.evaluator.places
        source, *step = (self.value(part) for part in expr.operands)
        known = places.lines_named(expr.line)
        line = of_source(known, source)
        if line is None:
            return _elsewhere("line", expr.line, known, source)
        if not places.is_known(line):
            return _uncalibrated(line.source)
        if not is_wanted:
            return "the step crosses it", 0.5
        points = line.points_px(places.frame_size(line, expr.line))
        if line.units != "metres":
            return _why_no_crossing(points, step, expr.direction, "px")
        # North is up on the ground and y is down in a picture: turned round, left and right are as seen.
        ends = [self.on_ground(source, *step[at : at + 2]) for at in (0, 2)]
        turned = [value for east, north in ends for value in (east, -north)]
        if not np.isfinite(turned).all():
            return "the step begins or ends above the horizon", 1.0
        return _why_no_crossing(points * np.array([1.0, -1.0]), turned, expr.direction, "m")

    def on_ground(self, source: str, x: float, y: float) -> tuple[float, float]:
        """Metres to the east and north of a point in pixels."""
        east, north = self.judge.evaluator.places.ground(source, np.array([x]), np.array([y]))
        return float(east[0]), float(north[0])


def _uncalibrated(source: str) -> tuple[str, float]:
    return f"source {source} is not calibrated. Next: vian zones calibrate {source} POINTS.yaml", 5.0


def _elsewhere(what: str, name: str, known: Sequence[Zone | Line], got: Any) -> tuple[str, float]:
    there = ", ".join(sorted({each.source for each in known}))
    if not there:
        return f"no source has a {what} {name!r}: never true", 5.0
    return f"{what} {name!r} is of source {there}, and this row is of {got}: never true", 5.0


def _why_no_crossing(points: Any, step: Sequence[float], direction: str, unit: str) -> tuple[str, float]:
    (ax, ay), (bx, by) = points
    x0, y0, x1, y1 = step
    ends = (np.array([x0]), np.array([y0]), np.array([x1]), np.array([y1]))
    if crosses_line(points, ends, "any")[0]:
        return f"the step crosses it the other way; wanted {direction.replace('_', ' ')}", 0.5
    before, after = ((bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0 for x, y in ((x0, y0), (x1, y1)))
    far = float(shapely.distance(shapely.LineString(points), shapely.LineString([(x0, y0), (x1, y1)])))
    if before == after:
        side = "right" if after else "left"
        return f"the step stays on the {side} side, {far:.1f} {unit} from the line", _share(far, NEAR[unit])
    return f"the step passes {far:.1f} {unit} beyond the line's end", _share(far, NEAR[unit])


def _measured(op: str, got: float, wanted: float, tell: Callable[[float], str]) -> tuple[str, float]:
    """What was got and wanted, and the difference, for values that can be subtracted."""
    apart = abs(got - wanted)
    said = f"{tell(got)} got, {_WANTED[op]}{tell(wanted)} wanted"
    if op == "<>" or not np.isfinite(apart):
        return said, 1.0
    size = _share(apart, abs(wanted) or 1.0)
    if not apart:
        return f"{said}: exactly at the limit", size
    return f"{said}: {tell(apart)} {'too much' if got > wanted else 'short'}", size


def _share(apart: float, usual: float) -> float:
    """A distance as 0 to 1: at the usual distance a half."""
    return apart / (apart + usual)


def _added(expr: Expr) -> int | None:
    """The constant duration that is added to a time of the match; None: that is not what the expression is."""
    inner = expr.operand if isinstance(expr, Reference) else expr
    if not isinstance(inner, Call) or inner.op != "+" or len(inner.operands) != 2:
        return None
    constants = [part for part in inner.operands if isinstance(part, Const) and part.kind is Kind.DURATION]
    return constants[0].value if len(constants) == 1 and isinstance(constants[0].value, int) else None


def _one_of(parts: tuple[Expr, ...]) -> tuple[Expr, list[str]] | None:
    """Of `x = 1 OR x = 2 OR ...` the x and the values."""
    flat = [each for part in parts for each in (_one_of_parts(part))]
    pairs = [part.operands for part in flat if isinstance(part, Call) and part.op == "="]
    if len(pairs) != len(flat) or len({left for left, _ in pairs}) != 1:
        return None
    if not all(isinstance(right, Const) for _, right in pairs):
        return None
    return pairs[0][0], [told(right, "") for _, right in pairs]


def _one_of_parts(expr: Expr) -> tuple[Expr, ...]:
    if isinstance(expr, Call) and expr.op == "or":
        return tuple(each for part in expr.operands for each in _one_of_parts(part))
    return (expr,)
