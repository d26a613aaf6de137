"""What explains a mask of figures, whose boxes are known."""

import cv2
import numpy as np
import pytest

from extractors.motion import MotionConfig
from extractors.motion.blobs import boxes, xywh, xyxy
from extractors.motion.covering import explained
from extractors.motion.detection import Detections
from extractors.motion.sizes import LearntSizes
from vian.evaluation.scoring import iou_of

SIZES = LearntSizes(np.array([0.25, 0.0, 5.0]), np.zeros((3, 3)), aspect=0.4, spread=0.05, deviation_max=0.25)
NOBODY = np.zeros((0, 4))


def figure_boxes(*feet: tuple[float, float]) -> np.ndarray:
    xy = np.array(feet, float)
    known = SIZES.expected(xy)
    return xyxy(np.column_stack([xy, known.width, known.height]))


def drawn(people: np.ndarray) -> np.ndarray:
    """A mask with a figure in each box: a head, a body, two legs."""
    mask = np.zeros((360, 480), np.uint8)
    for x, y, w, h in xywh(people):
        cv2.ellipse(mask, (int(x), int(y - 0.91 * h)), (int(0.2 * w), int(0.09 * h)), 0, 0, 360, 255, -1)
        cv2.ellipse(mask, (int(x), int(y - 0.62 * h)), (int(0.5 * w), int(0.26 * h)), 0, 0, 360, 255, -1)
        for side in (-1, 1):
            corner = (int(x + side * 0.22 * w - 0.14 * w), int(y - 0.5 * h))
            cv2.rectangle(mask, corner, (int(x + side * 0.22 * w + 0.14 * w), int(y) - 1), 255, -1)
    return mask


def found_in(mask: np.ndarray, tracked: np.ndarray = NOBODY) -> Detections:
    objects = explained(mask, boxes(mask, MotionConfig()), tracked, SIZES)
    assert objects is not None
    return objects


def assert_are(found: Detections, people: np.ndarray, iou_min: float) -> None:
    assert len(found) == len(people)
    assert (iou_of(people, found.boxes_xyxy).max(axis=1) >= iou_min).all()


def test_one_figure_is_one_object() -> None:
    people = figure_boxes((200, 250))
    found = found_in(drawn(people))
    assert_are(found, people, 0.8)
    assert found.doubts.tolist() == [1]


@pytest.mark.parametrize(
    "feet", [((200, 250), (222, 252)), ((200, 250), (208, 215)), ((200, 250), (224, 248), (249, 251))]
)
def test_figures_in_one_blob_are_told_apart(feet: tuple[tuple[float, float], ...]) -> None:
    people = figure_boxes(*feet)
    mask = drawn(people)
    assert len(boxes(mask, MotionConfig())) == 1
    assert_are(found_in(mask), people, 0.5)


def test_a_figure_behind_a_post_is_one_object() -> None:
    people = figure_boxes((200, 250))
    mask = drawn(people)
    mask[215:224] = 0
    assert len(boxes(mask, MotionConfig())) == 2
    assert_are(found_in(mask), people, 0.6)


def test_who_is_half_hidden_is_found_where_a_track_is_expected() -> None:
    people = figure_boxes((200, 250))
    mask = drawn(people)
    mask[215:] = 0
    found = found_in(mask, tracked=people)
    assert_are(found, people, 0.5)
    assert found.scores[0] < MotionConfig().score_new  # it may go on with a track, and begins none


def test_a_vehicle_among_people_stays_whole() -> None:
    mask = np.zeros((360, 480), np.uint8)
    cv2.rectangle(mask, (150, 190), (289, 249), 255, -1)
    found = found_in(mask)
    assert_are(found, np.array([[150.0, 190, 290, 250]]), 0.95)


def test_what_the_edge_cuts_keeps_its_box() -> None:
    people = figure_boxes((3, 250))
    (box,) = found_in(drawn(people)).boxes_xyxy
    assert box[0] == 0
    assert box[2] < people[0, 2] + 3


def test_who_leaves_at_the_edge_is_no_part_of_who_stands_near() -> None:
    people = figure_boxes((200, 402), (248, 350))
    mask = drawn(people)
    assert len(boxes(mask, MotionConfig())) == 2
    found = found_in(mask)
    assert_are(found, np.minimum(people, 360), 0.7)
    assert found.doubts.tolist() == [1, 1]


def test_two_who_are_cut_by_the_side_are_told_apart() -> None:
    people = figure_boxes((3, 190), (5, 250))
    mask = drawn(people)
    assert len(boxes(mask, MotionConfig())) == 1
    assert_are(found_in(mask), people, 0.5)


def test_where_sizes_are_not_known_it_abstains() -> None:
    people = figure_boxes((200, 250))
    unknown = LearntSizes(np.array([0.25, 0.0, 5.0]), np.eye(3) * 1e6, aspect=0.4, spread=0.05, deviation_max=0.25)
    mask = drawn(people)
    assert explained(mask, boxes(mask, MotionConfig()), NOBODY, unknown) is None


def test_an_empty_mask_has_nothing() -> None:
    assert len(found_in(np.zeros((360, 480), np.uint8))) == 0
