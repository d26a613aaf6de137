import numpy as np

from extractors.motion.association import Decision, decide, placed_within
from extractors.motion.blobs import BoxesXyxy, xywh

GATE = 16.0


def boxes(*rows: tuple[float, float, float, float]) -> BoxesXyxy:
    return np.array(rows, float).reshape(-1, 4)


def decided(expected: BoxesXyxy, blobs: BoxesXyxy, confirmed: bool = True) -> Decision:
    """A decision with costs of squared distance over 25 px²."""
    is_confirmed = np.full(len(expected), confirmed)
    offsets = xywh(expected)[:, None, :2] - xywh(blobs)[None, :, :2]
    costs = (offsets**2).sum(axis=2) / 25
    return decide(expected, is_confirmed, is_confirmed, blobs, costs, GATE)


def test_each_track_takes_its_own_blob_and_a_new_one_is_free() -> None:
    expected = boxes((0, 0, 10, 30), (100, 0, 110, 30))
    blobs = boxes((101, 1, 111, 31), (300, 0, 310, 30), (2, 0, 12, 30))
    found = decided(expected, blobs)
    np.testing.assert_array_equal(found.measured_xyxy, blobs[[2, 0]])
    np.testing.assert_array_equal(found.free_xyxy, blobs[[1]])
    assert not found.is_shared.any()


def test_the_cheapest_whole_is_chosen_not_the_greediest_pair() -> None:
    expected = boxes((0, 0, 10, 30), (8, 0, 18, 30))
    blobs = boxes((6, 0, 16, 30), (14, 0, 24, 30))
    np.testing.assert_array_equal(decided(expected, blobs).measured_xyxy, blobs)


def test_a_blob_beyond_the_gate_is_not_taken() -> None:
    found = decided(boxes((0, 0, 10, 30)), boxes((40, 0, 50, 30)))
    assert np.isnan(found.measured_xyxy).all()
    assert len(found.free_xyxy) == 1


def test_two_tracks_share_the_blob_that_holds_both_and_keep_their_sizes() -> None:
    expected = boxes((0, 0, 10, 30), (12, 2, 22, 32))
    found = decided(expected, boxes((1, 0, 24, 31)))
    assert found.is_shared.all()
    sizes = found.measured_xyxy[:, 2:] - found.measured_xyxy[:, :2]
    np.testing.assert_array_equal(sizes, [[10, 30], [10, 30]])
    np.testing.assert_array_equal(found.measured_xyxy, [[1, 0, 11, 30], [12, 1, 22, 31]])
    assert not len(found.free_xyxy)


def test_parts_above_each_other_are_one_object() -> None:
    parts = boxes((1, 0, 9, 12), (0, 15, 10, 30))
    found = decided(boxes((0, 0, 10, 30)), parts)
    np.testing.assert_array_equal(found.measured_xyxy, [[0, 0, 10, 30]])
    assert not len(found.free_xyxy)


def test_parts_side_by_side_are_two_objects() -> None:
    found = decided(boxes((0, 0, 24, 30)), boxes((0, 0, 10, 30), (14, 0, 24, 30)))
    assert not np.array_equal(found.measured_xyxy[0], [0, 0, 24, 30])
    assert len(found.free_xyxy) == 1


def test_a_blob_much_larger_than_its_track_is_held_for_doubtful() -> None:
    found = decided(boxes((0, 0, 10, 30)), boxes((0, 0, 26, 30)))
    assert found.is_shared.tolist() == [True]
    # The foot stays where the expected box fits in; the blob is the size, to be believed slowly.
    assert xywh(found.measured_xyxy)[0].tolist() == [5, 30, 26, 30]


def test_what_is_known_claims_before_what_is_new() -> None:
    expected = boxes((0, 0, 10, 30), (4, 0, 14, 30))
    blob = boxes((4, 0, 14, 30))
    costs = np.array([[2.0], [0.0]])
    is_confirmed = np.array([True, False])
    found = decide(expected, is_confirmed, is_confirmed, blob, costs, GATE)
    assert np.isnan(found.measured_xyxy[1]).all()
    np.testing.assert_array_equal(found.measured_xyxy[0], blob[0])


def test_nothing_meets_nothing() -> None:
    nothing = np.zeros((0, 4))
    assert len(decided(nothing, nothing).measured_xyxy) == 0
    assert len(decided(nothing, boxes((0, 0, 5, 5))).free_xyxy) == 1
    assert np.isnan(decided(boxes((0, 0, 5, 5)), nothing).measured_xyxy).all()


def test_a_box_larger_than_its_blob_is_centred_on_it() -> None:
    placed = placed_within(boxes((0, 0, 10, 30)), np.array([20.0, 0, 26, 40]))
    np.testing.assert_array_equal(placed, [[18, 0, 28, 30]])
