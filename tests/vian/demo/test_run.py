import json
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from events import StreamName, SyncPlanned, decode, events_of
from extractors import motion
from extractors.scene import street, write
from patterns.files.loading import parse_rule
from patterns.processor import Processor, deploy
from store import Log, verify
from sync.station.daemon import Daemon
from tests.vian.clips import Walk, write_clip
from tests.vian.demo.conftest import Stage
from tests.vian.samples import append, points
from vian.demo import run as demo
from vian.demo.clip import SQUARE, Clip, Origin
from vian.demo.run import CENTRAL, CLIP_START, STATION, Summary, summary_rows
from vian.demo.scenes import rules_for, source_of
from vian.errors import WorldFailed, WrongUsage
from vian.evaluation.lines import Horizon, error_of
from vian.extraction import Appender
from vian.querying import query
from vian.rules import file_text

pytestmark = pytest.mark.usefixtures("decoded_once")


@pytest.fixture(autouse=True)
def quick_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts that wait for something to do look up sooner."""
    monkeypatch.setattr(demo, "_STEP_SECONDS", 0.05)


def test_a_clip_becomes_events_situations_an_answer_and_a_second_log(stage: Stage) -> None:
    summary = stage.run()
    assert summary.is_sound
    assert summary.frames == 60
    assert summary.events == summary.events_replicated > 40
    assert 10 < summary.bytes_per_event < 500
    station, central = stage.heads()
    assert station == central
    source = summary.extractions[0].source
    found = {row["rule"]: row["situations"] for row in summary.situations.to_pylist()}
    assert found == {f"zone-intrusion-{source}": 1, f"line-crossing-{source}": 1}
    counts = "select type, count(*) as n from events where station = 'demo' group by all order by all"
    assert query(stage.station, counts).to_pylist() == query(stage.central, counts).to_pylist()
    assert verify(stage.central).is_sound
    assert_rows_are_up_to_date(stage, summary)
    assert_the_log_names_central_and_not_its_port(stage)


def assert_rows_are_up_to_date(stage: Stage, summary: Summary) -> None:
    for log in (stage.station, stage.central):
        with log.connection() as connection:
            rows = connection.execute("select count(*) from events where station = 'demo'").fetchone()
        assert rows == (summary.events,)


def assert_the_log_names_central_and_not_its_port(stage: Stage) -> None:
    (segment,) = stage.station.read_all(types=[SyncPlanned.type_name])
    (planned,) = events_of(decode(segment, stage.station.catalogue))
    assert isinstance(planned, SyncPlanned)
    assert planned.central == CENTRAL


def test_a_second_run_appends_nothing_and_shows_the_same(stage: Stage) -> None:
    first, before = stage.run(), stage.heads()
    page = stage.report.read_text()
    with capture_logs() as said:
        second = stage.run()
    assert [each["event"] for each in said if each["log_level"] != "info"] == []
    assert stage.heads() == before
    assert second.extractions[0].was_done
    assert list(summary_rows(second))[1:] == list(summary_rows(first))[1:]
    assert ("frames", "60 (extracted in an earlier run)") in summary_rows(second)
    assert stage.report.read_text() == page.replace(
        "<dd>60</dd>", "<dd>60 <small>(extracted in an earlier run)</small></dd>"
    )


def test_a_log_of_another_releases_demo_is_said_to_be_one(stage: Stage) -> None:
    rule = next(iter(rules_for(stage.clip)))
    text = file_text(rule).replace("title: ", "title: 'then' # ", 1)
    deploy(stage.station, STATION, [parse_rule(text, "<then>")], {rule.rule: text}, CLIP_START)
    with pytest.raises(WrongUsage, match=r"begun by another release's demo, whose rules .*--data-dir FOLDER"):
        stage.run()


def test_another_releases_tracks_are_not_counted_beside_this_ones(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(motion, "VERSION", "0.0.1")
        stage.run()
    before = stage.heads()
    with pytest.raises(WrongUsage, match=r"begun by another release's demo, whose tracks .*--data-dir FOLDER"):
        stage.run()
    assert stage.heads() == before


class Stopped(Exception):
    """The demo was stopped here."""


PLACES: list[tuple[type, str, int]] = [
    (Appender, "append", 3),
    *((Processor, "_commit", number) for number in (1, 2)),
    (Daemon, "_hello", 1),
    (Daemon, "_launch", 2),
    (Daemon, "_land", 1),
    (Daemon, "_set_plan", 1),
]
"""Where a demo is stopped: before the n-th call of a method, in whichever thread that is."""


@pytest.fixture(scope="module")
def undisturbed() -> list[Any]:
    """The heads after a demo that nothing disturbed, once there was one."""
    return []


def heads_of_undisturbed(make_stage: Callable[[], Stage], undisturbed: list[Any]) -> Any:
    if not undisturbed:
        stage = make_stage()
        stage.run()
        undisturbed.append(stage.heads())
    return undisturbed[0]


def test_demos_of_one_clip_have_the_same_events(make_stage: Callable[[], Stage], undisturbed: list[Any]) -> None:
    stage = make_stage()
    stage.run()
    assert stage.heads() == heads_of_undisturbed(make_stage, undisturbed)


@pytest.mark.parametrize("place", PLACES, ids=lambda place: f"{place[0].__name__}.{place[1]}-{place[2]}")
def test_a_demo_that_was_stopped_anywhere_ends_as_if_it_had_not(
    make_stage: Callable[[], Stage],
    place: tuple[type, str, int],
    undisturbed: list[Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wanted = heads_of_undisturbed(make_stage, undisturbed)
    stage = make_stage()
    with monkeypatch.context() as patched:
        patched.setattr(place[0], place[1], _stopping(getattr(place[0], place[1]), place[2]))
        with pytest.raises(Stopped):
            stage.run()
    assert stage.heads() != wanted
    stage.run()
    assert stage.heads() == wanted


def _stopping(method: Any, number: int) -> Any:
    calls = 0
    lock = threading.Lock()

    def stopping(*arguments: Any, **named: Any) -> Any:
        nonlocal calls
        with lock:
            calls += 1
            is_here = calls == number
        if is_here:
            raise Stopped
        return method(*arguments, **named)

    return stopping


def test_a_log_of_another_station_is_left_alone(stage: Stage) -> None:
    append(stage.station, points(1))
    with pytest.raises(WrongUsage, match=r"holds streams of brno.*Next: .*--data-dir FOLDER"):
        stage.run()
    assert stage.station.head() == 1
    assert stage.central.head() == 0


def test_a_log_of_the_demo_may_hold_another_stations_streams_too(stage: Stage) -> None:
    before = stage.run()
    append(stage.station, points(1))
    after = stage.run()
    assert (after.is_sound, after.events) == (True, before.events)


def test_a_central_log_with_another_history_is_told_at_once(stage: Stage) -> None:
    source = source_of(stage.clip)
    append(stage.central, points(3), StreamName.of(demo.STATION, source, "track_point"))
    with pytest.raises(WorldFailed, match=r"holds another demo's history: .*Next: .*--data-dir FOLDER"):
        stage.run()


def test_one_log_shows_several_clips_one_after_another(stage: Stage, tmp_path: Path) -> None:
    first = stage.run()
    other = write_clip(tmp_path / "other.mp4", [Walk(1.5, 5.0, (300, 150), (20, 150))], seed=9)
    second = stage.run(Clip(other, Origin.GIVEN, None))
    assert second.is_sound
    assert second.extractions[0].source != first.extractions[0].source
    found = {row["rule"]: row["situations"] for row in second.situations.to_pylist()}
    assert sorted(found.values()) == [1, 1, 1, 1]


def test_a_part_that_fails_ends_the_demo_at_once(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise KeyError("a defect in the rules")

    monkeypatch.setattr(Processor, "step", fail)
    with pytest.raises(KeyError, match="a defect in the rules"):
        stage.run()


def test_parts_that_do_not_come_together_are_told(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "_CONVERGE_SECONDS_MAX", 0.2)
    monkeypatch.setattr(Processor, "position", -1)
    with pytest.raises(
        WorldFailed, match=r"the rules have not seen all events after 0\.2 s\. Next: run the demo again"
    ):
        stage.run()


def test_logs_that_do_not_agree_make_no_sound_summary(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    summary = stage.run()
    assert ("chains verified", "yes, heads agree") in summary_rows(summary)
    same: Callable[[Log], Any] = demo._heads
    counts = iter(range(10_000))
    with monkeypatch.context() as patched:
        patched.setattr(demo, "_converge", lambda *_: None)
        patched.setattr(demo, "_heads", lambda log: [*same(log), next(counts)])
        summary = stage.run()
    assert not summary.is_sound
    assert ("chains verified", "NO") in summary_rows(summary)


@pytest.mark.slow
def test_the_square_shows_its_horizon_its_camera_and_speeds(
    stage: Stage, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(SQUARE, tmp_path / "square.mp4")
    summary = stage.run(Clip(tmp_path / "square.mp4", Origin.SQUARE, None))
    assert "has no calibration" not in caplog.text, "that metres come later is meant"
    (found,) = summary.cameras
    assert found.horizon is not None
    assert error_of(found.horizon, Horizon(*SQUARE.camera.horizon), SQUARE.width, SQUARE.height) < 0.05
    assert found.calibration is not None
    assert found.calibration.height_m == pytest.approx(SQUARE.camera.height_m, rel=0.15)
    runners = [actor for actor in SQUARE.actors if actor.waypoints[0][0] > SQUARE.actors[-3].waypoints[0][0]]
    assert 1 <= len(summary.in_metres) <= len(runners) == 2
    assert all(re.fullmatch(r"track \d+ on square went \d+ km/h at .*", title) for title in summary.in_metres)


@pytest.mark.slow
def test_the_rendered_street_shows_each_kind_of_situation(stage: Stage, tmp_path: Path) -> None:
    write(street(), tmp_path / "street.mp4")
    summary = stage.run(Clip(tmp_path / "street.mp4", Origin.RENDERED, None))
    found = {row["rule"]: row["situations"] for row in summary.situations.to_pylist()}
    assert found.keys() == {"zone-intrusion-street", "loitering-street", "line-crossing-street"}
    crossings = query(stage.station, "select measures from situation_detected where rule like 'line-crossing%'")
    directions = {json.loads(row["measures"])["direction"] for row in crossings.to_pylist()}
    assert directions
