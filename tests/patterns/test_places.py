"""Shared zones and lines, calibrations and lists: the same answer in columns and in guards, and what may change."""

import json
from collections.abc import Mapping
from datetime import timedelta
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from events import EventType, SceneChanged, VideoAdded, ZoneDefined, ZoneRemoved
from patterns import Match, RuleError, RuleRun, RuleSetRun, Zone, bind, match, parse_rule
from patterns.errors import MatchError
from patterns.scene.geometry import Line
from patterns.scene.ground import Calibration
from patterns.scene.site import Site
from tests.events.examples import camera_calibrated
from tests.patterns.samples import BEGINNING, SCHEMAS

HEAD = """\
rule: sample
version: 1
title: sample
severity: info
shared: [yard, door]
params: {watch: [3, 5], limit: 36 km/h, ids: [a, b]}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (
    PARTITION BY source, track_id ORDER BY time, sequence
    MEASURES LAST(A.x) AS x
"""
SQUARE = ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0))
# East is x / 10 and north is (100 - y) / 10 near the lower edge, and the horizon lies at y = -1000.
CALIBRATION = Calibration(((0.1, 0, 0), (0, -0.1, 10), (0, 0.001, 1)), (1000, 1000))


def rows(points: list[tuple[float | None, float | None]], source: str = "cam-01", first_s: int = 0,
         track_id: int = 1) -> pa.Table:  # fmt: skip
    count = len(points)
    sequences = np.arange(first_s + 1, first_s + count + 1)
    columns = {
        "time": pa.array([BEGINNING + timedelta(seconds=int(at) - 1) for at in sequences], pa.timestamp("us", "UTC")),
        "station": ["s"] * count,
        "source": [source] * count,
        "type": ["track_point"] * count,
        "sequence": sequences,
        "track_id": [track_id] * count,
        "x": pa.array([x for x, _ in points], pa.float32()),
        "y": pa.array([y for _, y in points], pa.float32()),
        "vx": pa.array([10.0] * count, pa.float32()),
        "vy": pa.array([0.0] * count, pa.float32()),
    }
    return pa.table(columns)


def found(define: str, table: pa.Table, site: Site) -> list[float | None]:
    """The x of the rows that the condition is true for; asked of columns, and of a guard."""
    local = parse_rule(HEAD + f"    PATTERN (A B??) DEFINE A AS {define})\n")
    columns = [each.measures["x"] for each in match(bind(local, SCHEMAS, site=site), table)]
    # A disjunct that reads the match makes the whole a guard.
    guarded = parse_rule(HEAD + f"    PATTERN (A B??) DEFINE A AS {define} OR LAST(B.x) IS NOT NULL)\n")
    guards = [each.measures["x"] for each in match(bind(guarded, SCHEMAS, site=site), table)]
    assert columns == guards
    return columns  # type: ignore[return-value]


def site(**said: Any) -> Site:
    return Site.of({"cam-01": (1000, 1000)}, said, {"cam-01": CALIBRATION})


def zone(units: str = "pixels", source: str = "cam-01", points: Any = SQUARE) -> Zone:
    return Zone(source=source, units=units, polygon=points)


def test_a_shared_zone_is_of_each_source_that_defines_it() -> None:
    known = site(yard=[zone(), zone(source="cam-02", points=((20, 0), (30, 0), (30, 10)))])
    points = [(5.0, 5.0), (25.0, 5.0), (None, 5.0), (10.0, 10.0)]
    assert found("in_zone(x, y, 'yard')", rows(points), known) == [5.0, 10.0]
    assert found("in_zone(x, y, 'yard')", rows(points, "cam-02"), known) == [25.0]
    assert found("in_zone(x, y, 'yard')", rows(points, "cam-03"), known) == []
    assert found("NOT in_zone(x, y, 'yard')", rows(points, "cam-03"), known) == [5.0, 25.0, None, 10.0]
    assert found("NOT in_zone(x, y, 'yard')", rows(points), known) == [25.0]


def test_a_name_that_is_a_line_is_no_zone() -> None:
    line = Line(source="cam-01", units="pixels", points=((5, 0), (5, 10)))
    known = site(yard=[line], door=[line])
    assert found("in_zone(x, y, 'yard')", rows([(5.0, 5.0)]), known) == []
    steps = [(0.0, 5.0), (8.0, 5.0), (9.0, 5.0), (1.0, 5.0), (9.0, 50.0)]
    assert found("crosses(PREV(x), PREV(y), x, y, 'door', 'any')", rows(steps), known) == [8.0, 1.0]


