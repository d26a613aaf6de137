"""A scene that never was: a camera over level ground, and who moves there; truth is exact.

Contract: everything follows from the scene. People and vehicles are made of boxes in space (`solids`), and what is
true of a picture is their exact projection: nothing is rounded to pixels. Ground: metres, ENU, with the point below
the camera as origin and north along its view (`extractors.calibration.Camera`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from extractors.calibration import Camera
from extractors.scene.solids import Floats, Solid, person, placed, vehicle


@dataclass(frozen=True, slots=True)
class Actor:
    """One object and its way through the scene."""

    object_id: int
    kind: str
    """`person` or `vehicle`"""
    waypoints: tuple[tuple[float, float, float], ...]
    """time (s), metres east and north; straight and at one speed in between, there at no other time"""
    colour_bgr: tuple[int, int, int]
    height_m: float = 1.70

    def at(self, time_s: float) -> tuple[float, float]:
        """Where it is, m east and north."""
        times, east, north = zip(*self.waypoints, strict=True)
        return float(np.interp(time_s, times, east)), float(np.interp(time_s, times, north))

    def is_there(self, time_s: float) -> bool:
        """Whether it has come, and has not gone."""
        return self.waypoints[0][0] <= time_s <= self.waypoints[-1][0]

    def solids(self, time_s: float) -> tuple[Solid, ...]:
        """What it is made of there and then, in metres of the scene."""
        walked_m, heading = self._way(time_s)
        parts = vehicle(self.height_m) if self.kind == "vehicle" else person(self.height_m, walked_m)
        return placed(parts, self.at(time_s), heading)

    def _way(self, time_s: float) -> tuple[float, float]:
        """Metres from its first waypoint, and where it looks, rad from east; who stands looks where they went."""
        points = np.array(self.waypoints)
        legs = np.diff(points[:, 1:], axis=0)
        lengths = np.hypot(*legs.T)
        walked = float(np.interp(time_s, points[:, 0], np.concatenate([[0.0], np.cumsum(lengths)])))
        leg = int(np.clip(np.searchsorted(points[:, 0], time_s, "right") - 1, 0, len(legs) - 1))
        went = legs[max((at for at in range(leg + 1) if lengths[at] > 0), default=leg)]
        return walked, float(np.arctan2(went[1], went[0]))


@dataclass(frozen=True, slots=True)
class Scene:
    """What is rendered."""

    camera: Camera
    actors: tuple[Actor, ...]
    fps: int = 10
    seconds: int = 30
    seed: int = 1
    noise_levels: float = 3.0
    """standard deviation of the camera's noise, grey levels"""
    blur_px: float = 0.0
    """standard deviation of the lens's blur, px"""

    @property
    def width(self) -> int:
        """Width of the pictures, px."""
        return self.camera.width

    @property
    def height(self) -> int:
        """Height of the pictures, px."""
        return self.camera.height

    @property
    def frames(self) -> int:
        """Number of pictures."""
        return self.fps * self.seconds


@dataclass(frozen=True, slots=True)
class TruthBox:
    """Where one object is in one picture, clipped to it."""

    frame: int
    object_id: int
    kind: str
    x1: float
    y1: float
    x2: float
    y2: float
    is_whole: bool
    """whether the picture's edge cuts nothing off"""
    east_m: float
    north_m: float


def truth(scene: Scene) -> list[TruthBox]:
    """The boxes of all objects in view, by picture, then by object."""
    boxes = (_truth_box(scene, actor, frame) for frame in range(scene.frames) for actor in scene.actors)
    return [box for box in boxes if box is not None]


def box_of(camera: Camera, solids: Sequence[Solid]) -> Floats | None:
    """The box `x1 y1 x2 y2` around their projections, px, not clipped; None where a part is behind the camera."""
    pixels = camera.project(np.concatenate([solid.corners_enu for solid in solids]))
    if not np.isfinite(pixels).all():
        return None
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def is_in_view(camera: Camera, box: npt.NDArray[np.float64]) -> bool:
    """Whether at least one pixel of the box lies in the picture."""
    x1, y1, x2, y2 = clipped(camera, box)
    return bool(x2 - x1 >= 1 and y2 - y1 >= 1)


def clipped(camera: Camera, box: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The part of the box within the picture."""
    return np.clip(box, 0.0, [camera.width, camera.height, camera.width, camera.height])


def _truth_box(scene: Scene, actor: Actor, frame: int) -> TruthBox | None:
    time_s = frame / scene.fps
    if not actor.is_there(time_s):
        return None
    box = box_of(scene.camera, actor.solids(time_s))
    if box is None or not is_in_view(scene.camera, box):
        return None
    seen = clipped(scene.camera, box)
    x1, y1, x2, y2 = (float(value) for value in seen)
    return TruthBox(frame, actor.object_id, actor.kind, x1, y1, x2, y2, bool((seen == box).all()), *actor.at(time_s))
