"""Noise of known size, in pictures of a scene with texture."""

import cv2
import numpy as np
import pytest

from extractors.media import Image
from extractors.motion import MotionConfig
from extractors.motion.grain import Grain

DT = 0.1
LIMIT = MotionConfig().noise_levels_max


def street() -> Image:
    coarse = np.random.default_rng(0).integers(60, 190, (24, 32, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC), np.uint8)


def noisy(deviation: float, count: int = 5, *, steps: float = 0.0) -> list[Image]:
    """Pictures, each brighter than the last by so many levels."""
    random = np.random.default_rng(1)
    return [
        np.clip(np.rint(street() + steps * at + random.normal(0, deviation, (240, 320, 3))), 0, 255).astype(np.uint8)
        for at in range(count)
    ]


def test_pictures_of_little_noise_come_out_as_they_went_in() -> None:
    grain = Grain(MotionConfig())
    for picture in noisy(1.5):
        assert grain.smoothed(picture, DT) is picture
        assert not grain.is_renewed
    # Of whole grey levels the median is whole, too.
    assert grain.deviation == pytest.approx(1.5, abs=0.6)


@pytest.mark.parametrize("deviation", [5.0, 8.0])
def test_noise_is_brought_down_from_the_second_picture_on(deviation: float) -> None:
    grain = Grain(MotionConfig())
    renewed, left = [], []
    for picture in noisy(deviation):
        smooth = grain.smoothed(picture, DT)
        renewed.append(grain.is_renewed)
        left.append(float(np.std(smooth.astype(float) - cv2.blur(street(), (5, 5)), ddof=1)))
    assert renewed == [False, True, False, False, False]
    assert left[0] > 0.9 * deviation
    assert grain.deviation <= LIMIT
    assert max(left[1:]) < 2 * LIMIT  # smoothing changes the scene itself, too


def test_what_smoothing_cannot_bring_down_is_told() -> None:
    grain = Grain(MotionConfig())
    for picture in noisy(25.0):
        grain.smoothed(picture, DT)
    # The median of n has pi / 2 times the variance of their mean (asymptotically; of 25 it is 1.53).
    assert grain.deviation == pytest.approx(np.sqrt(1.53) * 25 / 5, rel=0.1)


def test_flicker_of_the_whole_picture_is_no_noise() -> None:
    grain = Grain(MotionConfig())
    for picture in noisy(1.0, steps=9.0):
        assert grain.smoothed(picture, DT) is picture


def test_a_stream_that_repeats_pictures_is_no_quieter() -> None:
    grain = Grain(MotionConfig())
    for picture in noisy(8.0, 12):
        for _ in range(2):
            grain.smoothed(picture, 1.0)
    assert grain.deviation > 1


def test_noise_that_comes_with_the_night_is_met_after_a_few_looks_without_a_new_model() -> None:
    grain = Grain(MotionConfig())
    renewed, is_smoothed = [], []
    for picture in [*noisy(1.0), *noisy(8.0, 8)]:
        is_smoothed.append(grain.smoothed(picture, 1.0) is not picture)
        renewed.append(grain.is_renewed)
    assert not any(renewed)
    assert 5 < is_smoothed.index(True) < 9


def test_smoothing_ends_when_it_was_quiet_for_long() -> None:
    grain = Grain(MotionConfig())
    quiet = noisy(1.0, 10)
    for picture in [*noisy(8.0), *3 * quiet]:
        grain.smoothed(picture, 1.0)
    assert grain.smoothed(quiet[0], 1.0) is not quiet[0]
    renewed = []
    for picture in 4 * quiet:
        grain.smoothed(picture, 1.0)
        renewed.append(grain.is_renewed)
    assert sum(renewed) == 1
    assert grain.smoothed(quiet[0], 1.0) is quiet[0]


def test_noise_near_a_limit_does_not_keep_the_squares_of_the_night() -> None:
    """Looks ask for now no squares, now small ones: none of them asks for large ones."""
    grain = Grain(MotionConfig())
    evening = 5 * [*noisy(1.0, 8), *noisy(5.0, 8)]
    for picture in [*noisy(16.0), *evening]:
        grain.smoothed(picture, 1.0)
    np.testing.assert_array_equal(grain.smoothed(evening[0], 0.0), cv2.medianBlur(evening[0], 3))
