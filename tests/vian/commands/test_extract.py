"""`vian extract` at the command line; what it does is tried in `test_extraction` and `test_horizon_extraction`."""

import json
from pathlib import Path

import numpy as np
import pytest

from store import Log, Projector
from tests.extractors.films import film, film_of, turned
from tests.vian.conftest import Run
from tests.vian.samples import START, heads

pytestmark = pytest.mark.usefixtures("decoded_once")


def test_a_video_is_extracted_and_its_rows_are_there(log: Log, run: Run, clip: Path) -> None:
    options = ("--dsn", log.dsn, "--station", "brno", "--source", "gate", "--start", "2026-01-01T10:00:00Z")
    ran = run("extract", "motion", clip, *options, "--json")
    values = json.loads(ran.out)
    assert ran.code == 0
    assert (values["source"], values["frames"], values["gaps"], values["was_done"]) == ("gate", 60, 0, False)
    assert heads(log)["brno/gate/track_point"][0] > 30
    (points,) = {segment.header.time_min.date() for segment in log.read_all(types=["track_point"])}
    assert points == START.date()
    assert Projector(log).position == log.head()
    before = heads(log)
    again = run("extract", "motion", clip, *options)
    assert again.out == (
        f"process {values['process']}: 60 frames, {values['events']} events found besides the process's own, 0 gaps "
        "(done in an earlier run; --again 2 repeats it as a new process)\n"
    )
    assert heads(log) == before
    assert json.loads(run("extract", "motion", clip, *options, "--again", "2", "--json").out)["was_done"] is False


def test_a_video_in_which_nothing_moves_says_so(log: Log, run: Run, tmp_path: Path) -> None:
    still = film_of(tmp_path / "still.mkv", [np.full((120, 160), 90, np.uint8)] * 12, "gray")
    ran = run("extract", "motion", still, "--source", "gate", "--dsn", log.dsn)
    assert ran.code == 0
    assert "12 frames, 0 events found besides the process's own, 0 gaps: nothing moved that was large" in ran.out


def test_certificates_that_are_not_there_are_told(log: Log, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIAN_LIVE_CA_FILE", "gone.pem")
    ran = run("extract", "motion", "rtsps://127.0.0.1:9/1", "--source", "gate", "--dsn", log.dsn)
    assert (ran.code, "live_ca_file gone.pem cannot be read: No such file" in ran.words) == (2, True)


def test_what_is_odd_of_the_pictures_is_told_while_the_work_goes_on(log: Log, run: Run, tmp_path: Path) -> None:
    upright = turned(film(tmp_path / "film.mp4", frames=12))
    ran = run("extract", "motion", upright, "--source", "gate", "--dsn", log.dsn)
    assert "before frame 0: the pictures are turned upright" in ran.words
    assert "1 gap" in ran.out


def test_a_guessed_start_is_told(log: Log, run: Run, clip: Path) -> None:
    ran = run("extract", "motion", clip, "--source", "gate", "--dsn", log.dsn)
    assert "does not say when it was recorded: taking the file's modification time" in ran.words
    assert ran.words.count("modification time") == 1


@pytest.mark.parametrize(
    "video, options, code, said",
    [
        ("gone.mp4", [], 2, "gone.mp4: no such file or folder. Next: check the name"),
        (".", [], 1, "no pictures lie in this folder ("),
        ("ftp://host/1", [], 2, "an address must be rtsp://host/..., rtsps://host/..."),
        ("rtsp://user:geheim@127.0.0.1:9/1", [], 1, "rtsp://127.0.0.1:9/1: not a live stream that can be opened"),
        ("text.mp4", ["--fps", "0"], 2, "--fps must be above 0"),
        ("text.mp4", ["--resize", "720p"], 2, "--resize must be WIDTHxHEIGHT in px"),
        ("text.mp4", ["--resize", "1280x1"], 2, "--resize must leave at least 32 px of each side, got '1280x1'"),
        ("text.mp4", ["--person-height-m", "1e300"], 2, "--person-height-m must be from 0.1 to 10 m, got 1e+300"),
        ("text.mp4", ["--mask", "no.png"], 2, "no.png: no such file or folder"),
        ("text.mp4", ["--mask", "text.mp4"], 2, "text.mp4: is no picture, wanted a PNG"),
        ("text.mp4", ["--login-file", "text.mp4"], 2, "--login-file is for an address"),
        ("rtsp://host/1", ["--login-file", "gone"], 2, "gone: no such file or folder. Next:"),
        ("rtsp://host/1", ["--login-file", "."], 2, "--login-file . cannot be read: Is a directory. Next:"),
        ("text.mp4", [], 1, "text.mp4: not a video that can be opened"),
        ("text.mp4", ["--start", "noon"], 2, "--start must be a time such as"),
        ("text.mp4", ["--again", "0"], 2, "--again"),
        ("text.mp4", ["--class", "0"], 2, "--class needs --detector. Next: name the model file"),
        ("text.mp4", ["--detector", "gone.onnx"], 2, "gone.onnx: no such file or folder. Next:"),
        ("text.mp4", ["--source", "a b"], 2, "'a b'"),
        ("text.mp4", ["--station", "a/b"], 2, "'a/b'"),
    ],
)
def test_what_cannot_be_extracted_is_told(
    log: Log, run: Run, video: str, options: list[str], code: int, said: str
) -> None:
    Path("text.mp4").write_text("this is not a video\n" * 100)
    ran = run("extract", "motion", video, "--dsn", log.dsn, "--source", "gate", *options)
    assert (ran.code, ran.out) == (code, "")
    assert said in ran.words
    assert log.head() == 0


def test_a_source_must_be_named(log: Log, run: Run, clip: Path) -> None:
    ran = run("extract", "motion", clip, "--dsn", log.dsn)
    assert ran.code == 2
    assert "--source" in ran.words


@pytest.mark.parametrize("start, noted", [("2026-01-01T10:00", True), ("2026-01-01T12:00+02:00", False)])
def test_a_start_without_a_zone_is_utc_and_that_is_told(
    log: Log, run: Run, clip: Path, start: str, noted: bool
) -> None:
    ran = run("extract", "motion", clip, "--source", "gate", "--dsn", log.dsn, "--start", start)
    assert ran.code == 0
    assert ("--start names no time zone: taken as UTC, 2026-01-01T10:00:00+00:00" in ran.words) == noted
    assert min(segment.header.time_min for segment in log.read_all(types=["track_point"])).hour == START.hour


def test_the_horizon_is_looked_for_in_a_log_that_is_there(log: Log, run: Run, clip: Path) -> None:
    options = ("--dsn", log.dsn, "--station", "brno", "--source", "gate")
    assert run("extract", "motion", clip, *options, "--no-horizon").code == 0
    ran = run("extract", "horizon", *options)
    assert ran.code == 0
    assert "the tracks do not decide where the horizon is" in ran.out
    values = json.loads(run("extract", "horizon", *options, "--json").out)
    assert (values["source"], values["slope"], values["was_done"]) == ("gate", None, True)


def test_a_source_without_tracks_has_no_horizon(log: Log, run: Run) -> None:
    ran = run("extract", "horizon", "--dsn", log.dsn, "--source", "gate")
    assert (ran.code, ran.out) == (2, "")
    assert "the log holds no track points of source gate" in ran.words
    assert "Next: vian extract motion VIDEO --source gate" in ran.words
