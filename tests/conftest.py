"""Fixtures of the whole suite: a real PostgreSQL, a fresh log for each test, the folder of real videos.

One embedded server runs for the session; each log is a database of its own, cloned from a template
that was migrated once. `server` may be parametrised indirectly with "15", which runs the test on
an external PostgreSQL 15 where one is installed.
"""

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import psycopg
import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, settings

from events import Catalogue
from store import Log, open_log
from store.embedded import EmbeddedServer
from store.schema import migrate
from tests.store import disks

PG15 = Path("/usr/lib/postgresql/15/bin")
MEMORY = Path("/dev/shm")
TEMPLATE = "vian_template"
MakeLog = Callable[..., Log]

# How long an example takes says how busy the machine is, and no law here is about that. Hypothesis would
# otherwise take a profile for CI that tries the same examples each time; here they are new in each run, and a
# failure prints the seed that repeats it.
settings.register_profile("vian", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("vian")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whatever the order, the slow tests come first, so that no worker has one left when the others are done."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


class Server:
    """A running PostgreSQL with a migrated template database."""

    def __init__(self, dsn: str, close: Callable[[], None]) -> None:
        self._url = sa.make_url(dsn)
        self._close = close
        self._numbers = count(1)
        # One for the session: a test needs it twice, to make its log and to drop it.
        self._connection = psycopg.connect(self.dsn("postgres"), autocommit=True)
        # What is tested is the order of commits and a killed process, not a power cut.
        unneeded = ("fsync", "full_page_writes", "autovacuum")
        self.execute(*(f"alter system set {name} = off" for name in unneeded), "select pg_reload_conf()")
        self.execute(f"create database {TEMPLATE}")
        migrate(self.dsn(TEMPLATE), Catalogue.shipped())

    def dsn(self, database: str) -> str:
        """Address of one of its databases, as its owner."""
        return self._url.set(database=database).render_as_string(hide_password=False)

    def execute(self, *statements: str) -> None:
        """Run the statements, each in a transaction of its own, as the server's owner."""
        for statement in statements:
            self._connection.execute(statement)

    def wait_for(self, wanted: dict[str, str]) -> None:
        """Return when new connections have these settings: a reload takes a moment to reach them."""
        names, found = sorted(wanted), {}
        while found != wanted:
            with psycopg.connect(self.dsn("postgres"), autocommit=True) as connection:
                found = dict(
                    connection.execute(
                        "select name, setting from pg_settings where name = any(%s)", (names,)
                    ).fetchall()
                )

    def create_database(self, template: str = TEMPLATE) -> str:
        """Name of a new database, a clone of the template."""
        name = f"log_{next(self._numbers)}"
        # Copied as files: a third of the time that a clone through the write-ahead log takes.
        self.execute(f"create database {name} template {template} strategy file_copy")
        return name

    def drop_database(self, name: str) -> None:
        """Drop a database, whoever may be connected to it."""
        self.execute(f"drop database {name} with (force)")

    def close(self) -> None:
        """Stop it."""
        self._connection.close()
        self._close()


class Servers:
    """The session's servers, each started when first wanted."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, Server] = {}

    def get(self, kind: str) -> Server:
        """The server of a kind, "embedded" or "15"."""
        if kind not in self._running:
            self._running[kind] = self._embedded() if kind == "embedded" else self._external_15()
        return self._running[kind]

    def close(self) -> None:
        """Stop all of them."""
        for server in self._running.values():
            server.close()

    def _embedded(self) -> Server:
        embedded = EmbeddedServer(self._folder / "embedded")
        return Server(embedded.dsn, embedded.close)

    def _external_15(self) -> Server:
        if not PG15.exists():
            pytest.skip(f"no PostgreSQL 15 in {PG15}")
        data_dir = self._folder / "pg15"
        data_dir.mkdir()
        user = _unprivileged_user(data_dir)

        def run(program: str, *arguments: str) -> None:
            subprocess.run(
                [PG15 / program, "-D", data_dir, *arguments],
                user=user,
                cwd=self._folder,
                check=True,
                stdout=subprocess.DEVNULL,
            )

        run("initdb", "--username=postgres", "--auth=trust", "--encoding=UTF8", "--no-sync")
        run("pg_ctl", "-w", "-l", str(data_dir / "log"), "-o", f"-c listen_addresses='' -k {data_dir}", "start")
        return Server(
            f"postgresql://postgres@/postgres?host={data_dir}", lambda: run("pg_ctl", "-m", "immediate", "stop")
        )


def _unprivileged_user(folder: Path) -> str | None:
    """Who runs PostgreSQL, which refuses root; the folder becomes theirs. None for oneself."""
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    user = next(name for name in ("postgres", "pgserver", "nobody") if name in known)
    shutil.chown(folder, user)
    return user


@pytest.fixture(scope="session")
def public_folder() -> Iterator[Path]:
    """A folder that every user can reach, as PostgreSQL needs it when the tests run as root.

    Not pytest's own: that is closed to others again whenever another run of pytest begins.
    """
    # In memory where there is room: a database is three hundred small files, and each test has its own.
    is_roomy = MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > 2 * 2**30
    folder = Path(tempfile.mkdtemp(prefix="vian-tests-", dir=MEMORY if is_roomy else None))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def small_disk(public_folder: Path) -> Iterator[Path]:
    """A file system of 160 MiB in memory."""
    with disks.small_disk(public_folder / "small-disk") as disk:
        if disk is None:
            pytest.skip("a file system of limited size can be mounted by root only, and not in every container")
        yield disk


@pytest.fixture(scope="session")
def servers(public_folder: Path) -> Iterator[Servers]:
    started = Servers(public_folder)
    yield started
    started.close()


@pytest.fixture
def server(servers: Servers, request: pytest.FixtureRequest) -> Server:
    """The server that this test's logs live on; the embedded one unless parametrised."""
    return servers.get(getattr(request, "param", "embedded"))


@pytest.fixture
def make_log(server: Server) -> Iterator[MakeLog]:
    """Makes a log, empty and independent; `make_log(catalogue=...)` for types beyond ViAn's own."""
    logs: list[Log] = []
    names: list[str] = []

    def make(catalogue: Catalogue | None = None) -> Log:
        names.append(server.create_database())
        dsn = server.dsn(names[-1])
        logs.append(open_log(dsn=dsn, catalogue=catalogue) if catalogue else Log(dsn, Catalogue.shipped()))
        return logs[-1]

    yield make
    for log in logs:
        log.close()
    for name in names:
        server.drop_database(name)


@pytest.fixture
def log(make_log: MakeLog) -> Log:
    """An empty log."""
    return make_log()


@pytest.fixture(scope="session")
def vian_data() -> Path:
    """The folder of real videos: VIAN_DATA, or `shared/data` beside the repository."""
    folder = Path(os.environ.get("VIAN_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if folder.is_dir():
        return folder
    missing = f"no folder {folder}. Next: set VIAN_DATA to the folder of test videos"
    return pytest.fail(missing) if os.environ.get("CI") else pytest.skip(missing)