def test_metres_are_asked_through_the_calibration() -> None:
    ground = ((0.0, 0.0), (50.0, 0.0), (50.0, 100.0), (0.0, 100.0))
    known = site(yard=[zone("metres", points=ground)],
                 door=[Line(source="cam-01", units="metres", points=((20, 0), (20, 100)))])  # fmt: skip
    # Below y = 100 px the ground lies south of the zone; above y = -1000 px there is no ground.
    points = [(100.0, 50.0), (100.0, 150.0), (700.0, 50.0), (100.0, -1500.0), (200.0, 50.0)]
    assert found("in_zone(x, y, 'yard')", rows(points), known) == [100.0, 200.0]
    east, north = CALIBRATION.ground(np.array([200.0]), np.array([50.0]), None)
    assert (east[0], north[0]) == pytest.approx((20 / 1.05, 5 / 1.05))
    assert found(f"ground_x(x, y) > {east[0] - 1e-6}", rows(points), known) == [700.0, 200.0]
    assert found("ground_y(x, y) IS NULL", rows(points), known) == [100.0]
    # 10 px/s to the right at y = 50 px is 1/1.05 m/s to the east.
    assert found("ground_speed(x, y, vx, vy) BETWEEN 0.952380 AND 0.952381", rows([(7.0, 50.0)]), known) == [7.0]
    assert found("ground_speed(x, y, vx, vy) > :limit", rows([(7.0, 50.0)]), known) == []
    # North is ahead: from west to east is from left to right of a line that runs north.
    steps = [(150.0, 50.0), (250.0, 50.0), (150.0, 50.0), (150.0, -1500.0), (250.0, 50.0)]
    right = "crosses(PREV(x), PREV(y), x, y, 'door', 'left_to_right')"
    assert found(right, rows(steps), known) == [250.0]


def test_speeds_in_kmh_and_distances_are_written_short() -> None:
    # 10 px/s to the right at y = 50 px is 1/1.05 m/s to the east.
    assert found("speed_kmh BETWEEN 3.428571 AND 3.428572", rows([(7.0, 50.0)]), site()) == [7.0]
    assert found("A.speed_kmh > 3.43 OR speed_kmh IS NULL", rows([(7.0, 50.0)]), site()) == []
    assert found("speed_kmh IS NULL", rows([(7.0, 50.0)], "cam-02"), site()) == [7.0]


def test_the_distance_of_two_rows_is_in_metres() -> None:
    define = "A AS TRUE, B AS distance_m(A, B) > 9.52 AND distance_m(B, A) < 9.53"
    head = HEAD.replace("LAST(A.x) AS x", "LAST(B.x) AS x, distance_m(A, B) AS apart, B.speed_kmh AS kmh")
    assert head != HEAD
    bound = bind(parse_rule(head + f"    PATTERN (A B) DEFINE {define})\n"), SCHEMAS, site=site())
    (one,) = match(bound, rows([(100.0, 50.0), (200.0, 50.0), (205.0, 50.0)]))
    assert one.measures["apart"] == pytest.approx(10 / 1.05)
    assert one.measures["kmh"] == pytest.approx(3.6 / 1.05)


def test_pixels_of_another_frame_size_are_scaled_to_the_calibrations() -> None:
    large = Site.of({"cam-01": (2000, 4000)}, {}, {"cam-01": CALIBRATION})
    points = [(400.0, 200.0)]
    (x,), (y,) = CALIBRATION.ground(np.array([200.0]), np.array([50.0]), None)
    assert found(f"ABS(ground_x(x, y) - {x}) < 1e-9 AND ABS(ground_y(x, y) - {y}) < 1e-9", rows(points), large) == [400]


def test_metres_of_a_source_without_calibration_are_null_and_the_others_have_theirs() -> None:
    points = rows([(5.0, 5.0), (50.0, 50.0)], "cam-02")
    line = Line(source="cam-02", units="metres", points=((20.0, -900.0), (20.0, 900.0)))
    known = site(yard=[zone("metres"), zone("metres", "cam-02")], door=[line])
    crosses = "crosses(PREV(x), PREV(y), x, y, 'door', 'any')"
    for asked in ("in_zone(x, y, 'yard')", crosses, "ground_x(x, y) > 0", "ground_speed(x, y, vx, vy) > 0"):
        assert found(asked, points, known) == []
        assert found(f"NOT {asked}", points, known) == []
    assert found("ground_y(x, y) IS NULL AND in_zone(x, y, 'yard') IS NULL", points, known) == [5.0, 50.0]
    both = pa.concat_tables([points, rows([(95.0, 50.0)])])
    assert found("in_zone(x, y, 'yard') AND ground_speed(x, y, vx, vy) > 0.1", both, known) == [95.0]


