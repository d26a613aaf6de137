"""Scores are TrackEval's, which was run in an environment of its own on the cases of `trackeval.json` (1.3.0)."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vian.evaluation.boxes import Boxes
from vian.evaluation.scoring import pairs_of, scores

CASES: list[dict[str, Any]] = json.loads((Path(__file__).parent / "trackeval.json").read_text())


def boxes(rows: list[list[float]]) -> Boxes:
    found = np.array(rows, float).reshape(-1, 6)
    found = found[np.lexsort((found[:, 1], found[:, 0]))]
    numbers = found[:, :2].astype(np.int64)
    return Boxes(numbers[:, 0], numbers[:, 1], found[:, 2:], np.ones(len(found)), numbers[:, 0] * 40_000)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['figures']['hota']:.2f}")
def test_the_figures_are_those_of_trackeval(case: dict[str, Any]) -> None:
    found = scores(boxes(case["truth"]), boxes(case["found"]))
    for name, figure in case["figures"].items():
        assert getattr(found, name) == pytest.approx(figure, abs=1e-12), name


def test_truth_scores_one_against_itself() -> None:
    truth = boxes(CASES[1]["truth"])
    found = scores(truth, truth)
    assert (found.hota, found.mota, found.idf1) == pytest.approx((1, 1, 1))
    assert (found.misses, found.false_positives, found.switches) == (0, 0, 0)


def test_nothing_found_scores_nothing() -> None:
    found = scores(boxes(CASES[1]["truth"]), boxes([]))
    assert (found.hota, found.mota, found.idf1) == (0, 0, 0)


def test_boxes_of_the_same_object_are_paired_one_to_one() -> None:
    truth = boxes([[0, 1, 0, 0, 10, 10], [0, 2, 4, 0, 14, 10], [1, 1, 0, 0, 10, 10]])
    found = boxes([[0, 7, 3, 0, 13, 10], [0, 8, 1, 0, 11, 10], [2, 7, 0, 0, 10, 10]])
    here, there = pairs_of(truth, found)
    assert [(truth.track_id[i], found.track_id[j]) for i, j in zip(here, there, strict=True)] == [(1, 8), (2, 7)]
