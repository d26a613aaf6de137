"""The parts of a server whose disk fills: they wait, and go on by themselves when there is room."""

import random
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import psycopg
import structlog

from events import EventBatch, RuleDeployed, SituationDetected, StreamName, batch_of
from events.names import station_name
from store import Appender, Log, Projector, open_log, verify
from sync import Grants, token_hash
from tests.store.disks import fill
from tests.store.samples import NOON, PRODUCER, point, query
from tests.vian.test_rules import write_rule
from vian.api import bind, create_app, serving
from vian.parts import Parts, stepping
from vian.peers import peer_by_token
from vian.replication import load_plan, station_daemon, sync_part
from vian.watching import processor_part

GATE = StreamName.of("brno", "gate", "track_point")
NOISE = StreamName.of("brno", "noise", "rule_deployed")
TOKEN = "a-token-of-brno-that-nobody-guesses"
SECONDS_MAX = 60.0


def central_beside(log: Log) -> Log:
    """A second log on the same server, and so on the same disk."""
    with psycopg.connect(log.dsn, autocommit=True) as connection:
        connection.execute("create database central")
    return open_log(dsn=psycopg.conninfo.make_conninfo(log.dsn, dbname="central"))


def noise(number: int) -> EventBatch:
    """One event of a megabyte that does not compress well."""
    text = random.Random(number).randbytes(500_000).hex()
    return batch_of([RuleDeployed(time=NOON, rule="noise", rule_version=number, rule_hash="0" * 64, text=text)])


def at_gate(number: int, time: datetime) -> EventBatch:
    """One event that the rule looks for."""
    return batch_of([point(number, time=time, x=9.0)])


def wait_until(running: Parts, is_so: Callable[[], object]) -> None:
    waited = 0.0
    while not is_so():
        assert running.wait(0.1), "a part ended"
        running.check()
        waited += 0.1
        assert waited < SECONDS_MAX


def test_projector_rules_and_sync_wait_for_room_and_then_catch_up(small_disk: Path, tmp_path: Path) -> None:
    grants = Grants({"brno": token_hash(TOKEN)})
    with (
        structlog.testing.capture_logs() as logged,
        open_log(data_dir=small_disk / "log") as log,
        central_beside(log) as central,
        serving(create_app(central, grants), bind("127.0.0.1", 0)) as address,
        station_daemon(log, station_name("brno"), peer_by_token(address, TOKEN), load_plan(None)) as daemon,
    ):
        projector = Projector(log)
        parts = [
            stepping("projector", lambda: projector.step(0.2), log, projector.close),
            processor_part(log, "brno", write_rule(tmp_path / "high.yaml")),
            sync_part(daemon),
        ]
        ballast = fill(small_disk, leave_mib=14)
        frame = 0

        def make_room(_: float) -> None:
            if {each.get("part") for each in logged if each["event"] == "waits for the database"} >= {"projector"}:
                ballast.unlink(missing_ok=True)

        appender = Appender(log, PRODUCER, wait_s=SECONDS_MAX, sleep=make_room)
        with Parts(parts) as running:
            while ballast.exists():
                frame += 1
                assert frame < 100, "the disk never filled"
                appender.append([(GATE, at_gate(frame, NOON + timedelta(seconds=frame))), (NOISE, noise(frame))])
                running.check()
            # What makes the last one final.
            appender.append([(GATE, at_gate(frame + 1, NOON + timedelta(hours=1)))])

            def situations() -> int:
                return sum(s.header.event_count for s in log.read_all(types=[SituationDetected.type_name]))

            wait_until(running, lambda: situations() >= frame)
            wait_until(running, lambda: projector.position == log.head())
            wait_until(running, lambda: {h.sequence for h in central.streams()} and _heads(central) == _heads(log))
        found = verify(log)
        assert found.is_sound
        assert verify(central).is_sound
        assert situations() == frame
        assert query(log, "select count(*), count(distinct id) from events") == [(found.events, found.events)]
        said = [each["error"] for each in logged if each.get("part") == "projector"]
        assert said, "the projector never waited"


def _heads(log: Log) -> dict[StreamName, tuple[int, bytes]]:
    return {head.stream: (head.sequence, head.chain_hash) for head in log.streams()}
