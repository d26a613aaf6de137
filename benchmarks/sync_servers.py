"""A central server and a station's daemon as an operator runs them, each in a namespace of its own.

Contract: both are processes of `vian`, over embedded logs; this process reads and fills these logs beside them. What a
process and the PostgreSQL of its log cost is read from the system.
"""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import psutil

from benchmarks.link import CENTRAL_IP, Link, inside
from events import station_name
from store import load_key, make_key, open_log
from sync.central.access import REPLICATE
from sync.protocol.enrolment import new_secret
from vian.admission import access_for
from vian.clock import utc_now
from vian.membership import Membership, save_membership
from vian.settings import load_settings
from vian.signatures import KEY_NAME
from vian.tls import own_certificate

STATION = "brno"
_CENTRAL = "central"
_PORT = 8470
CENTRAL_URL = f"https://{CENTRAL_IP}:{_PORT}"
_END_SECONDS_MAX = 60.0


@dataclass(frozen=True, slots=True)
class Cost:
    """What a program and its log's PostgreSQL have used since they started."""

    program_s: float
    postgres_s: float

    def since(self, before: "Cost") -> "Cost":
        """What was used after that."""
        return Cost(self.program_s - before.program_s, self.postgres_s - before.postgres_s)

    @property
    def total_s(self) -> float:
        """CPU seconds of both."""
        return self.program_s + self.postgres_s


class Program:
    """A running `vian` over the log of a folder."""

    def __init__(self, namespace: str, arguments: Sequence[str], data_dir: Path) -> None:
        command = [sys.executable, "-m", "vian", *arguments, "--data-dir", str(data_dir), "--json"]
        self._said = (data_dir.parent / f"{data_dir.name}.said").open("ab")
        self._command = inside(namespace, command)
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, stderr=self._said)
        self._data_dir = data_dir

    def first_line(self) -> str:
        """What it says first; it runs then."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline().decode()
        if not line:
            self.wait()
        return line

    def wait(self) -> None:
        """Wait for its end, which must be a good one."""
        _, status = self._process.communicate(), self._process.returncode
        if status:
            raise SystemExit(
                f"{' '.join(self._command)}: ended with {status}, said: {Path(self._said.name).read_text()[-2000:]}"
            )

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.communicate(timeout=_END_SECONDS_MAX)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        self._said.close()

    def cost(self) -> Cost:
        """What it and its log's PostgreSQL have used."""
        times = psutil.Process(self._process.pid).cpu_times()
        return Cost(times.user + times.system, postgres_cpu_s(self._data_dir / "pg"))

    def memory_bytes(self) -> int:
        """Its resident memory."""
        return int(psutil.Process(self._process.pid).memory_info().rss)


def postgres_cpu_s(pgdata: Path) -> float:
    """CPU seconds of all processes that a PostgreSQL ever had."""
    postmaster = _postmaster(pgdata)
    own = postmaster.cpu_times()
    used = own.user + own.system + own.children_user + own.children_system
    for child in postmaster.children():
        times = child.cpu_times()
        used += times.user + times.system
    return float(used)


def postgres_memory_bytes(pgdata: Path) -> int:
    """Memory of all processes of a PostgreSQL; what they share is counted once."""
    postmaster = _postmaster(pgdata)
    return sum(map(_pss_bytes, (postmaster, *postmaster.children())))


def _pss_bytes(process: psutil.Process) -> int:
    """Memory of a process, its share of what is shared; 0 of one that has just ended."""
    try:
        return int(process.memory_full_info().pss)
    except psutil.NoSuchProcess:
        return 0


def _postmaster(pgdata: Path) -> psutil.Process:
    return psutil.Process(int((pgdata / "postmaster.pid").read_text().split("\n", 1)[0]))


@contextmanager
def central_server(link: Link, folder: Path) -> Iterator[Program]:
    """`vian serve --role central` on the link, over the log in folder/central."""
    arguments = ["serve", "--role", "central", "--host", CENTRAL_IP, "--port", str(_PORT), "--tls", "generate"]
    program = Program(link.central, [*arguments, "--station", _CENTRAL], folder / "central")
    try:
        program.first_line()
        yield program
    finally:
        program.stop()


@contextmanager
def station_daemon(link: Link, folder: Path, plan: Path | None = None) -> Iterator[Program]:
    """`vian sync` at the other end of the link, over the log in folder/station."""
    arguments = ["sync", "--station", STATION, *(["--plan", str(plan)] if plan else [])]
    program = Program(link.station, arguments, folder / "station")
    try:
        yield program
    finally:
        program.stop()


def enrol(folder: Path, names: Sequence[str] = (STATION,)) -> None:
    """Let the stations speak to central, all by the key of the log in folder/station."""
    settings = load_settings(data_dir=folder / "central", station=_CENTRAL)
    own_certificate(settings.data_dir)
    key = make_key(folder / "station" / KEY_NAME)
    with open_log(data_dir=settings.data_dir) as log:
        registry = access_for(log, settings).registry
        for name in names:
            secret = new_secret()
            registry.invite(station_name(name), secret, [REPLICATE], [], utc_now() + timedelta(hours=1))
            registry.enrol(name, secret, key.public, None)
    save_membership(load_settings(data_dir=folder / "station", station=STATION), membership(folder, STATION))


def membership(folder: Path, name: str) -> Membership:
    """What a station that was enrolled knows of central."""
    central = load_key(folder / "central" / KEY_NAME)
    return Membership(
        address=CENTRAL_URL,
        station=name,
        central=_CENTRAL,
        public_key=central.public.hex(),
        certificate=own_certificate(folder / "central").certificate.read_text(),
    )
