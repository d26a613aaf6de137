"""Which detection belongs to which track, where a detection is one object.

Pure functions of arrays. The rounds, each an assignment of least total cost: known tracks take sure
detections where they are expected, then tracks that are not yet confirmed do, on equal terms with those that
the picture's edge cuts: who enters where another leaves is told apart by what fits, and not by age. What they left
goes to known tracks that lie near where they were last seen, then to those that look alike and can have come
there, unless they were at the edge, where who is not seen has left. Doubtful detections go to known tracks only.
What is sure and untaken begins a track, unless a track has that place.

Sources: two rounds by score: Y. Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every
Detection Box", ECCV 2022, algorithm 1. The look back at where a track was last seen: J. Cao et al.,
"Observation-Centric SORT", CVPR 2023, section 4.2 (observation-centric recovery).
"""

import numpy as np
import numpy.typing as npt

from extractors.motion.association import Decision, assigned
from extractors.motion.blobs import BoxesXyxy, areas, intersections
from extractors.motion.config import MotionConfig
from extractors.motion.detection import Detections

POSITION_COST = 0.5
"""Cost of a position at the gate, in units of no overlap at all."""


def matched(
    expected_xyxy: BoxesXyxy,
    last_xyxy: BoxesXyxy,
    is_confirmed: npt.NDArray[np.bool_],
    is_at_edge: npt.NDArray[np.bool_],
    found: Detections,
    position_costs: npt.NDArray[np.float64],
    away: npt.NDArray[np.float64],
    unlike: npt.NDArray[np.float64],
    config: MotionConfig,
) -> Decision:
    """What each of n tracks measures among m detections.

    Args:
        expected_xyxy: Where the tracks are expected, `(n, 4)` px.
        last_xyxy: Where they were last seen, `(n, 4)` px.
        is_confirmed: Which tracks are confirmed, `(n,)`.
        is_at_edge: Which the picture's edge cut when they were last clearly seen: they may have left, `(n,)`.
        found: The detections.
        position_costs: Squared Mahalanobis distances between tracks and detections, `(n, m)`.
        away: How far detections are from where tracks were last seen, in what objects can move since, `(n, m)`.
        unlike: How much they differ in appearance, 0 to 1, `(n, m)`.
        config: The parameters.
    """
    boxes = found.boxes_xyxy
    here, before = overlaps(expected_xyxy, boxes), overlaps(last_xyxy, boxes)
    is_near = position_costs <= config.gate
    costs = 1 - here + POSITION_COST * np.minimum(position_costs / config.gate, 1) + config.appearance_cost * unlike
    is_sure = found.scores >= config.score_sure
    is_expected = is_near & (here >= config.overlap_min)
    is_settled = is_confirmed & ~is_at_edge
    rounds = (
        (costs, is_expected, is_settled, is_sure),
        (costs, is_expected, ~is_settled, is_sure),
        (costs, here >= config.overlap_min, is_settled, is_sure),
        (1 - before + config.appearance_cost * unlike, before >= config.overlap_min, is_settled, is_sure),
        (away + config.appearance_cost * unlike, (away <= 1) & (unlike <= config.unlike_max), is_settled, is_sure),
        (costs, here >= config.overlap_doubtful_min, is_confirmed, ~is_sure & (found.scores >= config.score_min)),
        (costs, is_near | (here >= config.overlap_min), ~is_confirmed, is_sure),
    )
    measured = np.full((len(expected_xyxy), 4), np.nan)
    doubts = np.ones(len(expected_xyxy))
    is_taken = np.zeros(len(found), bool)
    for table, allowed, whose, which in rounds:
        waiting = np.flatnonzero(whose & np.isnan(measured[:, 0]))
        free = np.flatnonzero(which & ~is_taken)
        for track, detection in assigned(table, allowed, waiting, free):
            measured[track], doubts[track] = boxes[detection], found.doubts[detection]
            is_taken[detection] = True
    is_new = (found.scores >= config.score_new) & ~is_taken & ~_is_doubled(boxes, measured, config.overlap_double)
    return Decision(measured, doubts > 1, boxes[is_new], doubts)


def overlaps(a_xyxy: BoxesXyxy, b_xyxy: BoxesXyxy) -> npt.NDArray[np.float64]:
    """Intersection over union of each of n boxes with each of m, `(n, m)`."""
    common = intersections(a_xyxy, b_xyxy)
    return np.asarray(common / np.maximum(areas(a_xyxy)[:, None] + areas(b_xyxy)[None, :] - common, 1e-9))


def _is_doubled(boxes: BoxesXyxy, measured: BoxesXyxy, overlap: float) -> npt.NDArray[np.bool_]:
    """Which boxes lie where a track has just been measured: the same object, found twice."""
    seen = measured[~np.isnan(measured[:, 0])]
    if not len(seen) or not len(boxes):
        return np.zeros(len(boxes), bool)
    return np.asarray(overlaps(boxes, seen).max(axis=1) >= overlap)
