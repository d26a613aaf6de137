"""The geometric horizon of a frame from groups of parallel lines of the ground that somebody marked in it.

Each group's lines meet in a vanishing point, found by least squares of the distances that the marked ends have
from the line through the point and the segment's middle. The horizon is the line through the vanishing points, by
least squares that heed how well each is known.

Source: D. Liebowitz, A. Zisserman, "Metric Rectification for Perspective Images of Planes", 1998, section 4.1 (the
maximum likelihood vanishing point); R. Hartley, A. Zisserman, "Multiple View Geometry", 2004, section 8.6.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.optimize import least_squares

from vian.errors import WrongUsage
from vian.evaluation.files import text_of
from vian.evaluation.lines import Horizon

Floats = npt.NDArray[np.float64]
Coordinate = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Segment = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
SPREAD_MIN = 3.0
"""Lines count as parallel in the picture unless their directions differ by so many standard deviations."""
ROLL_MAX_DEG = 45.0
"""Beyond it a picture's up is nearer to sideways: rather are a group's lines not level than a camera so rolled."""
EXCESS_MAX = 3.0
"""Residuals of more times what marking explains are told: some marks are wrong, or not parallel in the world."""
WITHIN = 0.9
"""So far from its middle to its ends a segment has no vanishing point in it; one that is marked right up to the horizon
may have it at its end, by the noise of marking."""
ROUNDS = 10


class Group(BaseModel):
    """Segments whose lines are parallel in the world, and level."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    name: str = ""
    segments: Annotated[tuple[Segment, ...], Field(max_length=10_000)]
    """`x1 y1 x2 y2` px each"""


class Marks(BaseModel):
    """What was marked in one frame."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    width: Annotated[int, Field(ge=1, le=100_000)]
    """of the frame, px"""
    height: Annotated[int, Field(ge=1, le=100_000)]
    """of the frame, px"""
    groups: Annotated[tuple[Group, ...], Field(max_length=1000)]
    marked_px: Annotated[float, Field(gt=0, le=100)] = 1.0
    """standard deviation of a marked end, px"""


@dataclass(frozen=True, slots=True, eq=False)
class VanishingPoint:
    """Where one group's lines meet."""

    group: str
    xy: Floats
    """`(2,)` px"""
    covariance: Floats
    """`(2, 2)` px²"""
    rms_px: float
    """root mean square distance of the marked ends from their lines, px"""
    excess: float
    """by what factor it exceeds what marking explains, at least 1"""


@dataclass(frozen=True, slots=True, eq=False)
class Marked:
    """The horizon that marks give."""

    horizon: Horizon
    points: tuple[VanishingPoint, ...]
    distances_px: tuple[float, ...]
    """how far each vanishing point lies below the horizon, px"""
    doubts: tuple[str, ...] = ()
    """what of the marks does not fit together, and what to do, for people"""


def read_marks(path: Path) -> Marks:
    """The marks of a file.

    Raises:
        WorldFailed: It cannot be read.
        WrongUsage: It does not hold what it should.
    """
    try:
        return Marks.model_validate(json.loads(text_of(path)))
    except json.JSONDecodeError as error:
        raise WrongUsage(f"{path}: not JSON: {error}. Next: mend that place") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise WrongUsage(
            f"{path}: {where}: {first['msg']}; wanted width, height and groups, each with segments [x1, y1, x2, y2]. "
            "Next: mend that place"
        ) from error


def horizon_of_marks(marks: Marks) -> Marked:
    """The horizon through the vanishing points of all groups.

    Raises:
        WrongUsage: The marks do not fix it: one group, too few segments, lines that are parallel in the picture,
            or vanishing points above each other. Or it cannot be: it is too steep, or lines meet within a segment.
    """
    if len(marks.groups) < 2:
        raise WrongUsage(
            f"groups of parallel lines: {len(marks.groups)}, wanted two or more of different directions, since each "
            "gives one point of the horizon. Next: mark another direction"
        )
    points = tuple(_vanishing_point(group, number, marks.marked_px) for number, group in enumerate(marks.groups, 1))
    horizon, excess = _line_through(points)
    _check_roll(horizon)
    distances = tuple(float(point.xy[1] - horizon.at(point.xy[0])) for point in points)
    return Marked(horizon, points, distances, tuple(_doubts(points, distances, excess)))


def _vanishing_point(group: Group, number: int, marked_px: float) -> VanishingPoint:
    name = group.name or f"group {number}"
    segments = np.array(group.segments, float).reshape(-1, 2, 2)
    if len(segments) < 2:
        raise WrongUsage(
            f"{name}: {len(segments)} segment, wanted two or more. Next: mark more lines of that direction"
        )
    middles, halves = segments.mean(axis=1), (segments[:, 1] - segments[:, 0]) / 2
    lengths = np.hypot(*halves.T)
    if lengths.min() < marked_px:
        raise WrongUsage(
            f"{name}: segment {int(lengths.argmin()) + 1} is {2 * lengths.min():.1f} px long, which has no direction. "
            "Next: mark longer pieces"
        )
    _check_spread(name, halves, lengths, marked_px)

    def off_px(point: Floats) -> Floats:
        """Distances of the ends from the line through the point and the segment's middle."""
        to_point = point - middles
        cross = to_point[:, 0] * halves[:, 1] - to_point[:, 1] * halves[:, 0]
        return np.asarray(cross / np.maximum(np.hypot(*to_point.T), 1e-9))

    meeting = _meeting(middles, halves / lengths[:, None])
    _check_beyond(name, meeting, middles, halves)
    fit = least_squares(off_px, meeting, x_scale="jac", xtol=1e-14, ftol=1e-14)
    # Each segment has two ends, whose distances are the same: half their variance is left in one.
    variance = marked_px**2 / 2
    excess = _excess((fit.fun**2 / variance).sum(), len(segments))
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * variance * excess**2
    return VanishingPoint(name, fit.x, covariance, float(np.sqrt(np.mean(fit.fun**2))), excess)


