"""Zones, lines and the ground in the script: as columns of the input where one row decides, else in place.

They are said as the rule draws them, or as the log says them when the script is written.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np

from patterns.binding.expressions import Column, Crosses, Expr, InZone, OnGround, Shift, is_row_local, rebuilt, walk
from patterns.errors import FrameSizeUnknown
from patterns.files.rule import Rule
from patterns.flink import geometry
from patterns.scene.geometry import Line, Zone
from patterns.scene.ground import Calibration
from patterns.scene.places import Places
from patterns.scene.site import CALIBRATION

Placed = InZone | Crosses | OnGround


@dataclass(slots=True)
class Shapes:
    """Asks the rule's places in SQL, and remembers what became a column.

    Attributes:
        rule: The rule, for errors.
        places: Its zones and lines, and what is known of the cameras.
        columns: The name of the input's column for each expression that became one.
    """

    rule: Rule
    places: Places
    columns: dict[Expr, str] = field(default_factory=dict)

    def as_columns(self, expr: Expr) -> Expr:
        """The expression with a column in place of each place that one row decides."""
        is_local = is_row_local(expr) and not any(isinstance(part, Shift) for part in walk(expr))
        if isinstance(expr, Placed) and is_local:
            return Column(self._named(expr), expr.kind)
        return rebuilt(expr, self.as_columns)

    def sql(self, expr: Placed, operands: list[str]) -> str:
        """The expression over these operands: the source, then the coordinates."""
        source, *coordinates = operands
        if isinstance(expr, OnGround):
            asked = [(name, self._on_ground(expr, name, coordinates)) for name in self._calibrated()]
            return geometry.of_sources(source, asked, coordinates, "CAST(NULL AS DOUBLE)")
        shapes = self._shapes(expr)
        asked = [(shape.source, self._asked(expr, shape, coordinates)) for shape in shapes]
        return geometry.of_sources(source, asked, coordinates, "FALSE")

    def _shapes(self, expr: InZone | Crosses) -> Sequence[Zone | Line]:
        if isinstance(expr, InZone):
            return self.places.zones_named(expr.zone)
        return self.places.lines_named(expr.line)

    def _asked(self, expr: InZone | Crosses, shape: Zone | Line, coordinates: list[str]) -> str:
        name = expr.zone if isinstance(expr, InZone) else expr.line
        try:
            frame_size = self.places.frame_size(shape, name)
        except FrameSizeUnknown as error:
            what = f"is in normalised coordinates, and the frame size of {shape.source!r} is not known"
            self._unknown(expr, what, f"give it, as in `--frame-size {shape.source}=1920x1080`", error)
        is_on_ground = shape.units == "metres"
        if isinstance(expr, InZone):
            assert isinstance(shape, Zone), "a zone is asked whether it holds a point"
            corners = shape.scaled(shape.polygon, frame_size)
            if not is_on_ground:
                return geometry.in_polygon(corners, *coordinates)
            ground = self._ground(expr, shape, coordinates)
            return f"({ground.is_seen} AND {geometry.in_polygon(corners, ground.east, ground.north)})"
        assert isinstance(shape, Line), "a line is asked whether it is crossed"
        points = shape.points_px(frame_size)
        if not is_on_ground:
            return geometry.crosses_line(points, coordinates, expr.direction)
        # On the ground north is up, in a picture down: with north turned round, sides are as in a picture.
        ends = [self._ground(expr, shape, coordinates[at : at + 2]) for at in (0, 2)]
        step = [value for end in ends for value in (end.east, f"(-{end.north})")]
        crossed = geometry.crosses_line(points * np.array([1.0, -1.0]), step, expr.direction)
        return f"({ends[0].is_seen} AND {ends[1].is_seen} AND {crossed})"

    def _ground(self, expr: InZone | Crosses, shape: Zone | Line, point: list[str]) -> geometry.Ground:
        calibration = self.places.site.calibration(shape.source)
        if calibration is None:
            what = f"is in metres, and the log says no calibration of {shape.source!r}"
            self._unknown(expr, what, "name the log that does, with --data-dir or --dsn", None)
        return geometry.Ground.of(calibration, self.places.site.frame_sizes.get(shape.source), *point)

    def _on_ground(self, expr: OnGround, source: str, values: list[str]) -> str:
        calibration = self.places.site.calibration(source)
        assert calibration is not None, "calibrated sources are asked"
        frame_size = self.places.site.frame_sizes.get(source)
        ground = geometry.Ground.of(calibration, frame_size, *values[:2])
        return f"CASE WHEN {ground.is_seen} THEN {self._value(expr, ground, values[2:])} END"

    def _value(self, expr: OnGround, ground: geometry.Ground, velocity: list[str]) -> str:
        if expr.what == "speed":
            return ground.speed(*velocity)
        return ground.east if expr.what == "x" else ground.north

    def _calibrated(self) -> list[str]:
        versions = self.places.site.versions
        found = sorted(source for (source, name) in versions if name == CALIBRATION)
        found = [source for source in found if isinstance(self.places.site.calibration(source), Calibration)]
        if not found:
            raise self.rule.error(
                "the rule asks for the ground, and the log says no calibration of any source. "
                "Next: name the log that does, with --data-dir or --dsn",
                "match",
            )
        return found

    def _unknown(self, expr: InZone | Crosses, what: str, following: str, error: Exception | None) -> NoReturn:
        kind, name = ("zones", expr.zone) if isinstance(expr, InZone) else ("lines", expr.line)
        raise self.rule.error(f"{name!r} {what}. Next: {following}", kind, name) from error

    def _named(self, expr: Placed) -> str:
        if expr not in self.columns:
            name = _name(expr)
            taken = set(self.columns.values())
            number = next(each for each in range(1, len(taken) + 2) if _numbered(name, each) not in taken)
            self.columns[expr] = _numbered(name, number)
        return self.columns[expr]


def _name(expr: Placed) -> str:
    if isinstance(expr, OnGround):
        return f"ground_{expr.what}"
    return f"in_{expr.zone}" if isinstance(expr, InZone) else f"crosses_{expr.line}"


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}_{number}"
