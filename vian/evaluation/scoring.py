"""Scores of tracks against truth: HOTA, MOTA and IDF1.

Own code, since no library with HOTA can be installed beside the headless OpenCV
(docs/decisions/0041-truth-and-evaluation.md); tests hold it to the figures of TrackEval.

Source: HOTA by Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 2021,
equations 1 to 20; MOTA by Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance: The CLEAR
MOT Metrics", 2008, section 2.1; IDF1 by Ristani et al., "Performance Measures and a Data Set for Multi-Target,
Multi-Camera Tracking", 2016, section 3.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from vian.evaluation.boxes import Boxes

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
IOU_MIN = 0.5
"""Intersection over union from which two boxes may be the same object, for MOTA and IDF1."""
ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Intersections over union that HOTA is the mean over."""
EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, slots=True)
class Scores:
    """How good tracks are; shares are 0 to 1, MOTA may be negative."""

    hota: float
    detection: float
    """DetA, how well objects are found"""
    association: float
    """AssA, how well their identity is kept"""
    mota: float
    idf1: float
    misses: int
    false_positives: int
    switches: int
    truth_boxes: int
    found_boxes: int
    truth_tracks: int
    found_tracks: int


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """One frame: rows of truth and found tracks, counted from 0, and the boxes' similarity."""

    truth: Ints
    found: Ints
    iou: Floats


def scores(truth: Boxes, found: Boxes) -> Scores:
    """Scores of the found tracks, over all frames of either."""
    truth_ids, truth_rows = np.unique(truth.track_id, return_inverse=True)
    found_ids, found_rows = np.unique(found.track_id, return_inverse=True)
    pictures = list(_pictures(truth, truth_rows, found, found_rows))
    shape = (len(truth_ids), len(found_ids))
    hota, detection, association = _hota(pictures, shape)
    misses, false_positives, switches = _clear(pictures, shape[0])
    return Scores(
        hota=hota,
        detection=detection,
        association=association,
        mota=1 - (misses + false_positives + switches) / max(1, len(truth)),
        idf1=_idf1(pictures, shape),
        misses=misses,
        false_positives=false_positives,
        switches=switches,
        truth_boxes=len(truth),
        found_boxes=len(found),
        truth_tracks=shape[0],
        found_tracks=shape[1],
    )


