"""Whether memory stays flat over a long input: a clip, looped to one file, from the video to stored segments.

    python -m benchmarks.long_input [--minutes N] [--folder DIR] [--results FILE] [--plot FILE] VIDEO

Each minute of media time the resident memory of this process and of its decoding process is taken. What counts is
how much it grows once the first minutes have filled what has a limit.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import psutil

from benchmarks.measuring import keep
from extractors.media import Frame
from extractors.video import frames
from store import Log, open_log
from vian.extraction import Extraction, Job, extract_motion

RATE = 10
"""Pictures per second of the looped clip."""
START = datetime(2026, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Sample:
    """Memory after so much of the input."""

    minutes: float
    extractor_mb: float
    """resident, MB"""
    decoder_mb: float
    """resident, MB"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, keep and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("video", type=Path, metavar="VIDEO")
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the input (default 60)")
    parser.add_argument("--folder", type=Path, help="where the input and the database live, on a real disk")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/long_input.json"))
    parser.add_argument("--plot", type=Path, help="draw the memory into this SVG file")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        Path(folder).chmod(0o755)
        long = looped(options.video, options.minutes, Path(folder))
        with open_log(data_dir=Path(folder) / "log") as log:
            samples, done = memory_over(log, long)
    found = {"events": done.events, "pictures": done.frames, "samples": [asdict(each) for each in samples]}
    keep(options.results, is_quick=options.minutes < 60, **found)
    if options.plot:
        _draw(samples, options.plot)


def memory_over(log: Log, video: Path) -> tuple[list[Sample], Extraction]:
    """Memory in each minute of the video while it is extracted into the log, and what that came to."""
    samples: list[Sample] = []
    print(f"{'media min':>10}{'extractor, MB':>15}{'decoder, MB':>13}")

    def take(done: int, _: int | None) -> None:
        minutes = done / RATE / 60
        if minutes >= len(samples) + 1:
            samples.append(_sample(minutes))

    job = Job(log=log, station="benchmark", source="gate", path=video, started_at=START, on_progress=take)
    return samples, extract_motion(job)


def looped(video: Path, minutes: float, folder: Path) -> Path:
    """A file that shows the clip again and again, `RATE` pictures a second, for so long."""
    once, long = folder / "once.mkv", folder / "long.mkv"
    with av.open(str(once), "w") as container:
        pictures = (item.image for item in frames(video) if isinstance(item, Frame))
        first = next(pictures)
        stream = container.add_stream("mpeg4", rate=RATE, options={"qscale": "4", "flags": "+qscale"})
        stream.height, stream.width, stream.pix_fmt = *first.shape[:2], "yuv420p"
        for image in chain([first], pictures):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    with av.open(str(once)) as source, av.open(str(long), "w") as target:
        copied = target.add_stream_from_template(source.streams.video[0])
        packets = [packet for packet in source.demux(video=0) if packet.size]
        for at in range(round(minutes * 60 * RATE)):
            packet = av.Packet(bytes(packets[at % len(packets)]))
            packet.stream, packet.time_base = copied, Fraction(1, RATE)
            packet.pts = packet.dts = at
            packet.is_keyframe = packets[at % len(packets)].is_keyframe
            target.mux(packet)
    return long


def _sample(minutes: float) -> Sample:
    here = psutil.Process()
    decoders = [each for each in here.children() if "extractors.decoder" in each.cmdline()]
    sample = Sample(minutes, _resident_mb([here]), _resident_mb(decoders))
    print(f"{minutes:>10.1f}{sample.extractor_mb:>15.1f}{sample.decoder_mb:>13.1f}", flush=True)
    return sample


def _resident_mb(processes: Sequence[psutil.Process]) -> float:
    return sum(each.memory_info().rss for each in processes) / 1e6


def _draw(samples: Sequence[Sample], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    minutes = [each.minutes for each in samples]
    axes.plot(minutes, [each.extractor_mb for each in samples], label="extractor, with the horizon")
    axes.plot(minutes, [each.decoder_mb for each in samples], label="decoding process")
    axes.set(xlabel="minutes of the input", ylabel="MB resident", ylim=(0, None), title="memory over a long input")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
