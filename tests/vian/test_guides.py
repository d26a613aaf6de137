"""The guides are followed literally: each of their commands does what the guide says, on a log like the reader's."""

import re
import shlex
from datetime import timedelta
from pathlib import Path

import pytest

from events import ProcessFinished, Producer, StreamName, TrackPoint, VideoAdded, batch_of, encode
from extractors.scene import street, truth
from store import Log
from tests.vian.conftest import Run
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


@pytest.mark.parametrize("guide", sorted(path.name for path in GUIDES.glob("*.md")))
def test_what_a_guide_links_to_is_there(guide: str) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", (GUIDES / guide).read_text()):
        assert (GUIDES / target).exists(), target
