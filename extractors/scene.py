"""A street that never was: a video with exact truth, rendered from a seed.

Contract: the same scene gives the same pictures, and the same file on the same version of the encoder.
People and vehicles move on a textured street that gets smaller with distance; one person loiters in
`LOITER_ZONE`, one crosses `CROSSING_LINE`. The truth names, for every picture, each object's box as it
was drawn. The picture is plain on purpose: it stands in for footage where none is at hand, and checks
the geometry of what was measured.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image

HORIZON_Y = 0.1
"""The horizon, of the picture's height; an object's size grows in proportion to its distance below it."""
PERSON_SHARE = 0.42
"""A person's height, of the distance between foot and horizon."""
NOISE_LEVELS = 3.0
"""Standard deviation of the camera's noise, grey levels."""

NOISE_PICTURES = 8
"""So many pictures of noise are drawn, and shifted at random from frame to frame: drawing is slow."""

LOITER_ZONE = ((0.16, 0.62), (0.44, 0.62), (0.44, 0.86), (0.16, 0.86))
"""Corners of the zone in which one person loiters, normalised image coordinates."""
CROSSING_LINE = ((0.50, 0.72), (0.90, 0.72))
"""The line that one person crosses upwards, normalised image coordinates."""


@dataclass(frozen=True, slots=True)
class Actor:
    """One object and its way through the scene."""

    object_id: int
    kind: str
    """`person` or `vehicle`"""
    waypoints: tuple[tuple[float, float, float], ...]
    """time (s), and ground contact point in normalised image coordinates; straight in between"""
    colour_bgr: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Scene:
    """What is rendered."""

    actors: tuple[Actor, ...]
    width: int = 640
    height: int = 360
    fps: int = 10
    seconds: int = 30
    seed: int = 1

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


def street(seed: int = 1) -> Scene:
    """The scene that demo and tests use: two walkers, a loiterer, a line crosser, two vehicles."""
    return Scene(
        actors=(
            Actor(1, "person", ((2.0, -0.05, 0.56), (16.0, 1.05, 0.52)), (60, 50, 150)),
            Actor(
                2, "person",
                ((3.0, -0.05, 0.80), (7.0, 0.30, 0.76), (21.0, 0.30, 0.76), (26.0, -0.06, 0.82)),
                (110, 60, 30),
            ),
            Actor(3, "person", ((8.0, 0.78, 1.25), (16.0, 0.66, 0.62), (24.0, 1.06, 0.58)), (35, 90, 40)),
            Actor(4, "vehicle", ((2.5, 1.25, 0.98), (6.5, -0.25, 0.98)), (170, 170, 175)),
            Actor(5, "vehicle", ((24.0, 1.25, 0.98), (28.5, -0.25, 0.98)), (50, 60, 190)),
            Actor(6, "person", ((17.0, 1.05, 0.44), (29.0, 0.35, 0.44)), (30, 30, 30)),
        ),
        seed=seed,
    )  # fmt: skip


def truth(scene: Scene) -> list[TruthBox]:
    """The boxes of all objects in view, by picture, then by object."""
    boxes = (_truth_box(scene, actor, frame) for frame in range(scene.frames) for actor in scene.actors)
    return [box for box in boxes if box is not None]


def render(scene: Scene) -> Iterator[Image]:
    """The pictures, one after another."""
    random = np.random.default_rng(scene.seed)
    background = _background(scene, random)
    textures = {actor.object_id: _texture(random) for actor in scene.actors}
    sizes = (NOISE_PICTURES, scene.height, scene.width, 3)
    noises = np.rint(random.normal(0, NOISE_LEVELS, sizes)).astype(np.int16)
    for frame in range(scene.frames):
        picture = background.copy()
        for actor in sorted(scene.actors, key=lambda a: _foot_y(scene, a, frame)):
            box = _box(scene, actor, frame)
            if box is not None:
                _draw(picture, actor, box, textures[actor.object_id], frame / scene.fps)
        shift = tuple(random.integers(0, 997, 2))
        noise = np.roll(noises[frame % len(noises)], shift, axis=(0, 1))
        yield np.clip(picture + noise, 0, 255).astype(np.uint8)


def write(scene: Scene, path: Path) -> None:
    """Write the scene as a video file (MPEG-4)."""
    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("mpeg4", rate=Fraction(scene.fps))
        stream.width, stream.height, stream.pix_fmt = scene.width, scene.height, "yuv420p"
        stream.codec_context.bit_rate = 4_000_000
        stream.codec_context.thread_count = 1  # more threads would not cut the same slices everywhere
        for picture in render(scene):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))


def _foot_y(scene: Scene, actor: Actor, frame: int) -> float:
    times, _, ys = zip(*actor.waypoints, strict=True)
    return float(np.interp(frame / scene.fps, times, ys))


def _box(scene: Scene, actor: Actor, frame: int) -> tuple[float, float, float, float] | None:
    """The whole box, px, or None outside the actor's time."""
    times, xs, ys = zip(*actor.waypoints, strict=True)
    time = frame / scene.fps
    if not times[0] <= time <= times[-1]:
        return None
    x, y = (float(np.interp(time, times, values)) for values in (xs, ys))
    height = PERSON_SHARE * (y - HORIZON_Y) * scene.height
    width = height * 0.4
    if actor.kind == "vehicle":
        height, width = height * 0.8, height * 2.0
    foot_x, foot_y = x * scene.width, y * scene.height
    return foot_x - width / 2, foot_y - height, foot_x + width / 2, foot_y


