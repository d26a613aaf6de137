"""Which track takes which part of the picture.

Blobs are not objects: two people who pass are one blob, and one person behind a lamp post is two. So
confirmed tracks first claim what lies where they are expected: parts of one object are joined, and a
blob that holds several tracks is shared among them. What is left is assigned one to one.

Pure functions of arrays: `decide` returns what each track measures, and which blobs nobody took.

Source of the one-to-one step: H. W. Kuhn, "The Hungarian Method for the Assignment Problem", 1955, as in
`scipy.optimize.linear_sum_assignment`.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from extractors.motion.blobs import BoxesXyxy, areas, intersections, xywh, xyxy

Indices = npt.NDArray[np.intp]

INSIDE = 0.6
"""Share of a box that must lie in another to count as inside."""
SHARED_AREA = 1.35
"""A blob is shared when it is larger than its largest track's box by this factor."""
PART_MARGIN = 0.1
"""Parts of an object are sought in its box and this share of its size around it."""
PART_GROWTH_MAX = 1.25
"""Joined parts may exceed the expected width and height by this factor."""
PART_FILL_MIN = 0.6
"""Parts of one object fill at least this share of the box around them."""
PART_STACKED = 0.5
"""Parts of one object have at least this share of the narrowest one's width in common; what stands side
by side is several objects more often than one."""
MERGED_AREA = 1.7
"""A blob larger than its one track's box by this factor holds something else besides."""
SIZE_COST = 4.0
"""Cost of a change of area by the factor e, in squared Mahalanobis distances of the position."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What was decided for one picture; `-1` stands for nothing."""

    measured_xyxy: BoxesXyxy
    """box that each track measures, `(n, 4)`; NaN where it measures nothing"""
    is_shared: npt.NDArray[np.bool_]
    """whether a track's box was cut out of a blob that holds something else besides, `(n,)`"""
    free_xyxy: BoxesXyxy
    """blobs that no track took, `(k, 4)`"""
    doubts: npt.NDArray[np.float64] | None = None
    """how many times less than a clear view each track's box says, `(n,)`; None where `is_shared` says it"""


def decide(
    expected_xyxy: BoxesXyxy,
    is_confirmed: npt.NDArray[np.bool_],
    is_settled: npt.NDArray[np.bool_],
    blobs_xyxy: BoxesXyxy,
    position_costs: npt.NDArray[np.float64],
    gate: float,
) -> Decision:
    """What each of n tracks measures among m blobs.

    Args:
        expected_xyxy: Where the tracks are expected, `(n, 4)` px.
        is_confirmed: Which tracks are confirmed, `(n,)`.
        is_settled: Which of them have a size that is known: not those that the picture's edge cuts, `(n,)`.
        blobs_xyxy: The blobs, `(m, 4)` px.
        position_costs: Squared Mahalanobis distances between tracks and blobs, `(n, m)`.
        gate: Largest such distance that may be taken.
    """
    measured = np.full((len(expected_xyxy), 4), np.nan)
    is_shared = np.zeros(len(expected_xyxy), bool)
    is_taken = np.zeros(len(blobs_xyxy), bool)
    for blob, members in shared_blobs(expected_xyxy, is_confirmed, blobs_xyxy):
        measured[members] = placed_within(expected_xyxy[members], blobs_xyxy[blob])
        is_shared[members] = True
        is_taken[blob] = True
    for track, parts in joined_parts(expected_xyxy, is_confirmed & ~is_shared, blobs_xyxy, is_taken):
        measured[track] = hull(blobs_xyxy[parts])
        is_taken[parts] = True
    costs = position_costs + SIZE_COST * _size_changes(expected_xyxy, blobs_xyxy)
    allowed = position_costs <= gate
    for chosen in (is_confirmed, ~is_confirmed):  # what is known claims first
        waiting = np.flatnonzero(chosen & np.isnan(measured[:, 0]))
        free = np.flatnonzero(~is_taken)
        for track, blob in assigned(costs, allowed, waiting, free):
            measured[track] = blobs_xyxy[blob]
            is_taken[blob] = True
    is_merged = is_settled & ~is_shared & (areas(measured) > MERGED_AREA * areas(expected_xyxy))
    measured[is_merged] = _anchored(expected_xyxy[is_merged], measured[is_merged])
    covered = _is_covered(blobs_xyxy, measured)
    return Decision(measured, is_shared | is_merged, blobs_xyxy[~is_taken & ~covered])


def shared_blobs(
    expected_xyxy: BoxesXyxy, is_confirmed: npt.NDArray[np.bool_], blobs_xyxy: BoxesXyxy
) -> list[tuple[int, Indices]]:
    """Blobs that hold two confirmed tracks or more, with these tracks."""
    if not len(blobs_xyxy) or is_confirmed.sum() < 2:
        return []
    common = intersections(expected_xyxy, blobs_xyxy)
    share = common / np.maximum(areas(expected_xyxy), 1)[:, None]
    is_home = (share >= INSIDE) & (common == common.max(axis=1, keepdims=True)) & is_confirmed[:, None]
    shared = []
    for blob in np.flatnonzero(is_home.sum(axis=0) >= 2):
        members = np.flatnonzero(is_home[:, blob])
        largest = areas(expected_xyxy[members]).max()
        if areas(blobs_xyxy[[blob]])[0] > SHARED_AREA * largest:
            shared.append((int(blob), members))
    return shared


