"""Tracking scores against truth, plainly: MOTA (Bernardin and Stiefelhagen 2008) and IDF1 (Ristani et al. 2016).

A row is (frame, track id, x1, y1, x2, y2). A pair of boxes may match when their intersection over
union is at least `iou_min`. These are sanity figures for tests, computed the slow and obvious way.
"""

from collections import Counter, defaultdict
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

Rows = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scores:
    mota: float
    idf1: float
    misses: int
    false_positives: int
    switches: int
    truth: int


def iou_matrix(a_xyxy: Rows, b_xyxy: Rows) -> Rows:
    low = np.maximum(a_xyxy[:, None, :2], b_xyxy[None, :, :2])
    high = np.minimum(a_xyxy[:, None, 2:], b_xyxy[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=2)
    areas = [np.prod(x[:, 2:] - x[:, :2], axis=1) for x in (a_xyxy, b_xyxy)]
    return common / (areas[0][:, None] + areas[1][None, :] - common)


def scores(truth: Rows, found: Rows, iou_min: float = 0.5) -> Scores:
    frames = np.unique(np.concatenate([truth[:, 0], found[:, 0]]))
    matched_before: dict[float, float] = {}
    overlaps: Counter[tuple[float, float]] = Counter()
    misses = false_positives = switches = 0
    for frame in frames:
        t, f = truth[truth[:, 0] == frame], found[found[:, 0] == frame]
        iou = iou_matrix(t[:, 2:], f[:, 2:])
        for i, j in np.argwhere(iou >= iou_min):
            overlaps[t[i, 1], f[j, 1]] += 1
        keep = np.array([[matched_before.get(a) == b for b in f[:, 1]] for a in t[:, 1]]).reshape(iou.shape)
        gain = np.where(iou >= iou_min, iou + 10 * keep, 0)
        pairs = [(i, j) for i, j in zip(*linear_sum_assignment(-gain), strict=True) if gain[i, j] > 0]
        for i, j in pairs:
            switches += matched_before.get(t[i, 1], f[j, 1]) != f[j, 1]
            matched_before[t[i, 1]] = f[j, 1]
        misses += len(t) - len(pairs)
        false_positives += len(f) - len(pairs)
    return Scores(
        mota=1 - (misses + false_positives + switches) / len(truth),
        idf1=2 * _identity_matches(overlaps) / (len(truth) + len(found)),
        misses=misses,
        false_positives=false_positives,
        switches=switches,
        truth=len(truth),
    )


def _identity_matches(overlaps: Counter[tuple[float, float]]) -> int:
    rows: defaultdict[float, int] = defaultdict(lambda: len(rows))
    columns: defaultdict[float, int] = defaultdict(lambda: len(columns))
    entries = [(rows[a], columns[b], n) for (a, b), n in overlaps.items()]
    table = np.zeros((len(rows), len(columns)), int)
    for i, j, n in entries:
        table[i, j] = n
    return int(table[linear_sum_assignment(-table)].sum())
