"""`vian extract calibration`, and what track points are on the ground from then on."""

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from psycopg.rows import dict_row

from events import (
    EventType,
    ProcessStarted,
    Producer,
    SceneChanged,
    StreamName,
    VideoAdded,
    batch_of,
    encode,
)
from extractors.calibration import CalibrationConfig, Camera
from store import Log, Projector
from store.field import field_session
from tests.events.examples import camera_calibrated, track_point
from tests.extractors.synthetic import walks
from tests.patterns.walkers import STATION
from tests.vian.conftest import Ran, Run
from vian.calibrating import config_for
from vian.errors import WrongUsage
from vian.querying import Scope, query

START = datetime(2026, 1, 1, 12, tzinfo=UTC)
PRODUCER = Producer("motion", "1", bytes(32))
Calibrate = Callable[..., Ran]


@pytest.fixture
def calibrate(log: Log, run: Run) -> Calibrate:
    def invoke(*arguments: object) -> Ran:
        return run("extract", "calibration", *arguments, "--dsn", log.dsn, "--station", STATION)

    return invoke


def say(log: Log, event: EventType, source: str = "cam-01") -> int:
    """Append the event; its position."""
    stream = StreamName.of(STATION, source, type(event).type_name)
    return log.append([encode(stream, batch_of([event]), PRODUCER)], [log.stream_head(stream).sequence])[0].position


def add_video(log: Log, source: str = "cam-01") -> None:
    size: dict[str, Any] = {"width": 768, "height": 576, "fps": 5.0, "frames_expected": 100, "codec": "h264"}
    say(log, VideoAdded(time=START, video="00", path="v", started_at=START, **size), source)


def walk(log: Log, camera: Camera, source: str = "cam-01") -> None:
    """Let people cross the view of the camera, whose frames are as large as those of `add_video`."""
    seen = walks(camera, people=9, seconds=12, noise_share=0.01, depth=0.18)
    points = []
    for at in range(len(seen.time_us)):
        x1, y1, x2, y2 = seen.boxes_xyxy[at].tolist()
        points.append(
            track_point(
                time=START + timedelta(microseconds=int(seen.time_us[at])), track_id=int(seen.track_id[at]),
                x=(x1 + x2) / 2, y=y2, x1=x1, y1=y1, x2=x2, y2=y2,
            )
        )  # fmt: skip
    stream = StreamName.of(STATION, source, "track_point")
    log.append([encode(stream, batch_of(points), PRODUCER)], [0])


