import json
import threading
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import psycopg
import pytest

from events import SHIPPED, Catalogue, EventType
from store import Log, LogUnavailable
from store.errors import QuestionFailed, QuestionTooDear
from store.field import Cost, field_session, field_tables
from sync.central.answering import Answering, QuestionLimits
from sync.errors import Refusal
from sync.protocol.questions import Answer, FindQuestion, QueryQuestion
from sync.protocol.wire import parse
from tests.conftest import Server
from tests.store.samples import on_both
from tests.sync.asking import EVERYBODY, answering, audit, caller, find, plate, project, query, situation, tell
from tests.sync.conftest import NOON
from tests.sync.test_selects import ALLOWED

BRNO = caller("brno-2")


@pytest.fixture
def central(central_log: Log) -> Log:
    """Central's log, with plates of three stations."""
    for number, station in enumerate(("brno-2", "oslo-1", "rome-3")):
        tell(central_log, station, [plate(f"{number}AB 23-4{minute}", minute) for minute in range(3)])
        tell(central_log, station, [situation("speeding", number), situation("wrong way", number, "alarm")], "rules")
    project(central_log)
    return central_log


def plates(answer: Answer) -> list[Any]:
    return [row["plate"] for row in answer.records()]


# Whose rows.


SEEING = [
    "select distinct station from plate_read order by 1",
    "select distinct station from events order by 1",
    "select distinct station from streams order by 1",
    "select distinct a.station from plate_read a, situation_detected b where a.station = b.station order by 1",
    "select station from (select station from plate_read union select station from events) u order by 1",
    "with p as (select station from plate_read) select distinct station from p order by 1",
    "select distinct e.station from streams s, lateral (select station from events e where e.station = s.station) e",
]


@on_both
def test_a_question_sees_the_stations_that_its_caller_may_read(central: Log) -> None:
    everywhere = ["brno-2", "oslo-1", "rome-3"]
    for reads, seen in ((["oslo-1"], ["oslo-1"]), (["*"], everywhere), (["nowhere"], []), ([], [])):
        for sql in SEEING:
            rows = query(central, sql, caller(*reads)).rows
            assert sorted(str(station) for (station,) in rows if station != "central") == seen, sql


@on_both
def test_every_relation_that_a_question_may_read_shows_the_granted_stations_only(central: Log) -> None:
    with central.connection() as connection:
        readable = connection.execute(
            "select c.relname, c.relkind::text, coalesce('security_barrier=true' = any (c.reloptions), false), "
            "pg_get_viewdef(c.oid) like '%field_stations()%' from pg_class c "
            "where c.relnamespace = 'public'::regnamespace and c.relkind in ('r', 'p', 'v', 'm', 'f') "
            "and has_table_privilege('vian_field', c.oid, 'select')"
        ).fetchall()
    assert {name for name, *_ in readable} == {f"field_{name}" for name in field_tables(central)}
    assert {tuple(rest) for _, *rest in readable} == {("v", True, True)}


@on_both
def test_the_role_of_questions_may_do_nothing_but_read_its_views(central: Log) -> None:
    for statement in (
        "select * from plate_read",
        "select * from plate_read_events",
        "select * from plate_read_20260501",
        "select * from events",
        "select * from streams",
        "select * from segments",
        "select * from checkpoints",
        "select * from field_callers",
        "insert into field_callers values (1, null)",
        "update field_plate_read set plate = ''",
        "create temp table t (a int)",
        "select set_config('transaction_read_only', 'off', true)",
        "set transaction read write",
        "select ensure_partition('plate_read', '2020-01-01')",
        "select make_field_view('plate_read')",
        "select pg_read_file('/etc/passwd')",
        "copy (select 1) to program 'true'",
        "lock table plate_read",
    ):
        with field_session(central, ["brno-2"]) as session, pytest.raises(psycopg.Error):
            session._connection.execute(statement.encode())


def test_what_a_question_may_read_cannot_be_changed_from_within(central: Log) -> None:
    with field_session(central, ["brno-2"]) as session:
        connection = session._connection
        for name in ("vian.stations", "vian_field.stations", "search_path"):
            connection.execute("select set_config(%s, 'oslo-1', true)", (name,))
        connection.execute("set local search_path to pg_temp, public")
        assert connection.execute("select distinct station from public.field_plate_read").fetchall() == [("brno-2",)]


