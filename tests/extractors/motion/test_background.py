from itertools import cycle

import cv2
import numpy as np
import pytest

from extractors.media import Image
from extractors.motion.background import Background, Foreground, is_grey, tone_table
from extractors.motion.config import MotionConfig
from extractors.motion.held import Box

DT = 0.1
HERE = np.s_[80:160, 100:140]
BOX = np.array([100.0, 80, 140, 160])


def street(seed: int = 0) -> Image:
    """An empty scene with texture, 320x240."""
    random = np.random.default_rng(seed)
    coarse = random.integers(60, 190, (24, 32, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC), np.uint8)


def with_person(image: Image, level: int = 15) -> Image:
    there = image.copy()
    there[HERE] = level
    return there


class Camera:
    """Shows pictures to a background model, with noise."""

    def __init__(self, config: MotionConfig | None = None) -> None:
        self.background = Background(config or MotionConfig())
        random = np.random.default_rng(1)
        self.noises = cycle(np.rint(random.normal(0, 2, (7, 240, 320, 3))).astype(np.int16))

    def show(self, image: Image, seconds: float = DT, standing: dict[int, Box] | None = None) -> Foreground:
        """What the last of the pictures showed."""
        for noise, _ in zip(self.noises, range(round(seconds / DT)), strict=False):
            noisy = np.clip(image + noise, 0, 255).astype(np.uint8)
            seen = self.background.foreground(noisy, DT, standing or {})
        return seen


def share_in_person(mask: Image) -> float:
    return float((mask[HERE] > 0).mean())


def test_what_was_not_there_is_foreground_and_the_rest_is_not() -> None:
    camera = Camera()
    camera.show(street(), 5)
    mask = camera.show(with_person(street())).mask
    assert share_in_person(mask) > 0.95
    mask[HERE] = 0
    assert (mask > 0).mean() < 0.001


def test_what_nobody_follows_becomes_background_after_its_time() -> None:
    camera = Camera(MotionConfig(absorb_s=5, memory_s=20))
    camera.show(street(), 30)
    assert share_in_person(camera.show(with_person(street()), 4).mask) > 0.9
    assert share_in_person(camera.show(with_person(street()), 3).mask) < 0.1


def test_what_is_held_stays_foreground_and_leaves_no_trace() -> None:
    camera = Camera(MotionConfig(absorb_s=5, memory_s=20))
    camera.show(street(), 30)
    camera.show(with_person(street()), 1)
    assert share_in_person(camera.show(with_person(street()), 30, {1: BOX}).mask) > 0.95
    assert (camera.show(street(), 1).mask > 0).mean() < 0.001
    # The next one of the same colour is seen as well as the first.
    assert share_in_person(camera.show(with_person(street())).mask) > 0.95


def test_the_hole_that_an_object_left_is_a_ghost_and_an_object_is_none() -> None:
    camera = Camera()
    camera.show(with_person(street()), 5)  # it was there from the beginning, and leaves
    assert share_in_person(camera.show(street()).mask) > 0.9
    assert {7} in [camera.show(street(), DT, {7: BOX}).ghosts for _ in range(10)]
    present = Camera()
    present.show(street(), 5)
    for _ in range(20):
        assert not present.show(with_person(street()), DT, {7: BOX}).ghosts


@pytest.mark.parametrize("change", ["exposure", "white balance", "gamma"])
def test_a_change_of_tones_is_not_motion(change: str) -> None:
    def changed(image: Image) -> Image:
        x = image / 255
        tones = {
            "exposure": x * 0.85,
            "white balance": x * np.array([0.9, 1.0, 1.08]),
            "gamma": x**1.2,
        }[change]
        return np.asarray(np.clip(np.rint(tones * 255), 0, 255), np.uint8)

    camera = Camera()
    camera.show(street(), 5)
    empty = camera.show(changed(street()))
    assert (empty.mask > 0).mean() < 0.01
    seen = camera.show(changed(with_person(street())))
    assert share_in_person(seen.mask) > 0.9
    assert not seen.is_light_change


def test_a_sudden_change_of_everything_is_no_object_and_is_learnt() -> None:
    camera = Camera()
    camera.show(street(0), 5)
    first = camera.show(street(5))
    assert first.is_light_change
    assert not first.mask.any()
    after = camera.show(street(5), 1.5)
    assert not after.is_light_change
    assert (after.mask > 0).mean() < 0.001
    assert share_in_person(camera.show(with_person(street(5))).mask) > 0.9


def test_a_shadow_is_background_unless_wanted() -> None:
    dark = street().copy()
    dark[HERE] = np.rint(dark[HERE] * 0.7)
    found = {}
    for is_removed in (True, False):
        camera = Camera(MotionConfig(is_shadow_removed=is_removed))
        camera.show(street(), 5)
        found[is_removed] = share_in_person(camera.show(dark).mask)
    assert found[True] < 0.2
    assert found[False] > 0.8


def test_who_is_darker_than_a_grey_scene_is_no_shadow_and_a_faint_shadow_is_one() -> None:
    grey = np.repeat(street()[:, :, :1], 3, axis=2)
    found = []
    for share in (0.6, 0.85):
        background, dark = Background(MotionConfig()), grey.copy()
        dark[HERE] = np.rint(dark[HERE] * share)
        for image in [grey] * 50:
            background.foreground(image, DT, {})
        found.append(share_in_person(background.foreground(dark, DT, {}).mask))
    assert found[0] > 0.8
    assert found[1] < 0.2


def test_a_picture_is_grey_where_hardly_a_pixel_has_a_colour() -> None:
    grey = np.full((30, 40, 3), 90, np.float32)
    grey[0, :5] = (90, 92, 91)
    assert is_grey(grey)
    grey[:, :2] = (60, 90, 90)
    assert not is_grey(grey)


def test_tones_that_agree_need_no_table() -> None:
    pixels = np.random.default_rng(0).uniform(0, 255, (1000, 3)).astype(np.float32)
    assert tone_table(pixels, pixels, 40) is None
    assert tone_table(pixels[:50], pixels[:50] + 20, 40) is None  # too few to say


def test_a_table_undoes_a_shift_despite_an_object() -> None:
    wanted = np.random.default_rng(0).uniform(40, 200, (3000, 3)).astype(np.float32)
    seen = wanted + 12
    seen[:200] = 0  # an object over a fifteenth of the picture
    table = tone_table(seen, wanted, 40)
    assert table is not None
    # Medians of bands of 500 values that spread over 27 levels, with objects in them, err by a level or two.
    np.testing.assert_allclose(table[0, 60:200].astype(int) - np.arange(60, 200)[:, None], -12, atol=2)
