"""The database's schema: bring it to this program's version, and check that it is there.

Contract: `migrate` runs as the database's owner, is idempotent, and one process at a time does it
(an advisory lock). Row tables of plug-in types are created from their definition, without SQL; one of an
older version of its type gets the newer one's columns and is filled anew from the log.
"""

import re
from collections.abc import Iterable
from importlib.resources import files
from typing import Any

import psycopg
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError
from psycopg.conninfo import conninfo_to_dict

from events import EventType
from store.errors import BadRequest, LogUnavailable, SchemaMismatch, TableBusy
from store.tables import projection_table

MAJOR_MIN = 15
"""Oldest major version of PostgreSQL that the migrations and the append function run on."""
_LOCK_KEY = 0x5669_416E  # "ViAn"
_CONNECT_SECONDS = 15


def migrate(dsn: str, catalogue: Iterable[type[EventType]], revision: str = "head") -> None:
    """Bring the database to `revision`, and give every type of the catalogue its row table.

    Raises:
        BadRequest: The address is none.
        LogUnavailable: The database cannot be reached, or the role may not create tables.
        SchemaMismatch: The database was migrated by a newer ViAn, is not ours, or is of a PostgreSQL
            that is too old.
        TableBusy: A row table of an older version is being read and cannot be changed.
    """
    engine = _engine(dsn)
    try:
        with engine.begin() as connection:
            _check_version(connection)
            connection.execute(sa.text("select pg_advisory_xact_lock(:key)"), {"key": _LOCK_KEY})
            _upgrade(connection, revision)
            if revision == "head":
                _bring_row_tables_up(connection, catalogue)
    except sa.exc.OperationalError as error:
        if isinstance(error.orig, psycopg.errors.LockNotAvailable):
            raise TableBusy(
                f"the row tables at {safe_dsn(dsn)} cannot be brought to this version while queries read them. "
                "Next: end these queries, then give the command again"
            ) from error
        raise LogUnavailable(f"no database at {safe_dsn(dsn)}: {_first_line(error)}. Next: vian doctor") from error
    except sa.exc.ProgrammingError as error:
        if isinstance(error.orig, psycopg.errors.InsufficientPrivilege):
            raise LogUnavailable(
                f"the schema cannot be created at {safe_dsn(dsn)}: {_first_line(error)}. "
                f"Next: {_next_without_privilege(error.orig, dsn)}"
            ) from error
        raise SchemaMismatch(
            f"the schema cannot be created at {safe_dsn(dsn)}: {_first_line(error)}. "
            "Next: give ViAn a database of its own"
        ) from error
    finally:
        engine.dispose()


def configuration() -> Config:
    """Alembic's configuration for the migrations that came with this program."""
    config = Config()
    config.set_main_option("script_location", str(files("migrations")))
    return config


def safe_dsn(dsn: str) -> str:
    """The address without its passwords, fit for a message.

    >>> safe_dsn("postgresql://u:secret@h/db")
    'postgresql://u:***@h/db'
    >>> safe_dsn("host=h user=u password=secret dbname=db")
    'postgresql://u:***@h/db'

    Raises:
        BadRequest: It is no address.
    """
    known = {name: str(value) for name, value in _parameters(dsn).items() if name != "sslpassword"}
    user, password, database = (known.pop(name, None) for name in ("user", "password", "dbname"))
    is_one_host = not set(known.get("host", "/")) & set("/,") and known.get("port", "0").isdecimal()
    host, port = (known.pop(name, None) if is_one_host else None for name in ("host", "port"))
    url = sa.URL.create("postgresql", user, password, host, int(port) if port else None, database, known)
    return url.render_as_string(hide_password=True)


def _engine(dsn: str) -> sa.Engine:
    """An engine for any address that libpq understands, written as a URL or in words."""
    parameters: dict[str, Any] = {"connect_timeout": _CONNECT_SECONDS, **_parameters(dsn)}
    return sa.create_engine(
        "postgresql+psycopg://", creator=lambda: psycopg.connect(**parameters), poolclass=sa.NullPool
    )


def _parameters(dsn: str) -> dict[str, Any]:
    try:
        return conninfo_to_dict(dsn)
    except psycopg.ProgrammingError:
        # libpq quotes what it was given, with the password in it.
        raise BadRequest(
            "the database's address cannot be read, wanted postgresql://user@host:port/database or "
            "host=... dbname=... user=..."
        ) from None


