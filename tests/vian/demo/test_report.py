"""The report: what is in it, for few and many, and that nothing in it leaves the page or escapes its place."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from events import HorizonEstimate, MatchedRange, SituationDetected, StreamName, TrackPoint, VideoAdded, batch_of
from extractors.calibration import Camera
from patterns.files.rule import Rule
from store import Log
from tests.vian.clips import write_clip
from tests.vian.demo.conftest import Stage
from tests.vian.samples import START, append
from vian.demo.cameras import CameraFound, camera_found, camera_rows
from vian.demo.clip import Clip, Origin
from vian.demo.report import Facts, View, write_report
from vian.demo.scenes import rules_for
from vian.errors import WorldFailed

HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)> & {{ 7 * 7 }} ščř " + "W" * 300
FACTS = Facts(
    summary=[("events", "5")],
    station="brno",
    answer_sql="SELECT 1",
    answer=[["1"]],
    answer_columns=["one"],
)


class Page(HTMLParser):
    """The page's tags, and the texts in them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str, **wanted: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag and _fits(attributes, wanted)]


def _fits(attributes: dict[str, str | None], wanted: dict[str, str]) -> bool:
    return all(value in (attributes.get(name.strip("_")) or "").split() for name, value in wanted.items())


def stream(type_name: str) -> StreamName:
    return StreamName.of("brno", "gate", type_name)


def fill(
    log: Log, clip: Path, *, tracks: int, situations: int, size: tuple[int, int] = (320, 240), **said: Any
) -> None:
    """A video, tracks of three points each, and situations that rest on the first tracks."""
    added = VideoAdded(
        time=START, video="0" * 64, path=str(clip), width=size[0], height=size[1], fps=10, frames_expected=60,
        codec="mpeg4", started_at=START,
    )  # fmt: skip
    append(log, batch_of([added]), stream("video_added"))
    points = [_point(track, number) for track in range(tracks) for number in range(3)]
    if points:
        append(log, batch_of(points), stream("track_point"))
    found = [_situation(number, **said) for number in range(situations)]
    if found:
        append(log, batch_of(found), stream("situation_detected"))


