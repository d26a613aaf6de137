"""Where an upright object stands by its box, against boxes that were projected."""

import numpy as np

from extractors.horizon.camera import FrameSize, feet_of, ground_points, log_heights
from tests.extractors.horizon.scenes import Camera, boxes_of

SIZE = FrameSize(640, 480)
ROLLED = Camera(np.radians(25), np.radians(15), 600, 5, SIZE)
NUMBERS = np.array([ROLLED.tilt, ROLLED.roll, np.log(ROLLED.focal)])
PLACES_M = np.array([[0.0, 9.0], [3.0, 14.0], [-4.0, 20.0]])
SIZE_M = 1.7


def test_feet_lie_beside_the_middle_of_a_box_that_leans() -> None:
    boxes = boxes_of(PLACES_M, SIZE_M, ROLLED)
    heights = boxes[:, 3] - boxes[:, 1]
    middles = np.column_stack([boxes[:, [0, 2]].mean(axis=1), boxes[:, 3]])
    feet = feet_of(NUMBERS, middles, heights, SIZE)
    assert (np.abs(feet[:, 0] - middles[:, 0]) > 0.05 * heights).all()
    np.testing.assert_allclose(ground_points(NUMBERS, feet, SIZE) * ROLLED.height_m, PLACES_M, rtol=1e-3, atol=1e-3)
    expected = log_heights(NUMBERS, np.full(3, np.log(SIZE_M / ROLLED.height_m)), feet, SIZE)
    np.testing.assert_allclose(expected, np.log(heights), atol=1e-3)  # depths are floored softly


def test_without_roll_the_middle_is_the_foot() -> None:
    level = np.array([ROLLED.tilt, 0.0, np.log(ROLLED.focal)])
    middles = np.array([[100.0, 300.0], [320.0, 400.0]])
    feet = feet_of(level, middles, np.array([40.0, 80.0]), SIZE)
    # Off the axis heads lie further out than feet, so that only there, with no roll, both are at one place.
    np.testing.assert_allclose(feet[1], middles[1])
    assert abs(feet[0, 0] - middles[0, 0]) < 10
