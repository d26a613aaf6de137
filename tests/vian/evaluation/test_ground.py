import numpy as np
import pytest

from tests.vian.evaluation.cameras import Pinhole, walkers
from vian.evaluation.ground import ground_scores, mapped, rigid

CAMERA = Pinhole(pitch=0.35)
BOXES, PLACES = walkers(CAMERA, np.random.default_rng(2))


def turned(points: np.ndarray, angle: float = 0.7) -> np.ndarray:
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(points @ rotation.T + [30.0, -4.0])


def test_a_homography_maps_feet_to_where_they_are() -> None:
    np.testing.assert_allclose(mapped(CAMERA.homography, BOXES.feet_xy), PLACES, atol=1e-6)


def test_the_frame_of_reference_does_not_count_and_scale_does() -> None:
    found = ground_scores(BOXES, turned(PLACES), PLACES)
    assert found is not None
    assert found.median_m < 1e-9
    assert found.speed_error < 1e-9
    scaled = ground_scores(BOXES, turned(1.1 * PLACES), PLACES)
    assert scaled is not None
    assert scaled.median_m > 0.3
    assert scaled.speed_ratio == pytest.approx(1.1)
    assert scaled.speed_within == 1.0


def test_a_mirrored_ground_is_wrong() -> None:
    found = ground_scores(BOXES, PLACES * [-1, 1], PLACES)
    assert found is not None
    assert found.median_m > 1


def test_what_lies_above_the_horizon_is_nowhere() -> None:
    above = np.array([[100.0, CAMERA.horizon.at(100.0) - 5], [100.0, CAMERA.horizon.at(100.0) + 50]])
    assert np.isnan(mapped(CAMERA.homography, above)).tolist() == [[True, True], [False, False]]
    places = PLACES.copy()
    places[:7] = np.nan
    found = ground_scores(BOXES, places, PLACES)
    assert found is not None
    assert found.unplaced == 7
    assert ground_scores(BOXES, np.full_like(PLACES, np.nan), PLACES) is None


def test_a_rigid_motion_is_found_again() -> None:
    rotation, shift = rigid(PLACES, turned(PLACES))
    np.testing.assert_allclose(PLACES @ rotation.T + shift, turned(PLACES), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
