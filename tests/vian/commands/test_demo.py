"""`vian demo` and `vian doctor` at the command line; what a demo does is tried in `demo/`."""

import json
import shlex
from contextlib import closing
from pathlib import Path

import psycopg
import pytest

from events import ProcessStarted, StreamName, batch_of
from store import Log, open_log
from store.embedded import EmbeddedServer
from store.schema import migrate, safe_dsn
from tests.conftest import MakeLog
from tests.vian.conftest import Run
from tests.vian.samples import START, append, points, reopened
from vian.commands import demo
from vian.demo.clip import Clip, Origin
from vian.demo.place import folder_for
from vian.demo.run import STATION
from vian.demo.scenes import source_of

pytestmark = pytest.mark.usefixtures("decoded_once")


@pytest.fixture
def central(make_log: MakeLog, monkeypatch: pytest.MonkeyPatch) -> Log:
    """The central log is a database beside the station's, not a server of its own."""
    log = make_log()
    monkeypatch.setattr(demo, "open_log", lambda data_dir: reopened(log))
    return log


def test_a_demo_ends_with_a_summary_and_the_next_commands(log: Log, central: Log, run: Run, clip: Path) -> None:
    ran = run("demo", "--video", clip, "--dsn", log.dsn)
    assert ran.code == 0, ran.err
    for text in (
        "frames",
        "60",
        "events in the log",
        "chains verified",
        "yes, heads agree",
        "next:   ",
        "situations: zone-int",
    ):
        assert text in ran.out
    assert f'query --dsn {shlex.quote(safe_dsn(log.dsn))} "SELECT rule' in ran.out
    report = Path("vian-demo-report.html")
    assert f"report: {report.resolve()}" in ran.out
    assert "crossing" in report.read_text()
    again = run("demo", "--video", clip, "--dsn", log.dsn, "--report", "other.html", "--json")
    values = json.loads(again.out)
    assert (values["origin"], values["frames"], values["sound"]) == ("given", 60, True)
    assert values["events"] == values["events_replicated"]
    (camera,) = values["cameras"].values()
    assert camera == dict.fromkeys(("slope", "offset_px", "focal_px", "height_m"))
    assert values["in_metres"] == []
    assert sum(values["situations"].values()) == 2
    assert Path(values["report"]).name == "other.html"
    assert "frames" not in again.err, "progress is for terminals"


def test_a_log_of_an_older_release_is_brought_up_and_one_of_another_demo_left_alone(
    central: Log, run: Run, clip: Path, public_folder: Path
) -> None:
    folder, beside = public_folder / "demo", public_folder / "demo-2"
    began = ProcessStarted(
        time=START, process="then", extractor="motion", extractor_version="0", configuration="{}", video="v"
    )
    source = source_of(Clip(clip, Origin.GIVEN, None))
    with open_log(data_dir=folder) as log:
        append(log, batch_of([began]), StreamName.of(STATION, source, began.type_name))
    with closing(EmbeddedServer(beside)) as server:
        migrate(server.dsn, [], "0018")
    ran = run("demo", "--video", clip, "--data-dir", folder)
    assert ran.code == 0, ran.err
    assert f"the log in {folder} was begun by another release's demo, whose tracks were others." in ran.words
    assert f"--data-dir {beside} " in ran.out
    with open_log(data_dir=folder) as log:
        assert log.head() == 1


def test_a_log_that_this_release_cannot_open_is_passed_over(public_folder: Path) -> None:
    newer, other_major = public_folder / "newer", public_folder / "newer-2"
    with open_log(data_dir=newer) as log, psycopg.connect(log.dsn) as connection:
        connection.execute("update alembic_version set version_num = '9999'")
    (other_major / "pg").mkdir(parents=True)
    (other_major / "pg" / "PG_VERSION").write_text("99\n")
    notes: list[str] = []
    assert folder_for(newer, lambda _: None, notes.append) == public_folder / "newer-3"
    assert notes[0].startswith(
        f"the log in {newer} is of a newer release, or not of ViAn alone. Nothing is added to it"
    )
    assert notes[1].startswith(f"the log in {other_major} is of a release with another PostgreSQL. Nothing is added")


@pytest.mark.parametrize(
    "options, code, said",
    [
        (["--video", "."], 2, "--video must be a video file, got ."),
        (["--report", "gone/x.html"], 1, "the report cannot be written to gone/x.html: no such folder. Next: "),
        (["--report", "."], 1, "the report cannot be written to ."),
        (["--video", "text.mp4"], 1, "text.mp4: not a video that can be opened"),
    ],
)
def test_a_demo_that_cannot_be_says_why(
    log: Log, central: Log, run: Run, options: list[str], code: int, said: str
) -> None:
    Path("text.mp4").write_text("this is not a video\n" * 50)
    ran = run("demo", "--dsn", log.dsn, *(options if "--video" in options else ["--video", "text.mp4", *options]))
    assert (ran.code, ran.out) == (code, "")
    assert said in ran.words
    assert "starting two PostgreSQL servers" not in ran.err


def test_a_demo_leaves_another_stations_log_alone(log: Log, central: Log, run: Run, clip: Path) -> None:
    append(log, points(1))
    ran = run("demo", "--video", clip, "--dsn", log.dsn)
    assert ran.code == 2
    assert "vian demo --data-dir FOLDER" in ran.words
    assert (log.head(), central.head()) == (1, 0)


def test_logs_that_do_not_agree_are_an_error(
    log: Log, central: Log, run: Run, clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo.Summary, "is_sound", False)
    ran = run("demo", "--video", clip, "--dsn", log.dsn)
    assert ran.code == 1
    assert "the two logs do not verify or do not agree. Next: vian verify" in ran.words


@pytest.mark.usefixtures("durable")
def test_doctor_finds_all_well(log: Log, run: Run) -> None:
    ran = run("doctor", "--dsn", log.dsn)
    assert ran.code == 0
    assert "ok    packages: " in ran.out
    assert {json.loads(line)["verdict"] for line in run("doctor", "--dsn", log.dsn, "--json").out.splitlines()} <= {
        "ok",
        "note",
    }


def test_doctor_counts_what_is_bad(run: Run) -> None:
    ran = run("doctor", "--dsn", "postgresql://nobody@127.0.0.1:1/none?connect_timeout=1")
    assert ran.code == 1
    assert "bad   log: " in ran.out
    assert "1 check came out bad; each says what to do next" in ran.words


def test_doctor_makes_no_log_in_a_folder_when_settings_name_an_address(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VIAN_DSN", "postgresql://nobody@127.0.0.1:1/none")
    ran = run("doctor", "--data-dir", tmp_path / "new")
    assert ran.code == 0
    assert not (tmp_path / "new").exists()
