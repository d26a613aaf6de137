from collections.abc import Callable, Iterator

import psycopg
import pytest
import sqlalchemy as sa

from store import Log, Projector, StoreError, open_log, verify
from tests.conftest import Server
from tests.store.samples import GATE, append, on_both, owner, query

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
            "select append_segments(" + ", ".join(["null"] * 20) + ")",
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


RIGHTS = ("SELECT", "INSERT", "UPDATE", "DELETE", "TRUNCATE", "REFERENCES", "TRIGGER")

WRITER_CHANGES = {
    "checkpoints": {"UPDATE", "DELETE"},  # a subscriber's own place, not the log
    "stations": {"UPDATE"},  # the registry, made of events
    "enrolment_codes": {"UPDATE"},  # which are used
    "sync_tokens": {"UPDATE", "DELETE"},  # sessions, which end
    "station_contacts": {"UPDATE"},  # what was heard last
}
"""What the writer may change of the log's tables; each with its reason. All else it can at most add to."""

ROW_TABLES = {"DELETE"}
"""Rows are projections: what is taken out can be made again."""

READER_SEES = {"streams", "events"}
"""What the reader sees beside the row tables and the views over them."""

KEPT_FROM_READER = {"segments", "checkpoints", "log_head", "projections", "maintenance"}


def rights(log: Log, role: str) -> dict[str, set[str]]:
    """What a role may do with every table, partition, view and sequence of the database, on any column of it."""
    relations = query(
        log,
        "select c.oid, c.relname, c.relkind = 'S' from pg_class c join pg_namespace n on n.oid = c.relnamespace "
        "where n.nspname not like 'pg\\_%%' and n.nspname <> 'information_schema' "
        "and c.relkind in ('r', 'p', 'v', 'm', 'f', 'S')",
    )
    found: dict[str, set[str]] = {}
    for oid, name, is_sequence in relations:
        if is_sequence:
            checked = [(right, f"has_sequence_privilege('{role}', {oid}, '{right}')") for right in ("UPDATE", "USAGE")]
        else:
            checked = [(right, f"has_table_privilege('{role}', {oid}, '{right}')") for right in RIGHTS]
            checked += [
                (right, f"has_any_column_privilege('{role}', {oid}, '{right}')")
                for right in ("SELECT", "INSERT", "UPDATE", "REFERENCES")
            ]
        (row,) = query(log, f"select {', '.join(check for _, check in checked)}")
        found[name] = {right for (right, _), has in zip(checked, row, strict=True) if has}
    return found


def row_tables(log: Log) -> set[str]:
    return {name for (name,) in query(log, "select name from projections")}


@pytest.fixture
def projected(log: Log) -> Log:
    """A log one of whose row tables has a partition."""
    append(log, GATE, 3)
    projector = Projector(log)
    projector.catch_up()
    projector.close()
    return log


@on_both
def test_no_table_or_partition_can_be_changed_by_the_writer(projected: Log) -> None:
    allowed = dict.fromkeys(row_tables(projected), ROW_TABLES) | WRITER_CHANGES
    changes = {"UPDATE", "DELETE", "TRUNCATE", "REFERENCES", "TRIGGER"}
    found = rights(projected, "vian_writer")
    assert {"segments", "streams", "log_head", "track_point_20260101", "maintenance"} <= set(found)
    excess = {name: got & changes - allowed.get(name, set()) for name, got in found.items()}
    assert {name: got for name, got in excess.items() if got} == {}


@on_both
def test_the_reader_sees_rows_and_heads_and_nothing_else_of_any_table(projected: Log) -> None:
    found = rights(projected, "vian_reader")
    assert {name for name in KEPT_FROM_READER if found[name]} == set()
    assert {name: got for name, got in found.items() if got - {"SELECT"}} == {}
    seen = {name for name, got in found.items() if got}
    assert READER_SEES | row_tables(projected) <= seen
    columns = query(
        projected,
        "select table_name, column_name from information_schema.columns where table_name = any(%s) "
        "and column_name ~ 'payload$|secret|private|token|^state$|_key$' and column_name <> 'public_key'",
        sorted(seen),
    )
    assert columns == []


@on_both
@pytest.mark.parametrize("role", ["vian_writer", "vian_reader", "vian_field"])
def test_no_role_owns_or_makes_anything_or_acts_as_another(log: Log, role: str) -> None:
    assert query(log, "select count(*) from pg_class where relowner = %s::regrole", role) == [(0,)]
    assert query(
        log,
        "select rolcanlogin, rolsuper, rolcreaterole, rolcreatedb, rolreplication, rolbypassrls, "
        "has_schema_privilege(rolname, 'public', 'CREATE'), "
        "(select count(*) from pg_auth_members where member = r.oid) from pg_roles r where rolname = %s",
        role,
    ) == [(False, False, False, False, False, False, False, 0)]


@on_both
def test_functions_that_run_as_the_owner_are_for_the_writer_alone(log: Log) -> None:
    found = query(
        log,
        "select proname, has_function_privilege('vian_reader', oid, 'EXECUTE') from pg_proc "
        "where prosecdef and pronamespace = 'public'::regnamespace",
    )
    assert {"append_segments", "ensure_partition"} <= {name for name, _ in found}
    assert [name for name, is_for_reader in found if is_for_reader] == []


def test_a_program_runs_as_the_writer(log: Log) -> None:
    with log.connection() as connection:
        assert connection.execute("select current_user").fetchone() == ("vian_writer",)


@pytest.fixture
def login(log: Log, server: Server) -> Iterator[Callable[[str], str]]:
    """Makes an account that is a member of one of our roles, and gives the log's address for it."""
    names: list[str] = []

    def make(role: str) -> str:
        names.append(f"account_{sa.make_url(log.dsn).database}_{len(names)}")
        server.execute(f"create role {names[-1]} login in role {role}")
        return sa.make_url(log.dsn).set(username=names[-1]).render_as_string(hide_password=False)

    yield make
    server.execute(*(f"drop role {name}" for name in names))


@on_both
def test_a_program_may_run_as_an_account_that_is_only_a_writer(log: Log, login: Callable[[str], str]) -> None:
    with open_log(dsn=login("vian_writer")) as as_writer:
        append(as_writer, GATE, 3)
        projector = Projector(as_writer)
        projector.catch_up()
        projector.close()
        with as_writer.transaction() as transaction:
            transaction.save_checkpoint("rules", 1)
        assert verify(as_writer).is_sound
    assert query(log, "select count(*) from events") == [(3,)]


@on_both
def test_an_analysts_account_reads_rows_and_is_refused_the_log(projected: Log, login: Callable[[str], str]) -> None:
    dsn = login("vian_reader")
    with psycopg.connect(dsn, autocommit=True) as connection:
        assert connection.execute("select count(*) from events").fetchone() == (3,)
        assert connection.execute("select sum(frame) from track_point").fetchone() == (6,)
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            connection.execute("select payload from segments")
    with pytest.raises(StoreError, match=r"permission denied .*Next: "):
        open_log(dsn=dsn)
