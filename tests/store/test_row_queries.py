"""The views, their comments, and the plans of the queries that docs/reference/log.md promises to be quick."""

import re
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import psycopg
import pytest

from events import SHIPPED, Catalogue, EventType, batch_of, encode, schema_of
from store import Log, SchemaMismatch, open_log
from tests.conftest import Server
from tests.store.samples import GATE, NOON, ONE_OF_EACH, PRODUCER, YARD, draft_of, on_both, owner, point, query
from tests.store.test_projector import project

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "log.md"
ENVELOPE = ["id", "station", "source", "type", "subject", "time", "sequence", "position", "recorded_at", "epoch"]
EVENTS = 3_000


def documented() -> dict[str, tuple[str, str, str]]:
    """The hot queries of the page: name to query, and the index that serves it on an open and on a closed day."""
    rows = re.findall(
        r"^\| ([a-z' ]+) \| `([^`]+)` \| ([A-Za-z -]+) \| ([A-Za-z -]+) \|$", PAGE.read_text(), re.MULTILINE
    )
    return {name: (statement, opened, closed) for name, statement, opened, closed in rows}


INDEXES = {"BRIN on time": "time", "BRIN on position": "position", "B-tree": "track"}


@pytest.fixture(params=["embedded", "15"], scope="module")
def connection(request: pytest.FixtureRequest, servers: Any) -> Iterator[psycopg.Connection[Any]]:
    """A log with tracks of two cameras on two days, as an analyst reaches it."""
    server: Server = servers.get(request.param)
    name = server.create_database()
    with Log(server.dsn(name), Catalogue.shipped()) as log:
        for day in (0, 1):
            for stream in (GATE, YARD):
                for first in range(0, EVENTS // 2, 100):
                    at = NOON + timedelta(days=day)
                    events = [
                        point(frame, time=at + frame * timedelta(milliseconds=40)).model_copy(
                            update={"track_id": 1 + frame % 50}
                        )
                        for frame in range(first, first + 100)
                    ]
                    log.append([encode(stream, batch_of(events), PRODUCER)])
        project(log)
        with log.connection() as writer:
            writer.execute("select close_partition('track_point', '2026-01-01')")
            writer.execute("select summarize_days('track_point')")
        with owner(log) as opened:
            opened.execute("analyze")
            opened.execute("set role vian_reader")
            yield opened
    server.drop_database(name)


def plan_of(connection: psycopg.Connection[Any], statement: str) -> str:
    return "\n".join(line for (line,) in connection.execute(f"explain {statement}").fetchall())


def moved(statement: str, is_closed: bool) -> str:
    """The documented query, on the day that is closed or on the one that is open, a day and 30 segments later."""
    if is_closed:
        return statement
    statement = statement.replace("2026-01-02", "2026-01-03").replace("2026-01-01", "2026-01-02")
    return statement.replace("position > 28", "position > 58")


@pytest.mark.parametrize("is_closed", [True, False])
@pytest.mark.parametrize("name", documented())
def test_a_documented_query_uses_its_index(connection: psycopg.Connection[Any], name: str, is_closed: bool) -> None:
    statement, opened, closed = documented()[name]
    found = connection.execute(moved(statement, is_closed)).fetchall()
    assert found
    assert found != [(0,)]
    plan = plan_of(connection, moved(statement, is_closed))
    wanted = closed if is_closed else opened
    day = "20260101" if is_closed else "20260102"
    if wanted == "the day alone":
        assert re.findall(r"track_point_(\d+)", plan) == [day], plan
    else:
        assert f"track_point_{day}_{INDEXES[wanted]}" in plan, plan
        assert "Seq Scan" not in plan, plan


def test_the_page_documents_the_hot_queries() -> None:
    assert list(documented()) == [
        "one camera's time span",
        "one track's points",
        "a track's whole path",
        "newest positions",
        "all events of a span",
        "newest point of a camera",
        "a day's count",
    ]


@on_both
def test_every_type_has_a_view_of_its_envelope_and_its_own_columns_in_order(log: Log) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    project(log)
    for event_type in SHIPPED:
        payload = [name for name in event_type.model_fields if name != "time"]
        view = f"{event_type.type_name}_events"
        names = query(
            log, "select attname from pg_attribute where attrelid = %s::regclass and attnum > 0 order by attnum", view
        )
        assert [name for (name,) in names] == [*ENVELOPE, *payload]
        in_type = query(log, f"select {', '.join(ENVELOPE)} from {view}")
        assert in_type == query(log, "select * from events where type = %s", event_type.type_name)
        assert len(in_type) == 1


@on_both
def test_tables_days_and_views_explain_themselves(log: Log) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    project(log)
    for event_type in SHIPPED:
        name = event_type.type_name
        described = {field.name: field.metadata[b"description"].decode() for field in schema_of(event_type)}
        del described["time"]
        for relation in (name, f"{name}_20260101", f"{name}_events"):
            rows = query(
                log,
                "select attname, col_description(attrelid, attnum) from pg_attribute "
                "where attrelid = %s::regclass and attnum > 0 and not attisdropped",
                relation,
            )
            comments = dict(rows)
            assert all(comments.values()), relation
            assert described.items() <= comments.items()
        summary = " ".join((event_type.__doc__ or "").split())
        assert query(
            log,
            f"select obj_description('{name}'::regclass), obj_description('{name}_events'::regclass), "
            f"obj_description('{name}_20260101'::regclass)",
        ) == [(summary, summary, f"Rows of {name} of one day, 2026-01-01 (UTC).")]
    assert query(log, "select obj_description('events'::regclass) like 'Every event that has a row%%'") == [(True,)]
    assert all(
        comment
        for (comment,) in query(
            log, "select col_description(attrelid, attnum) from pg_attribute where attrelid = 'events'::regclass"
        )
    )


def test_the_reader_reads_the_views_and_changes_nothing(log: Log) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    project(log)
    with owner(log) as connection:
        connection.execute("set role vian_reader")
        for event_type in SHIPPED:
            view = f"{event_type.type_name}_events"
            assert connection.execute(f"select count(*) from {view}").fetchone() == (1,)
            for statement in (
                f"delete from {view}",
                f"update {view} set sequence = 0",
                f"delete from {event_type.type_name}",
            ):
                with pytest.raises(psycopg.errors.InsufficientPrivilege):
                    connection.execute(statement)


def test_the_writer_adds_rows_and_takes_none_away(log: Log) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    project(log)
    for statement in ("delete from track_point", "update track_point set x = 0", "truncate track_point"):
        with pytest.raises(psycopg.errors.InsufficientPrivilege), log.connection() as connection:
            connection.execute(statement)


def test_a_type_whose_view_would_take_anothers_name_is_refused(make_log: Callable[..., Log]) -> None:
    log = make_log()
    with owner(log) as connection:
        connection.execute("create table honk_events (x int)")

    class Honk(EventType, type="honk", version=1):
        """Something honked."""

    with pytest.raises(SchemaMismatch, match=r"event type honk needs .* has another honk_events"):
        open_log(dsn=log.dsn, catalogue=Catalogue([*SHIPPED, Honk]))
    assert query(log, "select to_regclass('honk')") == [(None,)]
