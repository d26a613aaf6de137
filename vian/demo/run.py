"""The demo: videos become events, situations, an answer in SQL, and a second log with the same chain.

Contract: everything runs for real, and together: extraction, row projectors, the rule processor, a
central server over HTTP on loopback, and the sync daemon. The log depends on the clips alone: its
times are the clips', each beginning at `CLIP_START`. Run again after a kill it goes on; run again after
its end it appends nothing and shows the same.
"""

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from time import monotonic

import httpx
import pyarrow as pa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from events import station_name
from extractors import video
from patterns.engine.compiling import compiling_beside
from patterns.files.rule import Rule
from patterns.processor import Processor, deploy, passes
from store import Log, Projector, StationKey, Verification, verify
from sync.central.access import REPLICATE, Access
from sync.protocol.enrolment import new_secret
from sync.station.daemon import Daemon
from vian.api import bind, create_app, serving
from vian.clock import utc_now
from vian.demo.cameras import CameraFound, camera_found, camera_rows
from vian.demo.clip import SQUARE, Clip, Origin
from vian.demo.place import obstacle_in
from vian.demo.report import Facts, View, write_report
from vian.demo.scenes import RULES_IN_METRES, rules_for, source_of
from vian.enrolling import enrol_at
from vian.errors import WorldFailed, WrongUsage
from vian.extraction import Extraction, Job, extract_motion, media_clock, process_name
from vian.membership import Membership
from vian.output import Output
from vian.parts import Parts, stepping
from vian.peers import peer_by_membership
from vian.querying import query
from vian.replication import load_plan, station_daemon, sync_part
from vian.rules import file_text

STATION = "demo"
CLIP_START = datetime(2026, 1, 1, 10, tzinfo=UTC)
CENTRAL_DIR = "central"
CENTRAL = "http://central.localhost"
"""Address of the demo's central server in the log, the same each time whichever port it got."""
ANSWER_SQL = (
    "SELECT rule, severity, count(*) AS situations, min(time) AS first, max(time) AS last "
    "FROM situation_detected GROUP BY ALL ORDER BY rule"
)
_KEY, _CENTRAL_KEY = (
    StationKey(Ed25519PrivateKey.from_private_bytes(hashlib.sha256(seed).digest()))
    for seed in (b"the demo's station", b"the demo's central server")
)
"""Known to everybody, and the same each time: the demo's two logs trust each other on loopback alone."""
_CONVERGE_SECONDS_MAX = 120.0
_STEP_SECONDS = 0.5


@dataclass(frozen=True, slots=True)
class Summary:
    """What the demo came to."""

    clips: Sequence[Clip]
    extractions: Sequence[Extraction]
    """one a clip"""
    cameras: Sequence[CameraFound]
    """likewise"""
    seconds: float
    events: int
    """events in the station's log"""
    payload_bytes: int
    situations: pa.Table
    """answer to `ANSWER_SQL`"""
    in_metres: Sequence[str]
    """titles of the situations that a rule found in metres"""
    events_replicated: int
    """events in the central log"""
    station: Verification
    central: Verification
    heads_agree: bool
    report: Path

    @property
    def frames(self) -> int:
        """Frames of all clips."""
        return sum(each.frames for each in self.extractions)

    @property
    def bytes_per_event(self) -> float:
        """Stored payload bytes for each event."""
        return self.payload_bytes / self.events

    @property
    def is_sound(self) -> bool:
        """Whether both chains verify and their heads agree."""
        return self.station.is_sound and self.central.is_sound and self.heads_agree


def run_demo(
    open_station: Callable[[], Log],
    open_central: Callable[[], Log],
    clips: Sequence[Clip],
    report: Path,
    output: Output,
) -> Summary:
    """Run the demo on the clips, one after another, or go on with it.

    Args:
        open_station: Opens the station's log.
        open_central: Opens the central log.
        clips: The videos, of cameras of their own.
        report: File of the report.
        output: Where progress is shown.

    Raises:
        WrongUsage: The log holds another station's streams, or another release's demo.
        WorldFailed: The parts did not come together in time.
    """
    began = monotonic()
    with ExitStack() as stack:
        output.note("starting two PostgreSQL servers: the station's and the central one")
        station = stack.enter_context(open_station())
        if found := obstacle(station, clips):
            raise WrongUsage(f"the log {found}. Next: give the demo a folder of its own: vian demo --data-dir FOLDER")
        central = stack.enter_context(open_central())
        rules = {clip: rules_for(clip) for clip in clips}
        deployed = [rule for own in rules.values() for rule in own]
        deploy(station, STATION, deployed, {rule.rule: file_text(rule) for rule in deployed}, CLIP_START)
        extractions = _run_together(stack, station, central, rules, output)
        verified = verify(station), verify(central)
        agree = _heads(station) == _heads(central)
        answer = query(station, ANSWER_SQL)
        events, payload_bytes = _size(station)
        summary = Summary(
            clips,
            extractions,
            [_camera(station, clip) for clip in clips],
            monotonic() - began,
            events,
            payload_bytes,
            answer,
            _titles(station, RULES_IN_METRES),
            _size(central)[0],
            *verified,
            agree,
            report,
        )
        output.note("drawing the report")
        write_report(station, _views(summary, rules), _facts(summary), report)
    return summary


