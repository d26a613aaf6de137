"""From a mask to boxes: close gaps, join what touches, drop what is too small.

Pure functions of one picture. Boxes are `x1 y1 x2 y2` in px, upper edges exclusive.
"""

import cv2
import numpy as np
import numpy.typing as npt

from extractors.motion.config import MotionConfig
from extractors.motion.held import Mask

BoxesXyxy = npt.NDArray[np.float64]

SPECKLE = 5
"""Width of the median filter that removes speckle, px of the analysed picture."""
UPRIGHT = np.ones((SPECKLE, 1), np.uint8)
"""As far up and down as that filter can take something off an object."""


def cleaned(mask: Mask, config: MotionConfig) -> Mask:
    """The mask without speckle and with gaps closed.

    The median that removes speckle also takes off what is thinner than it: feet and heads of people far away. So
    what is foreground within its reach above or below of what it left is put back, a step of opening by
    reconstruction; last, so that it joins no neighbours, and not to the sides, where neighbours are.

    Source: L. Vincent, "Morphological Grayscale Reconstruction in Image Analysis: Applications and Efficient
    Algorithms", IEEE Transactions on Image Processing 2, 1993, section 3 (geodesic dilation).
    """
    height = max(3, round(config.close_share * mask.shape[0])) | 1
    width = max(3, height // 2) | 1
    element = cv2.getStructuringElement(cv2.MORPH_RECT, (width, height))
    whole = cv2.morphologyEx(cv2.medianBlur(mask, SPECKLE), cv2.MORPH_CLOSE, element)
    return np.asarray(cv2.bitwise_or(whole, cv2.bitwise_and(cv2.dilate(whole, UPRIGHT), mask)), np.uint8)


def boxes(mask: Mask, config: MotionConfig) -> BoxesXyxy:
    """Boxes of the connected parts of the mask that are large enough, `(n, 4)`, from top to bottom.

    A part's area, holes included, follows from its outline by Pick's theorem (G. Pick, 1899): pixels within
    and on a polygon of pixel centres = area + outline / 2 + 1. Following outlines takes a tenth of the time
    of labelling every pixel, since most of a mask is empty.
    """
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    area_min = config.area_share_min * mask.size
    large = [o for o in outlines if cv2.contourArea(o) + len(o) / 2 + 1 >= area_min]
    found = sorted((y, x, x + w, y + h) for x, y, w, h in map(cv2.boundingRect, large))
    return np.array([(x1, y1, x2, y2) for y1, x1, x2, y2 in found], np.float64).reshape(-1, 4)


def xywh(boxes_xyxy: BoxesXyxy) -> BoxesXyxy:
    """Middle of the lower edge, width and height, `(n, 4)`."""
    x1, y1, x2, y2 = boxes_xyxy.T
    return np.stack([(x1 + x2) / 2, y2, x2 - x1, y2 - y1], axis=1)


def xyxy(boxes_xywh: BoxesXyxy) -> BoxesXyxy:
    """The inverse of `xywh`."""
    x, y, w, h = boxes_xywh.T
    return np.stack([x - w / 2, y - h, x + w / 2, y], axis=1)


def areas(boxes_xyxy: BoxesXyxy) -> npt.NDArray[np.float64]:
    """Areas, `(n,)` px²."""
    return np.asarray(np.prod(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], axis=1))


def intersections(a_xyxy: BoxesXyxy, b_xyxy: BoxesXyxy) -> npt.NDArray[np.float64]:
    """Areas that each of n boxes has in common with each of m, `(n, m)` px²."""
    low = np.maximum(a_xyxy[:, None, :2], b_xyxy[None, :, :2])
    high = np.minimum(a_xyxy[:, None, 2:], b_xyxy[None, :, 2:])
    return np.asarray(np.prod(np.clip(high - low, 0, None), axis=2))
