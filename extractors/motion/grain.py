"""The noise of the camera, and pictures with less of it: small sensors at night.

Contract: pictures in order of time go in, each comes out smoothed by medians over so small squares as bring its
noise down to what the background model is made for; pictures of little noise come out as they went in. What is left of
the noise is told, so that the model can allow for it, and when it must begin anew, since it has learnt other pictures:
the first, of which the noise was not known, or smoother ones. Medians,
and not means, which make a drop of rain as wide as an object.

Noise is what differs from one picture to the next where nothing moves, which is most of the picture: so the median.
What the whole picture does together (exposure, flicker) is no noise. It is looked at now and then, since it changes
with the light. Two pictures that are the same (a stream that repeats them) say nothing.

Source: P. J. Rousseeuw and C. Croux, "Alternatives to the Median Absolute Deviation", 1993, equation 1.1.
"""

import math

import cv2
import numpy as np

from extractors.media import Image
from extractors.motion.config import MotionConfig

SAMPLES = 2000
"""About so many pixels, spread evenly, stand for the picture."""
MAD_TO_DEVIATION = 1.4826
"""Standard deviation of a normal distribution, of its median absolute deviation."""
LOOK_S = 1.0
"""Time between two looks at the noise, s."""
LOOKS_LARGER = 3
"""So many looks in a row must ask for larger squares; the first decides at once ..."""
LOOKS_SMALLER = 60
"""... and so many for smaller ones: a new model costs more than some detail, as after each lamp that is lit."""
RENEWAL = 0.3
"""Least share of a new look in what is known."""


class Grain:
    """What is known of one camera's noise."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._last: Image | None = None
        self._since_s = LOOK_S
        self._side = 1
        self._asked: list[int] = []
        """sides that looks in a row asked for, all larger or all smaller than the present one"""
        self._count = 0
        self._deviation = 0.0
        self._is_renewed = False

    @property
    def deviation(self) -> float:
        """Standard deviation of the noise that is left, grey levels."""
        return self._deviation

    @property
    def is_renewed(self) -> bool:
        """Whether a model of the pictures before the last must begin anew."""
        return self._is_renewed

    def smoothed(self, image: Image, dt_s: float) -> Image:
        """The picture with less noise."""
        last, self._last = self._last, image
        self._is_renewed = False
        self._since_s += dt_s
        if last is not None and self._since_s >= LOOK_S and not np.array_equal(_sample(last), _sample(image)):
            self._since_s = 0.0
            self._look(last, image)
        return _median(image, self._side)

    def _look(self, last: Image, image: Image) -> None:
        side, deviation = self._needed(last, image)
        if self._asked and (self._asked[-1] > self._side) != (side > self._side):
            self._asked = []
        self._asked = [*self._asked, side] if side != self._side else []
        is_larger = side > self._side
        if self._count == 0 or len(self._asked) >= (LOOKS_LARGER if is_larger else LOOKS_SMALLER):
            side = side if self._count == 0 else min(self._asked) if is_larger else max(self._asked)
            self._asked = []
            # Of larger squares a model that has learnt for long knows the means already.
            self._is_renewed = side < self._side or (self._count == 0 and side > 1)
            self._count = self._count if side == self._side else 0
            self._side = side
        if side == self._side:
            self._count += 1
            self._deviation += max(1 / self._count, RENEWAL) * (deviation - self._deviation)

    def _needed(self, last: Image, image: Image) -> tuple[int, float]:
        """The smallest side that leaves little noise, or the largest, px; and what noise it leaves, grey levels."""
        side, deviation = 1, _deviation(last, image)
        while deviation > self._config.noise_levels_max and side + 2 <= self._config.noise_side_max:
            side += 2
            deviation = _deviation(_median(last, side), _median(image, side))
        return side, deviation


def _median(image: Image, side: int) -> Image:
    return image if side == 1 else np.asarray(cv2.medianBlur(image, side), np.uint8)


def _deviation(last: Image, image: Image) -> float:
    """Standard deviation of the noise of either picture, grey levels."""
    change = _sample(image).astype(np.float32) - _sample(last)
    common = np.median(change, axis=(0, 1))
    return float(MAD_TO_DEVIATION * np.median(np.abs(change - common)) / math.sqrt(2))


def _sample(image: Image) -> Image:
    step = max(1, round(math.sqrt(image.shape[0] * image.shape[1] / SAMPLES)))
    return image[::step, ::step]