@pytest.mark.parametrize("uses_kernel", [True, False])
def test_a_rule_that_asks_for_metres_goes_on_beside_a_source_that_is_not_calibrated(uses_kernel: bool) -> None:
    define = "A AS in_zone(x, y, 'yard') AND ground_speed(x, y, vx, vy) > 0.1"
    bound = bind(parse_rule(HEAD + f"    PATTERN (A) DEFINE {define})\n"), SCHEMAS, site=site(yard=[zone("metres")]))
    group = RuleSetRun([bound], uses_kernel=uses_kernel)
    group.push(rows([(95.0, 50.0)], "cam-02"))
    group.push(rows([(95.0, 50.0)]))
    outcome = group.finish()["sample"]
    assert (group.failures, [each.first.stream for each in outcome.matches]) == ({}, ["s/cam-01/track_point"])


def test_values_of_a_list_are_found_in_it() -> None:
    points = [(1.0, 1.0)]
    assert found("track_id IN :watch", rows(points, track_id=3), site()) == [1.0]
    assert found("track_id IN (:watch)", rows(points, track_id=4), site()) == []
    assert found("track_id NOT IN :watch", rows(points, track_id=4), site()) == [1.0]
    assert found("track_id * 1.0 IN :watch", rows(points, track_id=5), site()) == [1.0]
    assert found("x IN :watch OR NOT x IN :watch", rows([(None, 1.0)]), site()) == []


@pytest.mark.parametrize(
    "define,message",
    [
        ("track_id IN :ids", "IN compares values of one type, got integer and string"),
        ("track_id = :watch", ":watch is a list; it stands after IN only"),
        ("track_id IN :limit", "IN takes a list, and the parameter :limit is none"),
        ("track_id IN :wotch", "unknown parameter :wotch"),
        ("in_zone(x, y, 'yrad')", "unknown zone 'yrad'; zones has: none; shared has: door, yard; did you mean 'yard'?"),
        ("distance_m(A) > 1", "wanted distance_m(a, b), the rows of two pattern variables, got 1 arguments"),
        ("distance_m(A, 3) > 1", "wanted distance_m(a, b), the rows of two pattern variables, got 3"),
        ("distance_m(A, C) > 1", "unknown pattern variable 'C'; there are: A"),
        ("ground_speed(x, y) > 1", "wanted ground_speed(x, y, vx, vy), got 2 arguments"),
    ],
)
def test_what_is_wrong_is_said(define: str, message: str) -> None:
    with pytest.raises(RuleError) as caught:
        bind(parse_rule(HEAD + f"    PATTERN (A) DEFINE A AS {define})\n"), SCHEMAS)
    assert message in caught.value.message


# What events say, and from when on.


def defined(name: str, version: int, points: Any, **changed: Any) -> ZoneDefined:
    plain: Mapping[str, Any] = {
        "time": BEGINNING, "zone": name, "kind": "zone", "zone_version": version, "points": json.dumps(points),
        "units": "pixels", "author": None, "reason": None,
    }  # fmt: skip
    return ZoneDefined(**{**plain, **changed})


def run_of(define: str, lateness: str = "2 s") -> RuleRun:
    text = HEAD.replace("match: |", f"time: {{lateness: {lateness}}}\nmatch: |")
    return RuleRun(bind(parse_rule(text + f"    PATTERN (A) DEFINE A AS {define})\n"), SCHEMAS))


def test_a_change_holds_for_rows_that_are_not_final_and_the_match_names_its_version() -> None:
    run = run_of("in_zone(x, y, 'yard')")
    far = ((100, 0), (110, 0), (110, 10), (100, 10))
    run.learn(defined("yard", 1, SQUARE), "s/cam-01/zone_defined", 1)
    first = run.push(rows([(5.0, 5.0)] * 6)).matches
    assert [each.last.sequence for each in first] == [1, 2, 3]
    run.learn(defined("yard", 2, far), "s/cam-01/zone_defined", 2)
    again = run_of("in_zone(x, y, 'yard')")
    again.restore(run.state())
    for each in (run, again):
        last = each.push(rows([(105.0, 5.0)] * 4, first_s=6)).matches + each.finish().matches
        assert [found.last.sequence for found in last] == [7, 8, 9, 10]
        judged = {found.judged_by["zone:yard"] for found in (*first, *last)}
        assert [(r.stream, r.first_sequence, r.last_sequence) for (r,) in sorted(judged, key=str)] == [
            ("s/cam-01/zone_defined", 1, 1),
            ("s/cam-01/zone_defined", 2, 2),
        ]


def test_a_match_over_a_change_names_both_versions() -> None:
    text = HEAD + "    PATTERN (A{4}) DEFINE A AS in_zone(x, y, 'yard'))\n"
    run = RuleRun(bind(parse_rule(text), SCHEMAS))
    run.learn(defined("yard", 1, SQUARE), "s/cam-01/zone_defined", 1)
    run.push(rows([(5.0, 5.0)] * 3))
    run.learn(defined("yard", 2, [*SQUARE[:3], (0, 11)]), "s/cam-01/zone_defined", 2)
    (found,) = run.push(rows([(5.0, 5.0)] * 3, first_s=3)).matches
    assert [each.first_sequence for each in found.judged_by["zone:yard"]] == [1, 2]


