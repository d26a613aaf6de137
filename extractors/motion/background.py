"""Which pixels differ from the empty scene.

Contract: pictures go in one after another; a mask comes out, 255 where something is that does not
belong to the background. Three things that would break a plain background model are handled here:

- the camera's exposure changes: each picture is brought to the brightness of the background first;
- most of the picture changes at once (lights, a jolt), or a part of it that still shows the background's edges (a
  cloud's shadow): no mask, and after a while a new model;
- people stand still: under boxes that the caller names, the model is not updated, and the mask comes
  from the difference to the background remembered there.

Source: Z. Zivkovic, "Improved adaptive Gaussian mixture model for background subtraction", ICPR 2004, as
in OpenCV's MOG2, with shadows as in A. Prati et al., "Detecting Moving Shadows", 2003.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image
from extractors.motion.config import MotionConfig
from extractors.motion.edges import BLOCKS_MIN, compared, share_different, sight
from extractors.motion.held import DIFFERENCE, FOREGROUND, Box, HeldBackground, Mask

Sample = npt.NDArray[np.float32]

TONE_SAMPLES = 2000
"""About so many pixels, spread evenly, stand for the picture when its tones are compared."""
TONE_BANDS = 6
"""Bands in which the change of tones is measured."""
TONE_BAND_SAMPLES_MIN = 30
"""Fewer pixels in a band say nothing."""
TONE_CHANGE_MIN = 1.5
"""Smaller changes are left alone: they are far below what makes a pixel foreground, grey levels."""
CHANNELS = 3
VARIANCE = 15.0
"""Variance with which a pixel's model begins, at least, grey levels squared: OpenCV's own, for noise of 2 levels ..."""
VARIANCES_MAX = 5.0
"""... and to so many times of which it may grow."""
HELD_DEVIATIONS = 5.0
"""What is held counts as hidden where the picture differs by so many standard deviations of the noise: as many as the
model asks for."""
SHADOW_MIN = 0.5
"""Share of the light that a shadow leaves at least; what is darker is an object ..."""
GREY_SHADOW_MIN = 0.7
"""... and the same in a grey picture, where most objects would pass for shadows: nothing tells them by their colour."""
GREY_SPREAD_MAX = 2.0
"""Channels of a grey picture differ by less, grey levels: conversion rounds, and the noise of colours is larger."""
GREY_SHARE = 0.99
"""A picture is grey where this share of its pixels is."""
YOUNG_SHARE = 0.5
"""The time constant of a new model, of the configured one, to which it grows as time goes by."""
SPECKLE = 5
"""Width of the median filter that leaves out rain and noise where the light is judged, px of the analysed picture."""
UNCHANGED_MIN = 0.7
"""Where more of the foreground's edges than this share are the background's, the light changed and nothing came."""
GHOST_CHECK_S = 0.5
"""Time between two looks whether what stands is there at all."""


@dataclass(frozen=True, slots=True)
class Foreground:
    """What one picture showed."""

    mask: Mask
    """`(height, width)`, 255 where something is"""
    share: float
    """share of the picture in the foreground, 0 to 1"""
    is_light_change: bool
    """whether the light changed, so that the mask says nothing (and is empty)"""
    ghosts: frozenset[int] = frozenset()
    """standing tracks that turned out to be no objects"""


class Background:
    """The model of the empty scene."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._restart()

    def _restart(self) -> None:
        self._subtractor = cv2.createBackgroundSubtractorMOG2(
            varThreshold=self._config.variance_threshold, detectShadows=self._config.is_shadow_removed
        )
        self._subtractor.setBackgroundRatio(math.exp(-self._config.absorb_s / self._config.memory_s))
        self._reference: npt.NDArray[np.float32] | None = None
        self._elapsed_s = 0.0
        self._light_s = 0.0
        self._held: HeldBackground | None = None
        self._ghost_check_s = 0.0

    def foreground(self, image: Image, dt_s: float, standing: dict[int, Box], noise: float = 0.0) -> Foreground:
        """What in the picture does not belong to the background.

        Args:
            image: The picture.
            dt_s: Time since the picture before, s.
            standing: Boxes `(4,)` px of what stands still, by track.
            noise: Standard deviation of the picture's noise, grey levels.
        """
        height, width = image.shape[:2]
        held = self._held = self._held or HeldBackground(width, height)
        levelled = self._levelled(image, dt_s)
        self._subtractor.setShadowThreshold(GREY_SHADOW_MIN if is_grey(self._sample) else SHADOW_MIN)
        held.hold(standing, lambda: self._dominant(levelled))
        self._allow(noise)
        mask = self._subtracted(levelled, dt_s, held, max(DIFFERENCE, HELD_DEVIATIONS * noise))
        share = cv2.countNonZero(mask) / mask.size
        self._is_quiet = mask[:: self._step, :: self._step] == 0
        is_light_change = self._is_light_change(levelled, mask, share)
        self._light_s = self._light_s + dt_s if is_light_change else 0.0
        if self._light_s > self._config.light_settle_s:
            self._restart()
        if is_light_change:
            return Foreground(np.zeros_like(mask), share, is_light_change=True)
        ghosts = held.ghosts(levelled, mask) if self._is_ghost_check_due(dt_s) else frozenset()
        return Foreground(mask, share, is_light_change=False, ghosts=ghosts)

    def known(self) -> Image | None:
        """The empty scene as far as it is known; None where the model has just begun anew."""
        background = self._subtractor.getBackgroundImage()
        return None if background is None else np.asarray(background, np.uint8)

    def _levelled(self, image: Image, dt_s: float) -> Image:
        """The picture with the tones of the background, channel by channel."""
        self._step = max(1, round(math.sqrt(image.shape[0] * image.shape[1] / TONE_SAMPLES)))
        small = image[:: self._step, :: self._step]
        self._sample = sample = small.astype(np.float32)
        if self._reference is None:
            self._reference, self._is_quiet = sample, np.ones(sample.shape[:2], bool)
            return image
        quiet = self._is_quiet
        table = tone_table(sample[quiet], self._reference[quiet], self._config.tone_max)
        rate = min(1.0, dt_s / self._config.memory_s)
        wanted = sample if table is None else cv2.LUT(small, table)
        self._reference[quiet] += (rate * (wanted - self._reference))[quiet]
        return image if table is None else np.asarray(cv2.LUT(image, table), np.uint8)

    def _allow(self, noise: float) -> None:
        """Let the model begin with the variance that noise makes, and reach it; it sums that of three channels."""
        variance = max(VARIANCE, CHANNELS * noise**2)
        self._subtractor.setVarInit(variance)
        self._subtractor.setVarMax(VARIANCES_MAX * variance)

    def _subtracted(self, image: Image, dt_s: float, held: HeldBackground, difference: float) -> Mask:
        self._elapsed_s += dt_s
        memory_s = min(self._config.memory_s, YOUNG_SHARE * self._config.memory_s + self._elapsed_s)
        rate = min(1.0, dt_s / memory_s)
        if held.mask is None:
            mask = self._subtractor.apply(image, learningRate=rate)
        else:
            mask = self._subtractor.apply(image, knownForegroundMask=held.mask, learningRate=rate)
        binary = np.asarray(cv2.threshold(mask, FOREGROUND - 1, FOREGROUND, cv2.THRESH_BINARY)[1], np.uint8)
        held.fill(image, binary, difference)
        return binary

    def _is_light_change(self, image: Image, mask: Mask, share: float) -> bool:
        """Whether so much is foreground, or so much that shows the edges of the background, that it is the light."""
        if share <= self._config.light_check_share or share > self._config.light_share_max:
            return share > self._config.light_share_max
        calm = np.asarray(cv2.medianBlur(mask, SPECKLE), np.uint8)  # rain shows the edges behind it
        if cv2.countNonZero(calm) <= self._config.light_check_share * calm.size:
            return False
        return unchanged_share(image, self._dominant(image), calm) > UNCHANGED_MIN

    def _is_ghost_check_due(self, dt_s: float) -> bool:
        self._ghost_check_s += dt_s
        if self._ghost_check_s < GHOST_CHECK_S:
            return False
        self._ghost_check_s = 0.0
        return True

    def _dominant(self, image: Image) -> Image:
        """The background as it was most of the time, without what has stood there for a while.

        A model that has just begun anew knows nothing of what is behind: what stands there is background.
        """
        ratio = self._subtractor.getBackgroundRatio()
        self._subtractor.setBackgroundRatio(0.5)
        known = self.known()
        self._subtractor.setBackgroundRatio(ratio)
        return image if known is None else known


