"""Objects of known size that explain a mask.

Blobs are not objects: people who pass are one blob, and one person behind a lamp post is two. Where the size
of an object is known at every place (`extractors.motion.sizes`), a blob of that size is one object, and what
is larger or in parts is covered with boxes of the expected size, the best explanation first: a box should be
filled with foreground that nothing else explains, have a head in the middle of its top, and nothing above it.
Where a track is expected, less will do. Then the boxes share the foreground among them, each moves to the
middle of its share, and what has become too little falls away.

Pure functions of one picture. Source of the idea: T. Zhao and R. Nevatia, "Tracking Multiple Humans in
Complex Situations", PAMI 2004, section 4 (heads on the outline of the foreground, then residues).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from extractors.motion.blobs import BoxesXyxy, areas, intersections, xywh, xyxy
from extractors.motion.detection import Detections, joined
from extractors.motion.held import FOREGROUND, Mask
from extractors.motion.sizes import LearntSizes

Array = npt.NDArray[np.float64]

LINES_OF_OBJECT = 24
"""The mask is shrunk until an object has about so many lines: enough to place a head, few enough to be quick."""
SINGLE_HEIGHT = (0.72, 1.3)
"""A blob within these heights, in expected ones, may be one object ..."""
SINGLE_WIDTH = (0.4, 1.6)
"""... if it is also within these widths."""
SOLID = 0.88
"""A wide blob that fills more of its convex hull than this is one object of another kind, as a vehicle: between
people who stand side by side the hull has gaps, at the heads and at the feet."""
PART_HEIGHT_MAX = SINGLE_HEIGHT[0]
"""Lower blobs may be parts of one object, and are looked at together with what is near."""
NEAR = (0.25, 0.6)
"""Near is within this share of the expected width to the side and of the expected height above or below."""
BODY = 0.8
"""Width of what should be filled, of the box's width."""
HEAD = (0.4, 0.16)
"""Width and height of the head, of the box's width and height."""
CHEST = 0.65
"""Height of the chest, of the box's height: what hides a person mostly hides the legs."""
EMPTY_COST = 0.6
"""Cost of a pixel in the body that is not foreground, in pixels that are explained."""
HEAD_GAIN = 0.25
"""Gain of a head that is filled, in bodies."""
ABOVE_COST = 0.2
"""Cost of foreground above the head, where the head is filled, in bodies."""
TRACK_GAIN = 0.25
"""Gain of standing where a track is expected, in bodies."""
TRACK_REACH = 0.35
"""How far that reaches: standard deviation in expected widths; twice that in height."""
GAIN_MIN = 0.45
"""A box explains something when its gain is at least so many bodies."""
ROUNDS = 2
"""Times the foreground is shared."""
SHARE_MIN = 0.25
"""A box with less foreground of its own than this share of its body is none, or falls away."""
SHARE_CLEAR = 0.5
"""With more than this it is clearly seen."""
BLOB_TRUST = 0.5
"""How far the size of a single blob counts beside the expected one."""
SCORE_CLEAR, SCORE_HIDDEN = 0.9, 0.4
"""Scores of what is clearly seen, and of what is mostly hidden: that may not begin a track."""
DOUBT = 2.0
"""How much less a box in a shared blob says of its position."""


@dataclass(frozen=True, slots=True, eq=False)
class _Crop:
    """A part of the shrunk mask that is explained on its own."""

    filled: Array
    """0 to 1, `(height, width)`"""
    x: int
    y: int
    picture_wh: Array
    """size of the picture, `(2,)` px"""


