"""Horizon and calibration beside motion: walks before known cameras, moves, other sizes, and what stands."""

import json
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from events import (
    CameraCalibrated,
    EventBatch,
    HorizonEstimate,
    SceneChanged,
    TrackPoint,
    batch_of,
    events_of,
    schema_of,
)
from extractors.calibration import Camera, CameraHeight, KnownLength
from extractors.horizon import FrameSize
from tests.events.examples import camera_calibrated
from tests.extractors.synthetic import Walks, walks
from vian.camera_folds import CameraConfig, CameraFolds, Resized, is_better

START = datetime(2026, 1, 1, 12, tzinfo=UTC)
FPS = 5
CAMERA = Camera(700.0, 0.4, 0.05, 5.0, 768, 576)
OTHER = Camera(500.0, 0.6, -0.05, 4.0, 768, 576)
SIZE = FrameSize(768, 576)
NO_HORIZON = CameraConfig(horizon=None)


@pytest.fixture(scope="module")
def walked() -> Walks:
    return walks(CAMERA, people=7, seconds=10, noise_share=0.01)


def points_of(seen: Walks, *, after_s: float = 0.0, first_frame: int = 0, first_track: int = 0) -> EventBatch:
    x1, y1, x2, y2 = seen.boxes_xyxy.T
    start_us = round((START - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 1e6) + round(after_s * 1e6)
    nothing = np.zeros(len(x1))
    columns = {
        "time": seen.time_us + start_us, "track_id": seen.track_id + first_track,
        "frame": np.rint(seen.time_us * FPS / 1e6).astype(int) + first_frame,
        "x": (x1 + x2) / 2, "y": y2, "x1": x1, "y1": y1, "x2": x2, "y2": y2, "vx": nothing, "vy": nothing,
        "confidence": seen.confidence,
    }  # fmt: skip
    schema = schema_of(TrackPoint)
    arrays = [pa.array(columns[field.name]).cast(field.type) for field in schema]
    return EventBatch(TrackPoint, pa.RecordBatch.from_arrays(arrays, schema=schema))


def change(cause: str, at_s: float) -> EventBatch:
    time = START + timedelta(seconds=at_s)
    return batch_of([SceneChanged(time=time, cause=cause, changed_share=1.0, dx=None, dy=None)])  # type: ignore[arg-type]  # one of its words


def calibrations(batches: Sequence[EventBatch]) -> list[CameraCalibrated]:
    return [e for batch in batches for e in events_of(batch) if isinstance(e, CameraCalibrated)]


def test_both_come_out_the_same_however_the_points_are_cut(walked: Walks) -> None:
    whole, cut = CameraFolds(SIZE, CameraConfig()), CameraFolds(SIZE, CameraConfig())
    batch = points_of(walked)
    said = [*whole.add([batch]), *whole.finish()]
    pieces = [batch.slice(at, at + 37) for at in range(0, len(batch), 37)]
    again = [each for piece in pieces for each in cut.add([piece])] + list(cut.finish())

    def told(batches: Sequence[EventBatch], name: str) -> list[Any]:
        return [event for each in batches if each.type.type_name == name for event in events_of(each)]

    for name in ("horizon_vote", "horizon_estimate", "camera_calibrated"):
        assert told(said, name) == told(again, name)
        assert told(said, name)
    assert calibrations(said)[-1].focal_px == pytest.approx(CAMERA.focal_px, rel=0.15)


def test_a_camera_that_was_moved_is_calibrated_anew_from_what_it_sees_then(walked: Walks) -> None:
    folds = CameraFolds(SIZE, NO_HORIZON)
    first = calibrations(folds.add([points_of(walked)]))
    assert first
    # What is found in the same interval before the move would stand behind it in the log.
    again = CameraFolds(SIZE, NO_HORIZON)
    assert not calibrations(again.add([points_of(walked), change("moved", 40)]))
    assert not calibrations(folds.add([change("moved", 40)]))
    elsewhere = walks(OTHER, people=7, seconds=10, noise_share=0.01)
    second = calibrations([*folds.add([points_of(elsewhere, after_s=60, first_track=100)]), *folds.finish()])
    assert second[-1].focal_px == pytest.approx(OTHER.focal_px, rel=0.15)
    assert second[-1].height_m == pytest.approx(OTHER.height_m, rel=0.15)


def test_few_tracks_do_not_replace_what_many_said_and_agree_with(walked: Walks) -> None:
    many = calibrations(
        CameraFolds(SIZE, NO_HORIZON).add([points_of(walks(CAMERA, people=16, seconds=16, noise_share=0.01))])
    )[-1]
    few = CameraFolds(SIZE, NO_HORIZON, many)
    assert not calibrations([*few.add([points_of(walked)]), *few.finish()])
    moved = CameraFolds(SIZE, NO_HORIZON, many)
    elsewhere = walks(OTHER, people=7, seconds=10, noise_share=0.01)
    assert calibrations([*moved.add([points_of(elsewhere)]), *moved.finish()])  # it contradicts what stands
    by_hand = CameraFolds(SIZE, NO_HORIZON, camera_calibrated(covariance=None, method="points"))
    assert not calibrations([*by_hand.add([points_of(elsewhere)]), *by_hand.finish()])
    covered = CameraFolds(SIZE, NO_HORIZON, many)
    assert not calibrations(covered.add([change("unknown", 0), points_of(walked)]))
    moved = CameraFolds(SIZE, NO_HORIZON, many)
    assert calibrations(moved.add([change("moved", 0), points_of(walked)]))


def test_another_size_of_the_frame_begins_anew_in_the_midst_of_a_batch(walked: Walks) -> None:
    large = Camera(2 * CAMERA.focal_px, CAMERA.pitch_rad, CAMERA.roll_rad, CAMERA.height_m, 1536, 1152)
    zoomed = walks(large, people=7, seconds=10, noise_share=0.01)
    small_points = points_of(walked)
    frame = int(small_points.data.column("frame")[-1].as_py()) + 1
    after = points_of(zoomed, after_s=60, first_frame=frame, first_track=100)
    both = EventBatch(TrackPoint, pa.concat_batches([small_points.data, after.data]))
    folds = CameraFolds(SIZE, CameraConfig(scale=CameraHeight(5.0, 0.1)))
    said = [*folds.add([both], [Resized(frame, 60_000_000, FrameSize(1536, 1152))]), *folds.finish()]
    assert {event.width for event in calibrations(said)} >= {768}
    estimates = [event for each in said if each.type is HorizonEstimate for event in events_of(each)]
    widths = [event.width for event in estimates if isinstance(event, HorizonEstimate)]
    assert (sorted(widths), set(widths)) == (widths, {768, 1536})


def test_a_length_that_was_marked_in_one_size_holds_in_the_other(walked: Walks) -> None:
    ends = CAMERA.project(np.array([[-1.0, 9.0, 0.0], [2.0, 9.0, 0.0]]))
    (x1, y1), (x2, y2) = ends.tolist()
    folds = CameraFolds(
        FrameSize(1536, 1152), CameraConfig(None, scale=KnownLength((2 * x1, 2 * y1), (2 * x2, 2 * y2), 3.0))
    )
    folds.resize(SIZE)
    found = calibrations([*folds.add([points_of(walked)]), *folds.finish()])
    assert (found[-1].scale, found[-1].height_m) == ("length", pytest.approx(CAMERA.height_m, rel=0.1))


def test_better_is_surer_or_contradicting() -> None:
    def of(focal: float, deviation: float, width: int = 768) -> CameraCalibrated:
        covariance = json.dumps(np.diag([deviation**2, 1e-4, 1e-4, 1e-2]).tolist())
        return camera_calibrated(
            focal_px=focal, pitch_rad=0.3, roll_rad=0.0, height_m=5.0, covariance=covariance, width=width
        )

    assert is_better(of(700, 10), of(700, 20))
    assert not is_better(of(710, 20), of(700, 10))
    assert is_better(of(800, 20), of(700, 10))
    assert not is_better(of(1410, 40, width=1536), of(700, 10))
    assert is_better(of(1410, 19, width=1536), of(700, 10))
