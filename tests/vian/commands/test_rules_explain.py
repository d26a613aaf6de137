"""`vian rules explain`: a situation's rows by variable, its rule and extractor, drawn on the video."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from events import SituationDetected, VideoAdded
from extractors import video as video_files
from patterns.files.loading import parse_rule
from patterns.processor import Processor, deploy
from store import Log
from tests.patterns.walkers import STATION, T0, add_video, end, point, rule, say, situations
from tests.vian.conftest import Run
from vian.rules import file_text

MANY = {"pattern": "(outside inside+)", "measures": "LAST(inside.x) AS x"}


@pytest.fixture
def entered(log: Log) -> Log:
    """A log in which track 7 went in while track 8 walked by, and the rule found it."""
    tried = rule(**MANY)
    deploy(log, STATION, [tried], {tried.rule: file_text(tried)}, T0)
    add_video(log, "gate")
    ways = [(track, second, 20 + 5 * second * (track == 7)) for second in range(16) for track in (7, 8)]
    say(log, "gate", *(point(*each) for each in ways))
    end(log, "gate")
    Processor(log, STATION, [tried]).catch_up()
    return log


def identity(log: Log) -> str:
    (found,) = situations(log)
    assert isinstance(found, SituationDetected)
    return found.situation


def test_rows_stand_by_variable_with_rule_and_extractor(entered: Log, run: Run) -> None:
    ran = run("rules", "explain", identity(entered)[:8], "--dsn", entered.dsn)
    assert ran.code == 0
    assert ran.out.startswith(f"track 7 came in\nsituation {identity(entered)}, brno/gate/situation_detected/1\n")
    assert f"rule      enters version 1, warning, hash {rule(**MANY).hash[:12]}" in ran.out
    assert "partition source: gate, track_id: 7\nmeasures  x: 95.0\n" in ran.out
    assert "said by   motion 1, configuration 000000000000 (brno/gate/track_point)" in ran.out
    assert "brno/gate/track_point/11 " in ran.out
    assert "... 4 more" in ran.out
    assert "... 4 more" not in run("rules", "explain", identity(entered), "--all", "--dsn", entered.dsn).out
    assert "zones:" in run("rules", "explain", identity(entered), "--text", "--dsn", entered.dsn).out


def test_machines_get_every_row_of_the_match_and_no_other(entered: Log, run: Run) -> None:
    (line,) = run("rules", "explain", identity(entered), "--json", "--dsn", entered.dsn).out.splitlines()
    said = json.loads(line)
    assert said["rows"][0]["variable"] == "outside"
    assert [row["sequence"] for row in said["rows"]] == list(range(11, 32, 2))
    assert {row["track_id"] for row in said["rows"]} == {7}
    assert said["partition"] == {"source": "gate", "track_id": 7}
    assert said["shadow"] is False
    assert said["missing"] == []


def test_it_is_drawn_on_the_frame_of_the_last_row(log: Log, run: Run, clip: Path, tmp_path: Path) -> None:
    info = video_files.probe(clip)
    size = {"width": info.width, "height": info.height}
    tried = rule(**MANY)
    deploy(log, STATION, [tried], {tried.rule: file_text(tried)}, T0)
    more = {"fps": 10.0, "frames_expected": 10, "codec": "h264", "started_at": T0}
    say(log, "gate", VideoAdded(time=T0, video=info.sha256, path=str(clip), **size, **more))
    say(log, "gate", *(point(7, second / 10, x) for second, x in enumerate((0.0, info.width - 2.0, info.width - 1.0))))
    end(log, "gate")
    Processor(log, STATION, [tried]).catch_up()
    drawing = tmp_path / "situation.png"
    ran = run("rules", "explain", identity(log), "--draw", drawing, "--dsn", log.dsn)
    assert ran.code == 0
    assert "without a picture" not in ran.err
    picture = cv2.imread(str(drawing))
    assert picture is not None
    frame = next(each for each in video_files.frames(clip) if getattr(each, "index", None) == 2)
    enlarged = cv2.resize(frame.image, (picture.shape[1], round(info.height * picture.shape[1] / info.width)))  # type: ignore[union-attr]
    corner = np.s_[enlarged.shape[0] // 2 :, : picture.shape[1] // 3]
    shown = picture[: enlarged.shape[0]]
    assert np.abs(shown[corner].astype(int) - enlarged[corner].astype(int)).mean() < 2, "the frame is the background"
    assert (picture[: enlarged.shape[0]] == (60, 215, 250)).all(axis=2).any(), "the zone is drawn"


def test_a_picture_that_is_not_there_is_said_and_drawn_blank(entered: Log, run: Run, tmp_path: Path) -> None:
    ran = run("rules", "explain", identity(entered), "--draw", tmp_path / "blank.png", "--dsn", entered.dsn)
    assert ran.code == 0
    assert "drawn without a picture: v: no such file" in ran.words
    assert (tmp_path / "blank.png").stat().st_size > 1000


def test_what_cannot_be_found_is_said(log: Log, run: Run) -> None:
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(7, 1, 80))
    end(log, "gate")
    Processor(log, STATION, [rule()]).catch_up()
    ran = run("rules", "explain", identity(log), "--dsn", log.dsn)
    assert ran.code == 0
    assert "not found: rule enters version 1: no rule_deployed of it is in this log" in ran.words
    assert "brno/gate/track_point/2" in ran.out


def test_rows_without_a_place_in_the_picture_cannot_be_drawn(log: Log, run: Run, tmp_path: Path) -> None:
    tried = parse_rule("""
rule: ended
version: 1
title: ended
severity: info
match: |
  SELECT * FROM process_finished MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence
    ONE ROW PER MATCH PATTERN (a) DEFINE a AS a.frames > 0)
""")
    end(log, "gate")
    Processor(log, STATION, [tried]).catch_up()
    ran = run("rules", "explain", identity(log), "--draw", tmp_path / "none.png", "--dsn", log.dsn)
    assert ran.code == 2
    assert "nothing to draw: no row of this situation says where it is in the picture" in ran.words


def test_a_situation_that_is_not_there_is_told(entered: Log, run: Run) -> None:
    for wanted, said in (("abc", "its first 6 characters or more; got 'abc'"), ("0" * 12, "no situation begins with")):
        ran = run("rules", "explain", wanted, "--dsn", entered.dsn)
        assert ran.code == 2
        assert said in ran.words
