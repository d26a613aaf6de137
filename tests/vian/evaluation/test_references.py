import numpy as np
import pytest

from tests.vian.evaluation.cameras import Pinhole, walkers
from vian.evaluation.boxes import Boxes
from vian.evaluation.estimators import HorizonEstimator, estimators
from vian.evaluation.lines import error_of
from vian.evaluation.references import SizeRelation, VoteLine

REFERENCES = [VoteLine(), SizeRelation()]


@pytest.mark.parametrize("method", REFERENCES, ids=lambda each: each.name)
def test_references_find_the_horizon_of_exact_boxes(method: HorizonEstimator) -> None:
    camera = Pinhole(pitch=0.03)
    boxes, _ = walkers(camera, np.random.default_rng(1))
    found = method.estimate(boxes, camera.width, camera.height)
    # The linear relation between size and height in the picture is an approximation for small tilts.
    assert error_of(found, camera.horizon, camera.width, camera.height) < 0.02


@pytest.mark.parametrize("method", REFERENCES, ids=lambda each: each.name)
def test_references_say_nothing_of_nothing(method: HorizonEstimator) -> None:
    none = Boxes(*(np.zeros(0, np.int64),) * 2, np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64))
    assert method.estimate(none, 640, 480) is None


def test_the_shipped_estimator_finds_the_horizon_of_exact_boxes_of_a_tilted_camera() -> None:
    camera = Pinhole(pitch=0.3, roll=0.1)
    boxes, _ = walkers(camera, np.random.default_rng(1))
    (shipped,) = estimators(["vian"])
    found = shipped.estimate(boxes, camera.width, camera.height)
    # Boxes of leaning people and priors leave something; what it is exactly, tests of the extractor tell.
    assert error_of(found, camera.horizon, camera.width, camera.height) < 0.05


def test_estimators_are_found_by_name() -> None:
    assert [each.name for each in estimators(["B", "A", "B"])] == ["B", "A"]