def unchanged_share(image: Image, background: Image, mask: Mask) -> float:
    """Share of the foreground that shows the background's edges, of that where it has any, 0 to 1; 0 where few has."""
    before, now = sight(background).gradients, sight(image).gradients
    size = (now.shape[1], now.shape[0])
    is_inside = (
        np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.float32)[:, :, None] > FOREGROUND / 2
    )
    alike, has_edges = compared(before * is_inside, now * is_inside)
    return 1 - share_different(alike, has_edges) if has_edges.sum() >= BLOCKS_MIN else 0.0


def is_grey(sample: Sample) -> bool:
    """Whether pixels `(rows, columns, 3)` have no colour, as by infrared light."""
    spread = sample.max(axis=2) - sample.min(axis=2)
    return bool(np.mean(spread <= GREY_SPREAD_MAX) >= GREY_SHARE)


def tone_table(seen: Sample, wanted: Sample, change_max: float) -> Mask | None:
    """A table `(1, 256, 3)` that maps the tones of one picture to those of another; None where they agree.

    Cameras change exposure, gamma and white balance at once, so one factor is not enough: the tones are
    cut into equally frequent bands, each band's change is the median over its pixels, and between the
    bands' middles it is interpolated. A median does not mind objects that cover less than half a band.

    Args:
        seen: Pixels `(n, 3)` of the one picture.
        wanted: The same pixels of the other, `(n, 3)`.
        change_max: Largest change of a tone, grey levels.
    """
    count = len(seen) // TONE_BANDS
    if count < TONE_BAND_SAMPLES_MIN:
        return None
    order = np.argsort(wanted, axis=0, kind="stable")[: count * TONE_BANDS]
    bands = (TONE_BANDS, count, 3)
    seen_sorted = np.take_along_axis(seen, order, axis=0).reshape(bands)
    wanted_sorted = np.take_along_axis(wanted, order, axis=0).reshape(bands)
    middles = np.median(seen_sorted, axis=1)
    changes = np.clip(np.median(wanted_sorted - seen_sorted, axis=1), -change_max, change_max)
    if np.abs(changes).max() < TONE_CHANGE_MIN:
        return None
    tones = np.arange(256)
    ranks = np.argsort(middles, axis=0, kind="stable")  # interpolation wants increasing middles
    table = np.stack([tones + np.interp(tones, middles[r, c], changes[r, c]) for c, r in enumerate(ranks.T)], axis=1)
    return np.asarray(np.clip(np.rint(table), 0, 255)[None], np.uint8)
