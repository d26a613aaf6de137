from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from pathlib import Path
from typing import Any

import psycopg
import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from events import SHIPPED, Catalogue, EventType, ProcessFinished, StreamName, batch_of, encode
from store import Log, LogUnavailable, Projector, SchemaMismatch, open_log, schema
from store import log as log_module
from store.schema import configuration, migrate
from store.tables import metadata, projection_table
from store.writing import APPEND
from tests.conftest import Server
from tests.store.samples import GATE, NOON, PRODUCER, YARD, append, draft_of, on_both, owner, points, query
from tests.store.tiered import seal_all


@pytest.fixture
def empty(server: Server) -> Iterator[str]:
    """Address of a database without tables."""
    name = server.create_database("template1")
    yield server.dsn(name)
    server.drop_database(name)


def engine(dsn: str) -> sa.Engine:
    return sa.create_engine("postgresql+psycopg://", creator=lambda: psycopg.connect(dsn), poolclass=sa.NullPool)


def differences(dsn: str) -> list[Any]:
    """How the database differs from the tables that the program believes in."""
    wanted = sa.MetaData()
    for table in metadata.tables.values():
        table.to_metadata(wanted)
    for event_type in SHIPPED:
        projection_table(event_type, wanted)

    def is_ours(_: Any, name: str | None, kind: str, *__: Any) -> bool:
        return not (kind == "table" and name in partitions)

    with engine(dsn).connect() as connection:
        partitions = set(connection.scalars(sa.text("select inhrelid::regclass::text from pg_inherits")))
        context = MigrationContext.configure(
            connection, opts={"include_object": is_ours, "compare_type": True, "compare_server_default": True}
        )
        return compare_metadata(context, wanted)


def run(dsn: str, action: Callable[..., None], revision: str) -> None:
    """Run an Alembic command over a connection of our own."""
    with engine(dsn).begin() as connection:
        config = configuration()
        config.attributes["connection"] = connection
        action(config, revision)


def objects(dsn: str) -> list[tuple[Any, ...]]:
    """All that the migrations made, but roles."""
    with psycopg.connect(dsn) as connection:
        return connection.execute(
            "select 'relation', relname, relkind::text, pg_get_viewdef(oid), relacl::text, obj_description(oid) "
            "from pg_class where relnamespace = 'public'::regnamespace and relname not like 'alembic%' "
            "union all select 'function', proname, pg_get_functiondef(oid), null, proacl::text, null "
            "from pg_proc where pronamespace = 'public'::regnamespace "
            "union all select 'trigger', tgname, pg_get_triggerdef(oid), null, null, null "
            "from pg_trigger where not tgisinternal "
            "union all select 'constraint', conname, pg_get_constraintdef(oid), null, null, null "
            "from pg_constraint where connamespace = 'public'::regnamespace and conname not like 'alembic%' "
            "union all select 'column', attrelid::regclass || '.' || attname, format_type(atttypid, atttypmod), "
            "attnum::text, attstorage::text || attnotnull, col_description(attrelid, attnum) from pg_attribute "
            "join pg_class c on c.oid = attrelid where relnamespace = 'public'::regnamespace and attnum > 0 "
            "and relname not like 'alembic%' order by 1, 2, 3"
        ).fetchall()


@on_both
def test_the_schema_is_the_sum_of_the_migrations(log: Log) -> None:
    append(log, GATE, 1)
    projector = Projector(log)
    projector.catch_up()
    projector.close()
    assert differences(log.dsn) == []


@on_both
def test_a_column_that_differs_from_its_type_would_be_noticed(log: Log) -> None:
    with owner(log) as connection:
        connection.execute("comment on column track_point.vx is 'something'")
        connection.execute("alter table track_ended alter reason drop not null")
        connection.execute("comment on table rule_deployed is 'something'")
    kinds = [change[0] if isinstance(change, tuple) else change[0][0] for change in differences(log.dsn)]
    assert sorted(kinds) == ["add_table_comment", "modify_comment", "modify_nullable"]


