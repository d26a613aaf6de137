import psycopg
import pytest

from store import Log
from tests.store.samples import GATE, append, on_both, owner

CHANGES = [
    "update {} set {} = {}",
    "delete from {}",
    "truncate {} cascade",
    "drop table {} cascade",
    "alter table {} disable trigger user",
]
TABLES = {"segments": "payload", "streams": "chain_hash", "log_head": "position"}


@on_both
@pytest.mark.parametrize("table", TABLES)
def test_the_writer_cannot_change_anything_in_the_log(log: Log, table: str) -> None:
    append(log, GATE, 2)
    for change in CHANGES:
        statement = change.format(table, TABLES[table], TABLES[table])
        with log.connection() as connection, pytest.raises(psycopg.errors.InsufficientPrivilege):
            connection.execute(statement)
    assert len(list(log.read_all())) == 1


@on_both
def test_the_writer_adds_to_the_log_through_the_append_function_only(log: Log) -> None:
    append(log, GATE, 2)
    for statement in (
        "insert into segments select * from segments",
        "insert into streams (station, epoch, source, type) values ('a', 1, 'b', 'c')",
        "insert into log_head values (false, 1, 1)",
        "insert into projections values ('segments')",
        "select adopt_projection('segments')",
        "create table track_point_copy (x int)",
        "drop function append_segments",
        "create or replace function refuse_change() returns trigger language plpgsql as 'begin end'",
    ):
        with log.connection() as connection, pytest.raises(psycopg.errors.InsufficientPrivilege):
            connection.execute(statement)


@on_both
def test_the_reader_sees_rows_and_stream_heads_and_changes_nothing(log: Log) -> None:
    with owner(log) as connection:
        connection.execute("set role vian_reader")
        for table in ("events", "track_point", "streams"):
            connection.execute(f"select * from {table}")
        for statement in (
            "select * from segments",
            "select * from checkpoints",
            "delete from track_point",
            "select append_segments(" + ", ".join(["null"] * 19) + ")",
            "select ensure_partition('track_point', '2026-01-01')",
        ):
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                connection.execute(statement)


@on_both
def test_even_the_owners_slip_is_refused(log: Log) -> None:
    append(log, GATE, 2)
    for statement in (
        "update segments set payload = ''",
        "update segments set producer = 'x' where position = 1",
        "delete from segments",
        "delete from segments where false",
        "truncate segments",
        "truncate streams cascade",
    ):
        with owner(log) as connection, pytest.raises(psycopg.Error, match="the log is append-only") as caught:
            connection.execute(statement)
        assert caught.value.sqlstate == "VA004"
    assert len(list(log.read_all())) == 1
