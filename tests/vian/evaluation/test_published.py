"""Real truth: the published calibration and annotation of the PETS clip, and the folder of scenes."""

from pathlib import Path

import numpy as np
import pytest

from vian.evaluation.estimators import estimators
from vian.evaluation.files import read_boxes, write_mot
from vian.evaluation.judging import judged, summaries
from vian.evaluation.scenes import read_scenes, read_truth
from vian.evaluation.tsai import read_camera

PETS = "video/pets2009_s2l1_view001"


def test_the_horizon_of_the_published_calibration(vian_data: Path) -> None:
    line = read_truth(vian_data / PETS / "View_001.xml", 480, 360)
    # The best line depends on where the curve is sampled, by a tenth of a pixel.
    assert line.slope == pytest.approx(-0.04857, abs=1e-4)
    assert line.offset == pytest.approx(-30.77, abs=0.1)


def test_annotated_people_walk_on_the_ground_before_the_camera(vian_data: Path) -> None:
    camera = read_camera(vian_data / PETS / "View_001.xml")
    boxes = read_boxes(vian_data / PETS / "PETS2009-S2L1.xml", fps=7)
    places = camera.ground_of(boxes.feet_xy)
    assert (len(boxes), len(np.unique(boxes.track_id))) == (4650, 19)
    assert np.ptp(places, axis=0).max() < 40
    one = boxes.where(np.flatnonzero(boxes.track_id == 9))
    way = np.hypot(*np.diff(camera.ground_of(one.feet_xy)[::7], axis=0).T)
    assert 0.3 < np.median(way) < 2.5  # a walk, m a second


def test_boxes_survive_a_file(vian_data: Path, tmp_path: Path) -> None:
    boxes = read_boxes(vian_data / PETS / "PETS2009-S2L1.xml", fps=7)
    write_mot(boxes, tmp_path / "found.txt")
    again = read_boxes(tmp_path / "found.txt", fps=7)
    np.testing.assert_array_equal(again.frame, boxes.frame)
    np.testing.assert_array_equal(again.time_us, boxes.time_us)
    np.testing.assert_allclose(again.xyxy, boxes.xyxy, atol=2e-3)


@pytest.mark.slow
def test_references_over_many_scenes(vian_data: Path) -> None:
    scenes = read_scenes(vian_data / "horizon/tracks_10")
    assert len(scenes) == 10
    for each in summaries(list(judged(scenes, estimators(["A", "B"])))):
        assert each.median < 0.25