def _point(track: int, number: int) -> TrackPoint:
    x, y = 10.0 + 90 * number, 30.0 + track % 200
    time = START + timedelta(milliseconds=5 * track + 1000 * number)
    return TrackPoint(
        time=time, track_id=track + 1, frame=min(59, track // 20 + 10 * number), x=x, y=y,
        x1=x - 8, y1=y - 30, x2=x + 8, y2=y, vx=0, vy=0, confidence=0.5,
    )  # fmt: skip


def _situation(number: int, **said: Any) -> SituationDetected:
    last = 3 * number + 3
    values: dict[str, Any] = {
        "time": START + timedelta(seconds=2), "situation": f"{number:064x}", "rule": "zone-intrusion-gate",
        "rule_version": 1, "rule_hash": "0" * 64, "severity": "warning", "title": f"track {number + 1} was there",
        "partition": json.dumps({"source": "gate", "track_id": number + 1}), "measures": "{}",
        "began_at": START + timedelta(seconds=1), "ended_at": START + timedelta(seconds=2),
        "lineage": (MatchedRange(variable="inside", stream=str(stream("track_point")), first_sequence=last - 1,
                                 last_sequence=last, events=2),),
    }  # fmt: skip
    return SituationDetected(**(values | said))


@pytest.fixture
def rules(clip: Path) -> list[Rule]:
    found = rules_for(Clip(clip, Origin.GIVEN, None))
    return [rule.model_copy(update={"rule": rule.rule.rsplit("-crossing-", 1)[0] + "-gate"}) for rule in found]


UNDECIDED = CameraFound("gate", None, None, None)


def report(
    log: Log,
    clip: Path,
    rules: Sequence[Rule],
    tmp_path: Path,
    facts: Facts = FACTS,
    *,
    attribution: str | None = None,
    camera: CameraFound = UNDECIDED,
) -> Page:
    write_report(log, [View(clip, attribution, camera, rules)], facts, tmp_path / "report.html")
    return Page((tmp_path / "report.html").read_text())


def test_the_demos_report_shows_tracks_places_timeline_and_pictures(stage: Stage) -> None:
    summary = stage.run()
    page = Page(stage.report.read_text())
    assert len(page.all("polyline", class_="track")) == 1
    assert len(page.all("polygon", class_="shape")) == 1
    assert len(page.all("polyline", class_="line")) == 1
    source = summary.extractions[0].source
    assert f"restricted (zone-intrusion-{source})watched (loitering-{source})" in page.text
    assert f"door (line-crossing-{source})" in page.text
    shown = page.all("article")
    assert len(shown) == sum(row["situations"] for row in summary.situations.to_pylist()) == 2
    assert len(page.all("img")) == 2
    targets = {attributes["href"] for attributes in page.all("a")}
    assert targets == {f"#{attributes['id']}" for attributes in shown}
    for name, value in (("frames", "60"), ("chains verified", "yes, heads agree")):
        assert f"{name}{value}" in page.text
    assert_is_self_contained(stage.report.read_text())


def assert_is_self_contained(text: str) -> None:
    page = Page(text)
    for tag, attributes in page.tags:
        for name in ("src", "href", "data", "action", "srcset"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name)
    assert not re.search(r"https?://|url\(|@import|//cdn|<link|<iframe", text)
    assert page.open == [], "every element is closed"


def test_names_and_titles_cannot_escape_their_place(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path
) -> None:
    fill(log, clip, tracks=2, situations=1, title=HOSTILE)
    facts = replace(FACTS, answer_sql=HOSTILE, answer=[[HOSTILE]], summary=[(HOSTILE, HOSTILE)])
    page = report(log, clip, rules, tmp_path, facts, attribution=HOSTILE)
    assert len(page.all("script")) == 1
    assert [attributes for _, attributes in page.tags if "onerror" in attributes] == []
    assert page.text.count("<script>alert(1)</script>") == 6
    assert "{{ 7 * 7 }}" in page.text
    (bar,) = page.all("a")
    assert bar["title"] == HOSTILE


def test_times_in_titles_are_short_and_the_whole_title_is_at_hand(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path
) -> None:
    title = "track 5 was there from 2026-01-01T10:00:01.668335Z to 2026-01-01T10:00:03Z on camera-2026-01-01"
    fill(log, clip, tracks=1, situations=1, title=title)
    page = report(log, clip, rules, tmp_path)
    assert "track 5 was there from 10:00:01.6 to 10:00:03 on camera-2026-01-01" in page.text
    (shown,) = page.all("b", title="track")
    assert shown["title"] == title


def test_a_box_outside_the_picture_has_a_picture_all_the_same(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = _point(0, 0).model_copy(update={"x1": -50.0, "x2": -50.0, "y1": 400.0, "y2": 400.0})
    fill(log, clip, tracks=0, situations=0)
    append(log, batch_of([outside]), stream("track_point"))
    lineage = (
        MatchedRange(variable="a", stream=str(stream("track_point")), first_sequence=1, last_sequence=1, events=1),
    )
    append(log, batch_of([_situation(0, lineage=lineage)]), stream("situation_detected"))
    assert len(report(log, clip, rules, tmp_path).all("img")) == 1


def test_a_video_in_which_nothing_happened_has_a_report(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path
) -> None:
    fill(log, clip, tracks=0, situations=0)
    page = report(log, clip, rules, tmp_path)
    assert "No rule found a situation in this video" in page.text
    assert page.all("article") == []
    assert page.all("polyline", class_="track") == []
    assert len(page.all("image")) == 1


def test_a_situation_that_rests_on_no_track_has_no_picture(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path
) -> None:
    fill(log, clip, tracks=1, situations=1, lineage=(), partition="{}")
    page = report(log, clip, rules, tmp_path)
    assert len(page.all("article")) == 1
    assert page.all("img") == []
    assert "None" not in page.text
    assert "track ," not in page.text


def test_the_background_is_a_frame_without_tracks_where_there_is_one(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path
) -> None:
    fill(log, clip, tracks=1, situations=0)  # points at the frames 0, 10 and 20
    assert "over frame 5;" in report(log, clip, rules, tmp_path).text


def test_brief_tracks_are_faint_and_others_are_not(log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path) -> None:
    fill(log, clip, tracks=1, situations=0)
    lasting = [_point(1, number) for number in (0, 1, 2, 5)]
    append(log, batch_of(lasting), stream("track_point"))
    page = report(log, clip, rules, tmp_path)
    assert [each["data-track"] for each in page.all("polyline", class_="brief")] == ["gate-1"]
    assert len(page.all("polyline", class_="track")) == 2


def test_a_note_to_a_number_stands_in_small_type(log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path) -> None:
    fill(log, clip, tracks=1, situations=0)
    facts = replace(FACTS, summary=[("frames", "60 (extracted in an earlier run)")])
    report(log, clip, rules, tmp_path, facts)
    page = (tmp_path / "report.html").read_text()
    assert "<dd>60 <small>(extracted in an earlier run)</small></dd>" in page


def test_a_thousand_tracks_fit(log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path) -> None:
    fill(log, clip, tracks=1000, situations=100)
    page = report(log, clip, rules, tmp_path)
    assert len(page.all("polyline", class_="track")) == 1000
    assert len(page.all("article")) == 100
    assert len(page.all("img")) == 48
    assert (tmp_path / "report.html").stat().st_size < 4_000_000
    places = re.findall(r"left:(-?[\d.]+)%;width:([\d.]+)%", (tmp_path / "report.html").read_text())
    assert len(places) == 1100
    assert all(0 <= float(left) <= 100 and float(left) + float(width) <= 101 for left, width in places)


@pytest.mark.parametrize("size", [(120, 360), (640, 64)])
def test_a_picture_of_any_shape_is_shown_whole(
    log: Log, rules: Sequence[Rule], tmp_path: Path, size: tuple[int, int]
) -> None:
    clip = write_clip(tmp_path / "odd.mp4", [], size=size)
    fill(log, clip, tracks=2, situations=2, size=size)
    page = report(log, clip, rules, tmp_path)
    (picture,) = page.all("svg")
    assert picture["viewbox"] == f"0 0 {size[0]} {size[1]}"
    assert len(page.all("img")) == 2


def test_only_the_sources_own_events_are_shown(log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path) -> None:
    fill(log, clip, tracks=3, situations=1)
    append(log, batch_of([_point(9, 1)]), StreamName.of("brno", "yard", "track_point"))
    assert len(report(log, clip, rules, tmp_path).all("polyline", class_="track")) == 3


def test_a_horizon_above_the_frame_is_drawn_with_its_interval_and_the_true_one(
    log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path
) -> None:
    fill(log, clip, tracks=1, situations=0)
    estimate = HorizonEstimate(
        time=START, slope=0.1, offset_px=-60, slope_variance=0, slope_offset_covariance=0, offset_variance=25,
        width=320, height=240, votes=9,
    )  # fmt: skip
    append(log, batch_of([estimate]), stream("horizon_estimate"))
    camera = camera_found(log, "brno", "gate", Camera(300.0, 0.55, 0.1, 4.0, 320, 240))
    page = report(log, clip, rules, tmp_path, camera=camera)
    (picture,) = page.all("svg")
    assert picture["viewbox"] == "0 -77 320 317", "the interval and a margin: 60 + 1.96 * 5 + 0.03 * 240 px above"
    (line, true), (band,) = page.all("polyline", class_="horizon"), page.all("polygon", class_="band")
    assert str(line["points"]).startswith("0.0,-60.0 40.0,-56.0")
    assert str(band["points"]).startswith("0.0,-69.8")
    assert "true" in str(true["class"])
    told = dict(camera_rows(camera))
    assert told["horizon of gate"].startswith("y = 0.100 x -60 px, +- 10 px in the middle (truly 0.100 x ")
    assert told["camera of gate"].startswith("not decided")


def test_a_camera_of_which_nothing_is_known_is_said_to_be_so(log: Log) -> None:
    told = dict(camera_rows(camera_found(log, "brno", "gate", None)))
    assert [value.partition(" (")[0] for value in told.values()] == ["not decided", "not decided"]


def test_a_report_that_cannot_be_written_is_told(log: Log, clip: Path, rules: Sequence[Rule], tmp_path: Path) -> None:
    fill(log, clip, tracks=1, situations=0)
    with pytest.raises(WorldFailed, match=r"cannot be written to .*gone.r\.html: No such file.*another --report FILE"):
        write_report(log, [View(clip, None, UNDECIDED, rules)], FACTS, tmp_path / "gone" / "r.html")