def test_nothing_is_seen_outside_of_a_question(central: Log) -> None:
    query(central, "select 1 as one")
    with psycopg.connect(central.dsn) as connection:
        assert connection.execute("select count(*) from field_callers").fetchone() == (0,)
        assert connection.execute("select field_stations()").fetchone() == ([],)
        connection.execute("insert into field_callers values (0, null)")
        connection.commit()
        connection.execute("set role vian_field")
        assert connection.execute("select count(*) from field_plate_read").fetchone() == (0,)


def test_an_error_tells_nothing_of_rows_that_may_not_be_seen(central: Log) -> None:
    for sql in (
        "select cast(plate as integer) from plate_read where station = 'oslo-1'",
        "select 1 / (case when plate like '1AB%' then 0 else 1 end) from plate_read",
        "select plate from plate_read where cast(plate as integer) = 1 and station <> 'brno-2'",
    ):
        told = _told(central, sql)
        assert "1AB" not in told
        assert "2AB" not in told


def _told(central: Log, sql: str) -> str:
    """All that brno-2 is told."""
    try:
        return str(query(central, sql, BRNO))
    except Refusal as refusal:
        return str(refusal)


class Ping(EventType, type="ping", version=1):
    """A type of a plug-in."""


def test_a_row_table_that_comes_later_is_asked_by_the_same_rule(make_log: Any) -> None:
    log = make_log(Catalogue([*SHIPPED, Ping]))
    for station in ("brno-2", "oslo-1"):
        tell(log, station, [Ping(time=NOON)])
    project(log)
    assert query(log, "select station from ping", BRNO).rows == (("brno-2",),)
    assert query(log, "select station from events", BRNO).rows == (("brno-2",),)


def test_an_account_that_may_not_act_for_questions_is_told_what_it_lacks(central: Log, server: Server) -> None:
    server.execute("create role lonely login in role vian_writer")
    try:
        dsn = psycopg.conninfo.make_conninfo(central.dsn, user="lonely")
        with (
            Log(dsn, central.catalogue) as log,
            pytest.raises(LogUnavailable, match="grant vian_field to this account"),
        ):
            query(log, "select 1 as one")
    finally:
        server.execute("drop role lonely")


# What an answer is.


def test_an_answer_says_its_columns_and_how_far_the_rows_go(central: Log) -> None:
    sql = (
        "select time, plate as p, plate as p, confidence, sequence, measures, true as yes, null as nothing, "
        "cast('NaN' as real) as nan from plate_read left join situation_detected s using (position) limit 1"
    )
    answer = query(central, sql.replace("time", "plate_read.time", 1).replace(" sequence", " plate_read.sequence"))
    assert [(column.name, column.type) for column in answer.columns] == [
        ("time", "timestamptz"), ("p", "text"), ("p", "text"), ("confidence", "float4"), ("sequence", "int8"),
        ("measures", "jsonb"), ("yes", "bool"), ("nothing", "text"), ("nan", "float4"),
    ]  # fmt: skip
    assert answer.rows[0][3:] == (0.5, 1, None, True, None, "NaN")
    assert answer.rows[0][0] == NOON.isoformat()
    assert answer.position == answer.rows_position == 6
    tell(central, "brno-2", [plate("NEW", 9)])
    answer = query(central, "select count(*) as n from plate_read")
    assert (answer.position, answer.rows_position) == (8, 6)  # behind the record of the first question


def test_an_answer_ends_at_its_limits_and_says_so(central: Log) -> None:
    assert query(central, "select plate from plate_read", limit=9).cut is None
    cut = query(central, "select plate from plate_read order by plate", limit=2)
    assert (plates(cut), cut.cut) == (["0AB 23-40", "0AB 23-41"], "the limit of 2 rows")
    assert len(query(central, "select plate from plate_read", limits=QuestionLimits(rows_max=4)).rows) == 4
    small = query(central, "select plate from plate_read", limits=QuestionLimits(answer_bytes_max=30))
    assert (len(small.rows), small.cut) == (2, "the limit of 30 bytes")
    with pytest.raises(Refusal, match="a row of more than 10 bytes"):
        query(central, "select plate from plate_read", limits=QuestionLimits(row_bytes_max=10))
    assert [(event.outcome, event.row_count) for event in audit(central)] == [
        ("answered", 9), ("cut", 2), ("cut", 4), ("cut", 2), ("refused", 0),
    ]  # fmt: skip


