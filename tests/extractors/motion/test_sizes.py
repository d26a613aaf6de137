"""The size of objects, learnt from views whose truth is exact."""

import numpy as np

from extractors.motion import MotionConfig
from extractors.motion.sizes import LearntSizes, SizeLearner, fitted

CONFIG = MotionConfig()
K, SLOPE, OFFSET = 0.3, -0.08, -40.0


def views(count: int, *, seed: int = 1, noise: float = 0.08, aspect: float = 0.4) -> np.ndarray:
    """`x y w h` of upright objects on a plane, with relative noise of their height."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(0, 480, count), random.uniform(80, 350, count)
    height = K * (y - SLOPE * x - OFFSET) * np.exp(random.normal(0, noise, count))
    return np.stack([x, y, aspect * height, height], axis=1)


def wanted(feet: np.ndarray) -> np.ndarray:
    return K * (feet[:, 1] - SLOPE * feet[:, 0] - OFFSET)


def learnt(boxes: np.ndarray, tracks: int = 12) -> LearntSizes:
    found = fitted(boxes, tracks, CONFIG)
    assert found is not None
    return found


def test_without_noise_the_relation_is_found_exactly() -> None:
    feet = views(50)[:, :2]
    # The wish for a level camera and the floor of the deviation leave less than a thousandth.
    np.testing.assert_allclose(learnt(views(60, noise=0)).expected(feet).height, wanted(feet), rtol=1e-3)


def test_views_of_groups_and_parts_do_not_matter() -> None:
    boxes = views(200)
    boxes[::6, 3] *= 1.8
    boxes[3::12, 3] *= 0.5
    feet = views(50, seed=2)[:, :2]
    np.testing.assert_allclose(learnt(boxes).expected(feet).height, wanted(feet), rtol=0.08)


def test_the_deviation_covers_the_error() -> None:
    """Of many fits of few views, two thirds lie within one deviation of what is true, and nearly all within three."""
    feet = np.array([[240.0, 200.0]])
    errors = []
    for seed in range(60):
        known = learnt(views(24, seed=seed)).expected(feet)
        errors.append(np.log(known.height / wanted(feet))[0] / known.deviation[0])
    assert np.mean(np.abs(errors) < 1) > 0.66
    assert np.mean(np.abs(errors) < 3) == 1


def test_far_from_all_views_it_abstains() -> None:
    boxes = views(40)
    boxes = boxes[(boxes[:, 1] > 150) & (boxes[:, 1] < 190)][:16]
    known = learnt(boxes, tracks=4).expected(np.array([[240.0, 170.0], [240.0, 2000.0], [240.0, -500.0]]))
    assert np.isnan(known.height).tolist() == [False, True, True]


def test_vehicles_are_not_told_apart_by_size() -> None:
    assert fitted(views(60, aspect=1.8), 12, CONFIG) is None


def test_sizes_of_several_kinds_are_no_relation() -> None:
    boxes = views(90)
    boxes[::2, 3] *= 2.5
    assert fitted(boxes, 12, CONFIG) is None


def test_it_takes_some_tracks_and_views_that_moved() -> None:
    learner = SizeLearner(CONFIG)
    for number, box in enumerate(views(60)):
        learner.add(1 + number % 3, box)
    assert learner.learnt() is None
    for number, box in enumerate(views(60)):
        learner.add(1 + number % 9, box)
    assert learner.learnt() is not None
    assert not learner.is_due
    for _ in range(100):
        learner.add(5, box)
    assert not learner.is_due


def test_its_memory_is_bounded() -> None:
    learner = SizeLearner(MotionConfig(size_samples_max=50))
    for number, box in enumerate(views(400)):
        learner.add(number, box)
        learner.forget(number)
    assert learner.learnt() is not None