def obstacle(station: Log, clips: Sequence[Clip]) -> str | None:
    """What stands in the way of a demo of the clips in the log; see `obstacle_in`."""
    jobs = {clip: _job(station, clip) for clip in clips}
    processes = {job.source: process_name(job, video.probe(clip.path).sha256) for clip, job in jobs.items()}
    return obstacle_in(station, STATION, processes, [rule for clip in clips for rule in rules_for(clip)])


def _run_together(
    stack: ExitStack, station: Log, central: Log, rules: Mapping[Clip, list[Rule]], output: Output
) -> list[Extraction]:
    """Extraction, projectors, rules, server and sync at once, until all have come to the same place."""
    clock = _Clock()
    access = Access(central, station_name("central"), _CENTRAL_KEY, now=clock)
    app = create_app(central, access=access)
    address = stack.enter_context(serving(app, bind("127.0.0.1", 0)))
    membership = _membership(access, address)
    clock.stands = False
    daemon = stack.enter_context(
        station_daemon(
            station,
            STATION,
            peer_by_membership(membership, _KEY, CENTRAL),
            load_plan(None),
            now=lambda: CLIP_START,
            transport=_Loopback(httpx.URL(address)),
        )
    )
    stack.enter_context(compiling_beside())
    if any(clip.origin is Origin.SQUARE for clip in rules):
        stack.enter_context(_said_of_metres(output))
    processor = Processor(station, STATION, [rule for own in rules.values() for rule in own])
    projectors = [Projector(station), Projector(central)]
    parts = [
        stepping("rules", lambda: processor.step(_STEP_SECONDS), station, processor.close),
        stepping("rows", lambda: projectors[0].step(_STEP_SECONDS), station, projectors[0].close),
        stepping("central rows", lambda: projectors[1].step(_STEP_SECONDS), central, projectors[1].close),
        sync_part(daemon),
    ]
    with Parts(parts) as running:
        extractions = [_extracted(station, clip, running, output) for clip in rules]
        output.note("bringing rules, row tables and the central log to the same place")
        _converge(running, station, central, processor, projectors, daemon)
    return extractions


def _extracted(station: Log, clip: Clip, running: Parts, output: Output) -> Extraction:
    with output.progress(f"frames of {source_of(clip)}", None) as bar:

        def show(done: int, expected: int | None) -> None:
            running.check()
            bar.at(done, expected)

        return extract_motion(replace(_job(station, clip), on_progress=show, on_note=output.note))


@contextmanager
def _said_of_metres(output: Output) -> Iterator[None]:
    """In place of the processor's warnings of sources without metres, a word that this is meant."""
    output.note("speeds of the square are known from when enough people have crossed it to calibrate its camera")
    logger = logging.getLogger(passes.__name__)
    logger.addFilter(_is_not_of_metres)
    try:
        yield
    finally:
        logger.removeFilter(_is_not_of_metres)


def _is_not_of_metres(record: logging.LogRecord) -> bool:
    return getattr(record, "kind", None) != passes.UNCALIBRATED


class _Clock:
    """Central's: it stands while the station is enrolled, whose events are so the same each time, and goes on then.

    A demo that is run again must not give the challenges that were answered before.
    """

    stands = True

    def __call__(self) -> datetime:
        return CLIP_START if self.stands else utc_now()


def _membership(access: Access, address: str) -> Membership:
    """The station taken in by the central server, by a one-time code unless it was in an earlier run."""
    name = station_name(STATION)
    found = access.registry.station(name)
    if found is None or found.key_id != _KEY.id:
        secret = new_secret()
        access.registry.invite(name, secret, [REPLICATE], [], CLIP_START + timedelta(minutes=5))
        return enrol_at(httpx.URL(address), None, secret, name, _KEY).membership
    central = access.registry.central
    return Membership(address=address, station=name, central=central, public_key=_CENTRAL_KEY.public.hex())


