"""Whether the camera still looks at the view that it looked at.

Contract: told every picture, looks at some; says when the view is lost (the camera moves, was turned or
covered), and when the camera rests again. Light may change and things may move: what is compared
are the directions of edges, block by block, with a slowly renewed memory of them, and only a large majority of
the blocks that have edges can say that the view is lost, for a while without a break. A picture without
edges (night, fog) says nothing, and the view counts as kept.

    kept --most blocks differ--> doubtful --still, after lost_s--> lost --no change for rest_s*--> kept
      ^                             |
      +-------they agree again------+

What covered the view (a lorry, a hand, the dark) and what is another view cannot be told apart when it is lost. It can
when the picture stays the same again: if it agrees with the memory of the view that was lost, nothing has changed; else
the camera was moved, which takes a longer rest (*), so that a lorry may stand there for a while. In the dark that waits
for light; where nobody will look again, the last picture decides.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from extractors.media import Image
from extractors.motion.config import MotionConfig
from extractors.motion.edges import (
    ALIKE_MIN,
    BLOCKS_MIN,
    DIFFERENT_MAX,
    WIDTH,
    Field,
    Sight,
    compared,
    edges_in,
    in_blocks,
    is_alike,
    is_same_view,
    share_different,
    sight,
)

LOOK_S = 0.5
"""Time between two looks, s."""
MEMORY_S = 20.0
"""Time constant of the memory of the view, s."""
RENEWAL_DIFFERENT = 0.25
"""What differs is learnt more slowly, by this factor: it may be an object that goes on."""
DIM_SHARE = 0.15
"""Less of its edges' energy than this share: they may be gone, not elsewhere."""
DARK_SHARE = 0.5
"""Less of its brightness than this share: it is dark."""
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
    """set in the picture in which the view is given up, or from which on it is known that another one came after it"""
    has_rested: bool = False
    """set in the picture from which on the camera rests again"""


