"""Track points on the ground: whatever a log says of its cameras, DuckDB and PostgreSQL give the same metres."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from psycopg.rows import dict_row

from events import (
    CameraCalibrated,
    Catalogue,
    EventType,
    Producer,
    SceneChanged,
    StreamName,
    VideoAdded,
    batch_of,
    encode,
)
from extractors.calibration import Camera
from patterns.binding.binder import bind
from patterns.files.loading import parse_rule
from patterns.processor import ProcessorLimits, schemas
from patterns.scene.ground import Calibration
from store import Log, Projector
from store.epochs import begin_epoch
from tests.conftest import MakeLog
from tests.events.examples import camera_calibrated, track_point
from tests.patterns.walkers import STATION
from vian.backtesting import Span, backtested
from vian.calibrating import standing_calibration
from vian.querying import Scope, query
from vian.zoning import calibrate

START = datetime(2026, 1, 1, 12, tzinfo=UTC)
PRODUCER = Producer("motion", "1", bytes(32))
SIZES = ((100, 80), (200, 160), (320, 100))


def say(log: Log, source: str, *events: EventType) -> int:
    """Append the events, of one type, as one segment; its position."""
    stream = StreamName.of(STATION, source, type(events[0]).type_name)
    return log.append([encode(stream, batch_of(events), PRODUCER)], [log.stream_head(stream).sequence])[0].position


def at(second: int) -> datetime:
    return START + timedelta(seconds=second)


def video(second: int, size: tuple[int, int]) -> VideoAdded:
    values: dict[str, Any] = {"fps": 5.0, "frames_expected": None, "codec": "h264", "path": "v", "video": "00"}
    return VideoAdded(time=at(second), started_at=at(second), width=size[0], height=size[1], **values)


def change(second: int, cause: str = "moved") -> SceneChanged:
    values: dict[str, Any] = {"cause": cause, "changed_share": 1.0, "dx": None, "dy": None}
    return SceneChanged(time=at(second), **values)


def given(second: int, scale: float = 0.1) -> CameraCalibrated:
    """A calibration by hand: as many metres east and south as the scale has for a pixel."""
    return camera_calibrated(time=at(second), homography=f"[[{scale}, 0, 0], [0, {scale}, 0], [0, 0, 1]]")


def found(second: int, camera: Camera) -> CameraCalibrated:
    """A calibration from tracks."""
    values: dict[str, Any] = {name: getattr(camera, name) for name in ("focal_px", "pitch_rad", "roll_rad", "height_m")}
    return camera_calibrated(
        time=at(second), width=camera.width, height=camera.height, method="tracks", scale="person_height",
        homography=str(camera.homography.tolist()),
        covariance="[[9, 0, 0, 0.1], [0, 0.001, 0, 0], [0, 0, 0.001, 0], [0.1, 0, 0, 0.01]]", **values,
    )  # fmt: skip


def point(second: int, x: float = 10.0, y: float = 20.0) -> EventType:
    return track_point(time=at(second), x=x, y=y, vx=3.0, vy=4.0, y1=y - 20, y2=y)


def metres(log: Log) -> list[dict[str, Any]]:
    """The rows of `track_ground` from DuckDB, in the order of the log, after PostgreSQL has given the same."""
    sql = "select * from track_ground order by position, sequence"
    Projector(log).catch_up()
    here: list[dict[str, Any]] = query(log, sql).to_pylist()
    with log.connection() as connection, connection.cursor(row_factory=dict_row) as cursor:
        there = cursor.execute(sql).fetchall()
    assert len(here) == len(there)
    for one, other in zip(here, there, strict=True):
        assert other == {name: pytest.approx(each, rel=1e-6, abs=1e-9) if isinstance(each, float) else each
                         for name, each in one.items()}, one  # fmt: skip
    return here


def test_footage_from_before_a_calibration_by_hand_has_its_metres_but_not_across_a_move(log: Log) -> None:
    for second in range(6):
        say(log, "gate", point(second))
    say(log, "gate", change(1), change(3, "unknown"))
    say(log, "gate", given(4, 0.1))
    assert [row["ground_x"] for row in metres(log)] == [None, 1.0, 1.0, 1.0, 1.0, 1.0]
    say(log, "gate", given(5, 0.2))  # another of the same view, from its time on
    assert [row["ground_x"] for row in metres(log)] == [None, 1.0, 1.0, 1.0, 1.0, 2.0]
    say(log, "gate", given(0, 0.3))
    assert [row["ground_x"] for row in metres(log)] == [3.0, 1.0, 1.0, 1.0, 1.0, 2.0]


def test_what_tracks_said_of_a_camera_does_not_hold_before_its_time(log: Log) -> None:
    say(log, "gate", video(0, (100, 80)))
    say(log, "gate", found(3, Camera(90.0, 0.6, 0.0, 5.0, 100, 80)))
    for second in (2, 3):
        say(log, "gate", point(second, 50, 70))
    assert [row["ground_x"] for row in metres(log)] == [None, pytest.approx(0.0)]
    say(log, "gate", given(9))
    assert [row["ground_x"] for row in metres(log)] == [5.0, pytest.approx(0.0)]  # at 3 s one was valid already


def test_points_that_came_before_their_video_are_scaled_by_its_size(log: Log) -> None:
    say(log, "gate", point(0))
    say(log, "gate", given(0))
    assert [row["ground_x"] for row in metres(log)] == [1.0]
    say(log, "gate", video(0, (200, 100)))
    say(log, "gate", video(1, (50, 100)))
    assert [row["ground_x"] for row in metres(log)] == [0.5]


def test_what_has_no_metres_is_noted_once_with_the_next_command(
    log: Log, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def noted(**scope: Any) -> list[str]:
        caplog.clear()
        query(log, "select * from track_ground", Scope(**scope))
        return [each.getMessage() for each in caplog.records]

    say(log, "gate", change(1))
    for second in range(3):
        say(log, "gate", point(second))
        say(log, "street", point(second))
    calibration = say(log, "gate", given(5))
    (said,) = noted()
    assert said == (
        "track_ground: no calibration holds for 1 of 3 points of gate, 3 of 3 points of street, which have no metres. "
        f"Next: vian extract calibration --source gate --station {STATION} finds one or says what is missing; "
        f"vian zones calibrate gate POINTS.yaml --station {STATION}"
    )
    assert noted(sources=["gate"], since=at(1)) == []
    (said,) = noted(calibration=calibration)
    assert said == (
        f"track_ground: calibration {calibration} is of one view of gate, between two moves, so 1 of 3 points of "
        "gate, 3 of 3 points of street have no metres. "
        "Next: add --source gate, or leave --calibration out: then each point is read through that of its time"
    )
    monkeypatch.setenv("VIAN_STATION", STATION)
    assert "--source gate finds one" in noted()[0]
    for source in ("a", "b", "c"):
        say(log, source, point(0))
    assert "1 of 1 points of c and points of 2 more sources, which" in noted()[0]


def test_both_doors_give_the_same_metres_of_random_cameras(log: Log) -> None:
    """Videos, moves, sizes and calibrations of both kinds, in any order, before and after the points."""
    random = np.random.default_rng(20260101)
    moves: dict[str, list[datetime]] = {}
    said: dict[int, CameraCalibrated] = {}
    for number in range(40):
        source = f"cam-{number}"
        for _ in range(random.integers(6, 16)):
            event = _happening(random)
            position = say(log, source, event)
            if isinstance(event, CameraCalibrated):
                said[position] = event
            elif isinstance(event, SceneChanged) and event.cause == "moved":
                moves.setdefault(source, []).append(event.time)
    rows = metres(log)
    through = [(row, said[row["calibration_position"]]) for row in rows if row["calibration_position"] is not None]
    assert len(rows) > len(through) > 50
    assert any(used.time > row["time"] for row, used in through)
    every = [row for at in said for row in query(log, "select * from track_ground", Scope(calibration=at)).to_pylist()]
    named = [(row, said[row["calibration_position"]]) for row in every if row["calibration_position"] is not None]
    assert len(named) > len(through)
    for row, used in through + named:
        first, last = sorted((row["time"], used.time))
        assert not any(first < moved <= last for moved in moves.get(row["source"], [])), row


FOUND = found(3, Camera(90.0, 0.6, 0.0, 5.0, 100, 80))


@pytest.mark.parametrize(
    "said,known",
    [
        ([FOUND, change(5), given(8)], "...0055555"),
        ([FOUND, given(8)], "5550000055"),  # what tracks said was valid from its time on
        ([given(2), change(3, "unknown"), change(5), given(6, 0.2), given(8, 0.1)], "5555500055"),
        ([change(3), change(6), given(8)], "......5555"),
    ],
)
def test_a_rule_over_the_past_has_the_metres_that_queries_have(log: Log, said: list[EventType], known: str) -> None:
    say(log, "gate", video(0, (100, 80)))
    for second in range(10):
        for event in said:
            if event.time == at(second):
                say(log, "gate", event)
        # The first is final when the second comes, so it is judged by what is known now.
        say(log, "gate", point(second, 50, 70), track_point(time=at(second) + timedelta(seconds=0.5), x=-1.0))
    rule = parse_rule(
        "rule: where\nversion: 1\ntitle: where\nseverity: info\ntime: {lateness: 0 s}\nmatch: |\n"
        "  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence\n"
        "    MEASURES LAST(A.time) AS at, ground_x(LAST(A.x), LAST(A.y)) AS east\n"
        "    PATTERN (A) DEFINE A AS x = 50 AND ground_x(x, y) > -1)\n"
    )
    bound = bind(rule, schemas(log.catalogue))
    matches = backtested(log, bound, Span(), ProcessorLimits(), lambda position: None).matches
    rows = [row for row in metres(log) if row["x"] == 50]
    assert "".join("." if row["ground_x"] is None else f"{row['ground_x']:.0f}"[-1] for row in rows) == known
    assert [(each.measures["at"], each.measures["east"]) for each in matches] == [
        (row["time"], row["ground_x"]) for row in rows if row["ground_x"] is not None
    ]


def times(log: Log) -> tuple[str, str]:
    """Of each point that lies at x = 50, in order of time: a rule's metres over the past, and those of queries."""
    rule = parse_rule(
        "rule: where\nversion: 1\ntitle: where\nseverity: info\ntime: {lateness: 0 s}\nmatch: |\n"
        "  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence\n"
        "    MEASURES LAST(A.time) AS at, ground_x(LAST(A.x), LAST(A.y)) AS east\n"
        "    PATTERN (A) DEFINE A AS x = 50 AND ground_x(x, y) > -1)\n"
    )
    bound = bind(rule, schemas(log.catalogue))
    matches = backtested(log, bound, Span(), ProcessorLimits(), lambda position: None).matches
    east = {each.measures["at"]: each.measures["east"] for each in matches}
    rows = sorted((row for row in metres(log) if row["x"] == 50), key=lambda row: row["time"])
    asked = ([east.get(row["time"]) for row in rows], [row["ground_x"] for row in rows])
    ruled, queried = ("".join("." if each is None else f"{each:.0f}"[-1] for each in every) for every in asked)
    return ruled, queried


