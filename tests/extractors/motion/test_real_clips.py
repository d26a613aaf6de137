"""Real footage: floors far below what is reached, so that they fail on breakage and not on taste."""

from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from extractors.video import frames
from tests.extractors.films import first_half
from tests.extractors.motion.runs import Run, run, scored

PETS = "video/pets2009_s2l1_view001"


@pytest.fixture(scope="module")
def pets_run(vian_data: Path) -> Run:
    return run(frames(vian_data / PETS / "vtest_480x360.avi"))


def pets_truth(vian_data: Path) -> np.ndarray:
    """`frame id x1 y1 x2 y2`, scaled from 768x576 to 480x360."""
    rows = []
    for frame in ElementTree.parse(vian_data / PETS / "PETS2009-S2L1.xml").getroot():
        for item in frame.iter("object"):
            box = item.find("box")
            assert box is not None
            w, h, x, y = (0.625 * float(box.attrib[name]) for name in ("w", "h", "xc", "yc"))
            rows.append(
                (int(frame.attrib["number"]), int(item.attrib["id"]), x - w / 2, y - h / 2, x + w / 2, y + h / 2)
            )
    return np.array(rows, float)


def test_pedestrians_are_followed(vian_data: Path, pets_run: Run) -> None:
    found = scored(pets_truth(vian_data), pets_run.rows)
    assert found.mota > 0.55
    assert found.idf1 > 0.5
    assert found.switches < 80


def test_four_vehicles_cross_the_line(vian_data: Path) -> None:
    """The hand count names frame and place of each crossing of row 216 by the vehicle's front."""
    found = run(frames(vian_data / "video/intel_car_detection/car-detection.mp4"))
    crossed = []
    for end in found.ends:
        own = found.rows[found.rows[:, 1] == end.track_id]
        height = (own[:, 5] - own[:, 3]).max()
        is_over = (own[:, 3] < 216) & (own[:, 5] > 216)
        if height > 100 and is_over.any():
            crossed.append(int(own[is_over][0, 0]))
    assert len(crossed) in (4, 5)
    for wanted in (78, 206, 209, 333):
        assert min(abs(frame - wanted) for frame in crossed) < 20


def test_people_who_stand_at_the_table_keep_their_track(vian_data: Path) -> None:
    """Two people come, stand for 10 s and 18 s, and leave; frames read off the clip by eye."""
    clip = vian_data / "video/intel_one_by_one_person/one-by-one-person-detection.mp4"
    found = run(islice(frames(clip), 470))
    frame, track, x, y = (found.column(name) for name in ("frame", "track_id", "x", "y"))
    at_table = (x > 380) & (x < 560) & (y > 330)
    for first, last in ((85, 180), (250, 435)):
        here = at_table & (frame >= first) & (frame <= last)
        numbers, counts = np.unique(track[here], return_counts=True)
        longest = numbers[counts.argmax()]
        assert counts.max() >= 0.95 * (last - first + 1)
        (end,) = [end for end in found.ends if end.track_id == longest]
        assert end.first_frame < first
        assert end.reason == "left_frame"


def test_a_copy_that_breaks_off_gives_the_same_events_before(vian_data: Path, tmp_path: Path, pets_run: Run) -> None:
    half = first_half(tmp_path / "half.avi", vian_data / PETS / "vtest_480x360.avi")
    found = run(frames(half))
    count = found.extractions[-1].frames
    assert 300 < count < 795
    gaps = [gap for extraction in found.extractions for gap in extraction.gaps]
    assert [gap.before_index for gap in gaps] == [count]
    certain = count - 25  # what was known of the last two seconds depends on what follows
    np.testing.assert_array_equal(found.rows[found.rows[:, 0] < certain], pets_run.rows[pets_run.rows[:, 0] < certain])


def test_a_preview_in_gif_has_its_objects(vian_data: Path) -> None:
    found = run(frames(vian_data / "video/intel_previews_gif/person-bicycle-car-detection.gif"))
    assert found.extractions[-1].frames == 41
    assert 2 <= len(found.ends) <= 10
