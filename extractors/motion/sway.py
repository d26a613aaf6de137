"""What may be the background itself, moved by a little: leaves and grass in the wind, ripples, blinds.

A pixel of a leaf that swings shows what its neighbours show otherwise. So foreground whose colours all lie within what
the background has nearby needs no object to explain it, and begins no track; one that came from elsewhere goes on.

Source: A. Elgammal et al., "Non-parametric Model for Background Subtraction", ECCV 2000, section 3 (suppression of
false detections by small movements of the background), with ranges of colour in place of sample densities.
"""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image
from extractors.motion.blobs import BoxesXyxy
from extractors.motion.config import MotionConfig
from extractors.motion.held import Mask

LOOK_S = 2.0
"""Time after which the background is looked at again, s."""
TOLERANCE = 12
"""Grey levels beyond the range of the background nearby that still belong to it: noise and light."""


class Sway:
    """The range of the background's colours around each pixel."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._since_s = LOOK_S
        self._low = self._high = np.zeros((0, 0, 3), np.uint8)

    def learn(self, background: Callable[[], Image | None], dt_s: float) -> None:
        """Look at the background again, if it is time."""
        self._since_s += dt_s
        if self._since_s < LOOK_S:
            return
        known = background()
        if known is None:
            return
        self._since_s = 0.0
        side = 2 * max(1, round(self._config.sway_share * known.shape[0])) + 1
        around = np.ones((side, side), np.uint8)
        tolerance = np.full_like(known, TOLERANCE)
        self._low = np.asarray(cv2.subtract(cv2.erode(known, around), tolerance), np.uint8)
        self._high = np.asarray(cv2.add(cv2.dilate(known, around), tolerance), np.uint8)

    def shares(self, image: Image, mask: Mask, boxes_xyxy: BoxesXyxy) -> npt.NDArray[np.float64]:
        """Share of the foreground in each of n boxes that may be background from nearby, 0 to 1, `(n,)`."""
        limits = [image.shape[1], image.shape[0]] * 2
        found = np.zeros(len(boxes_xyxy))
        if not self._low.size:
            return found
        for row, (x1, y1, x2, y2) in enumerate(np.clip(np.rint(boxes_xyxy), 0, limits).astype(int)):
            here = np.s_[y1:y2, x1:x2]
            if y2 <= y1 or x2 <= x1:
                continue
            may_be = cv2.bitwise_and(cv2.inRange(image[here], self._low[here], self._high[here]), mask[here])
            found[row] = cv2.countNonZero(may_be) / max(1, cv2.countNonZero(mask[here]))
        return found
