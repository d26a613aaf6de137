"""`vian evaluate`: what is measured, and what cannot be."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.vian.conftest import Run
from tests.vian.evaluation.cameras import Pinhole, walkers
from vian.evaluation.boxes import Boxes
from vian.evaluation.files import write_mot

CAMERA = Pinhole(pitch=0.05)
BOXES, PLACES = walkers(CAMERA, np.random.default_rng(4), tracks=6)
HEAD = "scene,frame,t,id,x,y,w,h"
TSAI = """<Camera><Geometry width="640" height="480" dpx="0.01" dpy="0.01"/>
<Intrinsic focal="7" kappa1="0" cx="320" cy="240" sx="1"/>
<Extrinsic tx="0" ty="5000" tz="0" rx="{rx}" ry="0" rz="0"/></Camera>"""
PETS = '<dataset><frame number="0"><objectlist>{}</objectlist></frame></dataset>'
BOX = '<object id="1"><box xc="{}" yc="50" w="{}" h="40"/></object>'


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """A folder of two scenes, the same tracks in both."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    rows = [
        f"{scene},{frame},{frame / 10},{track},{x1:.3f},{y1:.3f},{x2 - x1:.3f},{y2 - y1:.3f}"
        for scene in ("000", "001")
        for frame, track, (x1, y1, x2, y2) in zip(BOXES.frame, BOXES.track_id, BOXES.xyxy, strict=True)
    ]
    (folder / "tracks.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    line = {"a": CAMERA.horizon.slope, "b": CAMERA.horizon.offset}
    truth = {name: {"width": 640, "height": 480, "horizon": line, "source": "made"} for name in ("000", "001")}
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder


def told(out: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.splitlines()]


def test_horizons_of_a_folder_are_measured_scene_by_scene_and_in_sum(scenes: Path, run: Run) -> None:
    ran = run("evaluate", "horizon", scenes, "--method", "B", "--method", "A", "--json")
    assert ran.code == 0
    said = told(ran.out)
    assert [(each["scene"], each["method"]) for each in said[:4]] == [
        ("000", "B"), ("001", "B"), ("000", "A"), ("001", "A"),
    ]  # fmt: skip
    assert said[0]["error"] < 0.03
    assert [(each["method"], each["scenes"], each["abstained"]) for each in said[4:]] == [("B", 2, 0), ("A", 2, 0)]
    assert said[4]["AUC"] > 0.88


def test_errors_are_plotted_and_scenes_are_drawn(scenes: Path, run: Run, tmp_path: Path) -> None:
    svg, png = tmp_path / "errors.svg", tmp_path / "errors.png"
    for file in (svg, png):
        assert run("evaluate", "horizon", scenes, "--plot", file, "--overlays", tmp_path / "drawn").code == 0
    first = svg.read_bytes()
    assert b"<svg" in first
    assert cv2.imread(str(png)) is not None
    run("evaluate", "horizon", scenes, "--plot", svg)
    assert svg.read_bytes() == first
    pictures = sorted((tmp_path / "drawn").iterdir())
    assert [each.name for each in pictures] == ["000.png", "001.png"]
    drawn = cv2.imread(str(pictures[0]))
    assert drawn is not None
    assert drawn.shape[1] == 400
    assert pictures[0].stat().st_size < 60_000


@pytest.mark.parametrize(
    "rows, code, wanted",
    [
        ("", 2, "the file is empty"),
        (HEAD, 2, "no row in it"),
        ("scene,frame,id\n000,1,1", 2, "no column t, x, y, w, h"),
        (f"{HEAD}\n000,0,0,1,5,5,-3,9", 2, "a box of -3 x 9 px"),
        (f"{HEAD}\n000,0,0,1,5,nan,3,9", 2, "not finite"),
        (f"{HEAD}\n000,0,,1,5,5,3,9", 2, "no time"),
        (f"{HEAD}\n000,0,1e300,1,5,5,3,9", 2, "no time"),
        (f"{HEAD}\n000,0,0,1,5,5,,9", 2, "not finite"),
        (f"{HEAD}\n000,0,0,1,5,five,3,9", 2, "five"),
        (f"{HEAD}\n000,0.5,0,1,5,5,3,9", 2, "0.5"),
        (f"{HEAD}\n000,0,0,1,5,5,3,9\n000,0,0,1,5,5,3,9", 2, "track 1 has two boxes in frame 0"),
        (f"{HEAD}\n000,-1,0,1,5,5,3,9", 2, "before the first frame"),
        (f"{HEAD}\n000,0,0,1,5,5,3,9", 2, "scene 001 is in one of"),
        (None, 1, "no tracks.csv"),
    ],
)
def test_tracks_that_cannot_be_are_told(scenes: Path, run: Run, rows: str | None, code: int, wanted: str) -> None:
    (scenes / "tracks.csv").unlink()
    if rows is not None:
        (scenes / "tracks.csv").write_text(rows)
    ran = run("evaluate", "horizon", scenes)
    assert (ran.code, wanted in ran.words, "Next: " in ran.words) == (code, True, True), ran.err


@pytest.mark.parametrize(
    "truth, wanted",
    [
        ("{}", "no scene in it"),
        ('{"000": {"width": 640, "height": 480}}', "000.horizon"),
        ('{"000": {"width": 640, "height": 480, "horizon": {"a": NaN, "b": 3}}}', "finite number"),
        ('{"000": {"width": -1, "height": 480, "horizon": {"a": 0, "b": 3}}}', "000.width"),
        ("[1]", "the whole"),
        ("a: 3", "not JSON"),
    ],
)
def test_truths_that_cannot_be_are_told(scenes: Path, run: Run, truth: str, wanted: str) -> None:
    (scenes / "truth.json").write_text(truth)
    ran = run("evaluate", "horizon", scenes)
    assert (ran.code, wanted in ran.words, "Next: " in ran.words) == (2, True, True), ran.err


def test_options_that_do_not_fit_are_told(scenes: Path, run: Run, tmp_path: Path) -> None:
    assert "--method must be one of" in run("evaluate", "horizon", scenes, "--method", "C").words
    assert "--plot must end with" in run("evaluate", "horizon", scenes, "--plot", "errors.doc").words
    assert "goes with a video" in run("evaluate", "horizon", scenes, "--truth", scenes / "truth.json").words
    absent = run("evaluate", "horizon", tmp_path / "none.mp4")
    assert (absent.code, "no such file" in absent.words) == (2, True)
    (tmp_path / "a.mp4").write_text("x")
    assert "--truth FILE" in run("evaluate", "horizon", tmp_path / "a.mp4").words
    is_no_video = run("evaluate", "horizon", tmp_path / "a.mp4", "--truth", scenes / "truth.json")
    assert (is_no_video.code, "not a video" in is_no_video.words) == (1, True)


def test_a_video_is_measured_against_its_truth_and_not_that_of_another_frame(
    clip: Path, run: Run, tmp_path: Path
) -> None:
    video = cv2.VideoCapture(str(clip))
    width, height = (int(video.get(each)) for each in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    video.release()
    truth = {"width": 2 * width, "height": 2 * height, "horizon": {"a": 0.0, "b": 40.0}}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    ran = run("evaluate", "horizon", clip, "--truth", tmp_path / "truth.json", "--overlays", tmp_path / "o", "--json")
    assert ran.code == 0
    assert told(ran.out)[0]["scene"] == clip.name
    assert len(list((tmp_path / "o").iterdir())) == 1
    (tmp_path / "truth.json").write_text(json.dumps(truth | {"width": 3 * width}))
    ran = run("evaluate", "horizon", clip, "--truth", tmp_path / "truth.json")
    assert (ran.code, "give the truth of this picture" in ran.words) == (2, True)


def test_tracks_of_files_are_scored(run: Run, tmp_path: Path) -> None:
    write_mot(BOXES, tmp_path / "gt.txt")
    write_mot(BOXES.where(BOXES.frame > 9), tmp_path / "late.txt")
    ran = run("evaluate", "tracks", tmp_path / "gt.txt", tmp_path / "gt.txt", tmp_path / "late.txt", "--json")
    assert ran.code == 0
    (same, late) = told(ran.out)
    assert (same["HOTA"], same["MOTA"], same["IDF1"]) == (1.0, 1.0, 1.0)
    assert (late["MOTA"], late["misses"]) == (0.75, 60)


def test_detections_are_tracked_before_they_are_scored(run: Run, tmp_path: Path) -> None:
    write_mot(BOXES, tmp_path / "gt.txt")
    free = Boxes(BOXES.frame, np.full_like(BOXES.track_id, -1), BOXES.xyxy, BOXES.confidence, BOXES.time_us)
    write_mot(free, tmp_path / "det.txt")
    files = ("evaluate", "tracks", tmp_path / "gt.txt", tmp_path / "det.txt", "--fps", 10)
    (found,) = told(run(*files, "--truth-size", "640x480", "--json").out)
    assert found["found tracks"] >= 5
    assert found["MOTA"] > 0.5
    ran = run(*files)
    assert (ran.code, "Next: --truth-size" in ran.words) == (2, True)
    with (tmp_path / "det.txt").open("a") as file:
        file.write("99,7,5,5,9,9,1,-1,-1,-1\n")
    ran = run(*files)
    assert (ran.code, "with and without a track" in ran.words) == (2, True)


def test_truth_that_is_not_to_be_considered_is_left_out(run: Run, tmp_path: Path) -> None:
    (tmp_path / "gt.txt").write_text("1,1,5,5,9,9,1,-1,-1,-1\n1,2,50,50,9,9,0,-1,-1,-1\n")
    (tmp_path / "found.txt").write_text("1,1,5,5,9,9\n")
    (found,) = told(run("evaluate", "tracks", tmp_path / "gt.txt", tmp_path / "found.txt", "--json").out)
    assert (found["true boxes"], found["MOTA"]) == (1, 1.0)


@pytest.mark.parametrize(
    "name, text, wanted",
    [
        ("a.txt", "", "the file is empty"),
        ("a.txt", "1,1,5,5\n", "rows of 4 columns"),
        ("a.txt", "1,1,5,5,9,9\n1,2,5,5,9\n", "rows of 5, 6 columns"),
        ("a.txt", "frame,id,x,y,w,h\n1,1,5,5,9,9\n", "drop headers"),
        ("a.txt", "1,1,5,5,nan,9\n", "row 1 has a number that is not finite"),
        ("a.txt", "99999999999,1,5,5,9,9\n", "is of frame 99999999998"),
        ("a.txt", "1,1,5,5,1e200,9\n", "reaches 1e+200 px"),
        ("a.txt", "1,1,5,5,9,0\n", "a box of 9 x 0 px"),
        ("a.txt", "1,1,5,5,9,-4\n", "a box of 9 x -4 px"),
        ("a.txt", "0,1,5,5,9,9\n", "before the first frame"),
        ("a.txt", "1.5,1,5,5,9,9\n", "wanted a whole number"),
        ("a.txt", "inf,1,5,5,9,9\n", "wanted a whole number"),
        ("a.txt", "1,1,5,5,9,9\n1,1,6,6,9,9\n", "two boxes in frame 0"),
        ("a.xml", "<dataset>", "not an annotation"),
        ("a.xml", "<dataset/>", "no boxes in it"),
        ("a.xml", PETS.format(BOX.format("five", 20)), "not an annotation"),
        ("a.xml", PETS.format(BOX.format(5, -20)), "a box of -20 x 40 px"),
    ],
)
def test_boxes_that_cannot_be_are_told(run: Run, tmp_path: Path, name: str, text: str, wanted: str) -> None:
    (tmp_path / name).write_text(text)
    write_mot(BOXES, tmp_path / "gt.txt")
    for files in ((name, "gt.txt"), ("gt.txt", name)):
        ran = run("evaluate", "tracks", *(tmp_path / each for each in files))
        assert (ran.code, wanted in ran.words, "Next: " in ran.words) == (2, True, True), ran.err


def test_files_of_tracks_that_are_not_there(run: Run, tmp_path: Path) -> None:
    ran = run("evaluate", "tracks", tmp_path / "gt.txt", tmp_path / "found.txt")
    assert (ran.code, "no such file" in ran.words) == (2, True)


def test_a_video_is_scored_against_truth_of_its_own_frame(clip: Path, run: Run, tmp_path: Path) -> None:
    write_mot(BOXES, tmp_path / "gt.txt")
    ran = run("evaluate", "tracks", tmp_path / "gt.txt", clip, "--truth-size", "640")
    assert (ran.code, "must be like 768x576" in ran.words) == (2, True)
    ran = run("evaluate", "tracks", tmp_path / "gt.txt", clip, "--truth-size", "64x48")
    assert (ran.code, "Next: " in ran.words) == (2, True)


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """A camera 5 m above the ground that looks down by 20 degrees; the world's y is ahead."""
    file = tmp_path / "camera.xml"
    pitch = np.radians(20)
    file.write_text(
        TSAI.format(rx=np.pi / 2 + pitch)
        .replace('ty="5000"', f'ty="{5000 * np.cos(pitch)}"')
        .replace('tz="0"', f'tz="{5000 * np.sin(pitch)}"')
    )
    return file


def test_positions_are_measured_against_a_published_calibration(run: Run, tmp_path: Path, published: Path) -> None:
    camera = Pinhole(pitch=float(np.radians(20)))
    boxes, _ = walkers(camera, np.random.default_rng(8), tracks=6)
    write_mot(boxes, tmp_path / "gt.txt")
    said = {"homography": json.dumps(camera.homography.tolist()), "width": 640, "height": 480}
    (tmp_path / "calibration.json").write_text(json.dumps(said))
    arguments = ("evaluate", "ground", published, tmp_path / "gt.txt", "--calibration", tmp_path / "calibration.json")
    ran = run(*arguments, "--fps", 10, "--json")
    assert ran.code == 0, ran.err
    (found,) = told(ran.out)
    assert found["median_m"] < 1e-3  # the file rounds to 1/1000 px
    assert found["speed_error"] < 1e-3
    assert found["tracks"] == 6
    assert "positions of 6 tracks off by 0.000 m" in run(*arguments).out


def test_the_camera_is_calibrated_from_tracks_or_not_at_all(run: Run, tmp_path: Path, published: Path) -> None:
    camera = Pinhole(pitch=float(np.radians(20)))
    boxes, _ = walkers(camera, np.random.default_rng(8), tracks=30)
    write_mot(boxes, tmp_path / "gt.txt")
    arguments = ("evaluate", "ground", published, tmp_path / "gt.txt")
    (found, matched) = told(run(*arguments, tmp_path / "gt.txt", "--fps", 10, "--json").out)
    assert found["median_m"] < 1.0
    assert (found["feet"], matched["feet"], matched["positions"]) == ("annotated", "found", len(boxes))
    write_mot(boxes.where(boxes.track_id == 1), tmp_path / "one.txt")
    ran = run(*arguments, tmp_path / "one.txt")
    assert (ran.code, "do not decide the camera" in ran.words, "Next: " in ran.words) == (1, True, True)
    ran = run(*arguments)
    assert (ran.code, "got neither" in ran.words) == (2, True)


@pytest.mark.parametrize(
    "said, wanted",
    [
        ({"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "cannot be inverted"),
        ({"homography": [[1, 0, 0], [0, 1, 0]]}, "homography"),
        ({"homography": [[1, 0, 0], [0, float("nan"), 0], [0, 0, 1]]}, "finite number"),
        ({"homography": "[[1,"}, "not JSON"),
        ({"homography": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "fewer than two"),
        ({"width": 480}, "for frames of 480x480 px"),
        ({"height": -480}, "height"),
    ],
)
def test_calibrations_that_cannot_be_are_told(
    run: Run, tmp_path: Path, published: Path, said: dict[str, Any], wanted: str
) -> None:
    write_mot(BOXES, tmp_path / "gt.txt")
    whole = {"homography": np.eye(3).tolist(), "width": 640, "height": 480} | said
    (tmp_path / "calibration.json").write_text(json.dumps(whole))
    ran = run("evaluate", "ground", published, tmp_path / "gt.txt", "--calibration", tmp_path / "calibration.json")
    assert (ran.code, wanted in ran.words, "Next: " in ran.words) == (2, True, True), ran.err


def test_cameras_and_truths_that_do_not_fit_are_told(run: Run, tmp_path: Path, published: Path) -> None:
    (tmp_path / "calibration.json").write_text(
        json.dumps({"homography": np.eye(3).tolist(), "width": 64, "height": 48})
    )
    write_mot(BOXES.scaled(3, 3), tmp_path / "gt.txt")
    calibration = ("--calibration", tmp_path / "calibration.json")
    ran = run("evaluate", "ground", published, tmp_path / "gt.txt", *calibration)
    assert (ran.code, "lie outside a frame of 640x480 px" in ran.words) == (2, True)
    published.write_text("<Camera/>")
    ran = run("evaluate", "ground", published, tmp_path / "gt.txt", *calibration)
    assert (ran.code, "not a Tsai calibration" in ran.words) == (2, True)
    ran = run("evaluate", "ground", tmp_path / "none.xml", tmp_path / "gt.txt", *calibration)
    assert (ran.code, "no such file" in ran.words) == (2, True)
