from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from events import TrackPoint
from extractors.errors import MaskUnreadable
from extractors.media import Image
from extractors.motion import MotionConfig, extract, read_ignored_area
from extractors.motion.detection import Detections
from extractors.video import frames
from tests.vian.clips import Walk, write_clip

START = datetime(2026, 1, 1, tzinfo=UTC)


def mask_of(path: Path, ignored: tuple[slice, slice], size: tuple[int, int] = (240, 320)) -> Path:
    mask = np.zeros(size, np.uint8)
    mask[ignored] = 255
    cv2.imwrite(str(path), mask)
    return path


def points(video: Path, mask: Path | None) -> np.ndarray:
    ignored = read_ignored_area(mask) if mask else None
    batches = [
        batch
        for step in extract(frames(video), MotionConfig(), start_time=START, ignored=ignored)
        for batch in step.batches
        if batch.type is TrackPoint
    ]
    return np.concatenate([batch.data.column("x").to_numpy() for batch in batches] or [np.zeros(0)])


def test_motion_in_the_white_area_does_not_count(tmp_path: Path) -> None:
    left, right = Walk(1, 5, (20, 100), (140, 110)), Walk(1, 5, (300, 200), (180, 190))
    video = write_clip(tmp_path / "two.mp4", [left, right])
    everywhere = points(video, None)
    assert (everywhere < 150).any()
    assert (everywhere > 170).any()
    # A mask of another resolution of the same view.
    watched = points(video, mask_of(tmp_path / "mask.png", np.s_[:, 80:], (120, 160)))
    assert len(watched) > 10
    assert watched.max() < 170


def test_what_a_model_finds_within_the_mask_is_ignored(tmp_path: Path) -> None:
    area = read_ignored_area(mask_of(tmp_path / "mask.png", np.s_[:, 160:]))
    boxes = np.array([[10.0, 10, 30, 50], [300, 10, 340, 50], [600, 10, 680, 490]])
    assert area.is_watched(boxes, 640, 480).tolist() == [True, False, False]

    class Everywhere:
        def detect(self, image: Image) -> Detections:
            return Detections.clear(boxes / 2, np.ones(3))

    clip = write_clip(tmp_path / "clip.mp4")
    steps = extract(frames(clip), MotionConfig(), start_time=START, detector=Everywhere(), ignored=area)
    found = [batch.data.column("x") for step in steps for batch in step.batches if batch.type is TrackPoint]
    assert {round(x.as_py()) for column in found for x in column} == {10}


def test_a_mask_of_another_shape_is_refused(tmp_path: Path) -> None:
    area = read_ignored_area(mask_of(tmp_path / "mask.png", np.s_[:5, :5]))
    area.check_fits(640, 480)
    with pytest.raises(MaskUnreadable, match=r"is 320x240 px, and the video's pictures are 640x360: .*Next: draw it"):
        area.check_fits(640, 360)


def test_a_mask_that_leaves_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MaskUnreadable, match="white all over"):
        read_ignored_area(mask_of(tmp_path / "mask.png", np.s_[:, :]))
