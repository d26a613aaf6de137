"""The fold against scenes whose cameras are known."""

import json
from pathlib import Path

import numpy as np
import pytest

from events import CameraCalibrated, EventType, events_of
from extractors.calibration import (
    CalibrationConfig,
    CalibrationFold,
    Camera,
    CameraHeight,
    Horizon,
    KnownLength,
    Scale,
)
from extractors.horizon import HorizonConfig
from tests.extractors.motion.test_real_clips import pets_truth
from tests.extractors.synthetic import Walks, homography_error, walks

CAMERA = Camera(900.0, 0.35, 0.05, 5.0, 1280, 720)
ONCE = CalibrationConfig.of_boxes().model_copy(update={"camera": HorizonConfig(update_s=1e6)})
"""looks once, at the end"""
TILTED = Camera(650.0, 0.5, 0.3, 4.0, 768, 576)


def fold(camera: Camera, scale: Scale | None = None, config: CalibrationConfig | None = None) -> CalibrationFold:
    return CalibrationFold(config or ONCE, (camera.width, camera.height), scale)


def fed(run: CalibrationFold, seen: Walks, cuts: int = 1) -> list[EventType]:
    events: list[EventType] = []
    for part in np.array_split(np.arange(len(seen.time_us)), cuts):
        run.add_points(seen.time_us[part], seen.track_id[part], seen.boxes_xyxy[part], seen.confidence[part])
        events += [event for batch in run.take() for event in events_of(batch)]
    return events + [event for batch in run.finish() for event in events_of(batch)]


@pytest.mark.parametrize("camera", [CAMERA, TILTED], ids=["plain", "rolled by 17 degrees"])
def test_without_noise_the_homography_is_right(camera: Camera) -> None:
    run = fold(camera)
    fed(run, walks(camera))
    assert run.said is not None
    assert homography_error(camera, run.said.camera) < 0.01  # what is left is the priors' pull


def test_noise_is_told_by_the_uncertainty() -> None:
    deviations = []
    for noise in (0.01, 0.03, 0.06):
        run = fold(CAMERA)
        fed(run, walks(CAMERA, noise_share=noise))
        assert run.said is not None
        assert homography_error(CAMERA, run.said.camera) < 0.05 + 3 * noise
        off = np.abs(run.said.parameters - np.array([np.log(900.0), 0.35, 0.05, np.log(5.0)]))
        assert (off < 3 * np.sqrt(np.diag(run.said.covariance))).all()
        deviations.append(run.said.covariance[0, 0])
    assert deviations[0] < min(deviations[1:])  # the others are as wide: paces that differ by direction outweigh noise


def test_how_points_come_in_changes_nothing() -> None:
    seen = walks(CAMERA, people=9, noise_share=0.02)
    config = CalibrationConfig(camera=HorizonConfig(update_s=15.0))
    whole = fed(fold(CAMERA, config=config), seen)
    assert len(whole) > 1
    assert whole == fed(fold(CAMERA, config=config), seen, cuts=37)


def test_the_event_says_what_was_found() -> None:
    run = fold(CAMERA)
    events = fed(run, walks(CAMERA, people=8))
    event = events[-1]
    assert isinstance(event, CameraCalibrated)
    assert run.said is not None
    assert (event.method, event.scale, event.width, event.height) == ("tracks", "person_height", 1280, 720)
    assert event.focal_px == run.said.camera.focal_px
    np.testing.assert_array_equal(json.loads(event.homography), run.said.camera.homography)
    deviations = np.sqrt(np.diag(json.loads(str(event.covariance))))
    assert deviations[0] == pytest.approx(np.sqrt(run.said.covariance[0, 0]) * event.focal_px)


@pytest.mark.parametrize("kind", ["height", "length"])
def test_metres_come_from_what_is_known(kind: str) -> None:
    """People here are 9 % taller than the prior says: a height or a length that is known decides."""
    large = Camera(900.0, 0.35, 0.05, 5.0, 1280, 720)
    seen = walks(Camera(900.0, 0.35, 0.05, 5.0 / 1.09, 1280, 720))
    ends = np.array([[500.0, 500.0], [800.0, 520.0]])
    one, other = large.ground(ends)
    length = KnownLength((500.0, 500.0), (800.0, 520.0), float(np.hypot(*(one - other))))
    run = fold(large, CameraHeight(5.0, 0.02) if kind == "height" else length)
    fed(run, seen)
    assert run.said is not None
    assert run.said.camera.height_m == pytest.approx(5.0, rel=0.02)
    by_people = fold(large)
    fed(by_people, seen)
    assert by_people.said is not None
    assert by_people.said.camera.height_m == pytest.approx(5.0 / 1.09, rel=0.02)


def test_a_known_horizon_joins() -> None:
    seen = walks(CAMERA, people=9, noise_share=0.05)
    alone, told = fold(CAMERA), fold(CAMERA)
    told.add_horizon(Horizon(*CAMERA.horizon, np.diag([1e-8, 1e-2])))
    fed(alone, seen), fed(told, seen)
    assert told.said is not None
    assert told.said.camera.horizon[1] == pytest.approx(CAMERA.horizon[1], abs=0.5)
    assert alone.said is not None
    assert told.said.covariance[1, 1] < alone.said.covariance[1, 1]


