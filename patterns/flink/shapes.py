"""Zones and lines of a rule in the script: as columns of the input where one row decides, else in place."""

from dataclasses import dataclass, field
from typing import NoReturn

from patterns.errors import FrameSizeUnknown
from patterns.expressions import Column, Crosses, Expr, InZone, Kind, Shift, is_row_local, rebuilt, walk
from patterns.flink import geometry
from patterns.flink.refusing import refusal
from patterns.geometry import Line, Zone
from patterns.places import Places
from patterns.rule import Rule


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
        """The expression with a column in place of each zone or line that one row decides."""
        is_local = is_row_local(expr) and not any(isinstance(part, Shift) for part in walk(expr))
        if isinstance(expr, InZone | Crosses) and is_local:
            return Column(self._named(expr), Kind.BOOL)
        return rebuilt(expr, self.as_columns)

    def sql(self, expr: InZone | Crosses, operands: list[str]) -> str:
        """The condition over these operands: the source, then the coordinates."""
        source, *coordinates = operands
        asked = [(shape.source, self._asked(expr, shape, coordinates)) for shape in self._shapes(expr)]
        return geometry.of_sources(source, asked, coordinates)

    def _shapes(self, expr: InZone | Crosses) -> list[Zone] | list[Line]:
        if isinstance(expr, InZone):
            return self.places.zones_named(expr.zone)
        return self.places.lines_named(expr.line)

    def _asked(self, expr: InZone | Crosses, shape: Zone | Line, coordinates: list[str]) -> str:
        name = expr.zone if isinstance(expr, InZone) else expr.line
        if shape.units == "metres":
            raise self.rule.error(refusal("metres"), "zones" if isinstance(expr, InZone) else "lines", name)
        try:
            frame_size = self.places.frame_size(shape, name)
        except FrameSizeUnknown as error:
            self._unknown(expr, error)
        if isinstance(expr, InZone):
            assert isinstance(shape, Zone), "a zone is asked whether it holds a point"
            return geometry.in_polygon(shape.scaled(shape.polygon, frame_size), *coordinates)
        assert isinstance(shape, Line), "a line is asked whether it is crossed"
        return geometry.crosses_line(shape.points_px(frame_size), coordinates, expr.direction)

    def _unknown(self, expr: InZone | Crosses, error: FrameSizeUnknown) -> NoReturn:
        kind = "zones" if isinstance(expr, InZone) else "lines"
        message = (
            f"{error.shape!r} is in normalised coordinates, and the frame size of {error.source!r} is not known. "
            f"Next: give it, as in `--frame-size {error.source}=1920x1080`"
        )
        raise self.rule.error(message, kind, error.shape) from error

    def _named(self, expr: InZone | Crosses) -> str:
        if expr not in self.columns:
            name = f"in_{expr.zone}" if isinstance(expr, InZone) else f"crosses_{expr.line}"
            taken = set(self.columns.values())
            number = next(each for each in range(1, len(taken) + 2) if _numbered(name, each) not in taken)
            self.columns[expr] = _numbered(name, number)
        return self.columns[expr]


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}_{number}"