def rows(log: Log, sql: str, **scope: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = query(log, sql, Scope(**scope)).to_pylist()
    return found


def test_a_camera_is_calibrated_from_its_tracks_once(calibrate: Calibrate, log: Log) -> None:
    add_video(log)
    camera = Camera(700.0, 0.4, 0.05, 5.0, 768, 576)
    walk(log, camera)
    ran = calibrate("--source", "cam-01", "--camera-height-m", "5", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert (told["calibrated"], told["scale"], told["height_m"]) == (
        True,
        "camera_height",
        pytest.approx(5.0, rel=0.02),
    )
    assert told["focal_px"] == pytest.approx(camera.focal_px, rel=0.1)
    assert "0 events appended" in calibrate("--source", "cam-01", "--camera-height-m", "5").out
    found = rows(log, "select * from track_ground where time >= (select max(time) from camera_calibrated)")
    assert found
    assert all(row["ground_x_deviation"] > 0 and row["ground_speed_deviation"] > 0 for row in found)
    named = told_position(log)
    every = rows(log, "select * from track_ground order by time, track_id", calibration=named)
    assert {row["calibration_position"] for row in every} == {named}
    seen = walks(camera, people=9, seconds=12, noise_share=0.01, depth=0.18)
    mapped = np.array([(row["ground_x"], row["ground_y"]) for row in every])
    told_m = np.array([(row["ground_x_deviation"], row["ground_y_deviation"]) for row in every])
    assert np.median(np.hypot(*(mapped - seen.feet_enu).T) / np.hypot(*told_m.T)) < 2


def test_tracks_of_a_model_are_read_by_the_parameters_for_a_models_boxes(
    calibrate: Calibrate, run: Run, log: Log
) -> None:
    def motion_ran(detector: str | None) -> None:
        values: dict[str, Any] = {"process": f"{detector}", "extractor": "motion", "extractor_version": "2"}
        configuration = json.dumps({"detector": detector})
        say(log, ProcessStarted(time=START, video="00", configuration=configuration, **values))

    def found_with() -> set[bytes]:
        types = ["camera_calibrated", "horizon_estimate"]
        return {segment.header.producer.configuration_hash for segment in log.read_all(types=types)}

    boxes = CalibrationConfig.of_boxes()
    add_video(log)
    motion_ran(None)
    motion_ran("c0ffee")
    walk(log, Camera(700.0, 0.4, 0.05, 5.0, 768, 576))
    assert calibrate("--source", "cam-01").code == 0
    assert found_with() == {boxes.config_hash}
    assert run("extract", "horizon", "--source", "cam-01", "--dsn", log.dsn, "--station", STATION).code == 0
    assert found_with() == {boxes.config_hash, boxes.camera.config_hash}
    motion_ran(None)
    assert config_for(log, STATION, "cam-01") == CalibrationConfig()


def test_psql_and_central_have_the_same_metres(calibrate: Calibrate, log: Log) -> None:
    add_video(log)
    walk(log, Camera(700.0, 0.4, 0.05, 5.0, 768, 576))
    assert calibrate("--source", "cam-01").code == 0
    say(log, track_point(time=START + timedelta(minutes=1), x=300.0, y=500.0, vx=0.0, vy=0.0, y1=400.0, y2=500.0))
    say(log, track_point(time=START + timedelta(minutes=1), x=300.0, y=-900.0, vx=5.0, vy=0.0))  # above the horizon
    Projector(log).catch_up()
    here = rows(log, "select * from track_ground order by position, sequence")
    with log.connection() as connection, connection.cursor(row_factory=dict_row) as cursor:
        there = cursor.execute("select * from track_ground order by position, sequence").fetchall()
    assert [row.keys() for row in here[:1]] == [row.keys() for row in there[:1]]
    for one, other in zip(here, there, strict=True):
        assert other == {name: pytest.approx(each, rel=1e-6, abs=1e-9) if isinstance(each, float) else each
                         for name, each in one.items()}  # fmt: skip
    assert here[-1]["ground_x"] is here[-1]["ground_x_deviation"] is None
    for stations, count in ((["elsewhere"], 0), ([STATION], len(here))):
        with field_session(log, stations) as session:
            asked = session.lines(
                "select count(ground_x_deviation) + 1 from field_track_ground", 1, rows_max=2, bytes_max=99
            )
            assert list(asked) == [f"[{max(count, 1)}]"]


def told_position(log: Log) -> int:
    (found,) = rows(log, "select max(position) as newest from camera_calibrated")
    return int(found["newest"])


def test_a_later_calibration_edits_nothing_and_points_can_be_read_through_it(log: Log) -> None:
    scale = "[[{0}, 0, 0], [0, {0}, 0], [0, 0, 1]]"
    for second in range(4):
        say(log, track_point(time=START + timedelta(seconds=second), x=10.0, y=20.0, vx=3.0, vy=4.0, y1=0.0, y2=20.0))
    say(log, track_point(time=START, x=10.0, y=20.0), "cam-02")
    first = say(log, camera_calibrated(time=START + timedelta(seconds=1), homography=scale.format(0.1)))
    better = say(log, camera_calibrated(time=START + timedelta(seconds=3), homography=scale.format(0.2)))
    asked = "select source, ground_x, ground_speed, ground_x_deviation, calibration_position as c from track_ground "
    asked += "order by source, time"
    told = [(row["source"], row["ground_x"], row["ground_speed"], row["c"]) for row in rows(log, asked)]
    assert told == [
        ("cam-01", 1.0, 0.5, first),  # by hand: of what was before it, too
        ("cam-01", 1.0, 0.5, first),
        ("cam-01", 1.0, 0.5, first),
        ("cam-01", 2.0, 1.0, better),
        ("cam-02", None, None, None),
    ]
    assert {row["ground_x_deviation"] for row in rows(log, asked)} == {None}  # these say no uncertainty
    through = [row["ground_x"] for row in rows(log, asked, calibration=better)]
    assert through == [2.0, 2.0, 2.0, 2.0, None]
    since = rows(log, asked, since=START + timedelta(seconds=2))
    assert [row["ground_x"] for row in since] == [1.0, 2.0]
    with pytest.raises(WrongUsage, match=rf"no calibration at position 99; there are: {first}, {better}"):
        rows(log, asked, calibration=99)


def test_a_calibration_ends_where_the_camera_is_moved_and_what_is_said_later_of_a_time_counts(log: Log) -> None:
    scale = "[[{0}, 0, 0], [0, {0}, 0], [0, 0, 1]]"

    def calibrate(factor: float, second: int) -> int:
        return say(log, camera_calibrated(time=START + timedelta(seconds=second), homography=scale.format(factor)))

    add_video(log)
    calibrate(0.1, 1)
    for second in range(6):
        say(log, track_point(time=START + timedelta(seconds=second), x=10.0, y=20.0))
    for cause, second in (("moved", 3), ("unknown", 5)):
        values: dict[str, Any] = {"cause": cause, "changed_share": 1.0, "dx": None, "dy": None}
        say(log, SceneChanged(time=START + timedelta(seconds=second), **values))
    calibrate(0.2, 4)
    asked = "select round(ground_x * 7.68, 3) as x from track_ground order by time"  # of 768 px for 100
    assert [row["x"] for row in rows(log, asked)] == [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]
    calibrate(0.3, 0)  # of the whole of the first view, said afterwards
    assert [row["x"] for row in rows(log, asked)] == [3.0, 3.0, 3.0, 2.0, 2.0, 2.0]


def test_what_is_found_of_a_view_that_is_over_is_recorded_and_not_told_as_what_stands(
    calibrate: Calibrate, log: Log
) -> None:
    add_video(log)
    walk(log, Camera(700.0, 0.4, 0.05, 5.0, 768, 576))
    moved: dict[str, Any] = {"cause": "moved", "changed_share": 1.0, "dx": None, "dy": None}
    say(log, SceneChanged(time=START + timedelta(minutes=1), **moved))
    for appended in (1, 0):
        told = json.loads(calibrate("--source", "cam-01", "--json").out)
        assert (told["calibrated"], told["appended"]) == (False, appended)
        assert "got 0" in told["reason"]
    assert [row["time"] for row in rows(log, "select time from camera_calibrated")] == [START]


def test_points_are_scaled_from_the_size_that_their_frames_had(log: Log) -> None:
    add_video(log)
    say(log, camera_calibrated(time=START, homography="[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", width=768, height=576))
    say(log, track_point(time=START, x=10.0, y=20.0))
    size: dict[str, Any] = {"width": 1536, "height": 576, "fps": 5.0, "frames_expected": 100, "codec": "h264"}
    say(log, VideoAdded(time=START, video="01", path="v", started_at=START, **size))
    say(log, track_point(time=START, x=10.0, y=20.0))
    found = [(row["ground_x"], row["ground_y"]) for row in rows(log, "select * from track_ground order by position")]
    assert found == [(10.0, 20.0), (5.0, 20.0)]


def test_too_little_calibrates_nothing_and_says_why(calibrate: Calibrate, log: Log, run: Run) -> None:
    ran = calibrate("--source", "cam-01")
    assert (ran.code, "the log has no video of source cam-01" in ran.words) == (1, True)
    assert f"Next: vian extract motion VIDEO --source cam-01 --station {STATION}" in ran.words
    add_video(log)
    elsewhere = run("extract", "calibration", "--source", "cam-01", "--dsn", log.dsn)
    assert f"Next: vian extract calibration --source cam-01 --station {STATION}" in elsewhere.words
    ran = calibrate("--source", "cam-01")
    assert (ran.code, "the log has no track points of source cam-01" in ran.words) == (1, True)
    say(log, track_point(time=START))
    ran = calibrate("--source", "cam-01")
    assert ran.code == 0  # that there is none is an answer
    assert ran.out == (
        "cam-01 is not calibrated: no camera follows from 1 track of 1 point: no track has moved yet. "
        "Next: let more people pass and run this again, or vian zones calibrate cam-01 POINTS.yaml --station "
        f"{STATION} with points that you know\n"
    )
    told = json.loads(calibrate("--source", "cam-01", "--json").out)
    assert (told["calibrated"], told["tracks"], told["points"], told["appended"]) == (False, 1, 1, 0)
    assert told["reason"].startswith("no track has moved")
    assert rows(log, "select * from camera_calibrated") == []


def test_what_was_given_and_contradicts_the_tracks_gives_no_camera(calibrate: Calibrate, log: Log) -> None:
    add_video(log)
    walk(log, Camera(700.0, 0.4, 0.05, 5.0, 768, 576))
    for slip in (("--camera-height-m", "50"), ("--length", "200,400,500,420,7300")):
        ran = calibrate("--source", "cam-01", *slip)
        assert ran.code == 0, ran.err
        assert "cam-01 is not calibrated: no camera follows from 9 tracks" in ran.out
        assert "contradicts its tracks" in ran.out
    assert rows(log, "select * from camera_calibrated") == []


def test_a_calibration_by_hand_is_replaced_where_that_is_wanted_alone(calibrate: Calibrate, log: Log) -> None:
    add_video(log)
    walk(log, Camera(700.0, 0.4, 0.05, 5.0, 768, 576))
    say(log, camera_calibrated(time=START, method="points", covariance=None, width=768, height=576))
    ran = calibrate("--source", "cam-01")
    assert (ran.code, "cam-01 has a calibration by hand" in ran.words) == (1, True), ran.words
    assert f"Next: vian extract calibration --source cam-01 --station {STATION} --replace" in ran.words
    assert len(rows(log, "select * from camera_calibrated")) == 1
    assert calibrate("--source", "cam-01", "--replace").code == 0
    assert len(rows(log, "select * from camera_calibrated")) > 1


@pytest.mark.parametrize(
    "arguments,message",
    [
        (
            ("--camera-height-m", "5", "--person-height-m", "1.7"),
            "give one of --camera-height-m, --length and --person-height-m",
        ),
        (("--camera-height-m", "-5"), "--camera-height-m must be from 0.01 to 10000 m, got -5"),
        (("--camera-height-m", "1e-320"), "--camera-height-m must be from 0.01 to 10000 m, got"),
        (("--person-height-m", "nan"), "--person-height-m must be from 0.1 to 10 m, got nan"),
        (("--person-height-m", "1e300"), "--person-height-m must be from 0.1 to 10 m, got 1e+300"),
        (("--length", "100,100,200,100,1e300"), "--length must be from 0.01 to 10000 m, got 1e+300"),
        (("--length", "100,100,200,100,inf"), "--length must be from 0.01 to 10000 m, got inf"),
        (("--length", "1,2,3,4"), "--length must be X1,Y1,X2,Y2,METRES such as"),
        (("--length", "1,2,1,2,3"), "--length must be of two points apart"),
        (("--length", "100,100,105,100,3"), "--length must be of points at least 10 px apart"),
        (("--length", "1,2,90000,4,5"), "the point 90000,4 lies outside the frame"),
    ],
)
def test_what_is_wrong_is_said(calibrate: Calibrate, log: Log, arguments: tuple[str, ...], message: str) -> None:
    add_video(log)
    ran = calibrate("--source", "cam-01", *arguments)
    assert (ran.code, message in ran.words) == (2, True), ran.words