def test_what_does_not_decide_gets_no_event() -> None:
    run = fold(CAMERA)
    assert run.finish() == ()
    assert run.reason == "no track has moved yet"
    standing = walks(CAMERA, people=9)
    run.add_points(standing.time_us, standing.track_id, np.tile(standing.boxes_xyxy[:1], (len(standing.time_us), 1)),
                   standing.confidence)  # fmt: skip
    assert run.finish() == ()
    seen = walks(CAMERA, people=9)
    wild = seen.boxes_xyxy.copy()
    height = np.random.default_rng(1).uniform(20, 300, len(wild))
    wild[:, 1] = wild[:, 3] - height
    wild[:, 0], wild[:, 2] = wild[:, 0], wild[:, 0] + height * 0.4
    run = fold(CAMERA)
    run.add_points(seen.time_us, seen.track_id, wild, seen.confidence)
    assert run.finish() == ()


@pytest.mark.parametrize(
    "horizon, why",
    [
        (Horizon(0.0, 1e6, np.diag([1e-13, 1e-9])), "math range error"),
        (Horizon(*CAMERA.horizon, np.zeros((2, 2))), "Matrix is not positive definite"),
    ],
    ids=["out of this world", "exact"],
)
def test_what_the_numbers_cannot_bear_gets_no_event_and_a_reason(horizon: Horizon, why: str) -> None:
    run = fold(CAMERA)
    run.add_horizon(horizon)
    assert fed(run, walks(CAMERA, people=9, noise_share=0.01)) == []
    assert run.reason == f"what is known of the camera contradicts its tracks: {why}"


def test_a_length_whose_points_may_be_one_says_nothing() -> None:
    """A point that was marked is off by 1.5 px: these two may be the same, and then there is no logarithm."""
    assert KnownLength((640.0, 500.0), (641.5, 500.0), 1.0).deviations(CAMERA) == 100.0
    assert KnownLength((640.0, 500.0), (640.0, 500.0), 1.0).deviations(CAMERA) == 100.0
    assert abs(KnownLength((640.0, 500.0), (740.0, 500.0), 1.0).deviations(CAMERA)) < 100.0


def test_points_that_were_only_expected_and_boxes_cut_off_say_nothing() -> None:
    seen = walks(CAMERA, people=6)
    run = fold(CAMERA)
    run.add_points(seen.time_us, seen.track_id, seen.boxes_xyxy, 0 * seen.confidence)
    run.add_points(seen.time_us, seen.track_id, seen.boxes_xyxy - seen.boxes_xyxy[:, :1].repeat(4, 1), seen.confidence)
    assert run.finish() == ()
    assert run.reason == "no track has moved yet"


def test_what_is_wider_than_high_is_no_person_and_gives_no_metres() -> None:
    """Cars of one length and height: their camera is known, but only a given height makes metres of it."""
    seen = walks(CAMERA)
    heights = seen.boxes_xyxy[:, 3] - seen.boxes_xyxy[:, 1]
    wide = seen.boxes_xyxy + heights[:, None] * np.array([-0.8, 0, 0.8, 0])
    by_people, told = fold(CAMERA), fold(CAMERA, CameraHeight(5.0, 0.1))
    for run in (by_people, told):
        run.add_points(seen.time_us, seen.track_id, wide, seen.confidence)
        run.finish()
    assert by_people.said is None
    assert "no upright people" in by_people.reason
    assert told.said is not None
    assert told.said.camera.height_m == pytest.approx(5.0, rel=0.02)


def test_a_moved_camera_begins_anew() -> None:
    run = fold(CAMERA)
    assert fed(run, walks(CAMERA, people=9))
    run.restart()
    assert run.said is None
    assert run.finish() == ()


def test_boxes_of_blobs_are_trusted_less_for_metres() -> None:
    seen = walks(CAMERA, noise_share=0.02)
    blobs, boxes = fold(CAMERA, config=CalibrationConfig(camera=ONCE.camera)), fold(CAMERA)
    for run in (blobs, boxes):
        fed(run, seen)
    assert blobs.said is not None
    assert boxes.said is not None
    assert blobs.said.covariance[3, 3] > 2 * boxes.said.covariance[3, 3]


def test_the_annotated_clip_is_calibrated(vian_data: Path) -> None:
    """Against the published calibration: focal length 744 px, height 7.07 m, pitch 16.5 degrees."""
    rows = pets_truth(vian_data)
    run = CalibrationFold(ONCE, (480, 360))
    run.add_points(
        (rows[:, 0] / 7 * 1e6).astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2:], np.ones(len(rows))
    )
    run.finish()
    assert run.said is not None
    camera = run.said.camera
    assert camera.focal_px == pytest.approx(744, rel=0.2)
    assert camera.height_m == pytest.approx(7.07, rel=0.12)
    assert camera.pitch_rad == pytest.approx(0.288, abs=0.06)
