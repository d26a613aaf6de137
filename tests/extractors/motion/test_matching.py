import numpy as np

from extractors.motion import MotionConfig
from extractors.motion.association import Decision
from extractors.motion.detection import Detections
from extractors.motion.matching import matched

CONFIG = MotionConfig()
LEFT, RIGHT = np.array([10.0, 10, 30, 60]), np.array([100.0, 10, 120, 60])


def decide(
    tracks: list[np.ndarray],
    found: list[np.ndarray],
    scores: list[float],
    *,
    last: list[np.ndarray] | None = None,
    confirmed: list[bool] | None = None,
    at_edge: list[bool] | None = None,
    distances: float | np.ndarray = 0.0,
    away: float = 9.0,
    unlike: np.ndarray | None = None,
) -> Decision:
    shape = (len(tracks), len(found))
    expected, boxes = np.array(tracks).reshape(-1, 4), np.array(found).reshape(-1, 4)
    return matched(
        expected,
        expected if last is None else np.array(last),
        np.array([True] * len(tracks) if confirmed is None else confirmed, bool),
        np.array([False] * len(tracks) if at_edge is None else at_edge, bool),
        Detections.clear(boxes, np.array(scores)),
        np.full(shape, distances),
        np.full(shape, away),
        np.full(shape, 0.5) if unlike is None else unlike,
        CONFIG,
    )


def test_each_track_takes_what_lies_where_it_is_expected() -> None:
    decision = decide([LEFT, RIGHT], [RIGHT + 2, LEFT + 2], [0.9, 0.9])
    np.testing.assert_array_equal(decision.measured_xyxy, [LEFT + 2, RIGHT + 2])
    assert not len(decision.free_xyxy)


def test_a_doubtful_detection_goes_on_with_a_track_and_begins_none() -> None:
    decision = decide([LEFT], [LEFT + 2, RIGHT], [0.3, 0.3])
    np.testing.assert_array_equal(decision.measured_xyxy, [LEFT + 2])
    assert not len(decision.free_xyxy)
    assert np.isnan(decide([LEFT], [LEFT], [0.3], confirmed=[False]).measured_xyxy).all()


def test_what_is_sure_and_free_begins_a_track_unless_it_doubles_one() -> None:
    decision = decide([LEFT], [LEFT, LEFT + 1, RIGHT], [0.95, 0.9, 0.8])
    np.testing.assert_array_equal(decision.free_xyxy, [RIGHT])


def test_a_track_is_found_again_where_it_was_last_seen() -> None:
    decision = decide([RIGHT], [LEFT + 2], [0.9], last=[LEFT], distances=100)
    np.testing.assert_array_equal(decision.measured_xyxy, [LEFT + 2])


def test_who_looks_alike_is_found_again_within_reach() -> None:
    alike, unlike = np.array([[0.1]]), np.array([[0.8]])

    def is_taken(away: float, looks: np.ndarray) -> bool:
        decision = decide([LEFT], [RIGHT], [0.9], away=away, unlike=looks, distances=100.0)
        return not np.isnan(decision.measured_xyxy).any()

    assert is_taken(0.7, alike)
    assert not is_taken(0.7, unlike)
    assert not is_taken(1.1, alike)


def test_looks_decide_between_two_who_meet() -> None:
    looks = np.array([[0.7, 0.1], [0.1, 0.7]])
    decision = decide([LEFT, LEFT + 1], [LEFT, LEFT + 1], [0.9, 0.9], unlike=looks)
    np.testing.assert_array_equal(decision.measured_xyxy, [LEFT + 1, LEFT])


def test_a_track_that_the_edge_cut_leaves_a_newcomer_to_the_track_that_fits_it() -> None:
    def taker(*, at_edge: bool) -> int:
        distances = np.array([[9.0], [0.1]])
        decision = decide(
            [LEFT, LEFT + 6],
            [LEFT + 6],
            [0.9],
            confirmed=[True, False],
            at_edge=[at_edge, True],
            distances=distances,
        )
        return int(np.flatnonzero(~np.isnan(decision.measured_xyxy[:, 0]))[0])

    assert taker(at_edge=False) == 0  # inside the picture what is known claims first
    assert taker(at_edge=True) == 1


def test_a_track_that_the_edge_cut_takes_nothing_beyond_its_gate() -> None:
    alike, beyond = np.array([[0.1]]), CONFIG.gate + 1

    def is_taken(*, at_edge: bool) -> bool:
        decision = decide([LEFT], [LEFT + 2], [0.9], at_edge=[at_edge], distances=beyond, away=0.5, unlike=alike)
        return not np.isnan(decision.measured_xyxy).any()

    assert is_taken(at_edge=False)
    assert not is_taken(at_edge=True)


def test_nothing_meets_nothing() -> None:
    assert decide([], [], []).measured_xyxy.shape == (0, 4)
    assert np.isnan(decide([LEFT], [], []).measured_xyxy).all()
    np.testing.assert_array_equal(decide([], [LEFT], [0.9]).free_xyxy, [LEFT])
