"""The database's schema: bring it to this program's version, and check that it is there.

Contract: `migrate` runs as the database's owner, is idempotent, and one process at a time does it
(an advisory lock). Row tables of plug-in types are created from their definition, without SQL.
"""

from collections.abc import Iterable
from importlib.resources import files

import psycopg
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError

from events import EventType
from store.errors import LogUnavailable, SchemaMismatch
from store.tables import events_view, projection_table

_LOCK_KEY = 0x5669_416E  # "ViAn"


def migrate(dsn: str, catalogue: Iterable[type[EventType]], revision: str = "head") -> None:
    """Bring the database to `revision`, and give every type of the catalogue its row table.

    Raises:
        LogUnavailable: The database cannot be reached, or the role may not create tables.
        SchemaMismatch: The database was migrated by a newer ViAn.
    """
    engine = sa.create_engine(sqlalchemy_url(dsn), poolclass=sa.NullPool)
    try:
        with engine.begin() as connection:
            connection.execute(sa.text("select pg_advisory_xact_lock(:key)"), {"key": _LOCK_KEY})
            _upgrade(connection, revision)
            if revision == "head":
                _create_plugged(connection, catalogue)
    except sa.exc.OperationalError as error:
        raise LogUnavailable(f"no database at {safe_dsn(dsn)}: {_first_line(error)}. Next: vian doctor") from error
    except sa.exc.ProgrammingError as error:
        if not isinstance(error.orig, psycopg.errors.InsufficientPrivilege):
            raise
        raise LogUnavailable(
            f"the schema cannot be created at {safe_dsn(dsn)}: {_first_line(error)}. "
            "Next: connect once as a role that may create tables and roles"
        ) from error
    finally:
        engine.dispose()


def configuration() -> Config:
    """Alembic's configuration for the migrations that came with this program."""
    config = Config()
    config.set_main_option("script_location", str(files("migrations")))
    return config


def sqlalchemy_url(dsn: str) -> str:
    """The address as SQLAlchemy spells it, with psycopg 3 as the driver."""
    scheme, _, rest = dsn.partition("://")
    return f"postgresql+psycopg://{rest}" if scheme in ("postgresql", "postgres") else dsn


def safe_dsn(dsn: str) -> str:
    """The address without its password, fit for a message.

    >>> safe_dsn("postgresql://u:secret@h/db")
    'postgresql://u:***@h/db'
    """
    return sa.make_url(sqlalchemy_url(dsn)).set(drivername="postgresql").render_as_string(hide_password=True)


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


def _create_plugged(connection: sa.Connection, catalogue: Iterable[type[EventType]]) -> None:
    existing = set(sa.inspect(connection).get_table_names())
    types = {event_type.type_name: event_type for event_type in catalogue}
    missing = [event_type for name, event_type in types.items() if name not in existing]
    for event_type in missing:
        table = projection_table(event_type, sa.MetaData())
        table.create(connection)
        connection.execute(sa.text("select adopt_projection(:name)"), {"name": table.name})
    if missing:
        connection.execute(sa.text(events_view(types)))


def _first_line(error: sa.exc.DBAPIError) -> str:
    return str(error.orig).strip().splitlines()[0]
