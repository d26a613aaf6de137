import hashlib
import os
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from fractions import Fraction
from itertools import islice, pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from extractors.errors import DecoderDied, DecoderStalled, VideoHasNoFrames, VideoUnreadable
from extractors.media import Frame, Gap, GapReason, Shape
from extractors.video import DecodeLimits, frames, probe
from tests.extractors.films import film, film_of_two_sizes, first_half, picture, with_noise

CLIPS = {
    "pets2009_s2l1_view001/vtest_480x360.avi": (795, 480, 360, 10.0),
    "intel_car_detection/car-detection.mp4": (377, 768, 432, 12.5),
    "o4n_traffic/traffic.mp4": (480, 640, 360, 23.976),
    "intel_previews_gif/person-bicycle-car-detection.gif": (41, 480, 270, 12.5),
    "hostile/bgs_demo.avi": (51, 48, 48, 15.0),
}


def split(path: Path, limits: DecodeLimits | None = None) -> tuple[list[Frame], list[Gap]]:
    items = list(frames(path, limits))
    return [i for i in items if isinstance(i, Frame)], [i for i in items if isinstance(i, Gap)]


def children() -> set[int]:
    lists = Path("/proc/self/task").glob("*/children")
    return {int(pid) for children in lists for pid in children.read_text().split()}


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + 60
    while is_running(pid):
        assert time.monotonic() < deadline, f"process {pid} is still running"
        time.sleep(0.02)


def test_a_frame_has_its_pixels_number_and_time(tmp_path: Path) -> None:
    found, gaps = split(film(tmp_path / "film.mp4", frames=20))
    assert not gaps
    assert [frame.index for frame in found] == list(range(20))
    assert [frame.time_us for frame in found] == [100_000 * i for i in range(20)]
    assert found[7].time_s == pytest.approx(0.7)
    # The coder quantises to a few levels; bar and ground are 205 levels apart.
    difference = np.abs(found[7].image.astype(int) - picture(160, 120, 7))
    assert np.median(difference) <= 8


def test_times_are_those_of_the_container_to_the_microsecond(tmp_path: Path) -> None:
    path = tmp_path / "uneven.mkv"
    times_ms = [40, 73, 140, 141, 900]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=1000)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for at, time_ms in enumerate(times_ms):
            frame = av.VideoFrame.from_ndarray(picture(64, 48, at), format="bgr24")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    found, _ = split(path)
    assert [frame.time_us for frame in found] == [1000 * (t - times_ms[0]) for t in times_ms]


def test_a_stream_without_times_gets_even_ones(tmp_path: Path) -> None:
    found, _ = split(film(tmp_path / "raw.mjpeg", codec="mjpeg", frames=5))
    steps = {b.time_us - a.time_us for a, b in pairwise(found)}
    assert len(steps) == 1
    assert steps.pop() > 0


def test_probe_says_what_the_file_is(tmp_path: Path) -> None:
    path = film(tmp_path / "film.mp4", frames=20)
    info = probe(path)
    assert (info.width, info.height, info.fps, info.frames_expected) == (160, 120, 10.0, 20)
    assert info.duration_s == pytest.approx(2.0)
    assert info.codec == "mpeg4"
    assert info.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert info.creation_time is None


@pytest.mark.parametrize(
    "written, read",
    [
        ("2018-04-19T22:46:00.000000Z", datetime(2018, 4, 19, 22, 46, tzinfo=UTC)),
        ("2018-04-19T22:46:00+02:00", datetime(2018, 4, 19, 20, 46, tzinfo=UTC)),
        ("yesterday", None),
    ],
)
def test_probe_reads_the_time_of_recording(tmp_path: Path, written: str, read: datetime | None) -> None:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as container:
        container.metadata["creation_time"] = written
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(64, 48, 0), format="bgr24")))
        container.mux(stream.encode(None))
    assert probe(path).creation_time == read


@pytest.mark.parametrize("clip", CLIPS)
def test_a_real_clip_is_read_whole(vian_data: Path, clip: str) -> None:
    count, width, height, fps = CLIPS[clip]
    path = vian_data / "video" / clip
    found, gaps = split(path)
    assert not gaps
    assert len(found) == count
    assert {frame.image.shape for frame in found} == {(height, width, 3)}
    times = [frame.time_us for frame in found]
    assert times[0] == 0
    assert all(a < b for a, b in pairwise(times))
    # GIF times come in hundredths of a second, so single steps differ; the whole does not.
    assert times[-1] / (count - 1) == pytest.approx(1e6 / fps, rel=0.05)


