"""Zones and lines in the image or on the ground, and the two predicates over them.

Pixels have their origin at the top left, x to the right and y down. A zone is
a closed polygon: a point on its border is inside. A line has two sides as seen
when looking from its first point to its second; a point exactly on it counts
as right. The predicates take columns of finite pixels; who calls them deals
with NULL.
"""

from typing import Annotated, Any, Literal, Self

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

Points = NDArray[np.float64]
Flags = NDArray[np.bool_]
Units = Literal["normalised", "pixels", "metres"]
Direction = Literal["left_to_right", "right_to_left", "any"]
DIRECTIONS: tuple[Direction, ...] = ("left_to_right", "right_to_left", "any")

Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate]
FrameSize = tuple[int, int]


class _Shape(BaseModel):
    """What zones and lines share: the source that they belong to, and their units."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str = Field(min_length=1)
    units: Units = "normalised"

    def scaled(self, points: tuple[Point, ...], frame_size: FrameSize | None) -> Points:
        """The points in pixels, shape (n, 2), of a frame of this width and height; those in metres stay in metres."""
        array = np.asarray(points, dtype=np.float64)
        if self.units != "normalised":
            return array
        if frame_size is None:
            raise ValueError("normalised coordinates need a frame size")
        return array * np.asarray(frame_size, dtype=np.float64)

    def _check_normalised(self, points: tuple[Point, ...]) -> None:
        if self.units == "normalised" and any(not 0 <= value <= 1 for point in points for value in point):
            raise ValueError("normalised coordinates lie in 0 to 1; others need `units: pixels` or `units: metres`")


class Zone(_Shape):
    """A polygon in the image of one source, or on its ground; three points or more, not crossing itself."""

    polygon: tuple[Point, ...]

    @model_validator(mode="after")
    def _is_a_polygon(self) -> Self:
        if len(self.polygon) < 3:
            raise ValueError(f"a polygon needs 3 points or more, got {len(self.polygon)}")
        self._check_normalised(self.polygon)
        polygon = shapely.Polygon(self.polygon)
        if not polygon.is_valid or polygon.area == 0:
            raise ValueError("a polygon must have an area and not cross itself")
        return self

    def polygon_px(self, frame_size: FrameSize | None) -> Any:
        """The prepared shapely polygon in pixels, or in metres if it is in metres; `frame_size` is (width, height)."""
        polygon = shapely.Polygon(self.scaled(self.polygon, frame_size))
        shapely.prepare(polygon)
        return polygon


class Line(_Shape):
    """A straight line between two points in the image of one source, or on its ground."""

    points: tuple[Point, Point]

    @model_validator(mode="after")
    def _has_a_length(self) -> Self:
        self._check_normalised(self.points)
        if self.points[0] == self.points[1]:
            raise ValueError("a line's two points must differ")
        return self

    def points_px(self, frame_size: FrameSize | None) -> Points:
        """The two points in pixels, shape (2, 2), or in metres; `frame_size` is (width, height)."""
        return self.scaled(self.points, frame_size)


def in_polygon(polygon: Any, x: Points, y: Points) -> Flags:
    """Which points (pixels) lie in the prepared polygon or on its border."""
    inside: Flags = shapely.intersects_xy(polygon, x, y)
    return inside


def crosses_line(line: Points, steps: tuple[Points, Points, Points, Points], direction: Direction) -> Flags:
    """Which steps, from (x0, y0) to (x1, y1) in pixels, cross the line in this direction.

    A step crosses when it changes side and the straight step meets the line
    between its two points, end points included. A step that stands still, or
    runs along the line, changes no side.
    """
    (ax, ay), (bx, by) = line
    x0, y0, x1, y1 = steps
    right_before = (bx - ax) * (y0 - ay) - (by - ay) * (x0 - ax) >= 0
    right_after = (bx - ax) * (y1 - ay) - (by - ay) * (x1 - ax) >= 0
    first = (x1 - x0) * (ay - y0) - (y1 - y0) * (ax - x0)
    second = (x1 - x0) * (by - y0) - (y1 - y0) * (bx - x0)
    meets = np.minimum(first, second) <= 0
    meets &= np.maximum(first, second) >= 0
    if direction == "left_to_right":
        return np.asarray(meets & ~right_before & right_after)
    if direction == "right_to_left":
        return np.asarray(meets & right_before & ~right_after)
    return np.asarray(meets & (right_before != right_after))
