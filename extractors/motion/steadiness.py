"""Whether the camera still looks at the view that it looked at.

Contract: told every picture, looks at some; says when the view is lost (the camera moves, was turned or
covered), and when the camera rests again. Light may change and things may move: what is compared
are the directions of edges, block by block, with a slowly renewed memory of them, and only a large majority of
the blocks that have edges can say that the view is lost, for a while without a break. A picture without
edges (night, fog) says nothing, and the view counts as kept.

    kept --most blocks differ--> doubtful --still, after lost_s--> lost --no change for rest_s--> kept
      ^                             |
      +-------they agree again------+
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image
from extractors.motion.config import MotionConfig

Field = npt.NDArray[np.float32]

LOOK_S = 0.5
"""Time between two looks, s."""
WIDTH = 160
"""Pictures are compared at this width, px: shaking by a hundredth of the picture stays within an edge's blur."""
BLUR_PX = 1.5
"""Standard deviation of that blur, px."""
BLOCKS = (6, 8)
"""Rows and columns of blocks."""
EDGES_MIN = 1.0
"""Root mean square gradient from which a block has edges, grey levels a px: noise has less."""
BLOCKS_MIN = 6
"""With fewer blocks that have edges nothing is said."""
ALIKE_MIN = 0.5
"""Cosine between two blocks' gradients from which they show the same."""
MEMORY_S = 20.0
"""Time constant of the memory of the view, s."""
RENEWAL_DIFFERENT = 0.25
"""What differs is learnt more slowly, by this factor: it may be an object that goes on."""
DIM_SHARE = 0.15
"""Less of its edges' energy than this share: they are gone, not elsewhere."""
REST_AGAIN_S = 30.0
"""A rest that did not last for this long was none: the next must be twice as long, s."""
REST_MAX_S = 60.0
"""Longest rest that is asked for, s."""


@dataclass(frozen=True, slots=True)
class Change:
    """How a view was lost."""

    cause: Literal["moved", "covered", "unknown"]
    share: float
    """share of the blocks with edges that no longer show what they showed"""
    shift_xy: tuple[float, float] | None
    """how far the view was shifted, px of the picture; None where it was not only that"""


@dataclass(frozen=True, slots=True)
class View:
    """What is known of the view in one picture."""

    is_kept: bool = True
    """whether the camera rests and looks at what it looked at"""
    is_doubtful: bool = False
    """whether it may just be losing it: what moves now may be the camera"""
    change: Change | None = None
    """set in the picture in which the view is given up"""
    has_rested: bool = False
    """set in the picture from which on the camera rests again"""


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """A picture as it is compared."""

    grey: Field
    gradients: Field
    """`(rows, columns, 2)`, grey levels a px"""