def test_whatever_may_be_asked_is_answered(central: Log) -> None:
    for sql in [*ALLOWED, "select plate_key(plate), frame % 2 = 1 from plate_read", HUNDRED]:
        assert query(central, sql).columns


HUNDRED = f"select {', '.join(f'{n} as c{n}' for n in range(100))}"


def test_a_question_that_is_not_right_is_refused_with_what_is_wrong(central: Log) -> None:
    for sql, got in {
        "select plate, count(*) from plate_read": 'column "plate_read.plate" must appear in the GROUP BY',
        "select plate + 1 from plate_read": "operator does not exist",
        "select 1 / 0 as x": "division by zero",
        "select pg_sleep(1)": "the function pg_sleep is not for questions",
        f"select {', '.join(f'{n} as c{n}' for n in range(101))}": "101 columns",
    }.items():
        with pytest.raises(Refusal) as caught:
            query(central, sql)
        assert (caught.value.status, caught.value.code) == (422, "bad_question")
        assert got in caught.value.got


HEAVY = f"select count(*) from {', '.join(f'plate_read t{number}' for number in range(12))}"


@on_both
def test_a_question_ends_when_its_time_is_up(central: Log) -> None:
    limits = QuestionLimits(cost=Cost(seconds=0.2))
    with pytest.raises(Refusal) as caught:
        query(central, HEAVY, limits=limits)
    assert (caught.value.status, caught.value.code) == (422, "timed_out")
    assert query(central, "select 1 as one", limits=limits).rows == ((1,),)
    assert [event.outcome for event in audit(central)] == ["timed_out", "answered"]


def test_the_time_is_that_of_the_whole_question(central: Log) -> None:
    clock = iter([0.0, 0.0, 1.0, 2.0, 3.0])
    with field_session(central, None, Cost(seconds=2.5), lambda: next(clock)) as session:
        lines = session.lines("select plate from field_plate_read", 1, rows_max=9, bytes_max=100, batch=2)
        assert [next(lines), next(lines)] == ['["0AB 23-40"]', '["0AB 23-41"]']
        with pytest.raises(QuestionTooDear, match=r"longer than 2\.5 s"):
            list(lines)


def test_a_question_is_bounded_on_the_servers_disk(central: Log) -> None:
    cost = Cost(memory_mb=1, disk_mb=1)
    with field_session(central, None, cost) as session, pytest.raises(QuestionTooDear, match="temp_file_limit"):
        list(session.lines("select count(*) from generate_series(1, 1000000)", 1, rows_max=9, bytes_max=100))


def test_a_session_leaves_nothing_behind(central: Log) -> None:
    with field_session(central, None) as session, pytest.raises(QuestionFailed, match="division by zero"):
        session.columns("select 1 / 0 where (select 1 / 0) = 0")
    with central.connection() as connection:
        row = connection.execute("select current_user, current_setting('statement_timeout')").fetchone()
    assert row == ("vian_writer", "0")


# Who may, and the record.


def test_what_is_not_granted_is_refused_and_recorded(central: Log) -> None:
    desk = answering(central)
    sql, plates_ = QueryQuestion(sql="select 1").encoded(), FindQuestion(kind="plate", plate="1*").encoded()
    elsewhere = FindQuestion(kind="plate", plate="1*", station="oslo-1").encoded()
    for ask, who, body in (
        (desk.query, caller("*", operations=["replicate", "find"]), sql),
        (desk.find, caller("*", operations=["replicate", "query"]), plates_),
        (desk.find, BRNO, elsewhere),
    ):
        with pytest.raises(Refusal) as caught:
            ask(who, body)
        assert (caught.value.status, caught.value.code) == (403, "not_granted")
    events = audit(central)
    assert [(event.asked_by, event.outcome, event.row_count) for event in events] == [("brno-2", "refused", 0)] * 3
    assert all(event.reason is not None and event.reason.startswith("not_granted") for event in events)


