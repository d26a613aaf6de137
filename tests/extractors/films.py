"""Small videos made for the tests."""

from pathlib import Path

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


def film_of_two_sizes(folder: Path, *, frames: int = 12) -> Path:
    """A stream of pictures that changes its size in the middle."""
    small = film(folder / "small.mjpeg", frames=frames, codec="mjpeg")
    large = film(folder / "large.mjpeg", frames=frames, codec="mjpeg", size=(200, 160))
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
