"""How fast extraction is, beside OpenCV on the same frames in the same run.

    python -m benchmarks.extractors [--quick] [--threads N] [--lines N] [--results FILE] [VIDEO ...]

Medians of five rounds in which the candidates take turns, one thread each:

- decode: frames per second out of `extractors.video` (PyAV in a process of its own), beside PyAV in this
  process and OpenCV's reader, which is not safe (docs/decisions/0006-video-decoding.md);
- motion: the motion extractor from decoded frames to batches of events, beside OpenCV's MOG2 alone;
- whole: from a file of these frames to stored segments, as `vian extract motion` does it: decoding, tracks, horizon,
  calibration and a PostgreSQL of its own, all on one processor, beside the same;
- horizon: an update of the estimate when 200 people of a rendered square have passed, by the parameters of blobs.

Without a video it renders the synthetic street.
"""

import argparse
import itertools
import os
import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import av
import cv2
import numpy as np

from benchmarks.measuring import Figure, Row, compared, keep, rate
from extractors import scene
from extractors.horizon import FrameSize, Horizon, HorizonConfig, TrackPoints
from extractors.media import Frame
from extractors.motion import MotionConfig, extract
from extractors.video import frames
from store import Log, open_log
from vian.extraction import Job, extract_motion, media_clock

ROUNDS = 5
START = datetime(2026, 1, 1, tzinfo=UTC)
RESULTS = Path("benchmarks/results/extractors.json")
PEOPLE = 200
Work = Callable[[], int]
"""Does a piece of work; how many frames it was."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("videos", nargs="*", type=Path, metavar="VIDEO")
    parser.add_argument("--quick", action="store_true", help="one round of 100 frames")
    parser.add_argument("--threads", type=int, default=1, help="OpenCV's threads (default 1)")
    parser.add_argument("--lines", type=int, help="bring the pictures to so many lines before motion is measured")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(options.threads)
    rounds, frames_max = (1, 100) if options.quick else (ROUNDS, 800)
    found: list[Row | Figure] = []
    with tempfile.TemporaryDirectory() as folder:
        for video in options.videos or [_street(Path(folder))]:
            for row in _measured(video, rounds, frames_max, options.lines, Path(folder)):
                print(_line(row), flush=True)
                found.append(row)
    found.append(_of_the_horizon(rounds))
    print(_line(found[-1]))
    keep(options.results, is_quick=options.quick, rows=[row.plain() for row in found])


def _measured(video: Path, rounds: int, frames_max: int, lines: int | None, folder: Path) -> Iterator[Row | Figure]:
    pictures = [_of_lines(item, lines) for item in frames(video) if isinstance(item, Frame)][:frames_max]
    height, width = pictures[0].image.shape[:2]
    in_process: tuple[str, Work] = ("PyAV in this process", lambda: _decoded_in_process(video))
    mog2: tuple[str, Work] = ("OpenCV's MOG2 alone", lambda: _subtracted(pictures))
    yield _row(f"decode {video.name}", rounds, lambda: _decoded(video), in_process)
    yield _row(f"decode {video.name} by OpenCV", rounds, lambda: _decoded_by_opencv(video), in_process)
    yield _row(f"motion, {width}x{height}", rounds, lambda: _extracted(pictures), mog2)
    film = _film(pictures, folder / "film.mkv")
    with _one_processor(), open_log(data_dir=folder / "log") as log:
        sources = (f"film-{number}" for number in itertools.count())
        whole = _row(
            f"file to stored segments, {width}x{height}, one processor",
            rounds,
            lambda: _stored(film, log, next(sources)),
            mog2,
            target=0.5,
        )
    yield whole
    yield Figure(f"{whole.what}, by the clock", "frames/s", whole.ours, 50)


def _row(what: str, rounds: int, ours: Work, reference: tuple[str, Work], target: float | None = None) -> Row:
    name, theirs = reference
    return compared(what, "frames/s", rounds, lambda _: _rate(ours), (name, lambda _: _rate(theirs)), target)


def _rate(work: Work) -> float:
    """Frames a second."""
    counts: list[int] = []
    calls = rate(1, lambda: counts.append(work()))
    return calls * counts[0]


def _of_the_horizon(rounds: int) -> Figure:
    """How long an update of the estimate takes when so many have passed; their points are folded before."""
    square = scene.square(people=PEOPLE, apart_s=0.5)
    boxes = list(scene.truth(square))
    points = TrackPoints(
        np.array([round(box.frame * 1e6 / square.fps) for box in boxes]),
        np.array([box.object_id for box in boxes]),
        np.array([box.frame for box in boxes]),
        np.array([(box.x1, box.y1, box.x2, box.y2) for box in boxes]),
        np.ones(len(boxes)),
    )
    horizon = Horizon(FrameSize(square.width, square.height), HorizonConfig.of_blobs())
    horizon.add(points)
    seconds = [1 / rate(1, horizon.estimate) for _ in range(rounds)]
    tracks = len(np.unique(points.track_id))
    return Figure(f"update of the horizon, {tracks} tracks", "s", statistics.median(seconds), 0.5, at_least=False)


def _line(row: Row | Figure) -> str:
    if isinstance(row, Figure):
        return f"{row.what:<60}{row.reached:>10.2f} {row.unit}"
    return f"{row.what:<60}{row.ours:>10.0f} {row.unit}, {row.ratio:.2f} of {row.reference_name} ({row.reference:.0f})"


def _of_lines(frame: Frame, lines: int | None) -> Frame:
    """The frame, its picture brought to so many lines; as it is without a number."""
    if lines is None:
        return frame
    size = (round(frame.image.shape[1] * lines / frame.image.shape[0]), lines)
    return replace(frame, image=np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_LINEAR), np.uint8))


def _extracted(pictures: list[Frame]) -> int:
    *_, last = extract(pictures, MotionConfig(), start_time=START)
    return last.frames


def _stored(film: Path, log: Log, source: str) -> int:
    """From the file to what the log holds, all of `vian extract motion`."""
    return extract_motion(Job(log, "benchmark", source, film, START, stamp=media_clock)).frames


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


def _decoded(video: Path) -> int:
    return sum(isinstance(item, Frame) for item in frames(video))


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
