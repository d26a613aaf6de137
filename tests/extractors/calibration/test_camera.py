import math

import numpy as np
import pytest

from extractors.calibration import Camera, NotACamera, camera_of, meeting_point
from tests.extractors.synthetic import boxes_of, floor

CAMERA = Camera(900.0, 0.35, 0.2, 5.0, 1280, 720)


def test_what_the_ground_shows_is_seen_where_it_was() -> None:
    pixels = floor(CAMERA)
    ground = CAMERA.ground(pixels)
    np.testing.assert_allclose(CAMERA.project(np.column_stack([ground, np.zeros(len(ground))])), pixels, atol=1e-9)


def test_the_horizon_is_where_the_ground_ends() -> None:
    slope, offset = CAMERA.horizon
    assert slope == pytest.approx(math.tan(0.2))
    columns = np.array([0.0, 640.0, 1280.0])
    far = np.column_stack([columns, slope * columns + offset + 0.01])
    assert (np.hypot(*CAMERA.ground(far).T) > 1e4).all()
    assert np.isnan(CAMERA.ground(far - [0.0, 0.02])).all()


def test_without_roll_a_point_ahead_is_north() -> None:
    level = Camera(1000.0, math.pi / 4, 0.0, 3.0, 640, 480)
    np.testing.assert_allclose(level.ground(np.array([[320.0, 240.0]])), [[0.0, 3.0]], atol=1e-12)
    ((east, north),) = level.ground(np.array([[420.0, 240.0]]))
    assert (east > 0, north) == (True, pytest.approx(3.0))


def test_horizon_and_vertical_vanishing_point_give_the_camera() -> None:
    ground = CAMERA.ground(floor(CAMERA))
    feet = CAMERA.project(np.column_stack([ground, np.zeros(len(ground))]))
    heads = CAMERA.project(np.column_stack([ground, np.full(len(ground), 1.7)]))
    found = camera_of(CAMERA.horizon, meeting_point(feet, heads), (1280, 720), height_m=5.0)
    assert found.focal_px == pytest.approx(900.0, rel=1e-6)
    assert found.pitch_rad == pytest.approx(0.35)
    assert found.roll_rad == pytest.approx(0.2)


def test_the_body_leans_out_of_its_box_when_the_camera_is_rolled() -> None:
    (box,) = boxes_of(CAMERA, np.array([[0.0, 12.0]]), np.array([1.7]))
    ((foot_x, _),) = CAMERA.project(np.array([[0.0, 12.0, 0.0]]))
    assert abs((box[0] + box[2]) / 2 - foot_x) > 0.05 * (box[3] - box[1])


@pytest.mark.parametrize(
    "values,message",
    [
        ((0.0, 0.3, 0.0, 5.0), "a focal length and a height above 0"),
        ((900.0, math.nan, 0.0, 5.0), "finite angles"),
        ((900.0, 0.3, 2.0, 5.0), "within a right angle"),
    ],
)
def test_numbers_that_are_no_camera_are_refused(values: tuple[float, float, float, float], message: str) -> None:
    with pytest.raises(NotACamera, match=message):
        Camera(*values, 640, 480)


def test_a_level_view_fixes_no_focal_length() -> None:
    with pytest.raises(NotACamera, match="must lie on two sides"):
        camera_of((0.0, 240.0), (320.0, 9000.0), (640, 480))


def test_parallel_lines_have_no_vanishing_point() -> None:
    feet = np.array([[0.0, 10.0], [5.0, 12.0], [9.0, 14.0]])
    with pytest.raises(NotACamera, match="parallel"):
        meeting_point(feet, feet - [0.0, 8.0])
    with pytest.raises(NotACamera, match="two lines or more, got 1"):
        meeting_point(feet[:1], feet[:1] - [0.0, 8.0])
