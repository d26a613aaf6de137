"""Drawings of what a rule saw: zones, lines, trajectories and the rows that mattered, over a frame.

Contract: pure but for `write_png`; the same drawing gives the same picture. All coordinates are pixels of
the frame, origin top-left, x right, y down. The picture is enlarged to be readable; a strip below
tells what is what.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vian.errors import WorldFailed

Image = npt.NDArray[np.uint8]
Point = tuple[float, float]
Colour = tuple[int, int, int]
"""Blue, green, red."""

WIDTH_MIN_PX = 960
"""Frames narrower than this are enlarged to it."""
_GOLDEN_ANGLE = 0.381966
_WHITE, _BLACK, _RED, _YELLOW, _BLANK = (255, 255, 255), (0, 0, 0), (40, 40, 235), (60, 215, 250), (60, 60, 60)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TEXT_SCALE = 0.5
_LINE_PX = 20


@dataclass(frozen=True, slots=True)
class Shape:
    """A zone (a closed polygon) or a line with its direction, by name."""

    name: str
    points: Sequence[Point]
    is_zone: bool


@dataclass(frozen=True, slots=True)
class Dot:
    """Where a row is; `label` is the variable that took it, `box` its box `x1 y1 x2 y2` where it has one."""

    label: str
    at: Point
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Mark:
    """A row that matters most, with what is to be said of it."""

    at: Point
    text: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """What is drawn.

    Attributes:
        size: Width and height of the frame in pixels.
        picture: The frame, blue-green-red; None: it is not at hand.
        shapes: Zones and lines.
        trail: The whole way, of which the dots are a part.
        dots: Rows in their order.
        marks: What to look at.
        captions: Lines of text below.
        has_scale: Whether the edges bear shares of the picture (0 to 1), to read coordinates from.
    """

    size: tuple[int, int]
    picture: Image | None = None
    shapes: Sequence[Shape] = ()
    trail: Sequence[Point] = ()
    dots: Sequence[Dot] = ()
    marks: Sequence[Mark] = ()
    captions: Sequence[str] = ()
    has_scale: bool = False


def drawn(drawing: Drawing) -> Image:
    """The picture, with a strip of text below."""
    scale = max(1.0, WIDTH_MIN_PX / drawing.size[0])
    canvas = _background(drawing, scale)
    labels = _Labels(canvas)
    if drawing.has_scale:
        _draw_scale(labels)
    for shape in drawing.shapes:
        _draw_shape(labels, shape, scale)
    _draw_way(canvas, drawing.trail, scale, (215, 215, 215), 2)
    colours = _colours(drawing.dots)
    _draw_way(canvas, [dot.at for dot in drawing.dots], scale, _WHITE, 1)
    for dot in drawing.dots:
        _draw_dot(canvas, dot, scale, colours[dot.label])
    for mark in drawing.marks:
        _draw_mark(labels, mark, scale)
    return np.vstack([canvas, _strip(canvas.shape[1], drawing, colours)])


def write_png(image: Image, file: Path) -> None:
    """Write the picture as PNG.

    Raises:
        WorldFailed: The file cannot be written.
    """
    is_encoded, data = cv2.imencode(".png", image)
    assert is_encoded, "OpenCV encodes any 8-bit image as PNG"
    try:
        file.write_bytes(data.tobytes())
    except OSError as error:
        raise WorldFailed(
            f"the drawing cannot be written to {file}: {error.strerror}. Next: the same command with another file"
        ) from error


def _background(drawing: Drawing, scale: float) -> Image:
    width, height = (round(each * scale) for each in drawing.size)
    if drawing.picture is None:
        return np.full((height, width, 3), _BLANK, np.uint8)
    enlarged = cv2.resize(drawing.picture, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged, np.uint8)


class _Labels:
    """Texts on a picture, none over another: with a dark rim, and moved so that they lie within it."""

    def __init__(self, canvas: Image) -> None:
        self.canvas = canvas
        self._taken: list[tuple[int, int, int, int]] = []

    def write(self, text: str, at: tuple[int, int], colour: Colour) -> None:
        """Write the text with its lower left corner here, or as near below it as there is room."""
        text = _ascii(text)
        (width, height), _ = cv2.getTextSize(text, _FONT, _TEXT_SCALE, 1)
        x = max(4, min(at[0], self.canvas.shape[1] - width - 4))
        y = max(height + 4, min(at[1], self.canvas.shape[0] - 6))
        while self._is_taken(x, y, width, height) and y + _LINE_PX < self.canvas.shape[0]:
            y += _LINE_PX
        self._taken.append((x, y - height, x + width, y))
        cv2.putText(self.canvas, text, (x, y), _FONT, _TEXT_SCALE, _BLACK, 3, cv2.LINE_AA)
        cv2.putText(self.canvas, text, (x, y), _FONT, _TEXT_SCALE, colour, 1, cv2.LINE_AA)

    def _is_taken(self, x: int, y: int, width: int, height: int) -> bool:
        return any(
            x < right and left < x + width and y - height < low and top < y for left, top, right, low in self._taken
        )


def _draw_scale(labels: _Labels) -> None:
    """Shares of the picture along its upper and left edge."""
    height, width = labels.canvas.shape[:2]
    for tenth in range(1, 10):
        x, y = width * tenth // 10, height * tenth // 10
        cv2.line(labels.canvas, (x, 0), (x, 8), _WHITE, 1)
        cv2.line(labels.canvas, (0, y), (8, y), _WHITE, 1)
        labels.write(f"{tenth / 10:g}", (x - 10, 24), _WHITE)
        labels.write(f"{tenth / 10:g}", (12, y + 5), _WHITE)


def _draw_shape(labels: _Labels, shape: Shape, scale: float) -> None:
    canvas = labels.canvas
    points = np.array([_px(point, scale) for point in shape.points], np.int32)
    cv2.polylines(canvas, [points], shape.is_zone, _YELLOW, 2, cv2.LINE_AA)
    if not shape.is_zone:
        _draw_arrow(canvas, shape.points, scale)
    top = min(shape.points, key=lambda point: point[1])
    labels.write(shape.name, _px(top, scale), _YELLOW)


def _draw_arrow(canvas: Image, points: Sequence[Point], scale: float) -> None:
    """A short arrow from the line's left side to its right, as seen from its first point to its second."""
    (ax, ay), (bx, by) = points[0], points[1]
    length = float(np.hypot(bx - ax, by - ay)) or 1.0
    middle, along = ((ax + bx) / 2, (ay + by) / 2), ((bx - ax) / length, (by - ay) / length)
    far = 18 / scale
    tip = (middle[0] - along[1] * far, middle[1] + along[0] * far)
    cv2.arrowedLine(canvas, _px(middle, scale), _px(tip, scale), _YELLOW, 2, cv2.LINE_AA, tipLength=0.4)


