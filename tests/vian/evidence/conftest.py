"""A log with a situation and all that it rests on, and evidence exported from it."""

import json
import shutil
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest

from events import (
    Catalogue,
    EventType,
    MatchedRange,
    ProcessStarted,
    Producer,
    RuleDeployed,
    SituationDetected,
    StreamName,
    VideoAdded,
    batch_of,
    encode,
)
from store import Log, Signer, load_key, make_key
from tests.conftest import Servers
from tests.vian.conftest import Run
from tests.vian.samples import GATE, START, YARD, points
from vian.evidence.bundle import Source
from vian.evidence.bundle import export as write
from vian.evidence.selection import of_situation

SITUATION = "3f9c2a71" * 8
Export = Callable[..., Path]
VIDEO = "ab" * 32
MOTION = Producer("motion", "1.0.0", bytes(range(32)))
RULE = "rule: yard-dwell\nversion: 3\n"


def say(log: Log, event: EventType, source: str = "gate") -> None:
    stream = StreamName.of("brno", source, type(event).type_name)
    log.append([encode(stream, batch_of([event]), MOTION)], [log.stream_head(stream).sequence])


def track(log: Log, count: int, stream: StreamName = GATE) -> None:
    at = log.stream_head(stream).sequence
    log.append([encode(stream, points(count, first_frame=at), MOTION)], [at])


def fill(log: Log, sign: Callable[[], object]) -> None:
    """Points at the gate, the second and third segment matched, the fourth signed with them; a yard unasked for."""
    say(log, RuleDeployed(time=START, rule="yard-dwell", rule_version=3, rule_hash="ef" * 32, text=RULE), "rules")
    say(
        log,
        VideoAdded(
            time=START, video=VIDEO, path="gate.mp4", width=640, height=480, fps=25.0, frames_expected=None,
            codec="h264", started_at=START,
        ),
    )  # fmt: skip
    say(log, started("p1"))
    sign()
    track(log, 10)
    track(log, 5, YARD)
    sign()
    track(log, 10)
    track(log, 10)
    say(log, situation())
    track(log, 5)
    sign()
    track(log, 10)
    sign()


def started(process: str) -> ProcessStarted:
    return ProcessStarted(
        time=START, process=process, extractor="motion", extractor_version="1.0.0", configuration="{}", video=VIDEO
    )


def situation() -> SituationDetected:
    return SituationDetected(
        time=START + timedelta(seconds=30),
        situation=SITUATION,
        rule="yard-dwell",
        rule_version=3,
        rule_hash="ef" * 32,
        severity="alarm",
        title="track 1 has been in the yard",
        partition=json.dumps({"track_id": 1}),
        measures=json.dumps({"entered_at": START.isoformat()}),
        began_at=START + timedelta(seconds=12),
        ended_at=START + timedelta(seconds=25),
        lineage=(
            MatchedRange(variable="entry", stream=str(GATE), first_sequence=13, last_sequence=15, events=3),
            MatchedRange(variable="dwell", stream=str(GATE), first_sequence=16, last_sequence=25, events=9),
        ),
    )


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    make_key(tmp_path / "keys" / "station.key")
    return tmp_path / "keys" / "station.key"


def signer_of(log: Log, key_file: Path) -> Signer:
    times = (START + timedelta(hours=hour) for hour in range(100))
    return Signer(log, "brno", lambda: load_key(key_file), lambda: next(times))


@pytest.fixture
def signed_log(log: Log, key_file: Path) -> Log:
    """The log of `fill`, signed four times."""
    fill(log, signer_of(log, key_file).sign)
    return log


@pytest.fixture
def export(signed_log: Log, key_file: Path, tmp_path: Path, run: Run) -> Export:
    """Exports from the signed log; the directory."""

    def do(*arguments: object) -> Path:
        out = tmp_path / "evidence"
        options = ("--dsn", signed_log.dsn, "--key-file", key_file, "--out", out, "--by", "officer", "--why", "case 12")
        ran = run("evidence", "export", *arguments, *options)
        assert ran.code == 0, ran.err
        return out

    return do


@pytest.fixture(scope="session")
def exported_once(servers: Servers, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Evidence of the situation from a log of its own."""
    folder, server = tmp_path_factory.mktemp("exported"), servers.get("embedded")
    key_file, name = folder / "keys" / "station.key", server.create_database()
    make_key(key_file)
    with Log(server.dsn(name), Catalogue.shipped()) as log:
        fill(log, signer_of(log, key_file).sign)
        source = Source(log, "brno", True, load_key(key_file), "officer", "case 12", START)
        write(source, of_situation(log, SITUATION), folder / "evidence")
    server.drop_database(name)
    return folder / "evidence"


@pytest.fixture
def bundle(exported_once: Path, tmp_path: Path) -> Path:
    """Evidence of the situation, to be changed at will."""
    return Path(shutil.copytree(exported_once, tmp_path / "bundle"))
