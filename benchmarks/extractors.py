"""How fast extraction is, beside OpenCV on the same frames in the same run.

    python -m benchmarks.extractors [--quick] [--threads N] [--lines N] [VIDEO ...]

Three tables, medians of five rounds in which the candidates take turns:

- decode: frames per second out of `extractors.video` (PyAV in a process of its own), PyAV in this
  process, and OpenCV's reader, which is not safe (docs/decisions/0006-video-decoding.md);
- motion: the motion extractor from decoded frames to batches of events, beside OpenCV's MOG2 alone;
- whole: from a file of these frames to encoded segments, decoding included, all on one processor, beside the same.

Without a video it renders the synthetic street.
"""

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import av
import cv2
import numpy as np

from events.segment import encode_payload
from extractors import scene
from extractors.media import Frame
from extractors.motion import MotionConfig, extract
from extractors.video import frames

ROUNDS = 5
START = datetime(2026, 1, 1, tzinfo=UTC)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("videos", nargs="*", type=Path, metavar="VIDEO")
    parser.add_argument("--quick", action="store_true", help="one round of 100 frames")
    parser.add_argument("--threads", type=int, default=1, help="OpenCV's threads (default 1)")
    parser.add_argument("--lines", type=int, help="bring the pictures to so many lines before motion is measured")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(options.threads)
    rounds, frames_max = (1, 100) if options.quick else (ROUNDS, 400)
    with tempfile.TemporaryDirectory() as folder:
        for video in options.videos or [_street(Path(folder))]:
            _measure(video, rounds, frames_max, options.lines, Path(folder))


def _measure(video: Path, rounds: int, frames_max: int, lines: int | None, folder: Path) -> None:
    pictures = [_of_lines(item, lines) for item in frames(video) if isinstance(item, Frame)][:frames_max]
    height, width = pictures[0].image.shape[:2]
    print(f"\n{video.name}: {len(pictures)} frames of {width}x{height}, {rounds} rounds")
    decoders: dict[str, Callable[[], int]] = {
        "extractors.video": lambda: sum(isinstance(item, Frame) for item in frames(video)),
        "PyAV in this process": lambda: _decoded_in_process(video),
        "OpenCV in this process": lambda: _decoded_by_opencv(video),
    }
    _table("decode", decoders, rounds, reference="PyAV in this process")
    workers: dict[str, Callable[[], int]] = {
        "motion extractor": lambda: _extracted(pictures),
        "OpenCV MOG2 alone": lambda: _subtracted(pictures),
    }
    _table("motion", workers, rounds, reference="OpenCV MOG2 alone")
    film = _film(pictures, folder / "film.mkv")
    roads: dict[str, Callable[[], int]] = {
        "file to segments": lambda: _to_segments(film),
        "OpenCV MOG2 alone": lambda: _subtracted(pictures),
    }
    with _one_processor():
        _table("whole, one processor", roads, rounds, reference="OpenCV MOG2 alone")


def _table(title: str, candidates: dict[str, Callable[[], int]], rounds: int, reference: str) -> None:
    rates: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, work in candidates.items():
            begin = time.perf_counter()
            count = work()
            rates[name].append(count / (time.perf_counter() - begin))
    base = statistics.median(rates[reference])
    print(f"{title:<26}{'frames/s':>10}{'ms/frame':>10}{'ratio':>8}")
    for name, values in rates.items():
        rate = statistics.median(values)
        print(f"{name:<26}{rate:>10.0f}{1000 / rate:>10.2f}{rate / base:>8.2f}")


def _of_lines(frame: Frame, lines: int | None) -> Frame:
    """The frame, its picture brought to so many lines; as it is without a number."""
    if lines is None:
        return frame
    size = (round(frame.image.shape[1] * lines / frame.image.shape[0]), lines)
    return replace(frame, image=np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_LINEAR), np.uint8))


def _extracted(pictures: list[Frame]) -> int:
    *_, last = extract(pictures, MotionConfig(), start_time=START)
    return last.frames


def _to_segments(film: Path) -> int:
    """From the file to the bytes that the log stores."""
    for step in extract(frames(film), MotionConfig(), start_time=START):
        for batch in step.batches:
            encode_payload(batch)
    return step.frames


def _film(pictures: Sequence[Frame], path: Path) -> Path:
    """A file of these pictures, 10 a second."""
    height, width = pictures[0].image.shape[:2]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10, options={"qscale": "3", "flags": "+qscale"})
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture.image, format="bgr24")))
        container.mux(stream.encode(None))
    return path


@contextmanager
def _one_processor() -> Iterator[None]:
    """This process and its decoder share one processor, where the system lets them be bound (Linux)."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _subtracted(pictures: list[Frame]) -> int:
    subtractor = cv2.createBackgroundSubtractorMOG2()
    for picture in pictures:
        subtractor.apply(picture.image)
    return len(pictures)


def _decoded_in_process(video: Path) -> int:
    with av.open(str(video)) as container:
        return sum(1 for frame in container.decode(video=0) if frame.to_ndarray(format="bgr24").size)


def _decoded_by_opencv(video: Path) -> int:
    capture = cv2.VideoCapture(str(video))
    count = 0
    while capture.read()[0]:
        count += 1
    return count


def _street(folder: Path) -> Path:
    path = folder / "street.mp4"
    scene.write(scene.street(), path)
    return path


if __name__ == "__main__":
    main()