def _draw_way(canvas: Image, points: Sequence[Point], scale: float, colour: Colour, thick: int) -> None:
    if len(points) > 1:
        way = np.array([_px(point, scale) for point in points], np.int32)
        cv2.polylines(canvas, [way], False, colour, thick, cv2.LINE_AA)


def _draw_dot(canvas: Image, dot: Dot, scale: float, colour: Colour) -> None:
    if dot.box is not None:
        x1, y1, x2, y2 = dot.box
        cv2.rectangle(canvas, _px((x1, y1), scale), _px((x2, y2), scale), colour, 1, cv2.LINE_AA)
    cv2.circle(canvas, _px(dot.at, scale), 5, colour, -1, cv2.LINE_AA)
    cv2.circle(canvas, _px(dot.at, scale), 5, _BLACK, 1, cv2.LINE_AA)


def _draw_mark(labels: _Labels, mark: Mark, scale: float) -> None:
    x, y = _px(mark.at, scale)
    cv2.drawMarker(labels.canvas, (x, y), _RED, cv2.MARKER_TILTED_CROSS, 22, 3, cv2.LINE_AA)
    labels.write(mark.text, (x + 14, y - 8), _WHITE)


def _strip(width: int, drawing: Drawing, colours: dict[str, Colour]) -> Image:
    """What the colours mean, then the captions."""
    lines = [line for caption in drawing.captions for line in _folded(_ascii(caption), width)]
    strip = np.zeros((_LINE_PX * (len(lines) + bool(colours)) + 8, width, 3), np.uint8)
    y = _LINE_PX - 4
    if colours:
        _legend(strip, colours, y)
        y += _LINE_PX
    for line in lines:
        cv2.putText(strip, line, (8, y), _FONT, _TEXT_SCALE, _WHITE, 1, cv2.LINE_AA)
        y += _LINE_PX
    return strip


def _legend(strip: Image, colours: dict[str, Colour], y: int) -> None:
    x = 8
    for label, colour in colours.items():
        cv2.circle(strip, (x + 5, y - 5), 5, colour, -1, cv2.LINE_AA)
        cv2.putText(strip, _ascii(label), (x + 16, y), _FONT, _TEXT_SCALE, _WHITE, 1, cv2.LINE_AA)
        x += 32 + cv2.getTextSize(_ascii(label), _FONT, _TEXT_SCALE, 1)[0][0]


def _folded(text: str, width: int) -> list[str]:
    """The text in lines that fit."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and cv2.getTextSize(longer, _FONT, _TEXT_SCALE, 1)[0][0] > width - 16:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _colours(dots: Sequence[Dot]) -> dict[str, Colour]:
    labels = dict.fromkeys(dot.label for dot in dots)
    return {label: _colour(number) for number, label in enumerate(labels)}


def _colour(number: int) -> Colour:
    red, green, blue = colorsys.hls_to_rgb((0.33 + number * _GOLDEN_ANGLE) % 1.0, 0.58, 0.85)
    return round(blue * 255), round(green * 255), round(red * 255)


def _px(point: Point, scale: float) -> tuple[int, int]:
    limit = 1 << 14
    x, y = (max(-limit, min(limit, round(value * scale))) for value in point)
    return x, y


def _ascii(text: str) -> str:
    """The text with what OpenCV's fonts lack as question marks."""
    return text.encode("ascii", "replace").decode()
