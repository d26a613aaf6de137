"""From decoded frames to pictures: upright, whole, 8 bits, blue-green-red, and no larger than asked for.

Contract: one picture out for each frame in, in order; deinterlacing holds one back until `flush`. What
is done to pictures beyond a change of format is told once, in words.

Interlaced frames are deinterlaced by FFmpeg's bwdif, one picture a frame. Grey frames of more than 8 bits
are mapped by a window that their first frame sets: most such cameras use a small part of the range, and
the upper 8 bits alone would show nothing.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import av
import av.error
import numpy as np
import numpy.typing as npt
from av.filter import Graph
from av.video.reformatter import VideoReformatter

from extractors.media import Image

_TURNS = {1: "90° counterclockwise", 2: "180°", 3: "90° clockwise"}
LEVELS = 65536
"""Levels of a grey value of 16 bits."""
WINDOW_QUANTILES = (0.001, 0.999)
"""The part of a deep grey picture that its window is laid around: single hot pixels do not count."""
WINDOW_MARGIN = 0.5
"""Room on each side of that part, of its width: what comes later may be brighter or darker."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture, and the pixels of the video for one of its own."""

    image: Image
    scale: float
    full_size: tuple[int, int]
    """width and height before it was made smaller, px"""


class Pictures:
    """Makes pictures of frames, each with what came along with it."""

    def __init__(self, width_max: int | None, height_max: int | None) -> None:
        self._width_max = width_max
        self._height_max = height_max
        self._reformatter = VideoReformatter()
        self._deinterlacer: _Deinterlacer | None = None
        self._window: tuple[float, float] | None = None
        self._told: list[str] = []
        self._quarters = 0

    def push(self, frame: av.VideoFrame, along: Any) -> Iterator[tuple[Picture, Any]]:
        """The pictures that are ready now, each with what came along with its frame."""
        form = (frame.width, frame.height, frame.format.name)
        if self._deinterlacer is not None and self._deinterlacer.form != form:
            yield from self.flush()
        if self._deinterlacer is None and frame.interlaced_frame:
            self._tell("the pictures are interlaced: they are deinterlaced (bwdif)")
            self._deinterlacer = _Deinterlacer(frame)
        if self._deinterlacer is None:
            yield self._picture(frame, frame.rotation), along
            return
        for whole, rotation, its in self._deinterlacer.push(frame, along):
            yield self._picture(whole, rotation), its

    def flush(self) -> Iterator[tuple[Picture, Any]]:
        """The pictures that were held back; no more frames come, or others."""
        if self._deinterlacer is not None:
            for whole, rotation, along in self._deinterlacer.flush():
                yield self._picture(whole, rotation), along
        self._deinterlacer = None

    def told(self) -> list[str]:
        """What was done to pictures, as far as it was not told before."""
        told, self._told = self._told, []
        return told

    def _tell(self, text: str) -> None:
        self._told.append(text)

    def _picture(self, frame: av.VideoFrame, rotation: int) -> Picture:
        quarters = round(rotation / 90) % 4
        width, height = frame.width, frame.height
        upright = (height, width) if quarters % 2 else (width, height)
        scale = shrinking(upright, self._width_max, self._height_max)
        size = (max(1, round(width / scale)), max(1, round(height / scale)))
        image = self._grey(frame, size) if is_deep_grey(frame) else self._colour(frame, size)
        if quarters:
            if quarters != self._quarters:
                self._tell(f"the pictures are turned upright, by {_TURNS[quarters]}")
            image = np.rot90(image, quarters)
        self._quarters = quarters
        return Picture(np.ascontiguousarray(image), scale, upright)

    def _colour(self, frame: av.VideoFrame, size: tuple[int, int]) -> Image:
        return np.asarray(self._reformatted(frame, size, "bgr24").to_ndarray(), np.uint8)

    def _grey(self, frame: av.VideoFrame, size: tuple[int, int]) -> Image:
        return self._levelled(np.asarray(self._reformatted(frame, size, "gray16le").to_ndarray(), np.uint16))

    def _reformatted(self, frame: av.VideoFrame, size: tuple[int, int], form: str) -> av.VideoFrame:
        if size == (frame.width, frame.height):
            return self._reformatter.reformat(frame, format=form, threads=1)
        return self._reformatter.reformat(frame, *size, format=form, threads=1, interpolation="AREA")

    def _levelled(self, grey: npt.NDArray[np.uint16]) -> Image:
        """A picture `(height, width, 3)` of 8 bits from grey levels `(height, width)` of 16."""
        if self._window is None:
            self._window = grey_window(grey)
            self._tell(
                f"the pictures have more than 8 bits of grey: levels {self._window[0]:.0f} to {self._window[1]:.0f} "
                f"of {LEVELS} are shown, as the first picture needs them"
            )
        low, high = self._window
        bright = np.clip((grey.astype(np.float32) - low) * (255 / (high - low)), 0, 255)
        return np.repeat(bright.astype(np.uint8)[:, :, None], 3, axis=2)


class _Deinterlacer:
    """FFmpeg's bwdif over frames of one form; frames that are not interlaced pass as they are."""

    def __init__(self, first: av.VideoFrame) -> None:
        self.form = (first.width, first.height, first.format.name)
        self._waiting: deque[tuple[int, Any]] = deque()
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=first.width, height=first.height, format=first.format, time_base=first.time_base
        )
        whole, sink = self._graph.add("bwdif", "mode=send_frame:deint=interlaced"), self._graph.add("buffersink")
        source.link_to(whole)
        whole.link_to(sink)
        self._graph.configure()

    def push(self, frame: av.VideoFrame, along: Any) -> Iterator[tuple[av.VideoFrame, int, Any]]:
        """Frames that are ready, with the rotation and what came along."""
        self._waiting.append((frame.rotation, along))
        self._graph.push(frame)
        yield from self._ready()

    def flush(self) -> Iterator[tuple[av.VideoFrame, int, Any]]:
        """The frames that are still held back."""
        self._graph.push(None)
        yield from self._ready()

    def _ready(self) -> Iterator[tuple[av.VideoFrame, int, Any]]:
        while self._waiting:
            try:
                frame = self._graph.pull()
            except (BlockingIOError, av.error.EOFError):
                return
            assert isinstance(frame, av.VideoFrame)
            yield frame, *self._waiting.popleft()


def is_deep_grey(frame: av.VideoFrame) -> bool:
    """Whether the frame has one channel of more than 8 bits."""
    return len(frame.format.components) == 1 and frame.format.components[0].bits > 8


def grey_window(grey: npt.NDArray[np.uint16]) -> tuple[float, float]:
    """The levels that become black and white: those of the picture, with room on both sides."""
    low, high = np.quantile(grey, WINDOW_QUANTILES)
    margin = max(WINDOW_MARGIN * (high - low), 128.0)  # a picture of one level has a window too
    return max(0.0, float(low - margin)), min(LEVELS - 1.0, float(high + margin))


def shrinking(size: tuple[int, int], width_max: int | None, height_max: int | None) -> float:
    """How many pixels become one so that the size fits; 1 where it does already."""
    width, height = size
    return max(1.0, width / (width_max or width), height / (height_max or height))
