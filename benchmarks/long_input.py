"""Whether memory stays flat over a long input: a clip, looped to one file, from decoding to batches of events.

    python -m benchmarks.extractors --hour [--minutes 60] VIDEO

Prints the resident memory of this process and of its decoding process at a hundredth, a quarter, a half, three
quarters and the end of the input.
"""

import tempfile
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import psutil

from extractors.media import Frame
from extractors.motion import MotionConfig, extract
from extractors.video import frames

SHARES = (0.01, 0.25, 0.5, 0.75, 1.0)
RATE = 10


def memory_over(video: Path, minutes: float) -> None:
    """Print the memory over so many minutes of the clip in a loop."""
    with tempfile.TemporaryDirectory() as folder:
        long = looped(video, minutes, Path(folder))
        print(f"\n{video.name}: {minutes:g} min in one file of {long.stat().st_size / 1e6:.0f} MB")
        print(f"{'media min':>10}{'this process, MB':>18}{'decoder, MB':>13}")
        due = list(SHARES)
        start = datetime(2026, 1, 1, tzinfo=UTC)
        for step in extract(frames(long), MotionConfig(), start_time=start):
            if due and step.time_us >= 0.99 * due[0] * minutes * 60e6:
                due.pop(0)
                _print_memory(step.time_us)


def looped(video: Path, minutes: float, folder: Path) -> Path:
    """A file that shows the clip again and again, 10 frames a second, for so long."""
    once, long = folder / "once.mkv", folder / "long.mkv"
    with av.open(str(once), "w") as container:
        pictures = (item.image for item in frames(video) if isinstance(item, Frame))
        first = next(pictures)
        stream = container.add_stream("mpeg4", rate=RATE, options={"qscale": "4", "flags": "+qscale"})
        stream.height, stream.width, stream.pix_fmt = *first.shape[:2], "yuv420p"
        for image in (first, *pictures):
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


def _print_memory(time_us: int) -> None:
    here = psutil.Process()
    decoding = sum(child.memory_info().rss for child in here.children())
    print(f"{time_us / 60e6:>10.1f}{here.memory_info().rss / 1e6:>18.1f}{decoding / 1e6:>13.1f}", flush=True)
