import socket
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import psycopg
import pytest

from events import SHIPPED, Catalogue, StreamName, batch_of, encode
from store import Log, Projector
from tests.events.plugged import VehicleWeighed
from tests.vian.samples import GATE, PRODUCER, START, YARD, append, points, reopened
from vian import querying
from vian.errors import WrongUsage
from vian.querying import Scope, query

WEIGHED = StreamName.of("brno", "gate", VehicleWeighed.type_name)


def rows(log: Log, sql: str, **scope: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = query(log, sql, Scope(**scope)).to_pylist()
    return found


@pytest.fixture
def filled(log: Log) -> Log:
    """Ten track points at the gate, in two segments, and three in the yard."""
    append(log, points(6))
    append(log, points(3), YARD)
    append(log, points(4, first_frame=6))
    return log


def in_postgresql(log: Log, sql: str) -> list[tuple[Any, ...]]:
    Projector(log).catch_up()
    with psycopg.connect(log.dsn, options="-c timezone=UTC") as connection:
        return connection.execute(sql).fetchall()


@pytest.mark.parametrize(
    "sql",
    [
        "select type, count(*) from events group by type order by type",
        "select count(*), min(frame), max(frame), sum(x) from track_point where source = 'gate'",
        "select source, subject, time, sequence, position, frame, x from track_point order by position, sequence",
        "select id, type, subject, time, recorded_at from events order by id",
    ],
)
def test_duckdb_and_postgresql_give_the_same_answer(filled: Log, sql: str) -> None:
    answer = query(filled, sql)
    columns = [column.to_pylist() for column in answer.columns]
    assert list(zip(*columns, strict=True)) == in_postgresql(filled, sql)


@pytest.mark.parametrize("event_type", SHIPPED, ids=lambda each: each.type_name)
def test_the_columns_of_each_type_are_those_of_its_row_table(log: Log, event_type: Any) -> None:
    wanted = in_postgresql(
        log,
        "select attname::text from pg_attribute where attnum > 0 "
        f"and attrelid = '{event_type.type_name}'::regclass order by attnum",
    )
    names = query(log, f"select * from {event_type.type_name}").column_names
    assert sorted(names) == sorted(name for (name,) in wanted)


def test_two_lives_of_a_stream_are_told_apart_as_in_the_row_tables(log: Log) -> None:
    drafted = encode(GATE, points(2), PRODUCER)
    log.append([drafted, drafted], epochs=[1, 2])
    sql = "select id, epoch, sequence from events order by position, sequence"
    Projector(log).catch_up()
    answer = query(log, sql)
    rows = list(zip(*(column.to_pylist() for column in answer.columns), strict=True))
    assert [row[0] for row in rows] == [f"{GATE}/1", f"{GATE}/2", f"{GATE}/2:1", f"{GATE}/2:2"]
    assert rows == in_postgresql(log, sql)


def test_an_empty_log_has_all_tables_and_no_rows(log: Log) -> None:
    for name in ["events", "streams", *(each.type_name for each in log.catalogue)]:
        assert query(log, f"select * from {name}").num_rows == 0


def test_the_streams_are_a_table(filled: Log) -> None:
    assert rows(filled, "select source, sequence from streams order by source") == [
        {"source": "gate", "sequence": 10},
        {"source": "yard", "sequence": 3},
    ]


@pytest.mark.parametrize(
    "sql",
    [
        'select count(*) as n from "TRACK_POINT"',
        "select count(*) as n from main.track_point",
        "with a as (from track_point) select count(*) as n from a;",
        "select (select count(*) from track_point) as n",
        "select count(*) as n from query_table('track_point')",
        "select count(*) as n from track_point join Track_Point as other using (source, sequence)",
    ],
)
def test_a_table_is_found_however_it_is_named(filled: Log, sql: str) -> None:
    assert rows(filled, sql) == [{"n": 13}]


def test_a_scope_prunes_by_time_and_source(filled: Log) -> None:
    sql = "select count(*) as n from track_point"
    at = [START + timedelta(seconds=seconds) for seconds in (2, 5)]
    assert rows(filled, sql, since=at[0]) == [{"n": 9}]
    assert rows(filled, sql, until=at[0]) == [{"n": 4}]
    assert rows(filled, sql, since=at[0], until=at[1], sources=["gate"]) == [{"n": 3}]
    assert rows(filled, sql, sources=["nobody"]) == [{"n": 0}]
    assert rows(filled, sql, stations=["brno"], sources=["yard"]) == [{"n": 3}]
    assert rows(filled, "select count(*) as n from events", since=at[1]) == [{"n": 5}]


def test_only_the_types_that_a_query_names_are_decoded(filled: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    decode: Callable[..., Any] = querying.decode

    def counted(segment: Any, catalogue: Catalogue) -> Any:
        seen.append(str(segment.stream))
        return decode(segment, catalogue)

    monkeypatch.setattr(querying, "decode", counted)
    assert rows(filled, "select count(*) as n from track_ended") == [{"n": 0}]
    assert seen == []
    rows(filled, "select count(*) from track_point")
    assert len(seen) == 3
    assert rows(filled, "select count(*) as n from track_point", sources=["yard"]) == [{"n": 3}]
    assert len(seen) == 4
    rows(filled, "select 'track_ended' from track_point where subject <> 'track_point' -- plate_read")
    assert len(seen) == 7


def test_a_type_that_is_unknown_here_has_its_envelope(make_log: Callable[..., Log]) -> None:
    log = make_log(catalogue=Catalogue([*SHIPPED, VehicleWeighed]))
    append(log, batch_of([weighed(0), weighed(1)]), WEIGHED)
    append(log, points(1))
    with reopened(log) as other:
        assert rows(other, "select id, type, subject, time from events where type = 'vehicle_weighed' order by id") == [
            {"id": f"{WEIGHED}/{number}", "type": "vehicle_weighed", "subject": None, "time": START}
            for number in (1, 2)
        ]
        assert rows(other, "select count(*) as n from events") == [{"n": 3}]
        with pytest.raises(WrongUsage, match="vehicle_weighed does not exist"):
            query(other, "select * from vehicle_weighed")


def weighed(seconds: int) -> VehicleWeighed:
    nothing = dict.fromkeys(name for name, field in VehicleWeighed.model_fields.items() if field.is_required())
    known = {"time": START + timedelta(seconds=seconds), "face": b"", "is_heavy": True, "mass": 1.0, "axles": ()}
    return VehicleWeighed(**(nothing | known))


def test_an_unknown_table_is_told_with_those_that_there_are(log: Log) -> None:
    with pytest.raises(
        WrongUsage,
        match=r"Table with name nowhere does not exist[\s\S]*\nTables: events, streams, track_ground, activity_",
    ):
        query(log, "select * from nowhere")


@pytest.mark.parametrize("sql", ["selct 1", "select frame from", "select nothing from track_point"])
def test_what_duckdb_says_of_a_mistake_is_passed_on(log: Log, sql: str) -> None:
    with pytest.raises(WrongUsage, match=r"the query is not right: \w+ .*Error: "):
        query(log, sql)


JUMPS = """
from (select source, frame, x from track_point where frame < 6) match_recognize (
  partition by source order by frame measures first(frame) as f, last(frame) as l, count(*) as n
  pattern (a b*) define b as b.frame = prev(b.frame) + 1) as m
join (select distinct source as "source" from track_ended right join track_point using (source)) using (source)
order by source
"""


def test_match_recognize_clauses_are_answered_over_the_log(filled: Log) -> None:
    assert rows(filled, JUMPS) == [
        {"source": "gate", "f": 0, "l": 5, "n": 6},
        {"source": "yard", "f": 0, "l": 2, "n": 3},
    ]
    assert rows(filled, JUMPS, sources=["yard"]) == [{"source": "yard", "f": 0, "l": 2, "n": 3}]


def test_a_mistake_in_a_clause_or_around_it_has_its_place(log: Log) -> None:
    clause = "match_recognize (order by frame pattern (a) define a as y > nothing)"
    with pytest.raises(WrongUsage, match=r"the query is not right: <query>:2:78: DEFINE: unknown column 'nothing'"):
        query(log, f"select *\nfrom track_point {clause}")
    with pytest.raises(
        WrongUsage, match=r"<query>:2:2: Catalog Error: Table with name nowhere.*\n.*\n +\^\nTables: events"
    ):
        query(log, f"from\n nowhere {clause}")


def test_a_query_opens_no_connection_to_the_network(filled: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/x.parquet"
        with pytest.raises(WrongUsage, match="httpfs"):
            query(filled, f"select * from '{url}'")
        with pytest.raises(BlockingIOError):
            server.accept()


def test_an_answer_is_of_one_moment(filled: Log) -> None:
    before = query(filled, "select count(*) from events")
    append(filled, points(1, first_frame=10))
    assert before.to_pylist() != query(filled, "select count(*) from events").to_pylist()


@pytest.mark.parametrize("name", ["log", "sql", "scope", "connection"])
def test_this_programs_own_variables_are_no_tables(log: Log, name: str) -> None:
    with pytest.raises(WrongUsage, match=f"Table with name {name} does not exist"):
        query(log, f"select * from {name}")
