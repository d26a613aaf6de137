"""Small videos made for the tests."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt


def picture(width: int, height: int, at: int, grey: int = 50) -> npt.NDArray[np.uint8]:
    """A grey picture with a bright bar that moves four pixels a frame."""
    image = np.full((height, width, 3), grey, np.uint8)
    left = (4 * at) % width
    image[:, left : left + 10] = 255
    return image


def film(
    path: Path, *, frames: int = 30, size: tuple[int, int] = (160, 120), codec: str = "mpeg4", grey: int = 50
) -> Path:
    """A video of `frames` pictures at 10 frames per second; the path's ending decides the container."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for at in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(*size, at, grey), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def film_of_two_sizes(folder: Path, *, frames: int = 12, second: tuple[int, int] = (200, 160)) -> Path:
    """A stream of pictures, 160x120 px, that changes its size in the middle."""
    small = film(folder / "small.mjpeg", frames=frames, codec="mjpeg")
    large = film(folder / "large.mjpeg", frames=frames, codec="mjpeg", size=second)
    both = folder / "both.mjpeg"
    both.write_bytes(small.read_bytes() + large.read_bytes())
    return both


def with_noise(path: Path, source: Path, *, start: float, stop: float) -> Path:
    """A copy whose bytes between two shares of its length are overwritten here and there."""
    data = bytearray(source.read_bytes())
    random = np.random.default_rng(3)
    for at in random.integers(int(start * len(data)), int(stop * len(data)), 400):
        data[at] = random.integers(256)
    path.write_bytes(bytes(data))
    return path


def first_half(path: Path, source: Path) -> Path:
    """A copy that breaks off after half of the bytes."""
    data = source.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


def film_of(path: Path, pictures: Sequence[npt.NDArray[Any]], form: str, *, codec: str = "ffv1") -> Path:
    """The pictures, of which `form` is the name that FFmpeg gives to their pixels, coded without loss; 10 a second."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=10)
        height, width = pictures[0].shape[:2]
        stream.width, stream.height, stream.pix_fmt = width, height, form
        for image in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=form)))
        container.mux(stream.encode(None))
    return path


def turned(path: Path) -> Path:
    """The MP4 with the note that it is to be shown turned by a quarter to the right, as telephones write it."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    return path


def interlaced_film(path: Path, *, frames: int = 10) -> Path:
    """A bar that moves eight pixels a frame, taken line after line in two fields."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.codec_context.options = {"flags": "+ildct+ilme", "top": "1"}
        for at in range(frames):
            image = np.full((120, 160, 3), 50, np.uint8)
            for field in (0, 1):
                left = 8 * at + 4 * field
                image[field::2, left : left + 10] = 255
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")))
        container.mux(stream.encode(None))
    return path
