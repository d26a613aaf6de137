"""A folder of pictures is a video."""

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from extractors.errors import VideoUnreadable
from extractors.media import Frame, Gap, GapReason, Shape
from extractors.video import frames, probe
from tests.extractors.films import picture

START = datetime(2026, 1, 31, 12, 0, tzinfo=UTC)
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def folder_of(folder: Path, names: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    for at, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(64, 48, at))
    return folder


def read(folder: Path, fps: float | None = None) -> tuple[list[Frame], list[Gap]]:
    items = list(frames(folder, shape=Shape(fps=fps)))
    return [i for i in items if isinstance(i, Frame)], [i for i in items if isinstance(i, Gap)]


def test_pictures_come_in_the_order_of_the_numbers_in_their_names(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", [f"frame{i}.png" for i in range(12)])
    (folder / "notes.txt").write_text("no picture")
    found, gaps = read(folder, fps=5)
    assert not gaps
    assert [frame.time_us for frame in found] == [200_000 * i for i in range(12)]
    assert all(np.array_equal(frame.image, picture(64, 48, frame.index)) for frame in found)
    info = probe(folder, shape=Shape(fps=5))
    assert (info.width, info.height, info.frames_expected, info.codec, info.fps) == (64, 48, 12, "pictures", 5)


@pytest.mark.parametrize(
    "name",
    ["gate_%Y%m%d_%H%M%S_%f.png", "%Y-%m-%dT%H-%M-%S.%f.png", "%Y-%m-%d %H.%M.%S,%f-gate.png", "epoch"],
)
def test_times_come_from_names(tmp_path: Path, name: str) -> None:
    times = [START + timedelta(seconds=0.25 * i * i) for i in range(4)]
    names = [
        f"{(time - EPOCH) // timedelta(microseconds=1)}000.png" if name == "epoch" else time.strftime(name)
        for time in times
    ]
    folder = folder_of(tmp_path / "f", names)
    found, _ = read(folder)
    assert [frame.time_us for frame in found] == [250_000 * i * i for i in range(4)]
    assert probe(folder).creation_time == START


def test_times_come_from_exif_where_names_say_none(tmp_path: Path) -> None:
    for at in range(3):
        image = Image.fromarray(picture(64, 48, at))
        exif = Image.Exif()
        ifd = exif.get_ifd(0x8769)
        ifd[0x9003], ifd[0x9011], ifd[0x9291] = f"2026:01:31 14:00:0{at}", "+02:00", "5"
        image.save(tmp_path / f"DSC{at}.jpg", exif=exif)
    found, _ = read(tmp_path)
    assert [frame.time_us for frame in found] == [0, 1_000_000, 2_000_000]
    assert probe(tmp_path).creation_time == START + timedelta(seconds=0.5)


def test_pictures_without_times_want_a_rate(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", ["a.png", "b.png"])
    with pytest.raises(VideoUnreadable, match="Next: --fps RATE") as caught:
        read(folder)
    assert "not a video" not in str(caught.value)


def test_a_picture_that_does_not_decode_is_a_gap(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", ["1.png", "2.png", "3.png"])
    (folder / "2.png").write_bytes(b"no picture at all")
    found, (gap,) = read(folder, fps=1)
    assert [frame.time_us for frame in found] == [0, 2_000_000]
    assert (gap.reason, gap.before_index) == (GapReason.CORRUPT, 1)
    assert "2.png" in gap.detail


def test_pictures_of_another_size_are_recorded(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", ["1.png", "2.png"])
    cv2.imwrite(str(folder / "3.png"), picture(80, 60, 0))
    found, (gap,) = read(folder, fps=1)
    assert len(found) == 3
    assert (gap.reason, gap.before_index) == (GapReason.SIZE_CHANGED, 2)


@pytest.mark.parametrize("ending", ["bmp", "jpg", "JPEG", "ppm", "tif", "webp"])
def test_every_kind_of_picture_is_read(tmp_path: Path, ending: str) -> None:
    cv2.imwrite(str(tmp_path / f"frame-000007.color.{ending}"), picture(64, 48, 3))
    (frame,), gaps = read(tmp_path, fps=1)
    assert not gaps
    assert np.abs(frame.image.astype(int) - picture(64, 48, 3)).mean() < 6  # some kinds lose a little


def test_pictures_of_16_bits_are_shown(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.full((48, 64), 700, np.uint16))
    found, (gap,) = read(tmp_path, fps=1)
    assert found[0].image.shape == (48, 64, 3)
    assert gap.reason is GapReason.CONVERTED


def test_a_folder_is_known_by_its_pictures_and_their_names(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "f", ["1.png", "2.png"])
    shape = Shape(fps=1)
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    assert probe(copy, shape=shape).sha256 == probe(folder, shape=shape).sha256
    (copy / "1.png").rename(copy / "0.png")
    assert probe(copy, shape=shape).sha256 != probe(folder, shape=shape).sha256
