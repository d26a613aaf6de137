"""How an object looks, in few numbers: where it is dark and light, and what colours it has.

A descriptor holds two histograms of 16 bins, of the upper and the lower half of the box's foreground: ten of
hues, where there is colour, six of brightness, where there is none. A track's descriptor is the mean over its
clear views. Descriptors of different cameras compare only as well as the cameras' colours do.

Source of the distance: A. Bhattacharyya, "On a Measure of Divergence", 1943, in Hellinger's form
`sqrt(1 - sum sqrt(p q))`.
"""

import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image
from extractors.motion.blobs import BoxesXyxy
from extractors.motion.held import FOREGROUND, Mask

Descriptors = npt.NDArray[np.float64]
"""`(n, 32)`, each half of a row sums to 1; NaN where nothing was seen."""

METHOD = "tones-2x16"
"""Name of the method in the log; a change of the descriptor changes it."""
PARTS = 2
HUES = 10
GREYS = 6
BINS = HUES + GREYS
LOOKS = PARTS * BINS
"""Numbers of a descriptor."""
COLOUR_MIN = 40
"""Saturation times value, over 255, from which a pixel has colour."""
PIXELS_MIN = 12
"""Fewer pixels of a half say nothing."""
MIDDLE = 0.6
"""Share of a box's width that is looked at, in its middle: at the sides others come in."""
PIXELS_SIDE = 24
"""About so many rows and columns of a box are looked at."""


def described(image: Image, mask: Mask, boxes_xyxy: BoxesXyxy) -> Descriptors:
    """Descriptors of the foreground in boxes, `(n, 32)`; NaN where there is too little.

    Args:
        image: The picture, BGR.
        mask: Its foreground.
        boxes_xyxy: The boxes, `(n, 4)` px.
    """
    found = np.full((len(boxes_xyxy), LOOKS), np.nan)
    limits = [image.shape[1], image.shape[0]] * 2
    margin = (boxes_xyxy[:, 2:3] - boxes_xyxy[:, :1]) * [[(1 - MIDDLE) / 2, 0, (MIDDLE - 1) / 2, 0]]
    for row, (x1, y1, x2, y2) in enumerate(np.clip(np.rint(boxes_xyxy + margin), 0, limits).astype(int)):
        middle = (y1 + y2) // 2
        step = max(1, (y2 - y1) // (2 * PIXELS_SIDE))
        for part, (top, bottom) in enumerate(((y1, middle), (middle, y2))):
            here = np.s_[top:bottom:step, x1:x2:step]
            found[row, part * BINS : (part + 1) * BINS] = _histogram(image[here], mask[here])
    found[np.isnan(found).any(axis=1)] = np.nan
    return found


def unlikeness(a: Descriptors, b: Descriptors) -> npt.NDArray[np.float64]:
    """How much each of n looks differs from each of m, 0 to 1, `(n, m)`; a half where one is unknown."""
    common = np.sqrt(a)[:, None, :] * np.sqrt(b)[None, :, :]
    distance = np.sqrt(np.maximum(0, 1 - common.sum(axis=2) / PARTS))
    return np.asarray(np.where(np.isnan(distance), 0.5, distance))


def packed(descriptor: Descriptors) -> bytes:
    """A descriptor of 32 numbers as 32 bytes: each is 255 times the root of a share, rounded."""
    return bytes(np.rint(255 * np.sqrt(descriptor)).astype(np.uint8))


def _histogram(image: Image, mask: Mask) -> npt.NDArray[np.float64]:
    pixels = image[mask == FOREGROUND]
    if len(pixels) < PIXELS_MIN:
        return np.full(BINS, np.nan)
    hue, saturation, value = cv2.cvtColor(pixels[None], cv2.COLOR_BGR2HSV)[0].astype(np.intp).T
    is_coloured = saturation * value >= COLOUR_MIN * 255
    bins = np.where(is_coloured, hue * HUES // 180, HUES + value * GREYS // 256)
    return np.asarray(np.bincount(bins, minlength=BINS) / len(pixels), np.float64)