@on_both
def test_row_tables_are_partitioned_by_time_and_shared_out_to_the_roles(log: Log) -> None:
    names = sorted(event_type.type_name for event_type in SHIPPED)
    assert [name for (name,) in query(log, "select name from projections order by 1")] == names
    assert query(
        log, "select partrelid::regclass::text, pg_get_partkeydef(partrelid) from pg_partitioned_table order by 1"
    ) == [(name, 'RANGE ("time")') for name in names]
    for name in [*names, "events"]:
        assert query(
            log,
            f"select has_table_privilege('vian_reader', '{name}', 'select'), "
            f"has_table_privilege('vian_reader', '{name}', 'insert')",
        ) == [(True, False)]


@on_both
def test_the_view_of_all_events_is_the_one_that_plug_ins_will_extend(log: Log) -> None:
    before = query(log, "select pg_get_viewdef('events'::regclass)")
    with owner(log) as connection:
        connection.execute("select make_events_view()")
    assert query(log, "select pg_get_viewdef('events'::regclass)") == before


@on_both
def test_up_down_and_up_again_give_the_same(empty: str) -> None:
    nothing = objects(empty)
    revisions = [script.revision for script in ScriptDirectory.from_config(configuration()).walk_revisions()]
    run(empty, command.upgrade, "head")
    whole = objects(empty)
    for _ in revisions:
        run(empty, command.downgrade, "-1")
    assert objects(empty) == nothing
    for _ in revisions:
        run(empty, command.upgrade, "+1")
    assert objects(empty) == whole
    assert differences(empty) == []


@on_both
def test_every_function_that_runs_as_the_owner_looks_for_temporary_tables_last(log: Log) -> None:
    found = query(
        log, "select proname, proconfig from pg_proc where prosecdef and pronamespace = 'public'::regnamespace"
    )
    assert found
    for name, settings in found:
        path = next(each for each in settings or () if each.startswith("search_path="))
        assert path.endswith(", pg_temp"), (name, path)
        assert path.count("pg_temp") == 1, (name, path)


def test_a_log_that_held_events_and_plug_ins_can_be_taken_down_and_put_up(empty: str) -> None:
    with open_log(dsn=empty, catalogue=Catalogue([*SHIPPED, Ping])) as log:
        append(log, GATE, 2)
        projector = Projector(log)
        projector.catch_up()
        projector.close()
    run(empty, command.downgrade, "base")
    with open_log(dsn=empty, catalogue=Catalogue([*SHIPPED, Ping])) as log:
        assert log.head() == 0
        assert query(log, "select count(*) from ping") == [(0,)]


@on_both
def test_every_sql_object_of_the_migrations_is_there(log: Log) -> None:
    files = {
        path.name.removesuffix(".sql").split("_", 1)[1]
        for path in resources.files("migrations").joinpath("sql").iterdir()
    }
    functions = {
        name for (name,) in query(log, "select proname from pg_proc where pronamespace = 'public'::regnamespace")
    }
    views = {name for (name,) in query(log, "select viewname from pg_views where schemaname = 'public'")}
    assert files - {"roles"} - views == functions
    assert {name for (name,) in query(log, "select rolname from pg_roles where rolname like 'vian_%%'")} >= {
        "vian_writer",
        "vian_reader",
    }
    assert query(
        log, "select attstorage::text from pg_attribute where attrelid = 'segments'::regclass and attname = 'payload'"
    ) == [("e",)]


@on_both
def test_migrating_again_changes_nothing(log: Log) -> None:
    before = objects(log.dsn)
    migrate(log.dsn, Catalogue.shipped())
    assert objects(log.dsn) == before


def test_a_database_newer_than_the_program_is_refused(log: Log) -> None:
    with owner(log) as connection:
        connection.execute("update alembic_version set version_num = '9999'")
    with pytest.raises(SchemaMismatch, match=r"revision 9999, .*newest is \d+\). Next: pip install --upgrade vian"):
        open_log(dsn=log.dsn)


def test_a_postgresql_that_is_too_old_is_refused(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "MAJOR_MIN", 99)
    with pytest.raises(SchemaMismatch, match=r"PostgreSQL 99 or newer is wanted, got 18\."):
        open_log(dsn=log.dsn)


def test_a_database_of_somebody_else_is_refused_and_left_alone(empty: str) -> None:
    with psycopg.connect(empty) as connection:
        connection.execute("create table streams (rivers text)")
    with pytest.raises(SchemaMismatch, match="give ViAn a database of its own"):
        open_log(dsn=empty)
    with psycopg.connect(empty) as connection:
        tables = connection.execute("select tablename from pg_tables where schemaname = 'public'").fetchall()
    assert tables == [("streams",)]


