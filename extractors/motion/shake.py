"""Pictures of a camera that shakes, as of one that does not: a pole in the wind, a bridge under lorries.

Contract: pictures in order of time go in, each comes out shifted back to where the camera mostly looks, so that
places are those of the camera at rest. Only shifts of a few hundredths of the picture are undone, and only where the
picture is then clearly more like the remembered one: what is larger or turns is no shake
(`extractors.motion.steadiness` judges that), and a scene without edges, or one full of movement, is left alone.

Source: C. D. Kuglin and D. C. Hines, "The Phase Correlation Image Alignment Method", 1975, as in OpenCV.
"""

from typing import TypeVar

import cv2
import numpy as np

from extractors.media import Image
from extractors.motion.config import MotionConfig
from extractors.motion.edges import Field

Picture = TypeVar("Picture", Image, Field)

WIDTH = 240
"""Shifts are sought in pictures of at least this width, px; they are found to a tenth of such a pixel."""
SHIFT_MIN = 0.4
"""Smaller shifts are left alone, px of the analysed picture: to interpolate would change it as much."""
BETTER = 0.85
"""Shifted back, the picture must differ from the remembered one by less than this share of what it did."""
MEMORY_S = 20.0
"""Time constant of what is remembered, s."""


class Shake:
    """What one camera looks at while it shakes."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._memory: Field | None = None
        self._last: Image | None = None

    def undone(self, image: Image, dt_s: float) -> Image:
        """The picture, shifted back; the strip at its edge that it then lacks is that of the picture before."""
        factor = max(1, image.shape[1] // WIDTH)
        if min(image.shape[:2]) < 2 * factor:
            return image  # a strip of a line shows no shift
        now = _small(image, factor)
        if self._memory is None or self._last is None:
            self._memory, self._last = now, image
            return image
        shift_xy, back = self._shift(self._memory, now)
        self._memory += min(1.0, dt_s / MEMORY_S) * (back - self._memory)
        if np.hypot(*shift_xy) * factor < SHIFT_MIN:
            self._last = image
        else:
            self._last = _shifted(image, -factor * shift_xy, self._last)
        return self._last

    def _shift(self, memory: Field, now: Field) -> tuple[Field, Field]:
        """By how much the picture is shifted against the remembered one, `(2,)` px of both, and it shifted back."""
        window = cv2.createHanningWindow((now.shape[1], now.shape[0]), cv2.CV_32F)
        shift, _ = cv2.phaseCorrelate(memory.copy(), now.copy(), window)  # it writes into what it is given
        shift_xy = np.asarray(shift, np.float32)
        stays = np.zeros(2, np.float32)
        if not 0 < np.hypot(*shift_xy) <= self._config.shake_share_max * now.shape[1]:
            return stays, now
        back = _shifted(now, -shift_xy, now)
        is_better = np.abs(back - memory).mean() < BETTER * np.abs(now - memory).mean()
        return (shift_xy, back) if is_better else (stays, now)


def _small(image: Image, factor: int) -> Field:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def _shifted(picture: Picture, by_xy: Field, before: Picture) -> Picture:
    """The picture, shifted; where it shows nothing then, the one before."""
    matrix = np.array([[1, 0, by_xy[0]], [0, 1, by_xy[1]]], np.float32)
    size = (picture.shape[1], picture.shape[0])
    shifted = before.copy()
    cv2.warpAffine(picture, matrix, size, shifted, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT)
    return shifted