def pass_by(log: Log, *seconds: int) -> None:
    """Points at x = 50, each final before anything else is said."""
    for second in seconds:
        say(log, "gate", point(second, 50, 70), track_point(time=at(second) + timedelta(seconds=0.5), x=-1.0))


def calibrate_by_hand(log: Log, scale: float = 0.1) -> int:
    """As people do when all the footage so far is long past."""
    matrix = Calibration(((scale, 0.0, 0.0), (0.0, scale, 0.0), (0.0, 0.0, 1.0)), (100, 80))
    return calibrate(log, STATION, "gate", matrix, 0.0, at(3600))


def test_a_calibration_by_hand_is_of_the_footage_that_there_was(log: Log) -> None:
    say(log, "gate", video(0, (100, 80)))
    pass_by(log, 0, 1, 2)
    named = calibrate_by_hand(log)
    pass_by(log, 10)
    say(log, "gate", change(11))
    pass_by(log, 12, 13)
    assert times(log) == ("5555..", "5555..")
    through = query(log, "select * from track_ground where x = 50 order by time", Scope(calibration=named)).to_pylist()
    assert [row["ground_x"] for row in through] == [5.0, 5.0, 5.0, 5.0, None, None]
    calibrate_by_hand(log, 0.12)
    assert times(log) == ("555566", "555566")