def placed_within(expected_xyxy: BoxesXyxy, blob_xyxy: npt.NDArray[np.float64]) -> BoxesXyxy:
    """The expected boxes, moved by the least that brings them into the blob, `(n, 4)`."""
    low = blob_xyxy[:2] - expected_xyxy[:, :2]
    high = blob_xyxy[2:] - expected_xyxy[:, 2:]
    shift = np.where(low > high, (low + high) / 2, np.clip(0, np.minimum(low, high), np.maximum(low, high)))
    return np.asarray(expected_xyxy + np.tile(shift, 2))


def joined_parts(
    expected_xyxy: BoxesXyxy,
    is_waiting: npt.NDArray[np.bool_],
    blobs_xyxy: BoxesXyxy,
    is_taken: npt.NDArray[np.bool_],
) -> list[tuple[int, Indices]]:
    """Tracks that are seen in two parts or more, with these blobs."""
    if not len(blobs_xyxy) or not is_waiting.any():
        return []
    margin = PART_MARGIN * np.tile(expected_xyxy[:, 2:] - expected_xyxy[:, :2], 2) * [-1, -1, 1, 1]
    share = intersections(expected_xyxy + margin, blobs_xyxy) / np.maximum(areas(blobs_xyxy), 1)
    is_part = (share >= INSIDE) & is_waiting[:, None] & ~is_taken[None, :]
    is_part &= is_part.sum(axis=0, keepdims=True) == 1  # a part that two tracks could claim is left
    joined = [(int(track), np.flatnonzero(is_part[track])) for track in np.flatnonzero(is_part.sum(axis=1) >= 2)]
    return [(t, parts) for t, parts in joined if _is_one(blobs_xyxy[parts], expected_xyxy[t])]


def _is_one(parts_xyxy: BoxesXyxy, expected_xyxy: npt.NDArray[np.float64]) -> bool:
    """Whether the parts lie above each other, fill their hull, and it is not much larger than expected."""
    whole = hull(parts_xyxy)
    grown = (whole[2:] - whole[:2]) / np.maximum(expected_xyxy[2:] - expected_xyxy[:2], 1)
    filled = areas(parts_xyxy).sum() / areas(whole[None])[0]
    narrowest = (parts_xyxy[:, 2] - parts_xyxy[:, 0]).min()
    in_common = parts_xyxy[:, 2].min() - parts_xyxy[:, 0].max()
    is_stacked = in_common >= PART_STACKED * narrowest
    return bool(is_stacked and np.all(grown <= PART_GROWTH_MAX) and filled >= PART_FILL_MIN)


def hull(boxes_xyxy: BoxesXyxy) -> npt.NDArray[np.float64]:
    """The smallest box that holds all of the boxes, `(4,)`."""
    return np.concatenate([boxes_xyxy[:, :2].min(axis=0), boxes_xyxy[:, 2:].max(axis=0)])


def assigned(
    costs: npt.NDArray[np.float64], allowed: npt.NDArray[np.bool_], tracks: Indices, blobs: Indices
) -> list[tuple[int, int]]:
    """Pairs of track and blob of least total cost, allowed pairs only, as many as can be."""
    if not len(tracks) or not len(blobs):
        return []
    block = np.ix_(tracks, blobs)
    forbidden = 1e6
    table = np.where(allowed[block], np.minimum(costs[block], forbidden / 1e3), forbidden)
    pairs = zip(*linear_sum_assignment(table), strict=True)
    return [(int(tracks[i]), int(blobs[j])) for i, j in pairs if table[i, j] < forbidden]


def _anchored(expected_xyxy: BoxesXyxy, blobs_xyxy: BoxesXyxy) -> BoxesXyxy:
    """Boxes with the ground contact where the expected box fits into its blob, and the blob's size."""
    feet = [placed_within(e[None], b) for e, b in zip(expected_xyxy, blobs_xyxy, strict=True)]
    placed = xywh(np.concatenate([np.zeros((0, 4)), *feet]))
    return xyxy(np.concatenate([placed[:, :2], xywh(blobs_xyxy)[:, 2:]], axis=1))


def _size_changes(expected_xyxy: BoxesXyxy, blobs_xyxy: BoxesXyxy) -> npt.NDArray[np.float64]:
    a, b = np.maximum(areas(expected_xyxy), 1), np.maximum(areas(blobs_xyxy), 1)
    return np.asarray(np.abs(np.log(a)[:, None] - np.log(b)[None, :]))


def _is_covered(blobs_xyxy: BoxesXyxy, measured_xyxy: BoxesXyxy) -> npt.NDArray[np.bool_]:
    """Blobs that lie within what some track measured: parts of it, not objects of their own."""
    seen = measured_xyxy[~np.isnan(measured_xyxy[:, 0])]
    if not len(seen) or not len(blobs_xyxy):
        return np.zeros(len(blobs_xyxy), bool)
    share = intersections(blobs_xyxy, seen) / np.maximum(areas(blobs_xyxy), 1)[:, None]
    return np.asarray(share.max(axis=1) >= INSIDE)
