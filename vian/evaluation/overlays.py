"""Tracks with the true and the estimated horizon, over a frame or over nothing, as a small picture.

The canvas reaches beyond the frame where a horizon does. Coordinates are pixels of the frame.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vian.errors import WorldFailed, WrongUsage
from vian.evaluation.boxes import Boxes
from vian.evaluation.lines import Horizon

Image = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]
"""Blue, green, red."""
WIDTH_PX = 400
"""Width of the picture: small enough to lie in a gallery."""
BEYOND_MAX = 1.5
"""How far the canvas reaches beyond the frame at most, frame heights."""
JPEG_QUALITY = 80
_FONT, _TEXT_SCALE, _LINE_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.4, 15
_BLANK, _BEYOND, _WHITE = (70, 70, 70), (35, 35, 35), (255, 255, 255)
TRUE: Colour = (90, 220, 90)
ESTIMATED: tuple[Colour, ...] = ((60, 110, 255), (255, 160, 80), (80, 230, 240), (220, 120, 220))
_GOLDEN_ANGLE = 0.381966


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """What is drawn."""

    width: int
    height: int
    boxes: Boxes
    truth: Horizon | None
    estimates: Sequence[tuple[str, Horizon | None]]
    """by name; a covariance is drawn as the band of its 95 % interval"""
    picture: Image | None = None
    caption: str = ""


def drawn(overlay: Overlay) -> Image:
    """The picture, with a legend below."""
    scale = WIDTH_PX / overlay.width
    top, bottom = _reach(overlay)
    canvas = np.full((max(1, round((bottom - top) * scale)), WIDTH_PX, 3), _BEYOND, np.uint8)
    _lay(canvas, overlay, top, scale)
    for track in overlay.boxes.by_track():
        _draw_way(canvas, track, top, scale)
    for number, (_, line) in enumerate(overlay.estimates):
        if line is not None:
            _draw_band(canvas, line, overlay.width, top, scale, _colour_of(number))
            _draw_line(canvas, line, overlay.width, top, scale, _colour_of(number))
    if overlay.truth is not None:
        _draw_line(canvas, overlay.truth, overlay.width, top, scale, TRUE)
    return np.vstack([canvas, _legend(overlay)])


def write_image(image: Image, file: Path) -> None:
    """Write the picture as PNG or JPEG, as the name says.

    Raises:
        WrongUsage: The name says neither.
        WorldFailed: It cannot be written.
    """
    if file.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise WrongUsage(f"{file}: wanted a name that ends with .png or .jpg")
    suffix = file.suffix.lower()
    smallest = [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    quality = smallest if suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    is_encoded, data = cv2.imencode(suffix, image, quality)
    assert is_encoded, "OpenCV encodes any 8-bit image as PNG or JPEG"
    try:
        file.write_bytes(data.tobytes())
    except OSError as error:
        raise WorldFailed(f"{file}: cannot be written: {error.strerror}. Next: give another place") from error


def _reach(overlay: Overlay) -> tuple[float, float]:
    """Upper and lower end of the canvas, px of the frame."""
    lines = [line for line in (overlay.truth, *(line for _, line in overlay.estimates)) if line is not None]
    ends = [0.0, float(overlay.height)]
    ends += [float(y) for line in lines for y in line.at(np.array([0.0, overlay.width - 1.0]))]
    margin, beyond = 0.04 * overlay.height, BEYOND_MAX * overlay.height
    top, bottom = min(ends), max(ends)
    return (
        max(-beyond, top - margin) if top < 0 else 0.0,
        min(overlay.height + beyond, bottom + margin) if bottom > overlay.height else float(overlay.height),
    )


def _lay(canvas: Image, overlay: Overlay, top: float, scale: float) -> None:
    """Put the frame, or a blank one, in its place."""
    size = (WIDTH_PX, round(overlay.height * scale))
    first = round(-top * scale)
    room = canvas[first : first + size[1]]
    if overlay.picture is None:
        room[:] = _BLANK
    else:
        room[:] = cv2.resize(overlay.picture, size, interpolation=cv2.INTER_AREA)[: len(room)]


def _draw_way(canvas: Image, track: Boxes, top: float, scale: float) -> None:
    way = _px(track.feet_xy, top, scale)
    hue = (int(track.track_id[0]) * _GOLDEN_ANGLE) % 1.0
    red, green, blue = (round(255 * each) for each in colorsys.hls_to_rgb(hue, 0.65, 0.75))
    # Without shades the many ways compress to a third.
    cv2.polylines(canvas, [way], False, (blue, green, red), 1, cv2.LINE_8)


def _draw_line(canvas: Image, line: Horizon, width: int, top: float, scale: float, colour: Colour) -> None:
    x = np.array([0.0, width - 1.0])
    ends = _px(np.stack([x, line.at(x)], axis=1), top, scale)
    cv2.line(canvas, tuple(map(int, ends[0])), tuple(map(int, ends[1])), colour, 2, cv2.LINE_AA)


def _draw_band(canvas: Image, line: Horizon, width: int, top: float, scale: float, colour: Colour) -> None:
    if line.covariance is None:
        return
    x = np.linspace(0, width - 1, 33)
    y, reach = line.at(x), line.reach_at(x)
    outline = np.concatenate([np.stack([x, y - reach], 1), np.stack([x, y + reach], 1)[::-1]])
    tinted = canvas.copy()
    cv2.fillPoly(tinted, [_px(outline, top, scale)], colour, cv2.LINE_AA)
    canvas[:] = cv2.addWeighted(tinted, 0.25, canvas, 0.75, 0)


def _legend(overlay: Overlay) -> Image:
    said: list[tuple[str, Colour]] = []
    if overlay.truth is not None:
        said.append(("true horizon", TRUE))
    for number, (name, line) in enumerate(overlay.estimates):
        said.append((name if line is not None else f"{name}: abstains", _colour_of(number)))
    if overlay.caption:
        said.append((overlay.caption, _WHITE))
    strip = np.zeros((_LINE_PX * len(said) + 6, WIDTH_PX, 3), np.uint8)
    for row, (text, colour) in enumerate(said, 1):
        plain = text.encode("ascii", "replace").decode()
        cv2.putText(strip, plain, (6, row * _LINE_PX), _FONT, _TEXT_SCALE, colour, 1, cv2.LINE_AA)
    return strip


def _colour_of(number: int) -> Colour:
    return ESTIMATED[number % len(ESTIMATED)]


def _px(points: npt.NDArray[np.float64], top: float, scale: float) -> npt.NDArray[np.int32]:
    shifted = (points - np.array([0.0, top])) * scale
    return np.asarray(np.clip(np.round(shifted), -(2**14), 2**14), np.int32)
