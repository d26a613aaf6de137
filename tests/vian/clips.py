"""Short videos of known content: textured boxes that cross a textured picture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

FPS = 10
WIDTH, HEIGHT = 320, 240


@dataclass(frozen=True, slots=True)
class Walk:
    """A box that goes from one place to another at a constant speed, and is there at no other time."""

    start_s: float
    end_s: float
    from_xy: tuple[float, float]
    to_xy: tuple[float, float]
    size: tuple[int, int] = (24, 48)


CROSSING = (Walk(1.5, 5.5, (20, 150), (300, 150)),)
"""One box from left to right, through the demo's zone and over its line."""


def write_clip(
    path: Path,
    walks: Sequence[Walk] = CROSSING,
    *,
    seconds: float = 6.0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    seed: int = 7,
    seen: Callable[[float], npt.NDArray[np.uint8]] | None = None,
) -> Path:
    """Write the walks as a video; the same file content means the same for the extractor.

    Args:
        path: Where to.
        walks: Who walks.
        seconds: How long it is, s.
        size: Width and height, px.
        seed: Of the picture behind them, and of their own.
        seen: The picture behind them at a time, s, where it is another one.
    """
    rng = np.random.default_rng(seed)
    width, height = size
    background = rng.integers(70, 130, (height, width, 3), np.uint8)
    texture = rng.integers(180, 256, (height, width, 3), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=FPS)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = width, height, "yuv420p", 4_000_000
        for index in range(round(seconds * FPS)):
            image = background.copy() if seen is None else seen(index / FPS)
            for walk in walks:
                _draw(image, texture, walk, index / FPS)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())
    return path


def _draw(image: np.ndarray, texture: np.ndarray, walk: Walk, time_s: float) -> None:
    if not walk.start_s <= time_s <= walk.end_s:
        return
    share = (time_s - walk.start_s) / (walk.end_s - walk.start_s)
    x, y = (a + share * (b - a) for a, b in zip(walk.from_xy, walk.to_xy, strict=True))
    width, height = walk.size
    left, top = round(x - width / 2), round(y - height)
    rows, columns = slice(max(0, top), max(0, top + height)), slice(max(0, left), max(0, left + width))
    image[rows, columns] = texture[: image[rows, columns].shape[0], : image[rows, columns].shape[1]]