def test_a_calibration_by_hand_is_of_its_video_or_of_now_where_nothing_has_passed(log: Log) -> None:
    calibrate_by_hand(log)
    say(log, "gate", video(5, (100, 80)))
    calibrate_by_hand(log)
    say(log, "gate", change(7))
    calibrate_by_hand(log)
    found = query(log, "select time from camera_calibrated order by position").to_pylist()
    assert [row["time"] for row in found] == [at(3600), at(5), at(7)]


def test_a_point_that_is_final_only_after_a_move_has_no_metres_of_the_next_view(log: Log) -> None:
    say(log, "gate", video(0, (100, 80)))
    for second in (0, 1, 2):
        say(log, "gate", point(second, 50, 70))
    say(log, "gate", change(3))
    pass_by(log, 4, 5)
    calibrate_by_hand(log)
    assert times(log) == ("...55", "...55")


NARROW, WIDE = (Camera(focal, 0.6, 0.0, 5.0, 100, 80) for focal in (90.0, 45.0))


@pytest.mark.parametrize("cause", ["moved", "unknown"])
def test_what_is_found_afterwards_of_each_view_holds_from_its_beginning(log: Log, cause: str) -> None:
    say(log, "gate", video(0, (100, 80)))
    pass_by(log, 1)
    say(log, "gate", found(1, WIDE))
    pass_by(log, 2)
    say(log, "gate", change(3, cause))
    pass_by(log, 4, 5)
    say(log, "gate", found(5, WIDE))
    pass_by(log, 6)
    first, second = (rescaled(found(second, NARROW), scale) for second, scale in ((0, 0.03), (3, 0.07)))
    say(log, "gate", first, second)
    assert times(log) == ("22444", "22444")