class Ping(EventType, type="ping", version=1):
    """Something pinged."""

    strength: int
    """how strong, dB"""


class Pong(EventType, type="pong", version=1):
    """Something answered."""

    answer: str
    """what it said"""


class Segments(EventType, type="segments", version=1):
    """A type that bears the name of one of the log's own tables."""


@on_both
def test_a_plug_in_type_gets_its_table_and_its_place_in_the_view(empty: str) -> None:
    open_log(dsn=empty, catalogue=Catalogue.shipped()).close()
    with open_log(dsn=empty, catalogue=Catalogue([*SHIPPED, Ping])) as log:
        log.append([encode(StreamName.of("brno", "gate", "ping"), batch_of([Ping(time=NOON, strength=3)]), PRODUCER)])
        append(log, GATE, 1)
        projector = Projector(log)
        projector.catch_up()
        projector.close()
        assert query(log, "select strength, time from ping") == [(3, NOON)]
        assert query(log, "select obj_description('ping'::regclass), col_description('ping'::regclass, 8)") == [
            ("Something pinged.", "how strong, dB")
        ]
        assert query(log, "select type from events order by 1") == [("ping",), ("track_point",)]
        assert query(log, "select has_table_privilege('vian_reader', 'events', 'select')") == [(True,)]


def test_rows_of_a_plug_in_that_is_gone_stay_in_the_view_when_another_comes(empty: str) -> None:
    with open_log(dsn=empty, catalogue=Catalogue([*SHIPPED, Ping])) as log:
        log.append([encode(StreamName.of("brno", "gate", "ping"), batch_of([Ping(time=NOON, strength=3)]), PRODUCER)])
        projector = Projector(log)
        projector.catch_up()
        projector.close()
    with open_log(dsn=empty, catalogue=Catalogue([*SHIPPED, Pong])) as log:
        assert query(log, "select type from events") == [("ping",)]
        assert query(log, "select count(*) from pong") == [(0,)]


@pytest.mark.parametrize("is_view", [False, True])
def test_a_plug_in_type_with_the_name_of_another_table_is_refused(log: Log, is_view: bool) -> None:
    strange = type("Events", (EventType,), {"__module__": __name__}, type="events", version=1) if is_view else Segments
    with pytest.raises(SchemaMismatch, match=f"event type {strange.type_name} needs a table of its name"):
        open_log(dsn=log.dsn, catalogue=Catalogue([*SHIPPED, strange]))
    assert differences(log.dsn) == []


@on_both
def test_many_programs_may_open_a_new_database_at_once(empty: str) -> None:
    with ThreadPoolExecutor(4) as pool:
        for log in pool.map(lambda _: open_log(dsn=empty), range(4)):
            log.close()
    assert differences(empty) == []


@on_both
def test_a_role_that_may_make_roles_and_tables_can_set_up_its_own_database(server: Server, empty: str) -> None:
    name = sa.make_url(empty).database
    server.execute(
        "create role founder login createrole", f"alter database {name} owner to founder", "create role stranger login"
    )
    # Another server's first user: the roles are not there yet.
    taken = ("vian_writer", "vian_reader", "vian_archiver", "vian_pruner", "vian_field")
    as_founder = sa.make_url(empty).set(username="founder").render_as_string(hide_password=False)
    try:
        for role in taken:
            server.execute(f"alter role {role} rename to {role}_kept")
        with open_log(dsn=as_founder) as log:
            append(log, GATE, 2)
            assert log.head() == 1
        as_stranger = sa.make_url(empty).set(username="stranger").render_as_string(hide_password=False)
        with pytest.raises(LogUnavailable, match="permission denied") as caught:
            Log(as_stranger, Catalogue.shipped())
        assert "grant vian_writer to this role" in str(caught.value)
    finally:
        with psycopg.connect(empty, autocommit=True) as connection:
            connection.execute("drop owned by founder cascade")
            connection.execute(f"drop owned by {', '.join(taken)}")
            connection.execute(f"alter database {name} owner to postgres")
            connection.execute(f"drop role if exists {', '.join(taken)}, founder, stranger")
        for role in taken:
            server.execute(f"alter role {role}_kept rename to {role}")