def test_a_small_shortfall_is_recorded(vian_data: Path) -> None:
    found, gaps = split(vian_data / "video/bgs_video02_osd/video02.avi")
    assert len(found) == 748
    assert [(gap.reason, gap.before_index) for gap in gaps] == [(GapReason.SHORTFALL, 748)]
    assert "750" in str(gaps[0])


@pytest.mark.parametrize("clip", ["intel_car_detection/car-detection.mp4", "bgs_video02_osd/video02.avi"])
def test_a_file_that_breaks_off_gives_all_before_and_then_says_so(vian_data: Path, tmp_path: Path, clip: str) -> None:
    whole = list(islice((f for f in frames(vian_data / "video" / clip) if isinstance(f, Frame)), 150))
    found, gaps = split(first_half(tmp_path / Path(clip).name, vian_data / "video" / clip))
    assert len(found) >= 150
    assert all(np.array_equal(a.image, b.image) for a, b in zip(found[:150], whole, strict=True))
    assert gaps[-1].reason is GapReason.BROKEN_OFF
    assert gaps[-1].before_index == len(found)


def test_a_file_cut_before_its_index_is_refused(vian_data: Path, tmp_path: Path) -> None:
    cut = first_half(tmp_path / "traffic.mp4", vian_data / "video/o4n_traffic/traffic.mp4")
    with pytest.raises(VideoUnreadable, match=r"traffic\.mp4: not a video that can be opened"):
        list(frames(cut))


@pytest.mark.parametrize("name, codec", [("film.ts", "mpeg2video"), ("film.mkv", "mjpeg"), ("film.mp4", "mpeg4")])
def test_corrupt_bytes_leave_gaps_and_the_frames_around_them(tmp_path: Path, name: str, codec: str) -> None:
    clean = film(tmp_path / f"clean-{name}", frames=200, codec=codec)
    found, gaps = split(with_noise(tmp_path / name, clean, start=0.4, stop=0.5))
    # A tenth of the bytes is hit; a decoder that needs the frame before loses a group of 12 more at each end.
    assert len(found) >= 200 - 20 - 24
    first = next(gap for gap in gaps if gap.reason is GapReason.CORRUPT)
    assert 60 <= first.before_index <= 110
    assert GapReason.BROKEN_OFF not in {gap.reason for gap in gaps}
    assert found[-1].time_us == pytest.approx(19.9e6, abs=1e6)


def test_an_index_that_corrupt_bytes_cut_off_is_a_file_that_breaks_off(tmp_path: Path) -> None:
    clean = film(tmp_path / "clean.avi", frames=200, codec="mjpeg")
    found, gaps = split(with_noise(tmp_path / "corrupt.avi", clean, start=0.4, stop=0.5))
    assert len(found) >= 70
    assert [gap.reason for gap in gaps] == [GapReason.CORRUPT, GapReason.BROKEN_OFF]


def test_a_change_of_size_is_recorded_where_it_happens(tmp_path: Path) -> None:
    items = list(frames(film_of_two_sizes(tmp_path, frames=12)))
    at = next(i for i, item in enumerate(items) if isinstance(item, Gap))
    gap, before, after = items[at], items[at - 1], items[at + 1]
    assert isinstance(gap, Gap)
    assert isinstance(before, Frame)
    assert isinstance(after, Frame)
    assert (gap.reason, gap.before_index, gap.size) == (GapReason.SIZE_CHANGED, 12, (200, 160))
    assert before.image.shape == (120, 160, 3)
    assert after.image.shape == (160, 200, 3)
    assert len(items) == 25


def test_a_size_that_does_not_follow_from_the_smaller_picture_is_told_exactly(tmp_path: Path) -> None:
    path = film_of_two_sizes(tmp_path, second=(250, 142))
    items = list(frames(path, shape=Shape(width_max=64)))
    after = items[-1]
    assert isinstance(after, Frame)
    assert round(after.image.shape[0] * after.scale) == 141
    assert [item.size for item in items if isinstance(item, Gap)] == [(250, 142)]


def test_a_clock_that_goes_back_is_recorded_and_time_goes_on(tmp_path: Path) -> None:
    one = film(tmp_path / "one.ts", codec="libx264", frames=12).read_bytes()
    both = tmp_path / "both.ts"
    both.write_bytes(one + one)
    found, gaps = split(both)
    assert GapReason.TIME_JUMPED in {gap.reason for gap in gaps}
    times = [frame.time_us for frame in found]
    assert all(a < b for a, b in pairwise(times))


