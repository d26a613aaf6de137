import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from extractors.motion import kalman
from extractors.motion.kalman import Noise

NOISE = Noise(position=0.1, size=0.2, acceleration=1.0, size_drift=0.3)
QUIET = Noise(position=0.1, size=0.2, acceleration=1e-9, size_drift=1e-9)


def boxes(*rows: tuple[float, float, float, float]) -> kalman.Array:
    return np.array(rows, float)


def test_a_newborn_rests_where_it_was_seen() -> None:
    means, covariances = kalman.born(boxes((10, 20, 4, 9)), NOISE)
    np.testing.assert_array_equal(means, [[10, 20, 4, 9, 0, 0]])
    size = 6.0  # sqrt(4 * 9)
    expected = (size * np.array([0.1, 0.1, 0.2, 0.2, 3.0, 3.0])) ** 2
    np.testing.assert_allclose(covariances[0], np.diag(expected))


def test_prediction_is_the_closed_form_of_constant_velocity() -> None:
    dt, size = 0.5, 10.0
    means = np.array([[1.0, 2.0, 10.0, 10.0, 3.0, -4.0]])
    covariances = np.diag([1.0, 1, 1, 1, 2, 2])[None]
    found, spread = kalman.predict(means, covariances, dt, NOISE)
    np.testing.assert_allclose(found, [[2.5, 0.0, 10, 10, 3, -4]])
    q = (size * NOISE.acceleration) ** 2
    assert spread[0, 0, 0] == pytest.approx(1 + 2 * dt**2 + q * dt**3 / 3)
    assert spread[0, 0, 4] == pytest.approx(2 * dt + q * dt**2 / 2)
    assert spread[0, 4, 4] == pytest.approx(2 + q * dt)
    assert spread[0, 2, 2] == pytest.approx(1 + (size * NOISE.size_drift) ** 2 * dt)


def test_two_short_steps_are_one_long_step() -> None:
    means, covariances = kalman.born(boxes((5, 5, 8, 8)), NOISE)
    means[0, 4:] = (3, -2)
    once = kalman.predict(means, covariances, 0.4, NOISE)
    twice = kalman.predict(*kalman.predict(means, covariances, 0.1, NOISE), 0.3, NOISE)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_an_update_weighs_by_the_variances() -> None:
    # One axis alone is the scalar filter: mean = (m / p + z / r) / (1 / p + 1 / r).
    means, covariances = np.array([[0.0, 0, 5, 5, 0, 0]]), np.diag([4.0, 1, 1, 1, 1, 1])[None]
    r = np.diag([1.0, 1, 1, 1])[None]
    found, spread = kalman.update(means, covariances, boxes((10, 0, 5, 5)), r)
    assert found[0, 0] == pytest.approx((0 / 4 + 10 / 1) / (1 / 4 + 1 / 1))
    assert spread[0, 0, 0] == pytest.approx(1 / (1 / 4 + 1 / 1))


def test_without_process_noise_the_filter_is_least_squares() -> None:
    """Positions fitted by a line of nearly unknown slope: the filter's mean is the regression's value."""
    times = np.arange(8) * 0.1
    positions = np.array([0.0, 1.2, 1.9, 3.1, 4.2, 4.8, 6.1, 7.0])
    wide = Noise(position=0.1, size=0.2, acceleration=1e-9, size_drift=1e-9, speed_at_birth=1e4)
    means, covariances = kalman.born(boxes((positions[0], 0, 10, 10)), wide)
    for position in positions[1:]:
        means, covariances = kalman.predict(means, covariances, 0.1, wide)
        r = kalman.measurement_noise(means, wide, np.ones((1, 4)))
        means, covariances = kalman.update(means, covariances, boxes((position, 0, 10, 10)), r)
    slope, offset = np.polyfit(times, positions, 1)
    # The prior on the speed is 1e4 sizes per second, so it pulls by less than a millionth.
    assert means[0, 0] == pytest.approx(slope * times[-1] + offset, rel=1e-5)
    assert means[0, 4] == pytest.approx(slope, rel=1e-5)


@given(st.integers(1, 6), st.integers(0, 2**31))
def test_many_boxes_at_once_are_as_each_alone(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    measured = random.uniform(5, 100, (count, 4))
    means, covariances = kalman.born(measured, NOISE)
    means, covariances = kalman.predict(means, covariances, 0.1, NOISE)
    r = kalman.measurement_noise(means, NOISE, np.ones((count, 4)))
    after = measured + random.normal(0, 2, (count, 4))
    together = kalman.update(means, covariances, after, r)
    for i in range(count):
        at = slice(i, i + 1)
        alone = kalman.update(means[at], covariances[at], after[at], r[at])
        np.testing.assert_allclose(together[0][at], alone[0])
        np.testing.assert_allclose(together[1][at], alone[1])


def test_distance_is_mahalanobis_of_the_position() -> None:
    means, covariances = kalman.born(boxes((0, 0, 10, 10), (50, 0, 10, 10)), QUIET)
    found = kalman.distances(means, covariances, boxes((3, 4, 10, 10)), QUIET)
    variance = 2 * (10 * 0.1) ** 2  # of the state and of the measurement
    np.testing.assert_allclose(found, [[25 / variance], [(47**2 + 16) / variance]])


def test_what_is_doubted_is_nearer() -> None:
    means, covariances = kalman.born(boxes((0, 0, 10, 10)), QUIET)
    found = kalman.distances(means, covariances, boxes((3, 4, 10, 10), (3, 4, 10, 10)), QUIET, np.array([1.0, 2.0]))
    np.testing.assert_allclose(found, [[25 / (1 + 1), 25 / (1 + 2**2)]])


def test_no_boxes_are_no_trouble() -> None:
    means, covariances = kalman.born(np.zeros((0, 4)), NOISE)
    means, covariances = kalman.predict(means, covariances, 0.1, NOISE)
    assert kalman.distances(means, covariances, boxes((1, 1, 1, 1)), NOISE).shape == (0, 1)
