"""Zones and lines as SQL arithmetic: the formulae of `patterns.geometry`, unrolled over their corners.

Doubles throughout. A line is asked exactly as there. A zone is asked by crossing
numbers; where a point lies nearer to a slanted side than a double tells apart,
about 1e-12 px, the answer may differ from the one there, which rounds later.
"""

from collections.abc import Sequence

from patterns.flink.names import number, text
from patterns.geometry import Direction, Points

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


def of_sources(source: str, asked: Sequence[tuple[str, str]], coordinates: Sequence[str]) -> str:
    """The condition of each source for its rows: false for others, NULL where a coordinate is NULL or not finite.

    Args:
        source: SQL of the row's source.
        asked: Sources, and the condition for each.
        coordinates: SQL of all that the conditions read, of type DOUBLE.
    """
    finite = " AND ".join(f"ABS({each}) <= {LARGEST}" for each in dict.fromkeys(coordinates))
    if not asked:
        return "FALSE"
    cases = [
        f"    WHEN {source} = {text(name)} THEN CASE WHEN {finite} THEN {condition} END" for name, condition in asked
    ]
    return "\n".join(["CASE", *cases, "    ELSE FALSE", "END"])


def _scaled(factor: float, value: str, origin: float) -> str:
    return f"{number(factor)} * ({value} - {number(origin)})"


def _between(value: str, one: float, other: float) -> str:
    return f"{value} BETWEEN {number(min(one, other))} AND {number(max(one, other))}"


def _lines(parts: list[str], joint: str) -> str:
    return f"\n        {joint.strip()} ".join(parts)
