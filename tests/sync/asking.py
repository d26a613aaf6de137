"""A central log with plates and situations of three stations, and who asks of it."""

import time
from collections.abc import Sequence
from datetime import timedelta
from typing import Any

from events import (
    EventType,
    PlateRead,
    QueryAnswered,
    SituationDetected,
    StreamName,
    batch_of,
    decode,
    encode,
    events_of,
    station_name,
)
from store import Log, Projector
from sync.central.access import EVERY_STATION, OPERATIONS, Caller
from sync.central.answering import Answering, QuestionLimits
from sync.central.pages import Pages
from sync.protocol.questions import Answer, FindQuestion, QueryQuestion
from sync.protocol.wire import parse
from tests.sync.conftest import NOON, PRODUCER

CENTRAL = station_name("central")
SECRET = bytes(range(32))


def plate(text: str, minute: float = 0.0, **given: Any) -> PlateRead:
    box = {"x1": 1.0, "y1": 2.0, "x2": 3.0, "y2": 4.0}
    values = {"confidence": 0.5, "frame": 1, "country": "CZ", "region": None, "candidates": None} | box | given
    return PlateRead(time=NOON + timedelta(minutes=minute), plate=text, **values)


def situation(rule: str, minute: float = 0.0, severity: Any = "warning") -> SituationDetected:
    at = NOON + timedelta(minutes=minute)
    return SituationDetected(
        time=at,
        situation=f"{rule}-{minute:g}",
        rule=rule,
        rule_version=1,
        rule_hash="0" * 64,
        severity=severity,
        title=f"{rule} at {minute:g}",
        partition="{}",
        measures='{"speed": 1.5}',
        began_at=at,
        ended_at=at,
        lineage=(),
    )


def tell(log: Log, station: str, events: Sequence[EventType], source: str = "gate") -> None:
    """Append the events as one segment of the station."""
    stream = StreamName.of(station, source, type(events[0]).type_name)
    log.append([encode(stream, batch_of(events), PRODUCER)])


def project(log: Log) -> None:
    """Bring the rows up to the log."""
    projector = Projector(log)
    projector.catch_up()
    projector.close()


def caller(*reads: str, station: str = "brno-2", operations: Sequence[str] = OPERATIONS) -> Caller:
    return Caller(station_name(station), frozenset(operations), frozenset(reads), "k", 1)


EVERYBODY = caller(EVERY_STATION)


def answering(log: Log, limits: QuestionLimits | None = None, **given: Any) -> Answering:
    return Answering(log, CENTRAL, Pages(SECRET), limits or QuestionLimits(), lambda: NOON, time.monotonic, **given)


def query(log: Log, sql: str, who: Caller = EVERYBODY, limits: QuestionLimits | None = None, **given: Any) -> Answer:
    body = QueryQuestion(sql=sql, **given).encoded()
    return parse(Answer, answering(log, limits).query(who, body))


def find(log: Log, who: Caller = EVERYBODY, limits: QuestionLimits | None = None, **given: Any) -> Answer:
    return parse(Answer, answering(log, limits).find(who, FindQuestion(**given).encoded()))


def audit(log: Log) -> list[QueryAnswered]:
    """What central recorded of the questions."""
    events = [
        event
        for segment in log.read_all(types=["query_answered"], stations=[CENTRAL])
        for event in events_of(decode(segment, log.catalogue))
    ]
    assert all(isinstance(event, QueryAnswered) for event in events)
    return events  # type: ignore[return-value]  # as just seen
