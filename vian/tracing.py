"""Rows of the log as a drawing: where they are, over the frame of the one that matters, with the rule's places."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from patterns.files.rule import Rule
from patterns.scene.geometry import FrameSize, Line, Zone
from patterns.scene.places import Places
from patterns.scene.site import Site
from store import Log
from vian.drawings import Dot, Drawing, Mark, Point, Shape
from vian.footage import footage_of

Row = Mapping[str, Any]
"""An event's columns by name, with the envelope."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What is to be drawn.

    Attributes:
        rows: The rows that were taken, each with its variable, in order.
        key_row: The row whose frame is shown.
        marked: Rows to point at, each with a text.
        trail: All rows of the partition around them, in order.
        captions: Lines of text below.
    """

    rows: Sequence[tuple[str, Row]]
    key_row: Row
    marked: Sequence[tuple[Row, str]] = ()
    trail: Sequence[Row] = ()
    captions: Sequence[str] = ()


def traced(log: Log, rule: Rule | None, site: Site, scene: Scene) -> tuple[Drawing, str]:
    """The scene as a drawing, and why it shows no picture; empty if it does."""
    key = scene.key_row
    footage = footage_of(log, key["station"], key["source"], key["time"], key.get("frame"))
    rows = [(label, row) for label, row in scene.rows if row["source"] == key["source"]]
    points = [place_of(row) for _, row in rows] + [place_of(row) for row, _ in scene.marked]
    size = footage.size or _size_around([point for point in points if point is not None])
    missing = [f"no picture: {footage.missing}"] if footage.missing else []
    drawing = Drawing(
        size=size,
        picture=footage.picture,
        shapes=[] if rule is None else shapes_of(rule, site, key["source"], size),
        trail=[point for row in scene.trail if (point := place_of(row)) is not None and row["source"] == key["source"]],
        dots=_dots(rows),
        marks=[Mark(at, text) for row, text in scene.marked if (at := place_of(row)) is not None],
        captions=[*scene.captions, *missing],
    )
    return drawing, footage.missing


def place_of(row: Row) -> Point | None:
    """Where the row is in its frame: its point, else the middle of its box; None: it says neither."""
    x, y = row.get("x"), row.get("y")
    if isinstance(x, int | float) and isinstance(y, int | float):
        return float(x), float(y)
    box = _box_of(row)
    return None if box is None else ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)


def shapes_of(rule: Rule, site: Site, source: str, size: FrameSize) -> list[Shape]:
    """The zones and lines that the rule knows at the source, own and shared, in pixels of a frame of this size."""
    places = Places(rule.zones, rule.lines, site)
    zones = {name: places.zones_named(name) for name in (*rule.zones, *rule.shared)}
    lines = {name: places.lines_named(name) for name in (*rule.lines, *rule.shared)}
    corners: list[tuple[str, Zone | Line, tuple[Point, ...], bool]] = [
        *((name, each, each.polygon, True) for name, known in zones.items() for each in known),
        *((name, each, each.points, False) for name, known in lines.items() for each in known),
    ]
    return [
        Shape(name, points, is_zone)
        for name, shape, written, is_zone in corners
        if shape.source == source and (points := _pixels(shape, written, site, size))
    ]


def _pixels(shape: Zone | Line, written: tuple[Point, ...], site: Site, size: FrameSize) -> list[Point]:
    """The shape's points in pixels; none if they are in metres and the camera is not calibrated."""
    if shape.units != "metres":
        return _points(shape.scaled(written, size))
    calibration = site.calibration(shape.source)
    if calibration is None:
        return []
    ground = np.array([(east, north, 1.0) for east, north in written])
    mapped = ground @ np.linalg.inv(np.asarray(calibration.matrix)).T
    scale = np.asarray(size) / np.asarray(calibration.frame_size)
    return _points(mapped[:, :2] / mapped[:, 2:] * scale)


def _points(pixels: Iterable[Any]) -> list[Point]:
    return [(float(x), float(y)) for x, y in pixels]


def _dots(rows: Sequence[tuple[str, Row]]) -> list[Dot]:
    """A dot for each row; boxes at the first and the last only: all of them would hide the picture."""
    ends = {0, len(rows) - 1}
    return [
        Dot(label, at, _box_of(row) if number in ends else None)
        for number, (label, row) in enumerate(rows)
        if (at := place_of(row)) is not None
    ]


def _box_of(row: Row) -> tuple[float, float, float, float] | None:
    x1, y1, x2, y2 = (row.get(name) for name in ("x1", "y1", "x2", "y2"))
    if x1 is None or y1 is None or x2 is None or y2 is None:
        return None
    return float(x1), float(y1), float(x2), float(y2)


def _size_around(points: Sequence[Point]) -> FrameSize:
    """A frame that holds the points, where no video says how large frames are."""
    far_x = max((x for x, _ in points), default=0.0)
    far_y = max((y for _, y in points), default=0.0)
    return max(640, round(far_x * 1.1)), max(360, round(far_y * 1.1))