def _check_spread(name: str, halves: Floats, lengths: Floats, marked_px: float) -> None:
    angles = np.arctan2(halves[:, 1], halves[:, 0])
    off = np.angle(np.exp(2j * (angles - angles[lengths.argmax()]))) / 2
    sd = marked_px / (np.sqrt(2) * lengths)
    spread, i, j = max((abs(off[i] - off[j]) / np.hypot(sd[i], sd[j]), i, j) for i in range(len(off)) for j in range(i))
    if spread < SPREAD_MIN:
        raise WrongUsage(
            f"{name}: its lines are parallel in the picture too "
            f"(within {np.degrees(abs(off[i] - off[j])):.2f} degrees, "
            "which the marks cannot tell from none), so they meet nowhere. "
            "Next: mark lines farther apart, or another direction"
        )


def _check_beyond(name: str, meeting: Floats, middles: Floats, halves: Floats) -> None:
    """A line in front of the camera goes towards its vanishing point and never through it."""
    reached = np.abs(((meeting - middles) * halves).sum(axis=1)) / (halves**2).sum(axis=1)
    if reached.min() < WITHIN:
        x, y = meeting
        raise WrongUsage(
            f"{name}: its lines meet at ({x:.0f}, {y:.0f}), within segment {int(reached.argmin()) + 1}, wanted beyond "
            "the ends of all: lines that are parallel in the world meet on the horizon, and none crosses it. "
            "Next: look whether they are parallel in the world"
        )


def _meeting(middles: Floats, along: Floats) -> Floats:
    """The point of least squared distance from all lines, `(2,)` px."""
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.asarray(np.linalg.lstsq(normals, (normals * middles).sum(axis=1), rcond=None)[0])


def _line_through(points: tuple[VanishingPoint, ...]) -> tuple[Horizon, float]:
    """The line, and by what factor the points' distances from it exceed what they explain themselves, at least 1."""
    xy = np.array([point.xy for point in points])
    spread = np.ptp(xy[:, 0])
    if spread < 1e-3 * max(1.0, float(np.abs(xy).max())):
        raise WrongUsage(
            f"the vanishing points lie within {spread:.1f} px of each other across the picture, so no line is fixed by "
            "them. Next: mark groups of other directions"
        )
    basis = np.stack([xy[:, 0], np.ones(len(xy))], axis=1)
    slope = 0.0
    for _ in range(ROUNDS):
        across = np.array([-slope, 1.0])
        weights = 1 / np.array([across @ point.covariance @ across for point in points])
        normal = basis.T @ (weights[:, None] * basis)
        slope, offset = np.linalg.solve(normal, basis.T @ (weights * xy[:, 1]))
    excess = _excess((weights * (xy[:, 1] - basis @ [slope, offset]) ** 2).sum(), len(points))
    return Horizon(float(slope), float(offset), np.linalg.inv(normal) * excess**2), excess


def _excess(chi2: float, count: int) -> float:
    """By what factor residuals behind two fitted parameters exceed the stated deviations, at least 1."""
    return float(np.sqrt(max(1.0, chi2 / (count - 2)))) if count > 2 else 1.0


def _check_roll(horizon: Horizon) -> None:
    degrees = np.degrees(np.arctan(horizon.slope))
    if abs(degrees) > ROLL_MAX_DEG:
        raise WrongUsage(
            f"the marks give a horizon that is {abs(degrees):.0f} degrees steep, wanted at most {ROLL_MAX_DEG:.0f}: "
            "the lines of a group are upright or on a slope, or not parallel in the world. "
            "Next: mark level lines alone, or turn the picture upright"
        )


def _doubts(points: tuple[VanishingPoint, ...], distances_px: tuple[float, ...], excess: float) -> Iterator[str]:
    for point in points:
        if point.excess > EXCESS_MAX:
            yield (
                f"{point.group}: its lines do not meet in one point: they are off by {point.excess:.0f} times what "
                "marking explains. Next: look whether all of them are parallel in the world"
            )
    if excess > EXCESS_MAX:
        farthest = max(range(len(points)), key=lambda at: abs(distances_px[at]))
        yield (
            f"the groups give no one horizon: their vanishing points are off it by {excess:.0f} times what marking "
            f"explains, that of {points[farthest].group} by {abs(distances_px[farthest]):.0f} px. "
            "Next: look whether the lines of each are level"
        )
