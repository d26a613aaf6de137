"""Sizes from a camera, against boxes of people who stand before it."""

import numpy as np
import pytest

from extractors import scene
from extractors.calibration import Camera
from extractors.media import Frame
from extractors.motion import CalibratedSizes, SizePrior
from extractors.motion.calibrated import ShrunkSizes
from tests.extractors.motion.runs import run
from tests.extractors.synthetic import boxes_of, floor


@pytest.mark.parametrize(("pitch", "roll"), [(0.05, 0.0), (0.5, 0.0), (1.0, 0.0), (0.4, 0.3)])
def test_heights_are_those_of_people_before_the_camera(pitch: float, roll: float) -> None:
    camera = Camera(900.0, pitch, roll, 6.0, 1280, 720)
    feet = floor(camera)
    boxes = boxes_of(camera, camera.ground(feet), np.full(len(feet), 1.75))
    found = CalibratedSizes(camera, 1.75).expected(feet)
    # Exact: both are the same projection, but for the half of a leaning person's width that is beside the foot.
    np.testing.assert_allclose(found.height, boxes[:, 3] - boxes[:, 1], rtol=1e-3 if roll == 0 else 0.02)


def test_a_person_seen_from_above_is_as_broad_as_before_and_lower() -> None:
    level, steep = (Camera(900.0, pitch, 0.0, 6.0, 1280, 720) for pitch in (0.3, 1.2))
    sizes = [CalibratedSizes(camera).expected(np.array([[640.0, 400.0]])) for camera in (level, steep)]
    aspects = [each.width[0] / each.height[0] for each in sizes]
    assert aspects[0] == pytest.approx(0.4, rel=0.15)
    assert aspects[1] > 2 * aspects[0]


def test_above_the_horizon_nothing_is_known() -> None:
    camera = Camera(900.0, 0.1, 0.0, 6.0, 1280, 720)
    found = CalibratedSizes(camera).expected(np.array([[640.0, 200.0], [640.0, 600.0]]))
    assert np.isnan(found.height).tolist() == [True, False]
    assert np.isnan(found.width).tolist() == [True, False]


def test_in_a_smaller_picture_sizes_are_smaller() -> None:
    whole = CalibratedSizes(Camera(900.0, 0.3, 0.0, 6.0, 1280, 720))
    feet = np.array([[640.0, 500.0]])
    found, wanted = ShrunkSizes(whole, 2.0).expected(feet / 2), whole.expected(feet)
    assert (found.height * 2, found.width * 2) == (wanted.height, wanted.width)


def test_a_calibration_that_comes_splits_people_who_walk_together() -> None:
    """From the first picture on they are one blob: nothing could be learnt from them."""
    camera = Camera(620.0, 0.3, 0.0, 5.0, 640, 360)
    ways = [((1.0, east, 14.0), (7.0, east + 7.0, 14.0)) for east in (-4.0, -3.55, -3.1)]
    colours = ((60, 50, 150), (110, 60, 30), (40, 120, 60))
    people = [scene.Actor(k, "person", way, colour) for k, (way, colour) in enumerate(zip(ways, colours, strict=True))]
    row = scene.Scene(camera, tuple(people), seconds=7)
    pictures = [Frame(i, 100_000 * i, image) for i, image in enumerate(scene.render(row))]

    def tracks_of(sizes: SizePrior | None) -> int:
        found = run(pictures, calibrated=lambda: sizes)
        return len({end.track_id for end in found.ends if end.points > 20})

    assert tracks_of(None) == 1
    assert tracks_of(CalibratedSizes(camera)) > 1