@pytest.mark.parametrize("name", ["notes.txt", "notes.mp4", "notes.avi"])
def test_text_is_no_video(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("This is not a video, whatever it is called.\n" * 200)
    for read in (probe, lambda p: list(frames(p))):
        with pytest.raises(VideoUnreadable, match="not a video that can be opened"):
            read(path)


def test_a_file_with_sound_only_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(VideoUnreadable, match="holds no video stream"):
        probe(path)


def test_a_video_without_frames_is_an_error(tmp_path: Path) -> None:
    whole = film(tmp_path / "whole.avi", codec="mjpeg", frames=3).read_bytes()
    path = tmp_path / "headers.avi"
    path.write_bytes(whole[: whole.index(b"movi") + 4])
    with pytest.raises(VideoHasNoFrames, match="not one frame decodes"):
        list(frames(path))


def test_a_picture_larger_than_the_limit_is_not_decoded(tmp_path: Path) -> None:
    path = film(tmp_path / "film.mp4")
    with pytest.raises(VideoUnreadable, match=r"film\.mp4: pictures of 160x120 px are too large, at most 10,000 px"):
        list(frames(path, DecodeLimits(pixels_max=100 * 100)))


def test_what_is_no_readable_file_is_named(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mp4"
    empty.touch()
    (tmp_path / "folder").mkdir()
    cases = {
        tmp_path / "folder": "no pictures lie in this folder .it is empty.",
        tmp_path / "no.mp4": "no such file",
        empty: "the file is empty",
    }
    for path, said in cases.items():
        with pytest.raises(VideoUnreadable, match=said):
            probe(path)
        with pytest.raises(VideoUnreadable, match=said):
            next(frames(path))


def test_a_file_without_permission_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = film(tmp_path / "secret.mp4")
    path.chmod(0)
    if os.access(path, os.R_OK):  # root reads everything

        def refuse(*_: object, **__: object) -> None:
            raise PermissionError(13, "Permission denied", str(path))

        monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(VideoUnreadable, match="no permission"):
        next(frames(path))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT])
def test_a_decoder_that_crashes_is_named_with_its_last_frame(tmp_path: Path, number: signal.Signals) -> None:
    path = film(tmp_path / "film.avi", codec="mjpeg", frames=300, size=(640, 480))
    before = children()
    reading = frames(path)
    seen = [next(reading) for _ in range(5)]
    (decoder,) = children() - before
    os.kill(decoder, number)
    with pytest.raises(DecoderDied, match=number.name) as error:
        seen.extend(reading)
    assert 5 <= len(seen) < 300
    assert f"after frame {len(seen) - 1}" in str(error.value)
    assert not is_running(decoder)
    assert len(list(frames(path))) == 300  # the reader lives


def test_a_decoder_that_hangs_is_ended(tmp_path: Path) -> None:
    path = film(tmp_path / "film.avi", codec="mjpeg", frames=300, size=(640, 480))
    before = children()
    reading = frames(path, DecodeLimits(stall_s=1.0))
    next(reading)
    (decoder,) = children() - before
    os.kill(decoder, signal.SIGSTOP)
    with pytest.raises(DecoderStalled, match="said nothing for 1 s after frame"):
        list(reading)
    assert not is_running(decoder)


def test_a_reader_that_stops_early_leaves_no_process(tmp_path: Path) -> None:
    path = film(tmp_path / "film.avi", codec="mjpeg", frames=300, size=(640, 480))
    before = children()
    reading = frames(path)
    next(reading)
    assert children() != before
    reading.close()  # type: ignore[attr-defined]
    assert children() == before


def test_the_decoder_dies_with_its_parent_and_ignores_the_terminal(tmp_path: Path) -> None:
    path = film(tmp_path / "film.avi", codec="mjpeg", frames=300, size=(640, 480))
    program = (
        "import sys, pathlib, os\n"
        "from extractors.video import frames\n"
        "reading = frames(pathlib.Path(sys.argv[1]))\n"
        "next(reading)\n"
        "print(open(f'/proc/self/task/{os.getpid()}/children').read(), flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as parent:
        assert parent.stdout is not None
        decoder = int(parent.stdout.readline())
        assert os.getsid(decoder) != os.getsid(parent.pid)  # Ctrl-C at the terminal does not reach it
        parent.kill()
    wait_until_gone(decoder)
