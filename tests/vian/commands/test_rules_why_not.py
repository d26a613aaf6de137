"""`vian rules why-not` over a real log: in words, as JSON, drawn; and what is said of each wrong use."""

import json
from pathlib import Path

import cv2
import pytest

from patterns.processor import Processor, deploy
from store import Log
from tests.patterns.walkers import STATION, T0, add_video, end, point, rule, say
from tests.vian.conftest import Run
from vian.rules import file_text


@pytest.fixture
def passed_by(log: Log) -> Log:
    """A log in which track 7 comes near the yard, track 8 goes in, and track 9 comes late."""
    tried = rule()
    deploy(log, STATION, [tried], {tried.rule: file_text(tried)}, T0)
    add_video(log, "gate")
    say(log, "gate", point(7, 0, 20), point(7, 1, 46.5), point(7, 2, 20), point(8, 2, 20), point(8, 3, 80))
    say(log, "gate", point(9, 1, 20), point(9, 30, 20))
    say(log, "gate", point(9, 2, 80))
    end(log, "gate")
    return log


def test_the_words_name_the_row_the_condition_and_the_distance(passed_by: Log, run: Run) -> None:
    ran = run("rules", "why-not", "enters", "--at", "2026-01-01T10:00:01Z", "--subject", "7", "--dsn", passed_by.dsn)
    assert ran.code == 0
    assert ran.out.splitlines() == [
        "enters v1, source gate, track_id 7, at 2026-01-01 10:00:01: fell short",
        "the best attempt took 1 row and needed 1 more; what came nearest to inside is the row of 2026-01-01T10:00:01Z",
        "taken:",
        "  outside: 10:00:00.000, brno/gate/track_point/1",
        "nearest: 10:00:01.000, brno/gate/track_point/2, tried as inside",
        "  x in_zone(inside.x, inside.y, 'yard'): (46.5, 10.0) is 3.5 px outside",
        "  and there the attempt ended",
    ]


def test_machines_get_the_rows_with_stream_and_sequence(passed_by: Log, run: Run) -> None:
    asked = ("rules", "why-not", "enters", "--at", "2026-01-01T10:00:03Z", "--dsn", passed_by.dsn, "--json")
    (line,) = run(*asked, "--subject", "8").out.splitlines()
    answer = json.loads(line)
    assert answer["verdict"] == "matched"
    assert [(row["variable"], row["sequence"]) for row in answer["taken"]] == [("outside", 4), ("inside", 5)]
    assert len(answer["situation"]) == 64
    answer = json.loads(run(*asked, "--subject", "9").out)
    assert answer["notes"] == [
        "2 of its 3 rows came too late to take part",
        "no further row came after 2026-01-01T10:00:30Z",
    ]


def test_it_is_drawn_on_a_blank_frame_where_the_video_is_gone(passed_by: Log, run: Run, tmp_path: Path) -> None:
    drawing = tmp_path / "why.png"
    asked = ("rules", "why-not", "enters", "--at", "2026-01-01T10:00:01Z", "--dsn", passed_by.dsn)
    ran = run(*asked, "--subject", "7", "--draw", drawing)
    assert ran.code == 0
    assert "drawn without a picture: v: no such file" in ran.words
    picture = cv2.imread(str(drawing))
    assert picture is not None
    assert picture.shape[1] == 960
    assert picture.shape[0] > 960, "the frame of 100 x 100, enlarged, and a strip below"
    assert run(*asked, "--subject", "8", "--draw", drawing).code == 0
    ran = run(*asked, "--subject", "7", "--draw", tmp_path / "gone" / "why.png")
    assert ran.code == 1
    assert "the drawing cannot be written to" in ran.words


AT = "2026-01-01T10:00:01Z"
WRONG: list[tuple[list[str], str]] = [
    (["gone.yaml", "--at", AT, "--subject", "7"], "the rule file gone.yaml cannot be read"),
    (["enters", "--subject", "7", "--at", "noon"], "--at must be a time such as"),
    (["enters", "--at", AT, "--subject", "7", "--window", "long"], "--window: a duration is a number and one of"),
    (["enters", "--at", AT, "--subject", "7", "--window", "0 s"], "--window must be longer than nothing"),
    (["enters", "--at", AT, "--subject", "7", "--source", "roof"], "no source 'roof' in this log"),
    (["enters", "--at", AT, "--subject", "77"], "there are, nearest in time first: 7, 9, 8. Next: vian tail"),
    (
        ["enters", "--at", "2026-01-01T12:00:00Z", "--subject", "7"],
        "nor of anything else. Next: '7' has events of gate from 2026-01-01T10:00:00Z to 2026-01-01T10:00:02Z",
    ),
]


def test_wrong_use_is_told_with_what_was_wanted(passed_by: Log, run: Run) -> None:
    for arguments, said in WRONG:
        ran = run("rules", "why-not", *arguments, "--dsn", passed_by.dsn)
        assert ran.code == 2, arguments
        assert said in ran.words
    assert run("rules", "why-not", "enters", "--subject", "7", "--dsn", passed_by.dsn).code == 2, "--at is missing"


def test_a_subject_of_two_sources_is_asked_back(passed_by: Log, run: Run) -> None:
    say(passed_by, "yard", point(7, 1, 20))
    asked = ("rules", "why-not", "enters", "--at", AT, "--subject", "7", "--dsn", passed_by.dsn)
    ran = run(*asked)
    assert ran.code == 2
    assert "'7' is in 2 partitions" in ran.words
    assert "Next: say which by --source: gate, yard" in ran.words
    ran = run(*asked, "--source", "yard")
    assert (
        "note: zone 'yard' is of source gate, and all rows here are of yard: no condition on it is ever true" in ran.out
    )
    assert "the best attempt took 1 row and needed 1 more" in ran.out


def test_a_rule_over_situations_is_settled_where_the_log_ends_as_in_a_backtest(
    passed_by: Log, run: Run, tmp_path: Path
) -> None:
    Processor(passed_by, STATION).catch_up()
    above = tmp_path / "above.yaml"
    above.write_text(
        'rule: above\nversion: 1\ntitle: "one"\nseverity: info\n'
        "match: SELECT * FROM situation('enters') MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence "
        "PATTERN (a) WITHIN INTERVAL '1' MINUTE)\n"
    )
    asked = ("--dsn", passed_by.dsn, "--json")
    (found,) = run("rules", "backtest", above, *asked).out.splitlines()
    ran = run("rules", "why-not", above, "--at", "2026-01-01T10:00:03Z", "--subject", "gate", *asked)
    answer = json.loads(ran.out)
    assert (answer["verdict"], answer["situation"]) == ("matched", json.loads(found)["situation"])