@on_both
def test_a_schema_that_was_taken_from_everybody_is_shared_with_the_roles(empty: str, tmp_path: Path) -> None:
    with psycopg.connect(empty, autocommit=True) as connection:
        connection.execute("revoke all on schema public from public")
    with open_log(dsn=empty) as log:
        append(log, GATE, 2)
        seal_all(log, tmp_path)
        with psycopg.connect(empty) as connection:
            connection.execute("set role vian_reader")
            assert connection.execute("select count(*) from track_point").fetchone() == (0,)


def test_an_owner_to_whom_the_roles_of_another_database_are_not_granted_is_told_what_helps(
    server: Server, empty: str
) -> None:
    name = sa.make_url(empty).database
    server.execute("create role founder login createrole", f"alter database {name} owner to founder")
    as_founder = sa.make_url(empty).set(username="founder").render_as_string(hide_password=False)
    step = 'grant vian_writer, vian_reader, vian_archiver, vian_pruner, vian_field to "founder" with admin option'
    try:
        with pytest.raises(LogUnavailable, match=f"Next: .*as a superuser: {step}$"):
            open_log(dsn=as_founder)
        server.execute(step)
        with open_log(dsn=as_founder) as log:
            append(log, GATE, 2)
    finally:
        with psycopg.connect(empty, autocommit=True) as connection:
            connection.execute("drop owned by founder cascade")
            connection.execute(f"alter database {name} owner to postgres")
            connection.execute("drop role founder")


def test_a_role_that_may_make_nothing_is_told_what_to_do(server: Server, empty: str) -> None:
    server.execute("create role visitor login")
    as_visitor = sa.make_url(empty).set(username="visitor").render_as_string(hide_password=False)
    try:
        with pytest.raises(LogUnavailable, match="Next: connect once as a role that may create tables and roles"):
            open_log(dsn=as_visitor)
    finally:
        server.execute("drop role visitor")


@on_both
def test_a_log_of_before_keeps_its_rows_and_gets_what_is_new(empty: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run(empty, command.upgrade, "0003")
    with Log(empty, Catalogue.shipped()) as log, monkeypatch.context() as before:
        # The append function of then did not ask whether sealed files are compared, and knew no bases.
        asked = APPEND.removesuffix(", %s, %b::bytea[])") + ") where %s::boolean is not null and %b::bytea[] is null"
        before.setattr(log_module, "APPEND", asked)
        append(log, GATE, 2)
        log.append([encode(YARD, points(7, 7), PRODUCER)], epochs=[2])
        log.append([draft_of(ProcessFinished(time=NOON, process="p", frames=1, events=1, gaps=0))])
        with owner(log) as connection:
            connection.execute("select ensure_partition('process_finished', '2026-01-01')")
            connection.execute("select ensure_partition('track_point', '2026-01-01')")
            connection.execute(
                "insert into process_finished values ('brno', 'gate', 'p', %s, 1, 3, now(), 'p', 1, 1, 0)", (NOON,)
            )
            connection.execute("insert into checkpoints values ('projector', 3, '')")
    with open_log(dsn=empty) as log:
        assert differences(empty) == []
        assert query(log, "select id, epoch, process from process_finished_events") == [
            ("brno/gate/process_finished/1", 1, "p")
        ]
        assert query(log, "select obj_description('process_finished_20260101'::regclass)") == [
            ("Rows of process_finished of one day, 2026-01-01 (UTC).",)
        ]
        # Rows of two lives could not be told apart: they are made anew.
        projector = Projector(log)
        assert projector.behind["track_point"] == 0
        assert "process_finished" not in projector.behind
        projector.catch_up()
        projector.close()
        assert query(log, "select id from events where type = 'track_point' order by position, sequence") == [
            ("brno/gate/track_point/1",),
            ("brno/gate/track_point/2",),
            ("brno/yard/track_point/2:1",),
        ]
    run(empty, command.downgrade, "0003")
    with psycopg.connect(empty) as connection:
        assert connection.execute("select id from events where type = 'process_finished'").fetchall() == [
            ("brno/gate/process_finished/1",)
        ]
        assert connection.execute("select has_table_privilege('vian_writer', 'track_point', 'delete')").fetchone() == (
            True,
        )
    open_log(dsn=empty).close()
    assert differences(empty) == []
