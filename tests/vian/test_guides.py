"""The guides are followed literally: each of their commands does what the guide says, on a log like the reader's."""

import re
import shlex
from datetime import timedelta
from pathlib import Path

import pytest

from events import ProcessFinished, Producer, StreamName, TrackPoint, VideoAdded, batch_of, encode
from extractors.calibration import Camera
from extractors.scene import street, truth
from store import Log
from tests.patterns.walkers import STATION
from tests.vian.commands.test_extract_calibration import add_video, walk
from tests.vian.conftest import Ran, Run
from tests.vian.samples import START
from vian.querying import query

GUIDES = Path(__file__).parents[2] / "docs" / "guides"
TRACKS = {1: 2, 2: 3, 3: 4, 4: 1, 5: 6, 6: 5}
"""The numbers that tracking gives the street's objects."""


@pytest.fixture
def street_log(log: Log, monkeypatch: pytest.MonkeyPatch) -> Log:
    """A log as the demo makes it of the rendered street, but of the scene's exact truth."""
    scene = street()
    producer = Producer("truth", "1", bytes(32))
    size = {"width": scene.width, "height": scene.height, "fps": 10.0, "frames_expected": scene.frames}
    video = VideoAdded(time=START, video="00", path="gone.mp4", codec="mpeg4", started_at=START, **size)
    points = [
        TrackPoint(
            time=START + timedelta(seconds=box.frame / scene.fps), track_id=TRACKS[box.object_id], frame=box.frame,
            x=(box.x1 + box.x2) / 2, y=box.y2, x1=box.x1, y1=box.y1, x2=box.x2, y2=box.y2, vx=0, vy=0, confidence=1,
        )
        for box in truth(scene)
    ]  # fmt: skip
    finished = ProcessFinished(time=START + timedelta(seconds=30), process="p", frames=300, events=0, gaps=0)
    for events in ([video], points, [finished]):
        log.append([encode(StreamName.of("demo", "street", events[0].type_name), batch_of(events), producer)])
    monkeypatch.setenv("VIAN_DSN", log.dsn)
    monkeypatch.setenv("VIAN_STATION", "demo")
    return log


def blocks(guide: str, kind: str) -> list[str]:
    return re.findall(rf"^```{kind}\n(.*?)^```$", (GUIDES / guide).read_text(), re.MULTILINE | re.DOTALL)


def test_the_first_rule_is_made_tried_explained_and_deployed(street_log: Log, run: Run) -> None:
    told: dict[str, str] = {}
    files = blocks("first-rule.md", "yaml")
    Path("linger-2.yaml").write_text(files[1])
    lines = [line for block in blocks("first-rule.md", "sh") for line in block.splitlines()]
    for line in lines:
        program, *arguments = shlex.split(line)
        if program == "export" or arguments[0] == "demo":
            continue
        assert program == "vian"
        if arguments[:2] == ["rules", "explain"]:
            (found,) = query(street_log, "select situation from situation_shadowed").to_pylist()
            arguments[2] = found["situation"][:6]
        ran = run(*arguments)
        assert ran.code == 0, (line, ran)
        told[" ".join(arguments[:2]) + " " * (" ".join(arguments[:2]) in told)] = ran.out
    written = Path("linger.yaml").read_text()
    assert written.startswith(files[0]), "the guide shows the file that the command writes"
    assert told["rules backtest"].endswith("0 situations\n")
    assert "fell short" in told["rules why-not"]
    assert "s got, at least 20 s wanted" in told["rules why-not"]
    assert told["rules backtest "].endswith("0 both, 0 only A, 1 only B\n")
    assert "(in shadow: nobody was alerted)" in told["rules explain"]
    for name in ("street.png", "why-not.png", "situation.png"):
        assert Path(name).stat().st_size > 1000


def test_metres_come_by_tracks_and_by_hand_and_a_rule_has_them(
    log: Log, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VIAN_DSN", log.dsn)
    monkeypatch.setenv("VIAN_STATION", STATION)
    add_video(log, "gate")
    walk(log, Camera(700.0, 0.4, 0.05, 5.0, 768, 576), "gate")
    points, rule = blocks("metres.md", "yaml")
    Path("points.yaml").write_text(points)
    Path("fast.yaml").write_text(rule)
    told: dict[str, Ran] = {}
    for command in re.split(r"^vian ", "".join(blocks("metres.md", "sh")).replace("\\\n", " "), flags=re.MULTILINE)[1:]:
        here = re.sub(r"--subject \S+ --at \S+", "--subject 3 --at 2026-01-01T12:00:05Z", command)
        if here.startswith("extract motion"):
            continue
        if "--calibration" in here:
            here = re.sub(r"--calibration \d+", f"--calibration {position_of_the_newest(log)}", here)
        ran = told[here[:30]] = run(*shlex.split(here))
        assert ran.code == 0, (command, ran)
    assert "gate is calibrated from 9 tracks" in told["extract calibration --source gate"[:30]].out
    assert "gate is calibrated from 5 points; met within 0.0" in told["zones calibrate gate points.yaml"[:30]].out
    (accuracy,) = [ran.out for start, ran in told.items() if start.startswith('query "SELECT time')]
    for name in ("focal_deviation_px", "pitch_deviation_deg", "roll_deviation_deg", "height_deviation_m"):
        assert name in accuracy
    Path("fast.yaml").write_text(re.sub("^zones:.*$", "shared: [yard]", rule, flags=re.MULTILINE))
    assert run("rules", "check", "fast.yaml").code == 0
    assert run("rules", "backtest", "fast.yaml").out == told["rules backtest fast.yaml\n"].out


def position_of_the_newest(log: Log) -> int:
    (found,) = query(log, "select max(position) as newest from camera_calibrated").to_pylist()
    return int(found["newest"])


@pytest.mark.parametrize("guide", sorted(path.name for path in GUIDES.glob("*.md")))
def test_what_a_guide_links_to_is_there(guide: str) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", (GUIDES / guide).read_text()):
        assert (GUIDES / target).exists(), target
