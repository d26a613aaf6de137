"""Pictures of a scene, and a video of them.

Contract: the same scene gives the same pictures, and the same file on the same version of the encoder. Edges are
where the projection says, to a quarter of a pixel. The picture is plain on purpose: it stands in for footage where
none is at hand, and checks the geometry of what was measured.
"""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt

from extractors.calibration import Camera
from extractors.media import Image
from extractors.scene.solids import FACES, SHADES, Floats, Solid
from extractors.scene.world import Actor, Scene, box_of, clipped, is_in_view

PICTURES = 2
"""Version of the pictures of a scene: whoever keeps them asks for those of this one."""

Floats32 = npt.NDArray[np.float32]

NOISE_PICTURES = 8
"""So many pictures of noise are drawn, and shifted at random from frame to frame: drawing is slow."""
FINER = 4
"""Objects are drawn so many times as large, and shrunk: their edges are where they are, not where pixels begin."""
GROUND_PX = 24
"""Pixels of the ground's pattern for a metre, which repeats after `GROUND_M`."""
GROUND_M = 16
"""Metres after which the ground's pattern repeats; slabs are one metre wide."""
BIT_RATE = 4_000_000


def render(scene: Scene) -> Iterator[Image]:
    """The pictures, one after another."""
    random = np.random.default_rng(scene.seed)
    ground = _background(scene.camera, random)
    textures = {actor.object_id: _texture(random) for actor in scene.actors}
    shape = (NOISE_PICTURES, scene.height, scene.width, 3)
    noises = np.rint(random.normal(0, scene.noise_levels, shape)).astype(np.int16)
    for frame in range(scene.frames):
        picture = ground.copy()
        for actor in _far_first(scene, frame / scene.fps):
            _draw(picture, scene.camera, actor, frame / scene.fps, textures[actor.object_id])
        if scene.blur_px:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), scene.blur_px), np.float32)
        shift = tuple(random.integers(0, 997, 2))
        noise = np.roll(noises[frame % len(noises)], shift, axis=(0, 1))
        yield np.clip(np.rint(picture) + noise, 0, 255).astype(np.uint8)


def write(scene: Scene, path: Path) -> None:
    """Write the scene as a video file (MPEG-4)."""
    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("mpeg4", rate=Fraction(scene.fps))
        stream.width, stream.height, stream.pix_fmt = scene.width, scene.height, "yuv420p"
        stream.codec_context.bit_rate = BIT_RATE
        stream.codec_context.thread_count = 1  # more threads would not cut the same slices everywhere
        for picture in render(scene):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))


def _far_first(scene: Scene, time_s: float) -> list[Actor]:
    there = [actor for actor in scene.actors if actor.is_there(time_s)]
    return sorted(there, key=lambda actor: -float(np.hypot(*actor.at(time_s))))


def _background(camera: Camera, random: np.random.Generator) -> Floats32:
    """Sky, and slabs on the ground with a grain of their own, `(height, width, 3)` grey levels."""
    x, y = np.meshgrid(np.arange(2 * camera.width), np.arange(2 * camera.height))
    pixels = (np.column_stack([x.ravel(), y.ravel()]) + 0.5) / 2
    metres = camera.ground(pixels)
    is_ground = np.isfinite(metres).all(axis=1)
    grey = 190.0 - 30.0 * pixels[:, 1] / camera.height  # the sky
    far = np.hypot(np.hypot(*metres[is_ground].T), camera.height_m) / (camera.height_m * 6)
    grey[is_ground] = 125.0 + _pattern(random, metres[is_ground]) / (1 + far**2)
    finer = grey.reshape(2 * camera.height, 2 * camera.width).astype(np.float32)
    picture = cv2.resize(finer, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.repeat(np.clip(picture, 0, 255)[:, :, None], 3, axis=2)


def _pattern(random: np.random.Generator, metres: Floats) -> Floats:
    """Grey levels above the ground's mean there, `(n,)`: each slab of one tone, joints between them, and a grain."""
    side = GROUND_M * GROUND_PX
    grain = cv2.GaussianBlur(random.normal(0, 1, (side, side)), (0, 0), 1.2, borderType=cv2.BORDER_REFLECT) * 40
    slabs = np.kron(random.normal(0, 9, (GROUND_M, GROUND_M)), np.ones((GROUND_PX, GROUND_PX)))
    tile = grain + slabs
    tile[::GROUND_PX] -= 35
    tile[:, ::GROUND_PX] -= 35
    at = (np.floor(np.clip(metres, -1e6, 1e6) * GROUND_PX) % side).astype(int)
    return np.asarray(tile[at[:, 1], at[:, 0]])


def _texture(random: np.random.Generator) -> Floats32:
    """A coarse pattern that is laid over an object, grey levels, `(64, 64)`."""
    coarse = random.integers(-22, 23, (8, 8)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (64, 64), interpolation=cv2.INTER_CUBIC), np.float32)


def _draw(picture: Floats32, camera: Camera, actor: Actor, time_s: float, texture: Floats32) -> None:
    """Draw the object where it is."""
    solids = actor.solids(time_s)
    box = box_of(camera, solids)
    if box is None or not is_in_view(camera, box):
        return
    whole = np.concatenate([np.floor(box[:2]), np.ceil(box[2:])])
    x1, y1, x2, y2 = (int(value) for value in clipped(camera, whole))
    colour, cover = _painted(camera, actor, solids, (x1, y1, x2, y2))
    pattern = _laid(texture, whole, (x1, y1, x2, y2))
    here = picture[y1:y2, x1:x2]
    here[:] = here * (1 - cover) + colour + pattern * cover


def _painted(
    camera: Camera, actor: Actor, solids: tuple[Solid, ...], room: tuple[int, int, int, int]
) -> tuple[Floats32, Floats32]:
    """The object's colours in this part of the picture, and how far it covers each pixel, 0 to 1."""
    x1, y1, x2, y2 = room
    shape = (FINER * (y2 - y1), FINER * (x2 - x1))
    colours, cover = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    eye = np.array([0.0, 0.0, camera.height_m])
    for solid in sorted(solids, key=lambda each: -float(np.linalg.norm(each.corners_enu.mean(axis=0) - eye))):
        pixels = (camera.project(solid.corners_enu) - (x1, y1)) * FINER - 0.5
        for face, shade in zip(FACES, SHADES, strict=True):
            corners = solid.corners_enu[list(face)]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            outwards = np.sign(normal @ (corners.mean(axis=0) - solid.corners_enu.mean(axis=0)))
            if outwards * (normal @ (eye - corners[0])) <= 0:
                continue  # seen from behind
            outline = np.rint(pixels[list(face)]).astype(np.int32)
            tone = shade * solid.tone
            cv2.fillConvexPoly(colours, outline, [tone * value for value in actor.colour_bgr])
            cv2.fillConvexPoly(cover, outline, 1.0)
    size = (x2 - x1, y2 - y1)
    shrunk = [np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.float32) for each in (colours, cover)]
    return shrunk[0], shrunk[1][:, :, None]


def _laid(texture: Floats32, whole: Floats, room: tuple[int, int, int, int]) -> Floats32:
    """The texture stretched over the whole box, in this part of the picture, `(height, width, 1)`."""
    left, top, right, low = whole
    x1, y1, x2, y2 = room
    columns = ((np.arange(x1, x2) - left) * 64 / (right - left)).astype(int)
    rows = ((np.arange(y1, y2) - top) * 64 / (low - top)).astype(int)
    return texture[np.ix_(rows, columns)][:, :, None]
