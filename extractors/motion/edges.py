"""Whether two pictures show the same, whatever the light: the directions of edges, block by block.

Light and shadow change how strong edges are, and hardly their direction; what comes in front brings its own.
Pure functions of small grey pictures.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image

Field = npt.NDArray[np.float32]

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

DIFFERENT_MAX = 0.5
"""Pictures show the same if no more than this share of the blocks differs: of one view in other light and with others
in it less does, of two views nearly all."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A picture as it is compared."""

    grey: Field
    gradients: Field
    """`(rows, columns, 2)`, grey levels a px"""


def sight(image: Image) -> Sight:
    """The picture as it is compared."""
    height = max(BLOCKS[0], round(image.shape[0] * WIDTH / image.shape[1]))
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32)
    soft = cv2.GaussianBlur(grey, (0, 0), BLUR_PX)
    scharr = [cv2.Scharr(soft, cv2.CV_32F, dx, dy, scale=1 / 32) for dx, dy in ((1, 0), (0, 1))]
    return Sight(np.asarray(grey, np.float32), np.stack(scharr, axis=2).astype(np.float32))


def compared(one: Field, other: Field) -> tuple[Field, npt.NDArray[np.bool_]]:
    """Cosine between the gradients of each block, `BLOCKS`, and whether the first has edges there."""
    product, energy, others = (in_blocks((a * b).sum(axis=2)) for a, b in ((one, other), (one, one), (other, other)))
    cosine = product / np.sqrt(np.maximum(energy * others, 1e-6))
    return cosine, energy > EDGES_MIN**2


def share_different(alike: Field, has_edges: npt.NDArray[np.bool_]) -> float:
    """Share of the blocks with edges that differ; 0 where too few have edges to say it."""
    count = int(has_edges.sum())
    return float((alike[has_edges] < ALIKE_MIN).sum() / count) if count >= BLOCKS_MIN else 0.0


def is_alike(one: Sight, other: Sight) -> bool:
    """Whether half of the blocks in which the first has edges, or more, show the same.

    Where it has too few, those of the other count: a lit picture is not alike a dark one.
    """
    alike, has_edges = compared(one.gradients, other.gradients)
    if has_edges.sum() < BLOCKS_MIN:
        alike, has_edges = compared(other.gradients, one.gradients)
    return share_different(alike, has_edges) <= DIFFERENT_MAX


def is_same_view(one: Sight, other: Sight, *, is_faint: bool = False) -> bool:
    """Whether half of the blocks in which the first has edges, or more, show the same, though in another light.

    Where the other is faint only blocks count in which both have edges: those that lost theirs say nothing. The night's
    infrared light may turn contrasts around, as of leaves before a wall: then edges have their places and orientations,
    and the opposite directions.
    """
    judged = edges_in(one) & edges_in(other) if is_faint else edges_in(one)
    alike = (compared(of(one), of(other))[0] for of in (_directions, _orientations))
    return min(share_different(each, judged) for each in alike) <= DIFFERENT_MAX


def edges_in(seen: Sight) -> npt.NDArray[np.bool_]:
    """Which blocks have edges."""
    return in_blocks((seen.gradients**2).sum(axis=2)) > EDGES_MIN**2


def _directions(seen: Sight) -> Field:
    return seen.gradients


def _orientations(seen: Sight) -> Field:
    """Gradients with the angle doubled, so that opposite ones are the same."""
    x, y = seen.gradients[:, :, 0], seen.gradients[:, :, 1]
    length = np.maximum(np.hypot(x, y), 1e-6)
    return np.stack([(x * x - y * y) / length, 2 * x * y / length], axis=2)


def in_blocks(values: Field) -> Field:
    """Mean of each block, `BLOCKS`."""
    return np.asarray(cv2.resize(values, BLOCKS[::-1], interpolation=cv2.INTER_AREA), np.float32)
