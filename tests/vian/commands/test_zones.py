"""`vian zones`: what is drawn, drawn anew, removed and imported; and rules that share it, from then on."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from events import CameraCalibrated, ZoneDefined, decode, events_of
from store import Log
from tests.patterns.walkers import STATION, add_video
from tests.vian.conftest import Ran, Run
from vian.errors import WrongUsage
from vian.zoning import GroundPoint, calibrated

SQUARE = "0.1,0.1 0.9,0.1 0.9,0.9"


@pytest.fixture
def zones(log: Log, run: Run):
    def invoke(*arguments: object) -> Ran:
        return run("zones", *arguments, "--dsn", log.dsn, "--station", STATION)

    return invoke


def told(ran: Ran) -> list[dict]:
    return [json.loads(line) for line in ran.out.splitlines()]


def test_a_zone_is_drawn_drawn_anew_removed_and_drawn_again(zones, log: Log) -> None:
    yard = ("define", "yard", "--source", "cam-01")
    assert told(zones(*yard, "--zone", SQUARE, "--author", "operator", "--json")) == [
        {"zone": "yard", "source": "cam-01", "changed": True, "version": 1}
    ]
    assert "stands so already" in zones(*yard, "--zone", SQUARE).out
    assert "stands so already" in zones(*yard, "--zone", SQUARE.replace(" ", ",")).out
    assert "version 2" in zones(*yard, "--zone", "0,0 1,0 1,1", "--reason", "fence moved").out
    assert "version 1" in zones("define", "door", "--source", "cam-01", "--line", "5,5 9,9", "--units", "pixels").out
    (door, found) = told(zones("list", "--json"))
    assert (found["name"], found["version"], found["points"], found["reason"]) == (
        "yard",
        2,
        "0,0 1,0 1,1",
        "fence moved",
    )
    assert (door["kind"], door["units"], door["points"]) == ("line", "pixels", "5,5 9,9")
    assert "its last version was 2" in zones("remove", "yard", "--source", "cam-01").out
    assert [each["name"] for each in told(zones("list", "--json"))] == ["door"]
    assert (
        "cam-01 has no zone or line 'yard'; there are: cam-01/door"
        in zones("remove", "yard", "--source", "cam-01").words
    )
    assert "version 3" in zones(*yard, "--zone", SQUARE).out
    stored = [
        event
        for segment in log.read_all(types=["zone_defined"])
        for event in events_of(decode(segment, log.catalogue))
        if isinstance(event, ZoneDefined)
    ]
    assert [(each.zone, each.zone_version, each.author) for each in stored] == [
        ("yard", 1, "operator"), ("yard", 2, None), ("door", 1, None), ("yard", 3, None),
    ]  # fmt: skip


def test_a_file_is_imported_and_only_what_changed_is_recorded(zones, tmp_path: Path) -> None:
    file = tmp_path / "zones.yaml"
    file.write_text("zones: {yard: {source: cam-01, polygon: [[0, 0], [1, 0], [1, 1]]}}\n"
                    "lines: {door: {source: cam-02, points: [[0, 0], [1, 0]]}}\n")  # fmt: skip
    assert told(zones("import", file, "--json")) == [{"zones": 2, "changed": 2}]
    file.write_text(file.read_text().replace("[1, 1]", "[0.5, 1]"))
    assert told(zones("import", file, "--json")) == [{"zones": 2, "changed": 1}]
    assert [each["source"] for each in told(zones("list", "--source", "cam-02", "--json"))] == ["cam-02"]


@pytest.mark.parametrize(
    "text,message",
    [
        (
            "zones: {yard: {source: cam-01, polygon: [[0, 0], [1, 0]]}}\n",
            "zones.yaml:1:15: zones.yard: a polygon needs",
        ),
        ("zones: {yard: {source: cam-01, polygn: []}}\n", "zones.yaml:1:32: zones.yard.polygn: unknown key"),
        ("zoens: {}\n", "zones.yaml:1:1: zoens: unknown key; there are: lines, zones"),
        ("{}\n", "has neither zones nor lines"),
        ("", "zones.yaml:1:1: a zones file is a mapping"),
        ("zones: [\n", "not YAML"),
        (
            "zones: {a: {source: c, polygon: [[0,0],[1,0],[1,1]]}}\nlines: {a: {source: c, points: [[0,0],[1,0]]}}\n",
            "'a' names both a zone and a line",
        ),
    ],
)
def test_a_file_that_is_wrong_is_told_with_its_place(run: Run, tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "zones.yaml"
    file.write_text(text)
    ran = run("zones", "import", file)
    assert ran.code == 2
    assert message in ran.words
    assert "Next: " in ran.words


@pytest.mark.parametrize(
    "arguments,message",
    [
        (("define", "yard", "--source", "cam-01"), "give either --zone or --line, got neither"),
        (("define", "yard", "--source", "cam-01", "--zone", SQUARE, "--line", "0,0 1,1"), "got both"),
        (("define", "yard", "--source", "cam-01", "--zone", "0,0 1"), "--zone must be points such as"),
        (("define", "yard", "--source", "cam-01", "--zone", "0,0 1,1"), "a polygon needs 3 points or more, got 2"),
        (("define", "yard", "--source", "cam-01", "--zone", "0,0 2,0 2,2"), "normalised coordinates lie in 0 to 1"),
        (("define", "yard", "--source", "cam-01", "--line", "0,0 0,0"), "a line's two points must differ"),
        (("define", "yard", "--source", "cam-01", "--zone", SQUARE, "--units", "feet"), "--units must be normalised"),
        (("define", "a yard", "--source", "cam-01", "--zone", SQUARE), "NAME is 1 to 64 of"),
        (("define", "yard", "--source", "cam/01", "--zone", SQUARE), "source"),
        (("import", "none.yaml"), "none.yaml: no such file or folder"),
        (("calibrate", "cam-01", "none.yaml"), "none.yaml: no such file or folder"),
    ],
)
def test_wrong_use_is_told(run: Run, arguments: tuple[str, ...], message: str) -> None:
    ran = run("zones", *arguments)
    assert ran.code == 2
    assert message in ran.words


def test_a_camera_is_calibrated_from_points(zones, log: Log, tmp_path: Path) -> None:
    file = tmp_path / "points.yaml"
    file.write_text(
        "points:\n"
        + "".join(
            f"  - {{px: [{x}, {y}], m: [{x / 10}, {(100 - y) / 10}]}}\n"
            for x, y in ((0, 0), (900, 0), (900, 80), (0, 80))
        )
    )
    add_video(log, "gate")
    words = zones("calibrate", "cam-01", file).words
    assert "the size of cam-01's frames is not known" in words
    assert f"it has of: gate --station {STATION}. Next: correct the name, or add `frame: [1920, 1080]` to" in words
    (tmp_path / "sized.yaml").write_text(file.read_text() + "frame: [100, 100]\n")
    words = zones("calibrate", "gtae", tmp_path / "sized.yaml").words
    assert f"no video of gtae of station {STATION} yet; it has of: gate --station {STATION}" in words
    assert "no video of gtae" in zones("define", "yard", "--source", "gtae", "--zone", SQUARE).words
    assert "warning" not in zones("define", "yard", "--source", "gate", "--zone", SQUARE).words
    add_video(log, "cam-01")
    ran = zones("calibrate", "cam-01", file, "--json")
    assert ran.code == 0, ran.err
    (values,) = told(ran)
    assert values["rms_m"] < 1e-9
    assert f"--source cam-01 --calibration {values['position']}" in ran.words
    assert "from 4 points; four always fit: a fifth shows how well" in zones("calibrate", "cam-01", file).out
    _, event, _ = [
        each
        for segment in log.read_all(types=["camera_calibrated"])
        for each in events_of(decode(segment, log.catalogue))
    ]
    assert isinstance(event, CameraCalibrated)
    matrix = np.array(json.loads(event.homography))
    assert matrix @ [450, 50, 1] / (matrix @ [450, 50, 1])[2] == pytest.approx([45, 5, 1])


@pytest.mark.parametrize("north, is_warned", [(4.0, False), (9.0, True)])
def test_points_that_miss_each_other_are_told(zones, tmp_path: Path, north: float, is_warned: bool) -> None:
    corners = [(0, 0, 10.0), (900, 0, 10.0), (900, 80, 2.0), (0, 80, 2.0), (450, 60, north)]
    points = "".join(f"  - {{px: [{x}, {y}], m: [{x / 10}, {m}]}}\n" for x, y, m in corners)
    (tmp_path / "points.yaml").write_text(f"frame: [900, 100]\npoints:\n{points}")
    ran = zones("calibrate", "cam-01", tmp_path / "points.yaml")
    assert ran.code == 0, ran.err
    assert ("warning: the points miss each other by" in ran.words) == is_warned


@pytest.mark.parametrize(
    "text,message",
    [
        ("points: [{px: [1, 2], m: [0, 0]}]\n", "points.yaml:1:9: points: wanted 4 values or more, got 1"),
        ("points: [{px: [1, 2], metres: [0, 0]}]\n", "points.yaml:1:23: points.0.metres: unknown key"),
        ("points: [\n", "not YAML"),
        ("", "a points file is a mapping"),
    ],
)
def test_points_that_are_wrong_are_told_with_their_place_and_what_next(
    run: Run, tmp_path: Path, text: str, message: str
) -> None:
    file = tmp_path / "points.yaml"
    file.write_text(text)
    ran = run("zones", "calibrate", "cam-01", file)
    assert (ran.code, message in ran.words) == (2, True), ran.words
    assert f"Next: correct {file}; vian zones calibrate --help says what it holds" in ran.words
    ran = run("zones", "calibrate", "cam-01", tmp_path)
    assert (ran.code, "cannot be read: Is a directory. Next: give a YAML file" in ran.words) == (2, True)


def test_points_that_fix_no_calibration_are_refused() -> None:
    def points(*pairs: tuple[float, float, float, float]) -> list[GroundPoint]:
        return [GroundPoint(px=(x, y), m=(east, north)) for x, y, east, north in pairs]

    with pytest.raises(WrongUsage, match="three of the four lie on a line"):
        calibrated(points((0, 0, 0, 0), (1, 0, 1, 0), (2, 0, 2, 0), (0, 1, 0, 1)), (10, 10))
    with pytest.raises(WrongUsage, match="both sides of the horizon"):
        calibrated(points((0, 0, 0, 0), (1, 0, 1, 0), (0, 1, 0, 1), (1, 1, -1, -1)), (10, 10))


def test_a_tilted_camera_is_calibrated_within_the_noise_of_its_points() -> None:
    truth = np.array([[0.02, 0.001, -10], [0.001, -0.03, 30], [0.00001, 0.0008, 1]])
    rng = np.random.default_rng(3)
    image = rng.uniform([0, 100], [1280, 720], (20, 2))
    mapped = np.column_stack([image, np.ones(20)]) @ truth.T
    ground = mapped[:, :2] / mapped[:, 2:] + rng.normal(0, 0.01, (20, 2))
    found, rms_m = calibrated(
        [GroundPoint(px=tuple(px), m=tuple(m)) for px, m in zip(image, ground, strict=True)], (1280, 720)
    )
    # Noise of 1 cm in each coordinate: the rest of the fit is below sqrt 2 cm.
    assert rms_m < 0.0142
    east, north = found.ground(image[:, 0], image[:, 1], None)
    assert np.abs(np.column_stack([east, north]) - mapped[:, :2] / mapped[:, 2:]).max() < 0.05


def test_zones_are_drawn_over_nothing_where_the_video_is_not_at_hand(zones, log: Log, tmp_path: Path) -> None:
    add_video(log, "cam-01")
    zones("define", "yard", "--source", "cam-01", "--zone", SQUARE)
    zones("define", "far", "--source", "cam-01", "--zone", "0,0 9,0 9,9", "--units", "metres")
    file = tmp_path / "zones.png"
    ran = zones("draw", "--source", "cam-01", "-o", file)
    assert ran.code == 0, ran.err
    assert "drawn without the picture" in ran.words
    assert "1 zones and lines drawn" in ran.out
    picture = cv2.imread(str(file))
    assert picture.std() > 1
    assert zones("draw", "--source", "cam-01", "-o", tmp_path / "no" / "zones.png").code == 1
