"""What a station is told when central answers, refuses, or is away."""

from datetime import timedelta
from typing import Any

import pyarrow as pa
import pytest

from events import station_name
from store import Log
from sync.central.access import Caller
from sync.central.answering import QuestionLimits
from sync.errors import BadAnswer, CentralError, CentralFailed, CentralUnreachable, Refused
from sync.protocol.questions import Answer, AnswerColumn, FindQuestion, QueryQuestion
from sync.protocol.reports import CHECKPOINT, Status
from sync.protocol.wire import parse
from tests.sync.asking import EVERYBODY, answering, plate, project, tell
from tests.sync.conftest import NOON
from vian.asking import Found, find_at_central, find_here, query_at_central, table_of
from vian.errors import WorldFailed

PLATES = FindQuestion(kind="plate", plate="*", limit=2)


class Central:
    """Central, asked without a network; what is in `faults` goes wrong first, in this order."""

    def __init__(self, log: Log, who: Caller = EVERYBODY, faults: list[CentralError | None] | None = None) -> None:
        self._desk = answering(log, QuestionLimits())
        self._who = who
        self._faults = faults or []

    def find(self, question: FindQuestion) -> Answer:
        self._go_wrong()
        return parse(Answer, self._desk.find(self._who, question.encoded()))

    def query(self, question: QueryQuestion) -> Answer:
        self._go_wrong()
        return parse(Answer, self._desk.query(self._who, question.encoded()))

    def _go_wrong(self) -> None:
        if self._faults and (fault := self._faults.pop(0)) is not None:
            raise fault


@pytest.fixture
def central_log(make_log: Any) -> Log:
    log: Log = make_log()
    for station in ("brno-2", "oslo-1"):
        tell(log, station, [plate(f"{station}", minute) for minute in range(3)])
    project(log)
    return log


@pytest.fixture
def station_log(make_log: Any) -> Log:
    log: Log = make_log()
    tell(log, "brno-2", [plate("brno-2", minute) for minute in range(3)])
    return log


def asked(central: Central, log: Log, question: FindQuestion = PLATES, *, is_all: bool = False) -> Found:
    return find_at_central(central, log, "brno-2", question, is_all=is_all)


def test_central_is_asked_for_one_page_or_for_all(central_log: Log, station_log: Log) -> None:
    page = asked(Central(central_log), station_log)
    assert (len(page.rows), page.source.by, page.source.is_partial) == (2, "central", False)
    assert page.source.next is not None
    assert "add --all" in page.source.remarks(NOON)[0]
    whole = asked(Central(central_log), station_log, is_all=True)
    assert (len(whole.rows), whole.source.next, whole.source.remarks(NOON)) == (6, None, [])
    assert [row[0] for row in whole.rows] == sorted((row[0] for row in whole.rows), reverse=True)


@pytest.mark.parametrize("fault", [CentralUnreachable("no link"), CentralFailed("busy"), BadAnswer("a hotel's page")])
def test_without_central_the_answer_is_the_stations_own_and_says_so(station_log: Log, fault: CentralError) -> None:
    found = asked(Central(station_log, faults=[fault]), station_log)
    assert [row[1] for row in found.rows] == ["brno-2", "brno-2"]
    assert (found.source.is_partial, found.source.by, found.source.last_contact) == (True, "brno-2", None)
    (partial, cut) = found.source.remarks(NOON)
    assert partial.startswith("PARTIAL: this is what station brno-2 itself holds; central did not answer.")
    assert f"Last contact with central: never, or not by a daemon of this ViAn. {fault}" in partial
    assert "the limit of 2 rows" in cut
    summary = found.source.summary(len(found.rows), NOON)
    assert summary["partial"] is True
    assert summary["last_contact_age_s"] is None


