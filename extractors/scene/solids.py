"""People and vehicles as boxes in space.

Metres. A body's own axes: x along its way, y to its left, z up from the ground it stands on.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

STRIDE_HEIGHTS = 0.85
"""Way of two steps, body heights: 1.4 m for an adult."""
SWING_HEIGHTS = 0.2
"""How far a foot is before or behind the hip at most, body heights: a step is 0.4 of the height."""
FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
"""Corners of the faces of a solid: below, above, and the four sides, each around its face."""
SHADES = (0.5, 1.15, 1.0, 0.8, 1.0, 0.8)
"""How bright the faces are: light falls from above, and from before and behind less than from the sides."""


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A box, upright or leaning."""

    corners_enu: Floats
    """m, `(8, 3)`: the four of the lower face counter-clockwise as seen from above, then those above them"""
    tone: float = 1.0
    """how bright it is beside the object's other parts"""


def person(height_m: float, walked_m: float) -> tuple[Solid, ...]:
    """Head, trunk and two legs that walk, as wide and deep as those of people.

    Feet are on the ground, the top of the head is `height_m` above it.

    Args:
        height_m: m.
        walked_m: Way so far, which says where in a stride the legs are.
    """
    h = height_m
    swing = SWING_HEIGHTS * h * np.sin(2 * np.pi * walked_m / (STRIDE_HEIGHTS * h))
    left, right = (
        _box((0.12 * h, 0.08 * h), (0.0, 0.49 * h), (0.0, side * 0.05 * h), foot_x=side * swing, tone=0.7)
        for side in (1, -1)
    )
    trunk = _box((0.14 * h, 0.26 * h), (0.46 * h, 0.86 * h))
    head = _box((0.10 * h, 0.09 * h), (0.85 * h, h), tone=1.25)
    return left, right, trunk, head


def vehicle(height_m: float) -> tuple[Solid, ...]:
    """Body and cabin, three times as long as high."""
    h = height_m
    body = _box((2.9 * h, 1.2 * h), (0.0, 0.62 * h))
    cabin = _box((1.5 * h, 1.1 * h), (0.6 * h, h), (-0.2 * h, 0.0), tone=0.75)
    return body, cabin


def placed(parts: Iterable[Solid], at_en: tuple[float, float], heading: float) -> tuple[Solid, ...]:
    """The parts where the body stands, turned to where it looks (rad from east, counter-clockwise)."""
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([*at_en, 0.0])
    return tuple(Solid(part.corners_enu @ turn.T + shift, part.tone) for part in parts)


def _box(
    size: tuple[float, float],
    z: tuple[float, float],
    middle: tuple[float, float] = (0.0, 0.0),
    *,
    foot_x: float = 0.0,
    tone: float = 1.0,
) -> Solid:
    """A box of so much along and across, between two heights; its lower face is `foot_x` further along."""
    half = np.array(size) / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half + np.array(middle)
    lower = np.column_stack([corners + np.array([foot_x, 0.0]), np.full(4, z[0])])
    upper = np.column_stack([corners, np.full(4, z[1])])
    return Solid(np.concatenate([lower, upper]), tone)