def _check_version(connection: sa.Connection) -> None:
    number, text = connection.execute(
        sa.text("select current_setting('server_version_num')::int, current_setting('server_version')")
    ).one()
    if number < MAJOR_MIN * 10_000:
        raise SchemaMismatch(
            f"PostgreSQL {MAJOR_MIN} or newer is wanted, got {text}. Next: upgrade it, "
            "or give --data-dir for a PostgreSQL of ViAn's own"
        )


def _upgrade(connection: sa.Connection, revision: str) -> None:
    config = configuration()
    current = MigrationContext.configure(connection).get_current_revision()
    script = ScriptDirectory.from_config(config)
    if current == script.get_current_head() and revision == "head":
        return
    try:
        script.get_revision(current) if current else None
    except CommandError as error:
        raise SchemaMismatch(
            f"the database is at revision {current}, which this ViAn does not know (its newest is "
            f"{script.get_current_head()}). Next: pip install --upgrade vian"
        ) from error
    config.attributes["connection"] = connection
    command.upgrade(config, revision)


def _bring_row_tables_up(connection: sa.Connection, catalogue: Iterable[type[EventType]]) -> None:
    """Give each type a table of its newest version; types that are not installed any more keep theirs."""
    versions = {row.name: row.version for row in connection.execute(sa.text("select name, version from projections"))}
    for event_type in catalogue:
        have = versions.get(event_type.type_name, 0)
        if have >= event_type.version:
            continue
        table = projection_table(event_type, sa.MetaData())
        if have == 0:
            _create(connection, table)
        else:
            _change(connection, table)
        # Also makes the views.
        connection.execute(sa.text("select adopt_projection(:name)"), {"name": table.name})
        connection.execute(
            sa.text("update projections set version = :version where name = :name"),
            {"name": table.name, "version": event_type.version},
        )


def _create(connection: sa.Connection, table: sa.Table) -> None:
    found = sa.inspect(connection)
    for name in (table.name, f"{table.name}_events", f"field_{table.name}"):
        if found.has_table(name):
            raise SchemaMismatch(
                f"event type {table.name} needs a table of its name and views beside it, and the database "
                f"has another {name}. "
                "Next: rename the type, or give ViAn a database of its own"
            )
    table.create(connection)


def _change(connection: sa.Connection, table: sa.Table) -> None:
    """Give an existing row table the columns of its type's newer version, and queue it to be filled anew.

    A column that the newer version lacks stays, empty, so that views and queries over it hold.
    """
    connection.execute(
        sa.text("select reset_projection(name, retained_from) from projections where name = :name"),
        {"name": table.name},
    )
    existing = {column["name"]: column for column in sa.inspect(connection).get_columns(table.name)}
    compiler = connection.dialect.type_compiler_instance
    quoted = connection.dialect.identifier_preparer.format_table(table)
    for column in table.columns:
        name = connection.dialect.identifier_preparer.format_column(column)
        kind, null = compiler.process(column.type), "drop not null" if column.nullable else "set not null"
        if column.name not in existing:
            connection.execute(sa.text(f"alter table {quoted} add column {name} {kind}"))
        elif compiler.process(existing[column.name]["type"]) != kind:
            connection.execute(sa.text(f"drop view if exists {_views_of(connection, table)}"))
            connection.execute(sa.text(f"alter table {quoted} alter column {name} type {kind} using null"))
        connection.execute(sa.text(f"alter table {quoted} alter column {name} {null}"))
        connection.execute(sa.schema.SetColumnComment(column))
    for gone in existing.keys() - table.columns.keys():
        name = connection.dialect.identifier_preparer.quote(gone)
        connection.execute(sa.text(f"alter table {quoted} alter column {name} drop not null"))
    connection.execute(sa.schema.SetTableComment(table))


def _views_of(connection: sa.Connection, table: sa.Table) -> str:
    names = (f"field_{table.name}", f"{table.name}_events")
    return ", ".join(map(connection.dialect.identifier_preparer.quote, names))


def _next_without_privilege(error: psycopg.Error, dsn: str) -> str:
    """The step that helps an account that may not do what a migration wants.

    Another database of the cluster may have brought the roles: then who made them, or a superuser, must share them.
    """
    # The statement that failed stands there in every language of the server.
    if re.search(r"grant vian_\w+ to current_user", error.diag.context or ""):
        owner = _parameters(dsn).get("user", "OWNER")
        return (
            "these roles came with another database of this server; as a superuser: "
            f'grant vian_writer, vian_reader, vian_archiver, vian_pruner, vian_field to "{owner}" with admin option'
        )
    return "connect once as a role that may create tables and roles; an account that only reads is for psql"


def _first_line(error: sa.exc.DBAPIError) -> str:
    return str(error.orig).strip().splitlines()[0]