def test_the_age_of_the_last_contact_is_that_which_the_daemon_saved(station_log: Log) -> None:
    status = Status(station_name("brno-2"), "https://c", (), NOON - timedelta(hours=26), None, 0, None)
    with station_log.transaction() as transaction:
        transaction.save_checkpoint(CHECKPOINT, 0, status.to_json())
    source = asked(Central(station_log, faults=[CentralUnreachable("no link")]), station_log).source
    assert "Last contact with central: 1 d 2 h ago (2026-04-30 10:00:00 UTC)" in source.remarks(NOON)[0]
    assert source.summary(2, NOON)["last_contact_age_s"] == 26 * 3600


def test_a_refusal_is_an_error_and_no_partial_answer(station_log: Log) -> None:
    with pytest.raises(Refused, match="not granted"):
        asked(Central(station_log, faults=[Refused("not granted", code="not_granted")]), station_log)


def test_an_answer_that_breaks_off_between_pages_is_none(central_log: Log, station_log: Log) -> None:
    central = Central(central_log, faults=[None, CentralUnreachable("no link")])
    with pytest.raises(WorldFailed, match="2 rows had come by then; none is shown"):
        asked(central, station_log, is_all=True)


def test_rows_that_are_not_made_yet_are_told(central_log: Log, station_log: Log) -> None:
    tell(central_log, "brno-2", [plate("newest", 9)])
    found = asked(Central(central_log), station_log)
    assert found.source.behind == 1
    assert "still making rows of its newest 1 segment," in found.source.remarks(NOON)[0]


def test_a_station_finds_by_itself_without_a_word_of_central(station_log: Log) -> None:
    found = find_here(station_log, "brno-2", PLATES, is_all=True)
    assert (len(found.rows), found.source.remarks(NOON)) == (3, [])
    assert found.source.summary(3, NOON) == {
        "answered_by": "brno-2", "partial": False, "rows": 3, "rows_behind": 0, "cut": None, "next": None,
    }  # fmt: skip


def test_sql_is_answered_by_central_or_else_by_duckdb_here(central_log: Log, station_log: Log) -> None:
    question = QueryQuestion(
        sql="select station, count(*) as n, max(time)::text as at from plate_read group by station"
    )
    source, table = query_at_central(Central(central_log), station_log, "brno-2", question)
    assert (source.by, sorted(table.column("station").to_pylist())) == ("central", ["brno-2", "oslo-1"])
    away = Central(central_log, faults=[CentralUnreachable("no link")] * 2)
    source, table = query_at_central(away, station_log, "brno-2", question)
    assert (source.is_partial, table.column("station").to_pylist(), table.column("n").to_pylist()) == (
        True,
        ["brno-2"],
        [3],
    )
    with pytest.raises(WorldFailed, match=r"no link\. Nor can this station answer it by itself: .*nope"):
        query_at_central(away, station_log, "brno-2", QueryQuestion(sql="select nope from plate_read"))


def test_an_answer_becomes_a_table_with_types() -> None:
    kinds = ("int8", "float4", "timestamptz", "bool", "jsonb", "text", "date")
    answer = Answer(
        station="central",
        time=NOON,
        columns=tuple(AnswerColumn(name=kind, type=kind) for kind in kinds),
        rows=(
            (1, "NaN", "2026-05-01T12:00:00.5+00:00", True, {"a": [1]}, "x", "2026-05-01"),
            (None,) * 7,
            (2**62, 0.5, "infinity", False, "text", "", "infinity"),
        ),
        position=1,
        rows_position=1,
    )
    table = table_of(answer)
    moment = pa.timestamp("us", tz="UTC")
    assert table.schema.types == [
        pa.int64(), pa.float64(), moment, pa.bool_(), pa.string(), pa.string(), pa.string()
    ]  # fmt: skip
    first, second, third = table.to_pylist()
    assert str(first.pop("float4")) == "nan"
    assert first == {
        "int8": 1, "timestamptz": NOON + timedelta(seconds=0.5), "bool": True, "jsonb": '{"a": [1]}', "text": "x",
        "date": "2026-05-01",
    }  # fmt: skip
    assert set(second.values()) == {None}
    assert (third["int8"], third["timestamptz"], third["jsonb"]) == (2**62, None, "text")
