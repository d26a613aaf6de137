"""Frames of every kind become pictures that are upright, whole, 8 bits and blue-green-red."""

from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from extractors.media import Frame, Gap, GapReason, Shape
from extractors.video import frames, probe
from tests.extractors.films import film, film_of, interlaced_film, picture, turned


def split(path: Path, shape: Shape | None = None) -> tuple[list[Frame], list[Gap]]:
    items = list(frames(path, shape=shape))
    return [i for i in items if isinstance(i, Frame)], [i for i in items if isinstance(i, Gap)]


def test_a_video_of_a_telephone_held_upright_is_turned(tmp_path: Path) -> None:
    path = turned(film(tmp_path / "film.mp4", frames=3))
    info = probe(path)
    assert (info.width, info.height) == (120, 160)
    found, (gap,) = split(path)
    assert found[1].image.shape == (160, 120, 3)
    # The bar stands at the left of the coded picture, so it lies at the top when that is turned to the right.
    assert found[1].image[5:13, 10:110].mean() > 200
    assert found[1].image[60:, 10:110].mean() < 70
    assert (gap.reason, gap.before_index) == (GapReason.CONVERTED, 0)
    assert "turned upright" in gap.detail


def test_interlaced_pictures_are_made_whole(tmp_path: Path) -> None:
    found, (gap,) = split(interlaced_film(tmp_path / "film.ts"))
    assert gap.reason is GapReason.CONVERTED
    assert "deinterlaced" in gap.detail
    assert [frame.index for frame in found] == list(range(10))
    assert all(b.time_us - a.time_us == 40_000 for a, b in pairwise(found))
    image = found[5].image[20:100].astype(int)
    # Where the fields differ by four columns, lines would alternate by 200 levels; coding leaves a few.
    assert np.abs(image[1:] - image[:-1]).max() < 60


@pytest.mark.parametrize("form", ["rgb24", "bgr24", "rgba", "yuv444p"])
def test_colours_are_in_order_whatever_the_order_in_the_file(tmp_path: Path, form: str) -> None:
    red = np.zeros((48, 64, 3), np.uint8)
    red[:, :, 2] = 200
    path = tmp_path / "film.nut"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("rawvideo", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, form
        container.mux(stream.encode(av.VideoFrame.from_ndarray(red, format="bgr24").reformat(format=form)))
        container.mux(stream.encode(None))
    (frame,), gaps = split(path)
    assert not gaps
    assert np.abs(frame.image.astype(int) - red).max() <= 4  # luma and chroma have 8 bits each


def test_grey_pictures_have_three_equal_channels(tmp_path: Path) -> None:
    grey = picture(64, 48, 3)[:, :, 0]
    (frame,), gaps = split(film_of(tmp_path / "film.mkv", [grey], "gray"))
    assert not gaps
    assert all(np.array_equal(frame.image[:, :, channel], grey) for channel in range(3))


def test_grey_of_16_bits_shows_what_a_thermal_camera_sees(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pictures = [rng.normal(22_000, 100, (48, 64)).astype(np.uint16) for _ in range(3)]
    for at, image in enumerate(pictures):
        image[20:40, 10 * at : 10 * at + 10] = 22_600
    found, (gap,) = split(film_of(tmp_path / "film.mkv", pictures, "gray16le"))
    assert gap.reason is GapReason.CONVERTED
    assert "more than 8 bits" in gap.detail
    for at, frame in enumerate(found):
        warm = frame.image[20:40, 10 * at : 10 * at + 10].mean()
        assert warm - np.median(frame.image) > 60, "the upper 8 bits alone would differ by 2"
    assert abs(np.median(found[0].image) - np.median(found[2].image)) <= 1, "one window for all"


def test_a_picture_of_one_level_has_a_window_too(tmp_path: Path) -> None:
    found, _ = split(film_of(tmp_path / "film.mkv", [np.full((48, 64), 900, np.uint16)] * 2, "gray16le"))
    assert len(found) == 2


def test_a_picture_of_8k_is_read_and_can_be_made_smaller(tmp_path: Path) -> None:
    path = film_of(tmp_path / "film.nut", [np.full((4320, 7680), 90, np.uint8)], "gray", codec="rawvideo")
    (frame,), _ = split(path, Shape(height_max=540))
    assert frame.image.shape == (540, 960, 3)
    assert frame.scale == 8
    (frame,), _ = split(path)
    assert frame.image.shape == (4320, 7680, 3)


def test_smaller_pictures_keep_their_ratio_and_name_their_scale(tmp_path: Path) -> None:
    path = film(tmp_path / "film.mp4", frames=2, size=(320, 240))
    found, _ = split(path, Shape(width_max=100, height_max=100))
    assert {(frame.image.shape, frame.scale) for frame in found} == {((75, 100, 3), 3.2)}
    info = probe(path, shape=Shape(width_max=100))
    assert (info.width, info.height) == (320, 240), "the video's own"
    found, _ = split(path, Shape(width_max=1000))
    assert {(frame.image.shape, frame.scale) for frame in found} == {((240, 320, 3), 1.0)}


@pytest.mark.parametrize("fps, indices", [(5.0, [0, 2, 4, 6, 8]), (3.0, [0, 4, 7]), (100.0, list(range(10)))])
def test_a_lower_rate_leaves_frames_out_and_keeps_their_numbers(tmp_path: Path, fps: float, indices: list[int]) -> None:
    found, gaps = split(film(tmp_path / "film.mp4", frames=10), Shape(fps=fps))
    assert [frame.index for frame in found] == indices
    assert [frame.time_us for frame in found] == [100_000 * index for index in indices]
    assert not gaps
