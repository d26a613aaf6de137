"""Addresses of an external PostgreSQL, good and bad."""

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
import sqlalchemy as sa

from store import BadRequest, LogUnavailable, open_log
from store.schema import safe_dsn
from tests.conftest import Server
from tests.store.samples import GATE, append, on_both

PASSWORD = "hunter2-geheim"


@pytest.fixture
def locked(server: Server) -> Iterator[sa.URL]:
    """Address of a database for a role that must give its password."""
    with psycopg.connect(server.dsn("postgres"), autocommit=True) as connection:
        (file,) = connection.execute("show hba_file").fetchone() or ("",)
        connection.execute(f"create role locked superuser login password '{PASSWORD}'")
    rules = Path(file).read_text()
    Path(file).write_text(f"local all locked scram-sha-256\n{rules}")
    server.execute("select pg_reload_conf()")
    name = server.create_database()
    yield sa.make_url(server.dsn(name)).set(username="locked", password=PASSWORD)
    Path(file).write_text(rules)
    server.execute("select pg_reload_conf()")
    server.drop_database(name)
    server.execute("drop role locked")


def text(url: sa.URL) -> str:
    return url.render_as_string(hide_password=False)


@on_both
def test_a_password_opens_the_log_and_is_never_shown(locked: sa.URL) -> None:
    with open_log(dsn=text(locked)) as log:
        append(log, GATE, 1)
    with pytest.raises(LogUnavailable, match="password authentication failed") as caught:
        open_log(dsn=text(locked.set(password=f"not-{PASSWORD}")))
    assert PASSWORD not in str(caught.value)
    assert "Next: vian doctor" in str(caught.value)


def test_an_address_in_words_opens_the_log(server: Server) -> None:
    name = server.create_database()
    host = sa.make_url(server.dsn(name)).query["host"]
    with open_log(dsn=f"host={host} user=postgres dbname={name}") as log:
        append(log, GATE, 1)
        assert log.head() == 1
    server.drop_database(name)


@on_both
def test_a_database_that_is_not_there_is_named(server: Server) -> None:
    url = sa.make_url(server.dsn("nowhere")).set(password=PASSWORD)
    with pytest.raises(LogUnavailable, match='database "nowhere" does not exist') as caught:
        open_log(dsn=text(url))
    assert PASSWORD not in str(caught.value)


@pytest.mark.parametrize(
    "dsn, reason",
    [
        (f"postgresql://u:{PASSWORD}@127.0.0.1:1/db", "refused"),
        (f"postgresql://u:{PASSWORD}@no-such-host.invalid/db", "resolve|not known|failure"),
        (f"host=/no/such/folder user=u password={PASSWORD} dbname=db", "No such file or directory"),
        (f"postgresql://u@127.0.0.1:1,127.0.0.1:2/db?password={PASSWORD}", "refused"),
    ],
)
def test_a_host_that_is_not_there_is_named_without_the_password(dsn: str, reason: str) -> None:
    with pytest.raises(LogUnavailable, match=reason) as caught:
        open_log(dsn=dsn)
    assert PASSWORD not in str(caught.value)
    assert "no database at postgresql://u" in str(caught.value)


@pytest.mark.parametrize("dsn", [f"postgresq://u:{PASSWORD}@h/db", f"u:{PASSWORD}@h", f"password {PASSWORD}"])
def test_what_is_no_address_is_refused_without_showing_it(dsn: str) -> None:
    with pytest.raises(BadRequest, match="wanted postgresql://user@host:port/database") as caught:
        open_log(dsn=dsn)
    assert PASSWORD not in str(caught.value)
    assert caught.value.__cause__ is None


@pytest.mark.parametrize(
    "dsn, safe",
    [
        ("postgresql://u:p@h:5433/db", "postgresql://u:***@h:5433/db"),
        ("postgresql://h/db?user=u&password=p&sslmode=require", "postgresql://u:***@h/db?sslmode=require"),
        ("postgresql://u@h/db?sslpassword=p", "postgresql://u@h/db"),
        ("host=h port=5 dbname=db", "postgresql://h:5/db"),
        ("postgresql://u:p@h:port/db", "postgresql://u:***@/db?host=h&port=port"),
        ("postgresql://u:p@/db?host=/run/pg", "postgresql://u:***@/db?host=%2Frun%2Fpg"),
    ],
)
def test_an_address_fit_for_a_message_holds_all_but_passwords(dsn: str, safe: str) -> None:
    assert safe_dsn(dsn) == safe
