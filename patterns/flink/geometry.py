"""Zones and lines as SQL arithmetic: the formulae of `patterns.scene.geometry`, unrolled over their corners.

Doubles throughout. A line is asked exactly as there. A zone is asked by crossing
numbers; where a point lies nearer to a slanted side than a double tells apart,
about 1e-12 px, the answer may differ from the one there, which rounds later.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from patterns.flink.names import number, text
from patterns.scene.geometry import Direction, FrameSize, Points
from patterns.scene.ground import Calibration

LARGEST = "1.7976931348623157E308"


def in_polygon(corners: Points, x: str, y: str) -> str:
    """A condition: the point lies in the polygon or on its border; corners in pixels, shape (n, 2).

    Args:
        corners: In order, the first not repeated.
        x: SQL of type DOUBLE, finite.
        y: SQL of type DOUBLE, finite.
    """
    borders, crossings = [], []
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        side = f"{_scaled(bx - ax, y, ay)} - {_scaled(by - ay, x, ax)}"
        borders.append(f"({side} = 0 AND {_between(x, ax, bx)} AND {_between(y, ay, by)})")
        if ay == by:
            continue
        low, high, sign = (ay, by, "<") if by > ay else (by, ay, ">")
        inside = f"{y} >= {number(low)} AND {y} < {number(high)} AND {side} {sign} 0"
        crossings.append(f"CASE WHEN {inside} THEN 1 ELSE 0 END")
    return f"({_lines(borders, ' OR ')} OR MOD({_lines(crossings, ' + ')}, 2) = 1)"


def crosses_line(points: Points, step: Sequence[str], direction: Direction) -> str:
    """A condition: the step crosses the line; points in pixels, shape (2, 2).

    Args:
        points: The line's two points.
        step: SQL of x0, y0, x1 and y1, of type DOUBLE, finite.
        direction: Which crossings count.
    """
    (ax, ay), (bx, by) = points
    x0, y0, x1, y1 = step
    before = f"{_scaled(bx - ax, y0, ay)} - {_scaled(by - ay, x0, ax)} >= 0"
    after = f"{_scaled(bx - ax, y1, ay)} - {_scaled(by - ay, x1, ax)} >= 0"
    first = f"({x1} - {x0}) * ({number(ay)} - {y0}) - ({y1} - {y0}) * ({number(ax)} - {x0})"
    second = f"({x1} - {x0}) * ({number(by)} - {y0}) - ({y1} - {y0}) * ({number(bx)} - {x0})"
    meets = f"LEAST({first}, {second}) <= 0 AND GREATEST({first}, {second}) >= 0"
    sides = {
        "left_to_right": f"NOT ({before}) AND {after}",
        "right_to_left": f"{before} AND NOT ({after})",
        "any": f"({before}) <> ({after})",
    }[direction]
    return f"({meets} AND {sides})"


@dataclass(frozen=True, slots=True)
class Ground:
    """Where a pixel lies on the ground, in SQL: the formulae of `patterns.scene.ground`, step by step.

    Attributes:
        calibration: Of the source.
        scale: Pixels of the calibration's frame for one pixel here, to the right and down.
        x: To the right, in the calibration's frame.
        y: Down, in the calibration's frame.
    """

    calibration: Calibration
    scale: tuple[float, float]
    x: str
    y: str

    @classmethod
    def of(cls, calibration: Calibration, frame_size: FrameSize | None, x: str, y: str) -> "Ground":
        """The ground of a pixel of a frame of this size; None: of the calibration's."""
        if frame_size is None or frame_size == calibration.frame_size:
            return cls(calibration, (1.0, 1.0), x, y)
        (width, height), (to_width, to_height) = frame_size, calibration.frame_size
        scale = (to_width / width, to_height / height)
        return cls(calibration, scale, _times(x, scale[0]), _times(y, scale[1]))

    @property
    def is_seen(self) -> str:
        """A condition: the pixel lies below the horizon."""
        return f"{self._mapped(2)} > 0"

    @property
    def east(self) -> str:
        """Metres to the east."""
        return f"({self._mapped(0)} / {self._mapped(2)})"

    @property
    def north(self) -> str:
        """Metres to the north."""
        return f"({self._mapped(1)} / {self._mapped(2)})"

    def speed(self, vx: str, vy: str) -> str:
        """Metres a second of a point that moves with this velocity in the picture."""
        depth = self._mapped(2)
        rates = [self._rate(row, _times(vx, self.scale[0]), _times(vy, self.scale[1])) for row in range(3)]
        ways = [f"(({rates[row]} - {self._mapped(row)} / {depth} * {rates[2]}) / {depth})" for row in (0, 1)]
        return f"SQRT({ways[0]} * {ways[0]} + {ways[1]} * {ways[1]})"

    def _mapped(self, row: int) -> str:
        return f"({self._rate(row, self.x, self.y)} + {number(self.calibration.matrix[row][2])})"

    def _rate(self, row: int, x: str, y: str) -> str:
        first, second, _ = self.calibration.matrix[row]
        return f"({number(first)} * {x} + {number(second)} * {y})"


def of_sources(source: str, asked: Sequence[tuple[str, str]], coordinates: Sequence[str], other: str) -> str:
    """What is asked of each source for its rows, and NULL there where a coordinate is NULL or not finite.

    Args:
        source: SQL of the row's source.
        asked: Sources, and the expression for each.
        coordinates: SQL of all that the expressions read, of type DOUBLE.
        other: SQL for the rows of other sources.
    """
    finite = " AND ".join(f"ABS({each}) <= {LARGEST}" for each in dict.fromkeys(coordinates))
    if not asked:
        return other
    cases = [
        f"    WHEN {source} = {text(name)} THEN CASE WHEN {finite} THEN {condition} END" for name, condition in asked
    ]
    return "\n".join(["CASE", *cases, f"    ELSE {other}", "END"])


def _times(value: str, factor: float) -> str:
    return value if factor == 1 else f"({value} * {number(factor)})"


def _scaled(factor: float, value: str, origin: float) -> str:
    return f"{number(factor)} * ({value} - {number(origin)})"


def _between(value: str, one: float, other: float) -> str:
    return f"{value} BETWEEN {number(min(one, other))} AND {number(max(one, other))}"


def _lines(parts: list[str], joint: str) -> str:
    return f"\n        {joint.strip()} ".join(parts)
