import numpy as np
import pytest

from vian.evaluation.lines import Horizon, auc, error_of, is_covered, is_in_region


def test_the_error_is_the_largest_distance_within_the_image_over_its_height() -> None:
    truth = Horizon(0.1, 50.0)
    assert error_of(Horizon(0.1, 60.0), truth, 101, 100) == pytest.approx(0.1)
    assert error_of(Horizon(0.2, 45.0), truth, 101, 100) == pytest.approx(0.05)
    assert error_of(None, truth, 101, 100) == float("inf")


def test_an_abstention_counts_for_the_area_as_an_error_without_bound() -> None:
    assert auc([0.0, 0.0, float("inf"), 1.0]) == pytest.approx(0.5)


def test_a_horizon_is_the_same_one_in_a_frame_of_another_size() -> None:
    covariance = np.array([[1e-4, -1e-2], [-1e-2, 9.0]])
    large = Horizon(0.1, 50.0, covariance)
    small = large.scaled(0.5, 0.25)
    assert small.at(100.0) == pytest.approx(large.at(200.0) * 0.25)
    assert small.sd_at(100.0) == pytest.approx(large.sd_at(200.0) * 0.25)


def test_intervals_and_regions_of_honest_covariances_cover_as_stated() -> None:
    rng = np.random.default_rng(5)
    covariance = np.array([[1e-4, -2e-2], [-2e-2, 9.0]])
    truth = Horizon(-0.05, -30.0)
    drawn = rng.multivariate_normal([truth.slope, truth.offset], covariance, 2000)
    estimates = [Horizon(float(slope), float(offset), covariance) for slope, offset in drawn]
    # 2000 draws leave 0.5 % of chance in a share of 95 %.
    assert np.mean([is_covered(each, truth, 480) for each in estimates]) == pytest.approx(0.95, abs=0.02)
    assert np.mean([is_in_region(each, truth) for each in estimates]) == pytest.approx(0.95, abs=0.02)