def test_each_question_is_recorded_with_who_asked_what(central: Log) -> None:
    query(central, "select 1 as one", person="jana")
    find(central, kind="plate", plate="1ab*", station="oslo-1", person="petr")
    find(central, kind="situation", rule="speed*")
    first, second, third = audit(central)
    assert (first.asked_by, first.person, first.kind, first.question) == ("brno-2", "jana", "sql", "select 1 as one")
    assert (second.person, second.kind, second.outcome, second.row_count) == ("petr", "plate", "answered", 3)
    assert json.loads(second.question) == {"kind": "plate", "plate": "1ab*", "station": "oslo-1"}
    assert (third.person, third.kind) == (None, "situation")
    assert first.time == NOON
    assert 0 <= first.duration_s < 60


def test_an_answer_that_cannot_be_recorded_is_not_given(central: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    def unavailable(*_: Any, **__: Any) -> Any:
        raise LogUnavailable("gone")

    desk = answering(central)
    monkeypatch.setattr(central, "append", unavailable)
    monkeypatch.setattr(central, "transaction", unavailable)
    with pytest.raises(LogUnavailable, match="gone"):
        desk.query(EVERYBODY, QueryQuestion(sql="select 1 as one").encoded())


def test_who_is_shut_out_while_a_question_is_answered_gets_no_answer(central: Log) -> None:
    def shut_out(_: Any, who: Any) -> None:
        raise Refusal(401, "revoked", "the station was revoked", who.station, "an enrolled station", "ask central")

    desk = answering(central, still_allowed=shut_out)
    with pytest.raises(Refusal, match="revoked"):
        desk.query(EVERYBODY, QueryQuestion(sql="select plate from plate_read").encoded())
    (event,) = audit(central)
    assert (event.outcome, event.row_count, event.reason) == ("refused", 0, "revoked: brno-2")


def test_a_body_that_is_no_question_is_refused(central_log: Log) -> None:
    desk = answering(central_log)
    for body in (b"", b"{}", b"[]", b'{"kind": "face"}', b'{"kind": "plate"}', b'{"sql": 1}'):
        for ask in (desk.find, desk.query):
            with pytest.raises(Refusal) as caught:
                ask(EVERYBODY, body)
            assert (caught.value.status, caught.value.code) == (400, "bad_question")


@pytest.fixture
def held(central: Log) -> Iterator[tuple[Answering, threading.Event, list[threading.Thread]]]:
    """Central while a question of brno-2 is being answered; the event lets it end."""
    going, end = threading.Event(), threading.Event()
    desk = answering(central, QuestionLimits(of_station_max=1, at_once_max=2))
    look = desk._told

    def slow(*given: Any) -> Any:
        if threading.current_thread() is not threading.main_thread():
            going.set()
            assert end.wait(60)
        return look(*given)

    desk._told = slow  # type: ignore[method-assign]
    thread = threading.Thread(target=desk.query, args=(EVERYBODY, QueryQuestion(sql="select 1 as one").encoded()))
    thread.start()
    assert going.wait(60)
    yield desk, end, [thread]
    end.set()
    thread.join()


def test_one_station_asks_so_many_questions_at_a_time(held: tuple[Answering, threading.Event, list[Any]]) -> None:
    desk, end, (thread,) = held
    body = QueryQuestion(sql="select 2 as two").encoded()
    with pytest.raises(Refusal) as caught:
        desk.query(EVERYBODY, body)
    assert (caught.value.status, caught.value.code) == (429, "too_many_questions")
    assert parse(Answer, desk.query(caller("*", station="oslo-1"), body)).rows == ((2,),)
    end.set()
    thread.join()
    assert parse(Answer, desk.query(EVERYBODY, body)).rows == ((2,),)


# Plates and situations.


@on_both
def test_a_plate_is_found_however_it_is_written(central: Log) -> None:
    for text in ("1AB2340", "1ab 23-40", "1a?2340", "1.AB.23.40"):
        assert plates(find(central, kind="plate", plate=text)) == ["1AB 23-40"]
    assert plates(find(central, kind="plate", plate="1AB*")) == ["1AB 23-42", "1AB 23-41", "1AB 23-40"]
    assert plates(find(central, kind="plate", plate="*41")) == ["2AB 23-41", "1AB 23-41", "0AB 23-41"]
    for text in ("1AB", "%", "1AB_", "_AB2340", "\\", "1AB2340'; drop table plate_read; --"):
        assert plates(find(central, kind="plate", plate=text)) == []


def test_a_find_answers_with_what_leads_to_the_evidence(central: Log) -> None:
    (row,) = find(central, kind="plate", plate="1AB2340").records()
    assert row == {
        "time": NOON, "station": "oslo-1", "source": "gate", "plate": "1AB 23-40", "confidence": 0.5,
        "country": "CZ", "region": None, "id": "oslo-1/gate/plate_read/1",
    }  # fmt: skip
    (row,) = find(central, kind="situation", rule="wrong*", station="oslo-1").records()
    assert row["situation"] == "wrong way-1"
    assert row["id"] == "oslo-1/rules/situation_detected/2"
    assert (row["severity"], row["title"]) == ("alarm", "wrong way at 1")


def test_a_find_is_narrowed_by_station_source_time_rule_and_severity(central: Log) -> None:
    def minutes(given: int) -> Any:
        return NOON + timedelta(minutes=given)

    assert len(find(central, kind="plate", plate="*").rows) == 9
    assert len(find(central, kind="plate", plate="*", station="oslo-1").rows) == 3
    assert len(find(central, kind="plate", plate="*", source="yard").rows) == 0
    assert len(find(central, kind="plate", plate="*", since=minutes(1), until=minutes(2)).rows) == 3
    assert len(find(central, kind="situation").rows) == 6
    assert len(find(central, kind="situation", severity="alarm").rows) == 3
    assert len(find(central, BRNO, kind="situation", rule="speeding").rows) == 1
    assert len(find(central, caller(), kind="situation").rows) == 0


def test_pages_give_each_row_once_whatever_comes_meanwhile(central: Log) -> None:
    whole = [row["id"] for row in find(central, kind="plate", plate="*").records()]
    for limits in (QuestionLimits(), QuestionLimits(rows_max=1), QuestionLimits(answer_bytes_max=200)):
        assert list(_paged(central, limits)) == [*whole]


def _paged(central: Log, limits: QuestionLimits) -> Iterator[str]:
    """What the pages give, while newer plates are read."""
    page = None
    while True:
        answer = find(central, limits=limits, kind="plate", plate="*23*", limit=4, page=page)
        yield from (row["id"] for row in answer.records())
        tell(central, "brno-2", [plate("NEW", 60)])
        project(central)
        page = answer.next
        if page is None:
            return


def test_a_page_is_of_one_station_and_one_question(central: Log) -> None:
    page = find(central, kind="plate", plate="*", limit=2).next
    assert page is not None
    forged = ("A" if page[0] != "A" else "B") + page[1:]
    for who, text, given in (
        (caller("*", station="oslo-1"), "*", page),
        (EVERYBODY, "1*", page),
        (EVERYBODY, "*", forged),
        (EVERYBODY, "*", "nonsense"),
        (EVERYBODY, "*", ""),
    ):
        with pytest.raises(Refusal) as caught:
            find(central, who, kind="plate", limit=2, plate=text, page=given)
        assert caught.value.code == "unknown_page"


def test_a_page_shows_no_station_that_is_no_longer_granted(central: Log) -> None:
    page = find(central, kind="plate", plate="*", limit=2).next
    rest = find(central, BRNO, kind="plate", plate="*", page=page)
    assert {row["station"] for row in rest.records()} == {"brno-2"}


def test_a_plate_is_found_by_its_index(central: Log) -> None:
    with central.connection() as connection:
        connection.execute("set enable_seqscan = off")
        plan = connection.execute(
            "explain select * from plate_read_events where plate_key(plate) like '1AB%' and station = any ('{oslo-1}')"
        ).fetchall()
        connection.execute("reset enable_seqscan")
    assert any("plate_key" in line and "Index" in line for (line,) in plan)