def rescaled(said: CameraCalibrated, scale: float) -> CameraCalibrated:
    """The same, of a ground that can be told from another by one figure."""
    nothing = dict.fromkeys(("focal_px", "pitch_rad", "roll_rad", "height_m"))
    return said.model_copy(update={"homography": f"[[{scale}, 0, 0], [0, {scale}, 0], [0, 0, 1]]", **nothing})


def test_what_is_found_of_a_view_that_is_over_is_not_of_the_next(log: Log) -> None:
    say(log, "gate", video(0, (100, 80)))
    pass_by(log, 1)
    say(log, "gate", change(2))
    pass_by(log, 3)
    say(log, "gate", found(0, NARROW))
    pass_by(log, 4)
    assert standing_calibration(log, STATION, "gate") is None
    assert times(log) == ("0..", "0..")
    say(log, "gate", found(2, NARROW), found(0, WIDE))
    pass_by(log, 5)
    assert standing_calibration(log, STATION, "gate") == found(2, NARROW)
    assert times(log) == ("0000", "0000")


def test_a_move_of_older_footage_does_not_end_a_later_calibration(log: Log) -> None:
    say(log, "gate", video(0, (100, 80)))
    say(log, "gate", change(5))
    say(log, "gate", given(6))
    pass_by(log, 7)
    say(log, "gate", change(3))
    assert standing_calibration(log, STATION, "gate") == given(6)
    pass_by(log, 8)
    assert times(log) == ("55", "55")
    say(log, "gate", change(9))
    assert standing_calibration(log, STATION, "gate") is None
    pass_by(log, 10)
    assert times(log) == ("55.", "55.")


def test_moves_of_one_time_begin_one_view(log: Log) -> None:
    say(log, "gate", video(0, (100, 80)))
    for _ in range(2):
        say(log, "gate", change(3))
    pass_by(log, 4)
    say(log, "gate", given(5))
    assert times(log) == ("5", "5")


def test_epochs_begin_their_sequences_anew_and_are_not_taken_for_each_other(make_log: MakeLog) -> None:
    first = make_log()
    say(first, "gate", video(0, (100, 80)))
    say(first, "gate", given(0, 0.1))
    pass_by(first, 1)
    say(first, "gate", change(2))
    pass_by(first, 3)
    say(first, "gate", given(4, 0.02))
    dsn = first.dsn
    first.close()
    begin_epoch(dsn, 2)
    with Log(dsn, Catalogue.shipped()) as second:
        say(second, "gate", video(20, (100, 80)))
        say(second, "gate", given(20, 0.06))
        pass_by(second, 21)
        say(second, "gate", change(22))
        pass_by(second, 23)
        assert times(second) == ("513.", "513.")


def _happening(random: np.random.Generator) -> EventType:
    second, kind = int(random.integers(8)), random.integers(10)
    if kind == 0:
        return video(second, SIZES[random.integers(3)])
    if kind in (1, 2):
        return change(second, ("moved", "unknown")[random.integers(2)])
    if kind == 3:
        return given(second, float(random.uniform(0.1, 0.3)))
    if kind == 4:
        width, height = SIZES[random.integers(3)]
        return found(
            second, Camera(float(random.uniform(60, 120)), 0.5, float(random.uniform(-0.1, 0.1)), 5.0, width, height)
        )
    return point(second, float(random.uniform(0, 100)), float(random.uniform(0, 80)))