def _truth_box(scene: Scene, actor: Actor, frame: int) -> TruthBox | None:
    box = _box(scene, actor, frame)
    if box is None:
        return None
    x1, x2 = (min(max(x, 0.0), float(scene.width)) for x in box[::2])
    y1, y2 = (min(max(y, 0.0), float(scene.height)) for y in box[1::2])
    if x2 - x1 < 1 or y2 - y1 < 1:
        return None
    return TruthBox(frame, actor.object_id, actor.kind, x1, y1, x2, y2, (x1, y1, x2, y2) == box)


def _background(scene: Scene, random: np.random.Generator) -> Image:
    """Sky and houses, pavement and road, each with a grain of its own."""
    grain = cv2.GaussianBlur(random.normal(0, 1, (scene.height, scene.width)).astype(np.float32), (0, 0), 1.5)
    rows = np.linspace(0, 1, scene.height)[:, None]
    level = np.select([rows < 0.3, rows < 0.86], [165 - 60 * rows, 120 + 30 * rows], 95.0)
    grey = level + 18 * grain
    picture = np.repeat(np.clip(grey, 20, 235).astype(np.uint8)[:, :, None], 3, axis=2)
    for left in range(0, scene.width, scene.width // 8):  # windows: edges that must not become objects
        corner = (left + scene.width // 32, int(0.08 * scene.height))
        cv2.rectangle(picture, corner, (corner[0] + scene.width // 16, int(0.22 * scene.height)), (90, 70, 60), -1)
    cv2.line(picture, (0, int(0.86 * scene.height)), (scene.width, int(0.86 * scene.height)), (190, 190, 190), 2)
    return picture


def _texture(random: np.random.Generator) -> Image:
    """A coarse pattern that is laid over an object, `(64, 64, 3)`."""
    coarse = random.integers(-22, 23, (8, 8, 1)).astype(np.float32)
    fine = cv2.resize(coarse, (64, 64), interpolation=cv2.INTER_CUBIC)
    return np.repeat(np.clip(128 + fine, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def _draw(picture: Image, actor: Actor, box: tuple[float, float, float, float], texture: Image, time_s: float) -> None:
    """Draw the object so that it fills its box."""
    shape = np.zeros(picture.shape[:2], np.uint8)
    if actor.kind == "vehicle":
        _draw_vehicle(shape, box)
    else:
        _draw_person(shape, box, time_s)
    colour = np.asarray(actor.colour_bgr, np.int16)
    x1, y1, x2, y2 = (round(value) for value in box)
    left, top = max(x1, 0), max(y1, 0)
    right, low = min(x2 + 1, picture.shape[1]), min(y2 + 1, picture.shape[0])
    if right <= left or low <= top:
        return
    pattern = cv2.resize(texture, (x2 - x1 + 1, y2 - y1 + 1)).astype(np.int16) - 128
    cut = pattern[top - y1 : low - y1, left - x1 : right - x1]
    here = np.s_[top:low, left:right]
    painted = np.clip(colour + cut, 0, 255).astype(np.uint8)
    picture[here] = np.where(shape[here][:, :, None] > 0, painted, picture[here])


def _draw_person(shape: npt.NDArray[np.uint8], box: tuple[float, float, float, float], time_s: float) -> None:
    """Head, trunk, arms and two legs that walk; head and feet touch the box, arms its sides."""
    x1, y1, x2, y2 = box
    width, height, middle = x2 - x1, y2 - y1, (x1 + x2) / 2
    radius = height * 0.075
    cv2.circle(shape, _px(middle, y1 + radius), max(1, round(radius)), 255, -1)
    cv2.rectangle(shape, _px(x1, y1 + 0.2 * height), _px(x2, y1 + 0.55 * height), 255, -1)
    cv2.rectangle(
        shape, _px(middle - 0.1 * width, y1 + 0.1 * height), _px(middle + 0.1 * width, y1 + 0.3 * height), 255, -1
    )
    stride = 0.3 * width * np.sin(2 * np.pi * time_s)
    for foot in (middle - stride, middle + stride):
        hip, thick = _px(middle, y1 + 0.5 * height), max(2, round(0.3 * width))
        cv2.line(shape, hip, _px(foot, y2 - thick / 2), 255, thick)


def _draw_vehicle(shape: npt.NDArray[np.uint8], box: tuple[float, float, float, float]) -> None:
    """Body and cabin."""
    x1, y1, x2, y2 = box
    width, height = x2 - x1, y2 - y1
    cv2.rectangle(shape, _px(x1, y1 + 0.4 * height), _px(x2, y2), 255, -1)
    cv2.rectangle(shape, _px(x1 + 0.2 * width, y1), _px(x2 - 0.2 * width, y1 + 0.5 * height), 255, -1)


def _px(x: float, y: float) -> tuple[int, int]:
    return round(x), round(y)