def explained(mask: Mask, blobs_xyxy: BoxesXyxy, tracked_xyxy: BoxesXyxy, sizes: LearntSizes) -> Detections | None:
    """The objects in the mask; None where the size of none is known.

    A blob at a place where nothing is known of sizes is one object.

    Args:
        mask: The cleaned mask.
        blobs_xyxy: Its blobs, `(m, 4)` px.
        tracked_xyxy: Where confirmed tracks are expected, `(n, 4)` px.
        sizes: What is known of sizes.
    """
    if not len(blobs_xyxy):
        return Detections.none()
    own = xywh(blobs_xyxy)
    known = sizes.expected(own[:, :2])
    if np.isnan(known.height).all():
        return None
    expected_wh = np.stack([known.width, known.height], axis=1)
    is_cut = _touches_edge(blobs_xyxy, mask.shape)
    found = []
    for members in _clusters(blobs_xyxy, expected_wh, is_cut):
        first = members[0]
        if len(members) == 1 and _is_one(mask, blobs_xyxy[first], own[first, 2:] / expected_wh[first], is_cut[first]):
            found.append(_single(own[first], expected_wh[first], is_cut=bool(is_cut[first])))
        else:
            found.append(_covered(mask, blobs_xyxy[members], tracked_xyxy, sizes))
    return joined(found)


def _is_one(mask: Mask, blob_xyxy: Array, relative_wh: Array, is_cut: np.bool_) -> bool:
    """Whether a blob is one object: of the expected or an unknown size, cut by the picture's edge, or another kind."""
    width, height = relative_wh
    if np.isnan(height):
        return True
    if is_cut:
        is_fitting = width <= SINGLE_WIDTH[1] and height <= SINGLE_HEIGHT[1]
    else:
        is_fitting = SINGLE_WIDTH[0] <= width <= SINGLE_WIDTH[1] and SINGLE_HEIGHT[0] <= height <= SINGLE_HEIGHT[1]
    return bool(is_fitting or (width > SINGLE_WIDTH[1] and _solidity(mask, blob_xyxy) > SOLID))