class Steadiness:
    """Watches one camera's view."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._memory: Sight | None = None
        self._before: Sight | None = None
        """the view that was lost, until it is known whether it came back"""
        self._newest: tuple[Sight, float] | None = None
        """what was seen last, and px of the picture for one of that"""
        self._rest: _Rest | None = None
        """watched from the loss of a view until it is known whether it came back"""
        self._is_lost = False
        self._since_look_s = LOOK_S
        self._differs_s = 0.0
        self._rest_needed_s = config.view_rest_s
        self._kept_s = REST_AGAIN_S
        self._is_doubtful = False

    def look(self, image: Image, dt_s: float) -> View:
        """What is known with one more picture, `dt_s` after the one before."""
        self._since_look_s += dt_s
        if self._since_look_s < LOOK_S:
            return View(is_kept=not self._is_lost, is_doubtful=self._is_doubtful)
        step_s, self._since_look_s = self._since_look_s, 0.0
        now, scale = sight(image), image.shape[1] / WIDTH
        self._newest = now, scale
        if self._memory is None:
            self._memory = now
            return View()
        if self._rest is not None:
            self._rest.look(now, step_s)
        return self._wait(now, scale) if self._is_lost else self._watch(self._memory, now, step_s, scale)

    def end(self) -> Change | None:
        """That the view was another than the one that was lost, when nobody will look again; None also in the dark."""
        return self._judged(*self._newest) if self._newest is not None else None

    def _watch(self, memory: Sight, now: Sight, step_s: float, scale: float) -> View:
        """Compare with the memory; renew it, or give it up."""
        alike, has_edges = compared(memory.gradients, now.gradients)
        share = share_different(alike, has_edges)
        self._is_doubtful = share > self._config.view_lost_share
        self._differs_s = self._differs_s + step_s if self._is_doubtful else 0.0
        self._kept_s += step_s
        if self._differs_s >= self._config.view_lost_s:
            return self._lose(memory, now, share, scale)
        if self._is_doubtful:
            return View(is_doubtful=True)
        self._memory = _renewed(memory, now, alike, step_s)
        return View(change=self._other_view(now, scale))

    def _lose(self, memory: Sight, now: Sight, share: float, scale: float) -> View:
        """Give the view up."""
        change = _change(memory, now, share, scale)
        self._before = None if change.cause == "moved" else self._before or memory
        was_no_rest = self._kept_s < REST_AGAIN_S
        self._rest_needed_s = min(2 * self._rest_needed_s, REST_MAX_S) if was_no_rest else self._config.view_rest_s
        self._is_lost, self._is_doubtful, self._rest = True, False, _Rest(now)
        return View(is_kept=False, change=change)

    def _wait(self, now: Sight, scale: float) -> View:
        """Wait until the picture stays the same for long enough; longer if it shows another view than the lost one."""
        if not self._is_settled(now):
            return View(is_kept=False)
        self._memory, self._is_lost = now, False
        self._differs_s = self._kept_s = 0.0
        return View(has_rested=True, change=self._other_view(now, scale))

    def _other_view(self, now: Sight, scale: float) -> Change | None:
        """That the picture rests at another view than the one that was lost; None also where that is not known yet."""
        return self._judged(now, scale) if self._is_settled(now) else None

    def _judged(self, now: Sight, scale: float) -> Change | None:
        """That this is another view than the one that was lost; in the dark that stays open."""
        before = self._before
        if before is None or _is_dim(before, now):
            return None
        is_other = self._is_other(now)
        self._before = self._rest = None
        if not is_other:
            return None
        shift = _shift(before, now)
        share = share_different(*compared(before.gradients, now.gradients))
        return Change("moved", share, None if shift is None else (shift[0] * scale, shift[1] * scale))

    def _is_other(self, now: Sight) -> bool:
        """Whether this is certainly another view than the one that was lost."""
        before = self._before
        if before is None or _is_dim(before, now):
            return False
        return not is_same_view(before, now, is_faint=_is_faint(before, now))

    def _is_settled(self, now: Sight) -> bool:
        """Whether the picture has stayed the same for long enough: longer if it shows another view than the lost."""
        needed_s = max(self._rest_needed_s, self._config.view_other_s if self._is_other(now) else 0.0)
        return self._rest is not None and self._rest.lasted_s >= needed_s


class _Rest:
    """How long the picture has stayed the same."""

    def __init__(self, anchor: Sight) -> None:
        self._anchor = anchor
        self.lasted_s = 0.0

    def look(self, now: Sight, step_s: float) -> None:
        """Take in the picture that came `step_s` after the one before."""
        self.lasted_s += step_s
        if not is_alike(self._anchor, now):
            self._anchor, self.lasted_s = now, 0.0


def _renewed(memory: Sight, now: Sight, alike: Field, step_s: float) -> Sight:
    rate = min(1.0, step_s / MEMORY_S)
    blockwise = np.where(alike < ALIKE_MIN, RENEWAL_DIFFERENT * rate, rate).astype(np.float32)
    size = (now.grey.shape[1], now.grey.shape[0])
    rates = np.asarray(cv2.resize(blockwise, size, interpolation=cv2.INTER_NEAREST), np.float32)
    grey = memory.grey + rates * (now.grey - memory.grey)
    return Sight(grey, memory.gradients + rates[:, :, None] * (now.gradients - memory.gradients))


def _change(memory: Sight, now: Sight, share: float, scale: float) -> Change:
    """What befell the view, as far as it can be told."""
    shift = _shift(memory, now)
    if shift is not None:
        return Change("moved", share, (shift[0] * scale, shift[1] * scale))
    return Change("covered" if _is_dim(memory, now) else "unknown", share, None)


def _is_dim(memory: Sight, now: Sight) -> bool:
    """Whether the edges are gone, so that nothing can be said of where they are.

    A picture as bright as it was that has some is one of less contrast. In the dark lamps have edges of their own, and
    strong ones: there as many blocks must have edges as decide between two views.
    """
    had = edges_in(memory)
    common = int((had & edges_in(now)).sum())
    if now.grey.mean() < DARK_SHARE * memory.grey.mean():
        return common < max(BLOCKS_MIN, DIFFERENT_MAX * int(had.sum()))
    return _is_faint(memory, now) and common < BLOCKS_MIN


def _is_faint(memory: Sight, now: Sight) -> bool:
    energy, left = (float((sight.gradients**2).sum()) for sight in (memory, now))
    return left < DIM_SHARE * energy


def _shift(memory: Sight, now: Sight) -> tuple[float, float] | None:
    """By how much the view is shifted, px, if shifting it back makes most of the blocks alike."""
    window = cv2.createHanningWindow((now.grey.shape[1], now.grey.shape[0]), cv2.CV_32F)
    # It writes into what it is given.
    (dx, dy), _ = cv2.phaseCorrelate(memory.grey.copy(), now.grey.copy(), window)
    back = np.array([[1, 0, -dx], [0, 1, -dy]], np.float32)
    size = (now.grey.shape[1], now.grey.shape[0])
    gradients = np.asarray(cv2.warpAffine(now.gradients, back, size), np.float32)
    covered = np.asarray(cv2.warpAffine(np.ones_like(now.grey), back, size), np.float32)
    alike, has_edges = compared(memory.gradients, gradients)
    judged = has_edges & (in_blocks(covered) > 0.9)
    is_shift = int(judged.sum()) >= BLOCKS_MIN and share_different(alike, judged) < 0.5
    return (float(dx), float(dy)) if is_shift else None