def test_a_row_that_waits_while_its_zone_is_redrawn_looks_ahead_to_no_later_row() -> None:
    far = ((200, 0), (210, 0), (210, 10), (200, 10))
    run = run_of("in_zone(x, y, 'yard') AND NEXT(x) < 50", "0 s")
    found: list[Match] = []
    for second, (points, x) in enumerate([(SQUARE, 5.0), (SQUARE, 100.0), (far, 7.0), (SQUARE, 100.0), (SQUARE, 0.0)]):
        run.learn(defined("yard", second + 1, points), "s/cam-01/zone_defined", second + 1)
        found += run.push(rows([(x, 5.0)], first_s=second)).matches
    assert (found, run.finish().matches) == ([], ()), "behind each row in the yard is one with x = 100"


def test_a_removed_zone_is_nowhere() -> None:
    run = run_of("in_zone(x, y, 'yard')")
    run.learn(defined("yard", 1, SQUARE), "s/cam-01/zone_defined", 1)
    run.learn(ZoneRemoved(time=BEGINNING, zone="yard", zone_version=1, author=None, reason=None), "s/cam-01/x", 1)
    assert run.push(rows([(5.0, 5.0)] * 9)).matches == ()


def test_a_calibration_is_learnt_and_named() -> None:
    run = run_of("ground_x(x, y) > 0", "0 s")
    matrix = json.dumps(CALIBRATION.matrix)
    calibrated = camera_calibrated(time=BEGINNING, homography=matrix, width=1000, height=1000)
    run.learn(calibrated, "s/cam-01/camera_calibrated", 4)
    (found,) = run.push(rows([(5.0, 5.0)] * 2)).matches
    assert [each.first_sequence for each in found.judged_by["calibration"]] == [4]


@pytest.mark.parametrize(
    "event,message",
    [
        (defined("yard", 1, [[0, 0], [1, 1]]), "defines no zone 'yard': a polygon needs 3 points"),
        (defined("yard", 1, 7), "defines no zone 'yard'"),
        (defined("yard", 1, [[0, 0], [1, 2]], kind="line", units="normalised"), "defines no line 'yard': normalised"),
        (camera_calibrated(homography="[[1, 2]]"), "says no"),
        (camera_calibrated(homography="[[0,0,0],[0,0,0],[0,0,0]]"), "must not be singular"),
    ],
)  # fmt: skip
def test_an_event_that_says_no_place_is_named(event: EventType, message: str) -> None:
    with pytest.raises(MatchError, match=message):
        Site().learn(event, "s/cam-01/some", 3)


def test_a_site_is_saved_whole() -> None:
    known = site(yard=[zone("metres"), zone(source="cam-02")], door=[Line(source="c", points=((0, 0), (1, 1)))])
    known.learn(VideoAdded(time=BEGINNING, video="v", path="p", width=64, height=48, fps=None, frames_expected=None,
                           codec="c", started_at=BEGINNING), "s/cam-09/video_added", 1)  # fmt: skip
    known.learn(ZoneRemoved(time=BEGINNING, zone="yard", zone_version=1, author=None, reason=None), "s/cam-02/x", 1, 9)
    assert Site.from_json(json.loads(json.dumps(known.to_json()))) == known
    assert known.frame_sizes["cam-09"] == (64, 48)


def test_metres_end_where_the_camera_is_moved_and_begin_with_its_next_calibration() -> None:
    run = run_of("speed_kmh > 3", "0 s")
    calibrated = camera_calibrated(homography=json.dumps([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 1]]), time=BEGINNING)
    moved_at = BEGINNING + timedelta(seconds=3)
    changes: list[tuple[EventType | None, str]] = [
        (None, ""),
        (calibrated, "camera_calibrated"),
        (scene_changed(cause="unknown"), "scene_changed"),
        (scene_changed(cause="moved", time=moved_at), "scene_changed"),
        (calibrated.model_copy(update={"time": moved_at}), "camera_calibrated"),
    ]
    found: list[Match] = []
    for second, (event, name) in enumerate(changes):
        if event is not None:
            run.learn(event, f"s/cam-01/{name}", second)
        found += run.push(rows([(5.0, 5.0)], first_s=second)).matches
    found += run.finish().matches
    # A row is judged when the next one comes, by what was said before that.
    assert [each.first.sequence for each in found] == [1, 2, 4, 5]
    assert [each.judged_by["calibration"][0].first_sequence for each in found] == [1, 1, 4, 4]


def scene_changed(**changed: Any) -> SceneChanged:
    return SceneChanged(**({"time": BEGINNING, "changed_share": 1.0, "dx": None, "dy": None} | changed))
