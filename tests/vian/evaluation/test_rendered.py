"""From pictures to a camera, and from exact boxes to one, on scenes that were rendered or computed."""

from pathlib import Path

import numpy as np
import pytest

from extractors.calibration import CalibrationConfig, CalibrationFold, Camera
from extractors.horizon import FrameSize, HorizonConfig, TrackPoints, estimated
from extractors.scene import square
from tests.extractors.calibration.decay import CAMERAS as DECAY_CAMERAS
from tests.extractors.synthetic import homography_error, walks
from vian.evaluation.lines import Horizon, error_of
from vian.evaluation.rendered import rendered, true_boxes

CAMERAS = {
    "rolled, horizon above the picture": Camera(620.0, 0.42, 0.07, 5.0, 640, 360),
    "horizon in the picture": Camera(640.0, 0.22, 0.0, 4.0, 640, 360),
    "portrait": Camera(620.0, 0.35, 0.03, 4.5, 360, 640),
    "wide": Camera(430.0, 0.55, 0.05, 5.0, 640, 480),
    "narrow": Camera(1000.0, 0.30, 0.0, 8.0, 640, 480),
} | dict(DECAY_CAMERAS)


OF_LINES = HorizonConfig(depth=0.0, depth_spread=0.005)
"""Exact boxes of upright lines, which have no depth."""


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_exact_boxes_give_the_horizon_and_the_ground(camera: Camera) -> None:
    errors = np.array([_errors_of_exact_boxes(camera, seed) for seed in (1, 2, 3)])
    # What is left is the pull of priors, and of people whose speed on a bent way is not that of the straight one.
    assert (np.median(errors, axis=0) < [0.005, 0.01]).all(), errors


def _errors_of_exact_boxes(camera: Camera, seed: int) -> tuple[float, float]:
    """Of the horizon, image heights, and of positions on the floor, of their distance."""
    seen, size = walks(camera, seed=seed), (camera.width, camera.height)
    columns = (seen.time_us, seen.track_id, seen.time_us // 200_000, seen.boxes_xyxy, seen.confidence)
    found = estimated(TrackPoints(*columns), FrameSize(*size), OF_LINES)
    assert found is not None
    line = Horizon(found.fit.line.slope, found.fit.line.offset)
    fold = CalibrationFold(CalibrationConfig(camera=OF_LINES, box_share=0.02), size)
    fold.add_points(seen.time_us, seen.track_id, seen.boxes_xyxy, seen.confidence)
    fold.finish()
    assert fold.said is not None
    return error_of(line, Horizon(*camera.horizon), *size), homography_error(camera, fold.said.camera)


def test_true_boxes_are_the_scenes() -> None:
    scene = square(people=3, runners=0)
    boxes, places = true_boxes(scene)
    assert len(boxes) == len(places)
    assert set(np.unique(boxes.track_id)) == {1, 2, 3}
    assert (boxes.time_us == 100_000 * boxes.frame).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rolled, horizon above the picture", "portrait"])
def test_pictures_give_a_horizon_a_height_and_speeds(name: str, tmp_path: Path) -> None:
    """Bounds are about twice of what is reached: boxes here have depth, gaits, noise and the extractor's own errors."""
    found = rendered(square(CAMERAS[name], people=14, apart_s=2.0), tmp_path / "square.mp4")
    assert found.horizon_error < 0.03
    assert found.height_error < 0.10
    assert found.speed_error < 0.20