def iou_of(a_xyxy: Floats, b_xyxy: Floats) -> Floats:
    """Intersections over union, `(n, m)`, of boxes `(n, 4)` and `(m, 4)`."""
    low = np.maximum(a_xyxy[:, None, :2], b_xyxy[None, :, :2])
    high = np.minimum(a_xyxy[:, None, 2:], b_xyxy[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=2)
    areas = [np.prod(each[:, 2:] - each[:, :2], axis=1) for each in (a_xyxy, b_xyxy)]
    return np.asarray(common / (areas[0][:, None] + areas[1][None, :] - common))


def pairs_of(truth: Boxes, found: Boxes) -> tuple[Ints, Ints]:
    """Rows of truth and of found boxes that are the same object in the same frame, one to one."""
    rows: tuple[list[int], list[int]] = ([], [])
    for frame in np.intersect1d(truth.frame, found.frame):
        here, there = np.flatnonzero(truth.frame == frame), np.flatnonzero(found.frame == frame)
        iou = iou_of(truth.xyxy[here], found.xyxy[there])
        for i, j in _assigned(np.where(iou >= IOU_MIN, iou, 0)):
            rows[0].append(int(here[i]))
            rows[1].append(int(there[j]))
    return np.array(rows[0], np.intp), np.array(rows[1], np.intp)


def _pictures(truth: Boxes, truth_rows: Ints, found: Boxes, found_rows: Ints) -> Iterator[_Picture]:
    frames = np.union1d(truth.frame, found.frame)
    starts = [
        (np.searchsorted(each.frame, frames), np.searchsorted(each.frame, frames, "right")) for each in (truth, found)
    ]
    for t0, t1, f0, f1 in zip(*starts[0], *starts[1], strict=True):
        yield _Picture(truth_rows[t0:t1], found_rows[f0:f1], iou_of(truth.xyxy[t0:t1], found.xyxy[f0:f1]))


def _hota(pictures: list[_Picture], shape: tuple[int, int]) -> tuple[float, float, float]:
    """HOTA, DetA and AssA, means over alpha."""
    alike = _alike(pictures, shape)
    truth_count, found_count = _counts(pictures, shape)
    matches = np.zeros((len(ALPHAS), *shape))
    for picture in pictures:
        here = np.ix_(picture.truth, picture.found)
        # Matching favours pairs that are alike over the whole sequence: section 3.3.
        i, j = linear_sum_assignment(-alike[here] * picture.iou)
        is_match = picture.iou[i, j] >= ALPHAS[:, None] - EPS
        for a, hits in enumerate(is_match):
            matches[a, picture.truth[i[hits]], picture.found[j[hits]]] += 1
    tp = matches.sum(axis=(1, 2))
    det = tp / np.maximum(1, truth_count.sum() + found_count.sum() - tp)
    ass_c = matches / np.maximum(1, truth_count[:, None] + found_count[None, :] - matches)
    ass = (matches * ass_c).sum(axis=(1, 2)) / np.maximum(1, tp)
    return float(np.sqrt(det * ass).mean()), float(det.mean()), float(ass.mean())


def _alike(pictures: list[_Picture], shape: tuple[int, int]) -> Floats:
    """How alike two tracks are over the whole sequence: their soft matches over all their boxes."""
    soft = np.zeros(shape)
    for picture in pictures:
        iou = picture.iou
        others = iou.sum(axis=0, keepdims=True) + iou.sum(axis=1, keepdims=True) - iou
        soft[np.ix_(picture.truth, picture.found)] += np.divide(iou, others, out=np.zeros_like(iou), where=others > EPS)
    truth_count, found_count = _counts(pictures, shape)
    return np.asarray(soft / (truth_count[:, None] + found_count[None, :] - soft))


def _counts(pictures: list[_Picture], shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Boxes of each true and of each found track."""
    counts = np.zeros(shape[0]), np.zeros(shape[1])
    for picture in pictures:
        counts[0][picture.truth] += 1
        counts[1][picture.found] += 1
    return counts


def _clear(pictures: list[_Picture], truth_tracks: int) -> tuple[int, int, int]:
    """Misses, false positives and switches of identity."""
    misses = false_positives = switches = 0
    last = np.full(truth_tracks, -1)  # what each true track was matched with when it was last matched
    before = np.full(truth_tracks, -1)  # ... in the frame before
    for picture in pictures:
        is_kept = before[picture.truth][:, None] == picture.found[None, :]
        gain = np.where(picture.iou >= IOU_MIN - EPS, picture.iou + 1000 * is_kept, 0)
        matched = _assigned(gain)
        i, j = picture.truth[matched[:, 0]], picture.found[matched[:, 1]]
        switches += int(((last[i] >= 0) & (last[i] != j)).sum())
        before[:] = -1
        last[i] = before[i] = j
        misses += len(picture.truth) - len(i)
        false_positives += len(picture.found) - len(i)
    return misses, false_positives, switches


def _idf1(pictures: list[_Picture], shape: tuple[int, int]) -> float:
    """Share of boxes that one lasting identity explains."""
    common = np.zeros(shape)
    for picture in pictures:
        common[np.ix_(picture.truth, picture.found)] += picture.iou >= IOU_MIN
    boxes = sum(len(picture.truth) + len(picture.found) for picture in pictures)
    return float(2 * common[linear_sum_assignment(-common)].sum() / max(1, boxes))


def _assigned(gain: Floats) -> Ints:
    """Pairs of rows and columns of most gain in all, `(k, 2)`; none without gain."""
    i, j = linear_sum_assignment(-gain)
    is_gained = gain[i, j] > 0
    return np.stack([i[is_gained], j[is_gained]], axis=1)