def _job(station: Log, clip: Clip) -> Job:
    return Job(
        log=station,
        station=STATION,
        source=source_of(clip),
        path=clip.path,
        started_at=CLIP_START,
        stamp=media_clock,
    )


def _converge(
    parts: Parts, station: Log, central: Log, processor: Processor, projectors: list[Projector], daemon: Daemon
) -> None:
    """Wait until every part has seen everything.

    Raises:
        WorldFailed: One of them has not in time, or central holds another history of a stream.
    """
    extracted = station.head()

    def is_replicated() -> bool:
        stopped = [each.error for each in daemon.status().streams if each.error is not None]
        if stopped:
            raise WorldFailed(
                f"the central log holds another demo's history: {stopped[0]}. "
                "Next: give the demo a folder of its own: vian demo --data-dir FOLDER"
            )
        return _heads(station) == _heads(central)

    _wait(parts, "the rules have not seen all events", lambda: processor.position >= extracted)
    _wait(parts, "the central log has not all events", is_replicated)
    for projector, log in zip(projectors, (station, central), strict=True):
        head = log.head()
        _wait(parts, "the row tables are behind", partial(_has_reached, projector, head))


def _has_reached(projector: Projector, head: int) -> bool:
    return projector.position >= head


def _wait(parts: Parts, what: str, is_done: Callable[[], bool]) -> None:
    deadline = monotonic() + _CONVERGE_SECONDS_MAX
    while not is_done():
        if not parts.wait(0.05):
            parts.check()
        if monotonic() > deadline:
            raise WorldFailed(f"{what} after {_CONVERGE_SECONDS_MAX:g} s. Next: run the demo again; it goes on")


def _heads(log: Log) -> list[tuple[str, int, bytes]]:
    """Name, sequence and chain hash of the demo station's streams."""
    return [
        (str(head.stream), head.sequence, head.chain_hash)
        for head in log.streams()
        if head.stream.station == STATION and head.sequence
    ]


def _size(log: Log) -> tuple[int, int]:
    """Events and payload bytes of the demo station's streams."""
    sizes = [(segment.header.event_count, len(segment.payload)) for segment in log.read_all(stations=[STATION])]
    return sum(count for count, _ in sizes), sum(size for _, size in sizes)


class _Loopback(httpx.HTTPTransport):
    """Carries what is for `CENTRAL` to the place on loopback where it listens."""

    def __init__(self, address: httpx.URL) -> None:
        super().__init__()
        self._address = address

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """The answer from there."""
        request.url = request.url.copy_with(host=self._address.host, port=self._address.port)
        return super().handle_request(request)


def summary_rows(summary: Summary) -> Iterator[tuple[str, str]]:
    """The summary as names and values, for the table and the report."""
    was_done = all(each.was_done for each in summary.extractions)
    yield "frames", f"{summary.frames}" + (" (extracted in an earlier run)" if was_done else "")
    yield "events in the log", f"{summary.events}"
    yield "bytes per event", f"{summary.bytes_per_event:.1f}"
    for row in summary.situations.to_pylist():
        yield f"situations: {row['rule']}", str(row["situations"])
    if not summary.situations.num_rows:
        yield "situations", "0"
    for found in summary.cameras:
        yield from camera_rows(found)
    yield "events replicated", f"{summary.events_replicated}"
    yield "chains verified", "yes, heads agree" if summary.is_sound else "NO"


def _shown(value: object) -> str:
    return f"{value:%Y-%m-%d %H:%M:%S}" if isinstance(value, datetime) else str(value)


def _camera(station: Log, clip: Clip) -> CameraFound:
    return camera_found(station, STATION, source_of(clip), SQUARE.camera if clip.origin is Origin.SQUARE else None)


def _titles(station: Log, rules: Sequence[str]) -> list[str]:
    """What situations of these rules, under the names that they have for a source, are called, in order of time."""
    like = " or ".join(f"rule like '{rule}-%'" for rule in rules)
    found = query(station, f"select title from situation_detected where {like} order by time, sequence")
    return [str(title) for title in found.column("title").to_pylist()]


def _views(summary: Summary, rules: Mapping[Clip, list[Rule]]) -> list[View]:
    return [
        View(clip.path, clip.attribution, found, rules[clip])
        for clip, found in zip(summary.clips, summary.cameras, strict=True)
    ]


def _facts(summary: Summary) -> Facts:
    return Facts(
        summary=list(summary_rows(summary)),
        station=STATION,
        answer_sql=ANSWER_SQL,
        answer=[[_shown(value) for value in row.values()] for row in summary.situations.to_pylist()],
        answer_columns=summary.situations.column_names,
    )