class Steadiness:
    """Watches one camera's view."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._memory: _Sight | None = None
        self._anchor: _Sight | None = None
        """while the view is lost: what the camera may be resting at"""
        self._since_look_s = LOOK_S
        self._differs_s = 0.0
        self._rest_s = 0.0
        self._rest_needed_s = config.view_rest_s
        self._kept_s = REST_AGAIN_S
        self._is_doubtful = False

    def look(self, image: Image, dt_s: float) -> View:
        """What is known with one more picture, `dt_s` after the one before."""
        self._since_look_s += dt_s
        if self._since_look_s < LOOK_S:
            return View(is_kept=self._anchor is None, is_doubtful=self._is_doubtful)
        step_s, self._since_look_s = self._since_look_s, 0.0
        now = _sight(image)
        if self._memory is None:
            self._memory = now
            return View()
        if self._anchor is None:
            return self._watch(self._memory, now, step_s, image.shape[1] / WIDTH)
        return self._wait(self._anchor, now, step_s)

    def _watch(self, memory: _Sight, now: _Sight, step_s: float, scale: float) -> View:
        """Compare with the memory; renew it, or give it up."""
        alike, has_edges = _compared(memory.gradients, now.gradients)
        share = _share_different(alike, has_edges)
        self._is_doubtful = share > self._config.view_lost_share
        self._differs_s = self._differs_s + step_s if self._is_doubtful else 0.0
        self._kept_s += step_s
        if self._differs_s < self._config.view_lost_s:
            if not self._is_doubtful:
                self._memory = _renewed(memory, now, alike, step_s)
            return View(is_doubtful=self._is_doubtful)
        change = _change(memory, now, share, scale)
        was_no_rest = self._kept_s < REST_AGAIN_S
        self._rest_needed_s = min(2 * self._rest_needed_s, REST_MAX_S) if was_no_rest else self._config.view_rest_s
        self._anchor, self._rest_s, self._is_doubtful = now, 0.0, False
        return View(is_kept=False, change=change)

    def _wait(self, anchor: _Sight, now: _Sight, step_s: float) -> View:
        """Wait until the picture stays the same for long enough."""
        self._rest_s += step_s
        if _share_different(*_compared(anchor.gradients, now.gradients)) > 0.5:
            self._anchor, self._rest_s = now, 0.0
        if self._rest_s < self._rest_needed_s:
            return View(is_kept=False)
        self._memory, self._anchor = now, None
        self._differs_s = self._kept_s = 0.0
        return View(has_rested=True)


def _sight(image: Image) -> _Sight:
    height = max(BLOCKS[0], round(image.shape[0] * WIDTH / image.shape[1]))
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32)
    soft = cv2.GaussianBlur(grey, (0, 0), BLUR_PX)
    scharr = [cv2.Scharr(soft, cv2.CV_32F, dx, dy, scale=1 / 32) for dx, dy in ((1, 0), (0, 1))]
    return _Sight(np.asarray(grey, np.float32), np.stack(scharr, axis=2).astype(np.float32))


def _compared(one: Field, other: Field) -> tuple[Field, npt.NDArray[np.bool_]]:
    """Cosine between the gradients of each block, `BLOCKS`, and whether the first has edges there."""
    product, energy, others = (_blocks((a * b).sum(axis=2)) for a, b in ((one, other), (one, one), (other, other)))
    cosine = product / np.sqrt(np.maximum(energy * others, 1e-6))
    return cosine, energy > EDGES_MIN**2


def _share_different(alike: Field, has_edges: npt.NDArray[np.bool_]) -> float:
    """Share of the blocks with edges that differ; 0 where too few have edges to say it."""
    count = int(has_edges.sum())
    return float((alike[has_edges] < ALIKE_MIN).sum() / count) if count >= BLOCKS_MIN else 0.0


def _renewed(memory: _Sight, now: _Sight, alike: Field, step_s: float) -> _Sight:
    rate = min(1.0, step_s / MEMORY_S)
    blockwise = np.where(alike < ALIKE_MIN, RENEWAL_DIFFERENT * rate, rate).astype(np.float32)
    size = (now.grey.shape[1], now.grey.shape[0])
    rates = np.asarray(cv2.resize(blockwise, size, interpolation=cv2.INTER_NEAREST), np.float32)
    grey = memory.grey + rates * (now.grey - memory.grey)
    return _Sight(grey, memory.gradients + rates[:, :, None] * (now.gradients - memory.gradients))


def _change(memory: _Sight, now: _Sight, share: float, scale: float) -> Change:
    """What befell the view, as far as it can be told."""
    shift = _shift(memory, now)
    if shift is not None:
        return Change("moved", share, (shift[0] * scale, shift[1] * scale))
    energy, left = (float((sight.gradients**2).sum()) for sight in (memory, now))
    return Change("covered" if left < DIM_SHARE * energy else "unknown", share, None)


def _shift(memory: _Sight, now: _Sight) -> tuple[float, float] | None:
    """By how much the view is shifted, px, if shifting it back makes most of the blocks alike."""
    window = cv2.createHanningWindow((now.grey.shape[1], now.grey.shape[0]), cv2.CV_32F)
    (dx, dy), _ = cv2.phaseCorrelate(memory.grey, now.grey, window)
    back = np.array([[1, 0, -dx], [0, 1, -dy]], np.float32)
    size = (now.grey.shape[1], now.grey.shape[0])
    gradients = np.asarray(cv2.warpAffine(now.gradients, back, size), np.float32)
    covered = np.asarray(cv2.warpAffine(np.ones_like(now.grey), back, size), np.float32)
    alike, has_edges = _compared(memory.gradients, gradients)
    judged = has_edges & (_blocks(covered) > 0.9)
    is_shift = int(judged.sum()) >= BLOCKS_MIN and _share_different(alike, judged) < 0.5
    return (float(dx), float(dy)) if is_shift else None


def _blocks(values: Field) -> Field:
    """Mean of each block, `BLOCKS`."""
    return np.asarray(cv2.resize(values, BLOCKS[::-1], interpolation=cv2.INTER_AREA), np.float32)