def _solidity(mask: Mask, blob_xyxy: Array) -> float:
    """Share of the blob's convex hull that it fills, 0 to 1."""
    x1, y1, x2, y2 = blob_xyxy.astype(int)
    outlines, _ = cv2.findContours(mask[y1:y2, x1:x2], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(outlines, key=cv2.contourArea)
    return float(cv2.contourArea(largest) / max(1.0, cv2.contourArea(cv2.convexHull(largest))))


def _single(blob_xywh: Array, expected_wh: Array, *, is_cut: bool) -> Detections:
    """One object, with the blob's middle and a size between the blob's and the expected one."""
    x, y, w, h = blob_xywh
    if is_cut or not w <= SINGLE_WIDTH[1] * expected_wh[0]:
        return Detections.clear(xyxy(blob_xywh[None]), np.array([SCORE_CLEAR]))
    width, height = np.exp(BLOB_TRUST * np.log([w, h]) + (1 - BLOB_TRUST) * np.log(expected_wh))
    box = np.array([x, y + (height - h) / 2, width, height])
    return Detections.clear(xyxy(box[None]), np.array([SCORE_CLEAR]))


def _touches_edge(boxes_xyxy: BoxesXyxy, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    return np.asarray(np.any((boxes_xyxy[:, :2] <= 2) | (boxes_xyxy[:, 2:] >= [shape[1] - 2, shape[0] - 2]), axis=1))


def _clusters(blobs_xyxy: BoxesXyxy, expected_wh: Array, is_cut: npt.NDArray[np.bool_]) -> list[npt.NDArray[np.intp]]:
    """Blobs that are looked at together: those too low for an object with what is near them.

    What the picture's edge cuts is low because of that, and no part of what is near.
    """
    count = len(blobs_xyxy)
    is_part = ((blobs_xyxy[:, 3] - blobs_xyxy[:, 1]) < PART_HEIGHT_MAX * expected_wh[:, 1]) & ~is_cut
    reach = expected_wh * NEAR / 2
    around = blobs_xyxy + np.concatenate([-reach, reach], axis=1)
    is_linked = (intersections(around, around) > 0) & (is_part[:, None] | is_part[None, :])
    label = np.arange(count)
    for i, j in np.argwhere(is_linked):
        label[label == label[max(i, j)]] = label[min(i, j)]
    return [np.flatnonzero(label == value) for value in np.unique(label)]


def _covered(mask: Mask, blobs_xyxy: BoxesXyxy, tracked_xyxy: BoxesXyxy, sizes: LearntSizes) -> Detections:
    """The boxes of expected size that explain the blobs."""
    low, high = blobs_xyxy[:, :2].min(axis=0), blobs_xyxy[:, 2:].max(axis=0)
    foot = np.array([[(low[0] + high[0]) / 2, high[1]]])
    height = sizes.expected(foot).height[0]
    if np.isnan(height):
        return Detections.clear(blobs_xyxy, np.full(len(blobs_xyxy), SCORE_CLEAR))
    factor = max(1, int(height / LINES_OF_OBJECT))
    crop = _crop(mask, low, high, margin=height * 0.6, factor=factor)
    boxes, shares = _greedy(crop, tracked_xyxy, sizes, factor)
    if not len(boxes):
        return Detections.none()
    boxes, shares = _shared_out(crop, boxes, factor)
    is_clear = shares >= SHARE_CLEAR
    keep = shares >= SHARE_MIN
    scores = np.where(is_clear, SCORE_CLEAR, SCORE_HIDDEN)
    doubts = np.full(len(boxes), DOUBT)
    return replace(Detections.clear(boxes[keep], scores[keep]), doubts=doubts[keep])


def _crop(mask: Mask, low: Array, high: Array, margin: float, factor: int) -> _Crop:
    x1, y1 = (np.maximum(low - margin, 0) // factor).astype(int) * factor
    x2, y2 = np.minimum(high + margin, [mask.shape[1], mask.shape[0]]).astype(int)
    width, height = max(1, (x2 - x1) // factor), max(1, (y2 - y1) // factor)
    part = mask[y1 : y1 + height * factor, x1 : x1 + width * factor]
    small = part if factor == 1 else cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    picture_wh = np.array(mask.shape[::-1], float)
    return _Crop(np.asarray(small, np.float64) / FOREGROUND, int(x1), int(y1), picture_wh)


def _greedy(crop: _Crop, tracked_xyxy: BoxesXyxy, sizes: LearntSizes, factor: int) -> tuple[BoxesXyxy, Array]:
    """Boxes, the best explanation first, and the share of each body that it alone explained."""
    feet, boxes = _candidates(crop, sizes, factor)
    if not len(boxes):
        return np.zeros((0, 4)), np.zeros(0)
    local = (boxes - [crop.x, crop.y, crop.x, crop.y]) / factor
    body = _inner(local, BODY, 0.0, 1.0)
    head, above = _inner(local, HEAD[0], 0.0, HEAD[1]), _inner(local, HEAD[0], -HEAD[1], -HEAD[1] / 4)
    whole = _Sums(crop.filled)
    area, head_area, above_area = (_seen_areas(crop, part, factor) for part in (body, head, above))
    empty = area - whole.within(body)
    head_filled = whole.within(head) / head_area
    fixed = HEAD_GAIN * head_filled - ABOVE_COST * whole.within(above) / above_area
    fixed += TRACK_GAIN * _pull(feet, boxes, tracked_xyxy) - EMPTY_COST * empty / area
    left = crop.filled.copy()
    chosen, shares = [], []
    for _ in range(len(boxes)):
        new = _Sums(left).within(body) / area
        gain = np.where(new >= SHARE_MIN, new + fixed, -np.inf)
        best = int(gain.argmax())
        if gain[best] < GAIN_MIN:
            break
        chosen.append(best)
        shares.append(new[best])
        x1, y1, x2, y2 = np.rint(local[best]).astype(int)
        left[max(0, y1) : max(0, y2), max(0, x1) : max(0, x2)] = 0
    return boxes[chosen], np.array(shares)


def _candidates(crop: _Crop, sizes: LearntSizes, factor: int) -> tuple[Array, BoxesXyxy]:
    """Ground contact points on the grid of the crop, and the boxes there whose chest is foreground."""
    rows, columns = np.mgrid[0 : crop.filled.shape[0] + 1, 0 : crop.filled.shape[1] + 1]
    feet = np.stack([columns.ravel() * factor + crop.x, rows.ravel() * factor + crop.y], axis=1).astype(float)
    known = sizes.expected(feet)
    chest = (feet[:, 1] - CHEST * known.height - crop.y) / factor
    with np.errstate(invalid="ignore"):
        is_inside = (chest >= 0) & (chest < crop.filled.shape[0]) & (columns.ravel() < crop.filled.shape[1])
    feet, height, width = feet[is_inside], known.height[is_inside], known.width[is_inside]
    x = ((feet[:, 0] - crop.x) / factor).astype(int)
    is_filled = crop.filled[chest[is_inside].astype(int), x] > 0.5
    feet = feet[is_filled]
    return feet, xyxy(np.column_stack([feet, width[is_filled], height[is_filled]]))


def _inner(boxes: BoxesXyxy, width: float, top: float, bottom: float) -> BoxesXyxy:
    """The part of boxes that has this share of the width and lies between these shares of the height."""
    x, y, w, h = xywh(boxes).T
    upper = y - h
    return np.stack([x - width * w / 2, upper + top * h, x + width * w / 2, upper + bottom * h], axis=1)


def _seen_areas(crop: _Crop, local: BoxesXyxy, factor: int) -> Array:
    """Areas of the parts of boxes that lie in the picture, px² of the crop, at least 1, `(n,)`.

    What the picture's edge cuts off is neither filled nor empty.
    """
    corner = np.array([crop.x, crop.y])
    limits = np.concatenate([-corner, crop.picture_wh - corner]) / factor
    seen = np.clip(local, np.tile(limits[:2], 2), np.tile(limits[2:], 2))
    return np.maximum(areas(seen), 1.0)


class _Sums:
    """Sums over boxes of an image, by its integral image."""

    def __init__(self, image: Array) -> None:
        self._table = cv2.integral(image)
        self._limits = np.array([image.shape[1], image.shape[0]] * 2)

    def within(self, boxes: BoxesXyxy) -> Array:
        """Sum within each box, to whole pixels, `(n,)`."""
        x1, y1, x2, y2 = np.clip(np.rint(boxes), 0, self._limits).astype(int).T
        t = self._table
        return np.asarray(t[y2, x2] - t[y1, x2] - t[y2, x1] + t[y1, x1])


def _pull(feet: Array, boxes: BoxesXyxy, tracked_xyxy: BoxesXyxy) -> Array:
    """How near a track is expected, 0 to 1, `(n,)`."""
    if not len(tracked_xyxy):
        return np.zeros(len(feet))
    tracked = xywh(tracked_xyxy)[:, :2]
    width = (boxes[:, 2] - boxes[:, 0])[:, None]
    dx = (feet[:, None, 0] - tracked[None, :, 0]) / width
    dy = (feet[:, None, 1] - tracked[None, :, 1]) / (2 * width)
    return np.asarray(np.exp(-(dx**2 + dy**2) / (2 * TRACK_REACH**2)).max(axis=1))


def _shared_out(crop: _Crop, boxes: BoxesXyxy, factor: int) -> tuple[BoxesXyxy, Array]:
    """The boxes, each moved to the middle of its share of the foreground, and their shares."""
    rows, columns = np.nonzero(crop.filled > 0.5)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1) * factor + [crop.x, crop.y]
    shares = np.zeros(len(boxes))
    for _ in range(ROUNDS):
        middles, sizes = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
        distance = np.abs(pixels[:, None] - middles[None]) / sizes[None]
        nearest = (distance**2).sum(axis=2).argmin(axis=1)
        seen = areas(np.clip(boxes, 0, np.tile(crop.picture_wh, 2)))
        is_in = (distance[np.arange(len(pixels)), nearest] <= 0.6).all(axis=1)
        for k in range(len(boxes)):
            own = pixels[is_in & (nearest == k)]
            shares[k] = len(own) * factor**2 / (BODY * seen[k])
            if shares[k] < SHARE_CLEAR:
                continue
            low, high = np.quantile(own, [0.05, 0.95], axis=0)
            boxes[k] += np.tile(((low + high) / 2 - middles[k]) / 2, 2)
    return boxes, shares
