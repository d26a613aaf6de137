"""Scenes with a known horizon: ground tracks through random cameras, as noisy boxes with false tracks among them.

Tracks are random walks, or the published ground tracks of ETH and UCY under VIAN_DATA. Cameras, sizes, noise and
false tracks are drawn from the generator that is passed in.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from extractors.horizon.camera import FrameSize, Line, horizon_of, up
from extractors.horizon.points import TrackPoints

Floats = npt.NDArray[np.float64]

FPS = 5.0
SIZES = (FrameSize(640, 480), FrameSize(768, 576), FrameSize(1280, 720), FrameSize(1920, 1080))


@dataclass(frozen=True, slots=True)
class Camera:
    tilt: float
    roll: float
    focal: float
    height_m: float
    size: FrameSize

    @property
    def horizon(self) -> Line:
        return horizon_of(self.tilt, self.roll, self.focal, self.size)


@dataclass(frozen=True, slots=True)
class Walk:
    """A way on the ground, `(n, 2)`, m, one point every 1 / FPS s from `first_frame` on."""

    first_frame: int
    xy_m: Floats


@dataclass(frozen=True, slots=True)
class Scene:
    points: TrackPoints
    camera: Camera


def random_camera(random: np.random.Generator, *, roll_deg: float = 4.0) -> Camera:
    size = SIZES[random.integers(len(SIZES))]
    return Camera(
        tilt=np.radians(random.uniform(10, 38)),
        roll=np.radians(np.clip(random.normal(0, roll_deg), -20, 20)),
        focal=size.width * random.uniform(0.75, 1.6),
        height_m=random.uniform(2.8, 12),
        size=size,
    )


def random_walks(random: np.random.Generator, count: int = 22, extent_m: float = 14.0) -> list[Walk]:
    """People who cross a square from edge to edge, turning a little and changing pace."""
    walks = []
    for _ in range(count):
        steps = int(random.integers(20, 120))
        heading = random.uniform(0, 2 * np.pi) + np.cumsum(random.normal(0, 0.06, steps))
        pace = np.clip(random.normal(1.3, 0.25) + np.cumsum(random.normal(0, 0.03, steps)), 0, 2) / FPS
        way = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1) * pace[:, None], axis=0)
        walks.append(
            Walk(int(random.integers(0, 500)), way - way.mean(axis=0) + random.uniform(-extent_m, extent_m, 2) / 2)
        )
    return walks


def published_walks(file: Path, random: np.random.Generator, *, annotated_fps: float, count: int = 22) -> list[Walk]:
    """Some of the tracks of an `obsmat.txt` (frame, person, x, z, y, ... in m), about their middle."""
    table = np.loadtxt(file)
    frames, people, ways = table[:, 0] / annotated_fps * FPS, table[:, 1], table[:, [2, 4]]
    numbers = [number for number in np.unique(people) if (people == number).sum() >= 4]
    walks = []
    for number in random.choice(numbers, min(count, len(numbers)), replace=False):
        own = people == number
        at = np.arange(np.ceil(frames[own][0]), frames[own][-1] + 1e-6)
        way = np.stack([np.interp(at, frames[own], column) for column in ways[own].T], axis=1)
        walks.append(Walk(int(at[0]), way))
    middle = np.median(np.concatenate([walk.xy_m for walk in walks]), axis=0)
    return [Walk(walk.first_frame, walk.xy_m - middle) for walk in walks]


def scene(
    walks: Sequence[Walk],
    camera: Camera,
    random: np.random.Generator,
    *,
    noise: float = 0.018,
    noise_px: float = 0.5,
    size_spread_m: float = 0.09,
    false_tracks: int = 2,
    is_clipped: bool = False,
) -> Scene:
    """The walks seen from the camera, which looks at their middle from a random side.

    Args:
        walks: Ways on the ground.
        camera: Who looks.
        random: Of everything that is drawn.
        noise: Standard deviation of each edge of a box, of the box's height ...
        noise_px: ... and besides, px.
        size_spread_m: Standard deviation of people's heights, m.
        false_tracks: Boxes of one size that move on straight lines, as many.
        is_clipped: Whether boxes end at the frame's edge.
    """
    turn = random.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    away_m = camera.height_m / np.tan(camera.tilt)
    tracks = []
    for walk in walks:
        boxes = boxes_of(walk.xy_m @ rotation.T + [0, away_m], max(1.2, random.normal(1.72, size_spread_m)), camera)
        heights = boxes[:, 3:] - boxes[:, 1:2]
        boxes = boxes + random.normal(0, 1, boxes.shape) * (noise * heights + noise_px)
        tracks.append((walk.first_frame + np.arange(len(boxes)), boxes))
    tracks += [_false_track(camera.size, random) for _ in range(false_tracks)]
    return Scene(_points([_visible(*track, camera.size, is_clipped) for track in tracks]), camera)


def boxes_of(feet_m: Floats, size_m: float, camera: Camera) -> Floats:
    """Boxes of upright objects, `x1 y1 x2 y2` px, `(n, 4)`; the ground is right and ahead of the camera, `(n, 2)`."""
    n = up(camera.tilt, camera.roll)
    ahead = np.array([0.0, 0.0, 1.0]) - n[2] * n
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, n)
    feet = feet_m[:, :1] * right + feet_m[:, 1:] * ahead - camera.height_m * n
    (head_x, head_y), (x, y) = _projected(feet + size_m * n, camera).T, _projected(feet, camera).T
    middle, half = (x + head_x) / 2, 0.18 * (y - head_y)
    return np.stack([middle - half, head_y, middle + half, y], axis=1)


def _projected(points_m: Floats, camera: Camera) -> Floats:
    depth = np.where(points_m[:, 2:] > 0.1, points_m[:, 2:], np.nan)
    return camera.focal * points_m[:, :2] / depth + np.array([camera.size.width, camera.size.height]) / 2


def _false_track(size: FrameSize, random: np.random.Generator) -> tuple[npt.NDArray[np.int64], Floats]:
    steps = int(random.integers(10, 40))
    box = size.height * random.uniform(0.04, 0.12, 2)
    corners = random.uniform(0, [size.width, size.height], (2, 2))
    at = corners[0] + np.linspace(0, 0.3, steps)[:, None] * (corners[1] - corners[0])
    return random.integers(0, 500) + np.arange(steps), np.hstack([at - box, at])


def _visible(
    frames: npt.NDArray[np.int64], boxes: Floats, size: FrameSize, is_clipped: bool
) -> tuple[npt.NDArray[np.int64], Floats]:
    x, y = boxes[:, [0, 2]].mean(axis=1), boxes[:, 3]
    is_seen = (x > 0) & (x < size.width) & (y > 0) & (y < size.height) & np.isfinite(boxes).all(axis=1)
    if is_clipped:
        boxes = np.clip(boxes, 0, [size.width, size.height, size.width, size.height])
    return frames[is_seen], boxes[is_seen]


def _points(tracks: Sequence[tuple[npt.NDArray[np.int64], Floats]]) -> TrackPoints:
    frames = np.concatenate([frames for frames, _ in tracks])
    boxes = np.concatenate([boxes for _, boxes in tracks])
    numbers = np.repeat(np.arange(1, len(tracks) + 1), [len(frames) for frames, _ in tracks])
    order = np.lexsort([numbers, frames])
    return TrackPoints(
        time_us=(frames[order] / FPS * 1e6).astype(np.int64),
        track_id=numbers[order],
        frame=frames[order],
        boxes_xyxy=boxes[order],
        confidence=np.ones(len(order)),
    )
