"""People on a ground plane before a known camera: exact truth, and boxes as noisy as asked for.

Pure geometry, from a seed. A person is upright, walks at a speed of their own along straight lines between points of
the part of the ground that the camera sees, and has a box whose ends are the images of foot and head.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from extractors.calibration import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Walks:
    """What was seen, by frame, then by track; and where people truly were.

    Attributes:
        time_us: µs, `(n,)`.
        track_id: From 1, `(n,)`.
        boxes_xyxy: px, `(n, 4)`.
        confidence: 1 throughout, `(n,)`.
        feet_enu: Where the foot is, m, `(n, 2)`.
        speed_mps: How fast it goes, `(n,)`.
    """

    time_us: NDArray[np.int64]
    track_id: NDArray[np.int64]
    boxes_xyxy: Floats
    confidence: Floats
    feet_enu: Floats
    speed_mps: Floats


def walks(
    camera: Camera,
    *,
    people: int = 20,
    seconds: float = 25.0,
    fps: float = 5.0,
    noise_share: float = 0.0,
    height_spread_m: float = 0.09,
    speed_spread: float = 0.2,
    depth: float = 0.0,
    seed: int = 1,
) -> Walks:
    """People who cross the ground that the camera sees.

    Args:
        camera: The camera.
        people: How many.
        seconds: How long each is followed.
        fps: Frames per second.
        noise_share: Standard deviation of each edge of a box, of the box's height.
        height_spread_m: Standard deviation of people's heights around 1.70 m.
        speed_spread: Standard deviation of the logarithm of people's speeds around 1.3 m/s.
        depth: How far the top of a box is behind its foot on the ground, of the height; 0: people are lines.
        seed: Of everything that is drawn.
    """
    random = np.random.default_rng(seed)
    frames = np.arange(round(seconds * fps))
    parts = []
    tall, fast = random.permutation(people), random.permutation(people)
    for person in range(people):
        # Standardised draws: the sample's own mean and spread are those asked for, so that truth is exact.
        height = 1.70 + height_spread_m * _spread(tall[person], people)
        speed = 1.3 * np.exp(speed_spread * _spread(fast[person], people))
        feet = _path(camera, random, speed * frames / fps)
        times = np.rint((frames / fps + 2.0 * person) * 1e6)
        parts.append(
            np.column_stack([times, np.full(len(frames), person + 1), feet, np.full((len(frames), 2), (height, speed))])
        )
    table = np.concatenate(parts)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    boxes = boxes_of(camera, table[:, 2:4], table[:, 4], depth)
    boxes = boxes + noise_share * (boxes[:, 3] - boxes[:, 1])[:, None] * random.normal(size=boxes.shape)
    seen = np.isfinite(boxes).all(axis=1)
    seen &= (boxes[:, 0] > 0) & (boxes[:, 1] > 0) & (boxes[:, 2] < camera.width) & (boxes[:, 3] < camera.height)
    table, boxes = table[seen], boxes[seen]
    return Walks(
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        boxes,
        np.ones(len(table)),
        table[:, 2:4],
        table[:, 5],
    )


def boxes_of(camera: Camera, feet_enu: Floats, heights_m: Floats, depth: float = 0.0) -> Floats:
    """Boxes of upright people who stand there, `(n, 4)`; their width is 0.4 of their height."""
    ground = np.column_stack([feet_enu, np.zeros(len(feet_enu))])
    foot = camera.project(ground)
    away = ground / np.hypot(*feet_enu.T)[:, None] * depth + np.array([0.0, 0.0, 1.0])
    head = camera.project(ground + away * heights_m[:, None])
    middle, half = (foot[:, 0] + head[:, 0]) / 2, 0.2 * (foot[:, 1] - head[:, 1])
    return np.column_stack([middle - half, head[:, 1], middle + half, foot[:, 1]])


def floor(camera: Camera) -> Floats:
    """Pixels of the ground, `(n, 2)`, on a grid over the part of the picture where people can be seen whole."""
    columns, rows = np.meshgrid(np.linspace(0.1, 0.9, 9) * camera.width, np.linspace(0.0, 0.95, 20) * camera.height)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    ground = camera.ground(pixels)
    near = np.isfinite(ground).all(axis=1) & (np.hypot(*ground.T) < 12 * camera.height_m)
    head = boxes_of(camera, np.where(near[:, None], ground, 1.0), np.full(len(ground), 1.9))
    return np.asarray(pixels[near & (head[:, 1] > 0)])


def homography_error(camera: Camera, found: Camera) -> float:
    """Largest error of a position on the floor, of its distance from the camera."""
    pixels = floor(camera)
    truth, mapped = camera.ground(pixels), found.ground(pixels)
    return float(np.max(np.hypot(*(mapped - truth).T) / np.hypot(np.hypot(*truth.T), camera.height_m)))


def _spread(at: int, count: int) -> float:
    """The at-th of so many numbers with mean 0 and standard deviation 1, evenly apart."""
    return float((at - (count - 1) / 2) / np.sqrt((count * count - 1) / 12)) if count > 1 else 0.0


def _path(camera: Camera, random: np.random.Generator, way_m: Floats) -> Floats:
    """Positions `(n, 2)` after such ways along straight lines between random points of the floor."""
    ground = camera.ground(floor(camera))
    corners = ground[random.choice(len(ground), 60)]
    steps = np.hypot(*np.diff(corners, axis=0).T)
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    return np.column_stack([np.interp(way_m, reached, corners[:, axis]) for axis in (0, 1)])
