"""Where things are: the zones, lines and ground of a rule, asked about pixels.

A rule's own zone or line belongs to one source. A shared one bears a name that each source may
have defined for itself; a source without it has no such place, and nothing there is in it. Of a source
that is not calibrated nothing is known in metres.
Pixels have their origin at the top left, x to the right and y down; columns hold finite pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from patterns.errors import FrameSizeUnknown
from patterns.scene.geometry import Direction, FrameSize, Line, Zone, crosses_line, in_polygon
from patterns.scene.ground import GroundValue
from patterns.scene.site import Site

Points = NDArray[np.float64]
Flags = NDArray[np.bool_]
Shape = TypeVar("Shape", Zone, Line)


def of_source(shapes: Sequence[Shape], source: object) -> Shape | None:
    """The one of the shapes of one name that the source has."""
    return next((each for each in shapes if each.source == source), None)


@dataclass(frozen=True, slots=True)
class Places:
    """The zones and lines of a rule's own, and what is known of the cameras; the site may learn more."""

    zones: Mapping[str, Zone]
    lines: Mapping[str, Line]
    site: Site = field(default_factory=Site)

    def zones_named(self, name: str) -> list[Zone]:
        """The zones of this name: the rule's own one, or the shared ones, one for each source that has it."""
        own = self.zones.get(name)
        shared = self.site.shapes(name, Zone) if own is None else [own]
        return [each for each in shared if isinstance(each, Zone)]

    def lines_named(self, name: str) -> list[Line]:
        """The lines of this name: the rule's own one, or the shared ones, one for each source that has it."""
        own = self.lines.get(name)
        shared = self.site.shapes(name, Line) if own is None else [own]
        return [each for each in shared if isinstance(each, Line)]

    def frame_size(self, shape: Zone | Line, name: str) -> FrameSize | None:
        """The frame size that scales the shape; None for one that is not normalised.

        Raises:
            FrameSizeUnknown: It is normalised and its source's frame size is not known.
        """
        if shape.units != "normalised":
            return None
        if shape.source not in self.site.frame_sizes:
            raise FrameSizeUnknown(name, shape.source)
        return self.site.frame_sizes[shape.source]

    def is_calibrated(self, source: str) -> bool:
        """Whether it is known where on the ground the source's pixels are."""
        return self.site.calibration(source) is not None

    def is_known(self, shape: Zone | Line) -> bool:
        """Whether it can be said which pixels of its source the shape is about: in metres, a calibration does."""
        return shape.units != "metres" or self.is_calibrated(shape.source)

    def inside(self, zone: Zone, name: str, x: Points, y: Points) -> Flags:
        """Which points of the zone's source lie in it or on its border; none above the horizon lies in one in metres.

        The zone `is_known`.

        Raises:
            FrameSizeUnknown: The zone cannot be laid into the picture.
        """
        polygon = zone.polygon_px(self.frame_size(zone, name))
        if zone.units == "metres":
            x, y = self.ground(zone.source, x, y)
            is_seen = np.isfinite(x)
            inside = np.zeros(len(x), dtype=bool)
            inside[is_seen] = in_polygon(polygon, x[is_seen], y[is_seen])
            return inside
        return in_polygon(polygon, x, y)

    def crossed(
        self, line: Line, name: str, steps: tuple[Points, Points, Points, Points], direction: Direction
    ) -> Flags:
        """Which steps of the line's source cross it; with a line in metres, none from or to above the horizon.

        The line `is_known`.

        Raises:
            FrameSizeUnknown: The line cannot be laid into the picture.
        """
        points = line.points_px(self.frame_size(line, name))
        if line.units != "metres":
            return crosses_line(points, steps, direction)
        # East is right and north is up on the ground, so its y is turned round: then sides are as in a picture.
        x0, y0 = self.ground(line.source, *steps[:2])
        x1, y1 = self.ground(line.source, *steps[2:])
        is_seen = np.isfinite(x0) & np.isfinite(x1)
        crossed = np.zeros(len(x0), dtype=bool)
        seen_steps = (x0[is_seen], -y0[is_seen], x1[is_seen], -y1[is_seen])
        crossed[is_seen] = crosses_line(points * np.array([1.0, -1.0]), seen_steps, direction)
        return crossed

    def ground(self, source: str, x: Points, y: Points) -> tuple[Points, Points]:
        """Metres to the east and north of the source's pixels; NaN above the horizon, or if it is not calibrated."""
        calibration = self.site.calibration(source)
        if calibration is None:
            nowhere = np.full(len(x), np.nan)
            return nowhere, nowhere
        return calibration.ground(x, y, self.site.frame_sizes.get(source))

    def on_ground(self, source: str, what: GroundValue, values: list[Points]) -> Points:
        """East or north (m) of points, or their speed (m/s) from points and velocities; NaN as `ground` has it."""
        if what != "speed":
            east, north = self.ground(source, *values)
            return east if what == "x" else north
        calibration = self.site.calibration(source)
        if calibration is None:
            return np.full(len(values[0]), np.nan)
        x, y, vx, vy = values
        return calibration.speed((x, y), (vx, vy), self.site.frame_sizes.get(source))
