"""The fault campaign: kill what writes, what projects and what stores, at random instants under load, and count.

Then flip bits, let two writers rival for one stream, and fill the disk.

Contract: `python -m tests.faults.campaign --rounds 200 --seed 1` (`make faults`) prints one table and
ends with 0 if nothing acknowledged was lost, nothing doubled, every chain holds, positions have no
hole, times of recording never go back, rows equal events and every flipped bit is located; else with
1, the seed and what was wrong. PostgreSQL runs with fsync on, in a folder of a real disk. The same
seed gives the same faults at the same instants, as far as the machine lets it.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import psycopg
from rich.console import Console
from rich.progress import track
from rich.table import Table

from events import StreamName, decode
from store import Journal, LogUnavailable, Projector, SharedAppender, open_log, verify
from tests.faults.bits import flip_many
from tests.faults.full_disk import fill_and_free
from tests.faults.load import (
    JOURNAL,
    STREAMS,
    SUBMITTED,
    Process,
    append_until_killed,
    opened,
    persistently,
    project_until_killed,
    submit_until_killed,
)
from tests.faults.rivals import rounds_of_rivalry
from tests.store.disks import small_disk
from tests.store.samples import owner
from tests.store.servers import postmaster

KINDS = (
    "appender killed",
    "shared appender killed",
    "projector killed",
    "PostgreSQL stopped",
    "PostgreSQL killed",
    "clock set back",
)
LOAD_SECONDS_MAX = 0.3
"""Longest load before a fault."""
WHOLE_EVERY = 50
"""Rounds after which the whole log is verified and its rows are counted."""


@dataclass(slots=True)
class Tally:
    """What came of the rounds."""

    seed: int
    rounds: Counter[str] = field(default_factory=Counter)
    acknowledged: int = 0
    stored: int = 0
    lost: int = 0
    doubled: int = 0
    recovery_s_max: float = 0.0
    wrong: list[str] = field(default_factory=list)

    @property
    def is_clean(self) -> bool:
        """Whether nothing went wrong."""
        return not self.wrong and not self.lost and not self.doubled


class GaveUp(Exception):
    """The appender ended by itself: it found something that it must not go on from."""


class Campaign:
    """A log under load, to which faults happen."""

    def __init__(self, data_dir: Path, seed: int) -> None:
        self.tally = Tally(seed)
        self._choose = random.Random(seed)
        self._data_dir = data_dir
        open_log(data_dir=data_dir).close()
        self._log = opened(data_dir)
        self._appender = self._started(append_until_killed)
        self._projector = self._started(project_until_killed)
        self._shared = self._started(submit_until_killed)
        self._acknowledged: dict[StreamName, int] = dict.fromkeys(STREAMS, 0)
        self._submitted: dict[StreamName, int] = dict.fromkeys(SUBMITTED, 0)
        """Acknowledged by the shared appender: in the log, or in its journal."""
        self._checked = 0
        self._heads: dict[StreamName, int] = dict.fromkeys((*STREAMS, *SUBMITTED), 0)
        self._recorded_at: datetime | None = None

    def close(self) -> None:
        """End the load and the log."""
        self._appender.close()
        self._shared.close()
        self._projector.close()
        self._log.close()

    def round(self) -> None:
        """Let the load run for a random while, do one thing to it, see it recover, and check what is stored."""
        kind = self._choose.choice(KINDS)
        self.tally.rounds[kind] += 1
        self._listen(self._choose.uniform(0.0, LOAD_SECONDS_MAX))
        begun = time.monotonic()
        _FAULTS[kind](self)
        self._hear(self._appender)
        self._hear_projector()
        self.tally.recovery_s_max = max(self.tally.recovery_s_max, time.monotonic() - begun)
        self._check_new()

    def finish(self) -> None:
        """End the load, and check the log and its rows as a whole."""
        self._appender.kill()
        self._note(self._appender.last_words())
        self._projector.kill()
        self._empty_journal()
        self.count()
        self.check_whole()

    def count(self) -> None:
        """Check what is stored, and count it."""
        self._check_new()
        self._expect_stored(self._submitted)
        self.tally.acknowledged = sum((*self._acknowledged.values(), *self._submitted.values()))
        self.tally.stored = sum(self._heads.values())

    def check_whole(self) -> None:
        """Chains from the stored bytes, and one row for each event."""
        found = verify(self._log)
        self._expect(found.is_sound, f"the log does not verify: {[str(each) for each in found.broken[:3]]}")
        # Another projector beside the one that runs: whoever is faster, each row is there once.
        projector = Projector(self._log)
        while projector.position < found.position:
            projector.step()
        projector.close()
        with owner(self._log) as connection:
            row = connection.execute(
                "select count(*), count(distinct id), count(*) filter (where position <= %(at)s) from events "
                "where position <= %(at)s",
                {"at": found.position},
            ).fetchone()
        assert row is not None
        self._expect(row[0] == row[1] == found.events, f"{found.events} events have {row[0]} rows, {row[1]} distinct")

    # Faults.

    def kill_appender(self) -> None:
        """SIGKILL of the process that appends."""
        self._appender.kill()
        self._note(self._appender.last_words())
        self._appender.close()
        self._appender = self._started(append_until_killed)

    def kill_shared(self) -> None:
        """SIGKILL of the process of the shared appender, with what waits in it and what its journal holds."""
        self._shared.kill()
        self._note_shared()
        self._shared.close()
        self._shared = self._started(submit_until_killed)

    def kill_projector(self) -> None:
        """SIGKILL of the process that projects."""
        self._projector.close()
        self._projector = self._started(project_until_killed)

    def stop_postgresql(self) -> None:
        """An immediate stop, as `pg_ctl stop -m immediate` asks for: no checkpoint, recovery at the next start."""
        postmaster(self._data_dir).send_signal(signal.SIGQUIT)

    def kill_postgresql(self) -> None:
        """SIGKILL of the server's first process and of all that serve."""
        server = postmaster(self._data_dir)
        for process in (server, *server.children()):
            try:
                process.kill()
            except Exception as error:
                if type(error).__name__ != "NoSuchProcess":
                    raise

    def set_clock_back(self) -> None:
        """As if the clock had stood a day ahead until now: the newest time of recording is tomorrow's."""
        persistently(
            self._log, lambda: self._execute("update log_head set recorded_at = clock_timestamp() + interval '1 day'")
        )

    # Checks.

    def _check_new(self) -> None:
        """What is stored since the last check: nothing acknowledged is missing, nothing is double or out of order."""
        segments = persistently(self._log, lambda: list(self._log.read_all(self._checked + 1)))
        for segment in segments:
            self._expect(segment.position == self._checked + 1, f"position {segment.position} follows {self._checked}")
            self._checked = segment.position
            numbers = decode(segment, self._log.catalogue).data.column("frame").to_pylist()
            head = self._heads[segment.stream]
            doubled = sum(number <= head for number in numbers)
            self.tally.doubled += doubled
            wanted = list(range(head + 1, head + 1 + len(numbers)))
            self._expect(numbers == wanted, f"{segment.stream}: frames {numbers[:3]}... follow {head}")
            self._heads[segment.stream] = segment.header.last_sequence
            if self._recorded_at is not None:
                self._expect(
                    segment.recorded_at >= self._recorded_at, f"recorded_at goes back at position {segment.position}"
                )
            self._recorded_at = segment.recorded_at
        self._expect_stored(self._acknowledged)

    def _expect_stored(self, acknowledged_by_stream: Mapping[StreamName, int]) -> None:
        for stream, acknowledged in acknowledged_by_stream.items():
            missing = max(0, acknowledged - self._heads[stream])
            self.tally.lost += missing
            self._expect(not missing, f"{stream}: acknowledged up to {acknowledged}, stored to {self._heads[stream]}")

    def _expect(self, is_so: bool, otherwise: str) -> None:
        if not is_so:
            self.tally.wrong.append(f"round {self.tally.rounds.total()}: {otherwise}")

    # Load.

    def _started(self, target: Callable[..., None]) -> Process:
        return Process(target, self._data_dir, self._choose.randrange(2**32))

    def _listen(self, seconds: float) -> None:
        """Note what is acknowledged, for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if self._appender.pipe.poll(left):
                self._note([self._appender.said()])
            self._projector.last_words()
            self._note_shared()

    def _hear(self, process: Process) -> None:
        """Wait until the appender acknowledges something that it began after now."""
        self._note(process.last_words())
        for _ in range(3):  # the one under way, its successor, and one that was whole begun after
            self._note([process.said()])

    def _hear_projector(self) -> None:
        self._projector.last_words()
        self._projector.said()

    def _note(self, words: list[Any]) -> None:
        for heads in words:
            if isinstance(heads, str):
                raise GaveUp(heads)
            self._acknowledged.update(heads)

    def _note_shared(self) -> None:
        for acknowledged in self._shared.last_words():
            self._submitted.update(acknowledged)

    def _empty_journal(self) -> None:
        """End the shared appender as a kill does, and let the next one store what its journal holds."""
        self._shared.kill()
        self._note_shared()
        with Journal(self._data_dir / JOURNAL) as journal, SharedAppender(self._log, journal=journal):
            pass

    def _execute(self, statement: str) -> None:
        try:
            with owner(self._log) as connection:
                connection.execute(statement)
        except psycopg.OperationalError as error:
            raise LogUnavailable(str(error)) from error


_FAULTS: dict[str, Callable[[Campaign], None]] = dict(
    zip(
        KINDS,
        (
            Campaign.kill_appender,
            Campaign.kill_shared,
            Campaign.kill_projector,
            Campaign.stop_postgresql,
            Campaign.kill_postgresql,
            Campaign.set_clock_back,
        ),
        strict=True,
    )
)


@contextmanager
def on_disk() -> Iterator[Path]:
    """A folder on a real disk that every user can reach, for a data directory."""
    folder = Path(tempfile.mkdtemp(prefix="vian-faults-", dir=os.environ.get("VIAN_FAULTS_DIR") or "/var/tmp"))
    folder.chmod(0o755)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # a server that is stopping takes its own files away
        shutil.rmtree(folder, ignore_errors=True)


def run(rounds: int, seed: int, data_dir: Path, show: Callable[[range], Any] = iter) -> Tally:
    """Do so many rounds, and check the whole at the end and now and then."""
    campaign = Campaign(data_dir, seed)
    try:
        for number in show(range(rounds)):
            campaign.round()
            if number % WHOLE_EVERY == WHOLE_EVERY - 1:
                campaign.check_whole()
        campaign.finish()
    except GaveUp as error:
        campaign.tally.wrong.append(str(error))
        campaign.count()
    finally:
        campaign.close()
    return campaign.tally


def table(tally: Tally) -> Table:
    """The figures."""
    shown = Table(title=f"faults, seed {tally.seed}", title_justify="left")
    shown.add_column("what")
    shown.add_column("count", justify="right")
    for kind in KINDS:
        shown.add_row(f"rounds: {kind}", str(tally.rounds[kind]))
    shown.add_row("events acknowledged", str(tally.acknowledged))
    shown.add_row("events stored", str(tally.stored))
    shown.add_row("acknowledged events lost", str(tally.lost))
    shown.add_row("events doubled", str(tally.doubled))
    shown.add_row("longest recovery, s", f"{tally.recovery_s_max:.1f}")
    shown.add_row("chains, positions, times of recording, rows", "hold" if not tally.wrong else "BROKEN")
    return shown


def main() -> int:
    """Run the campaign from the command line."""
    parser = argparse.ArgumentParser(description="Faults on purpose against a log on disk.")
    parser.add_argument("--rounds", type=int, default=200, help="rounds of kills and stops under load")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(2**31))
    given = parser.parse_args()
    console = Console()

    def shown(what: str) -> Callable[[range], Any]:
        return lambda rounds: track(rounds, what, console=console)

    with on_disk() as folder:
        tally = run(given.rounds, given.seed, folder / "log", shown("kills and stops"))
        result = table(tally)
        wrong = list(tally.wrong)
        wrong += _flips(folder / "bits", given.seed, max(1, given.rounds // 4), shown("flipped bits"), result)
        wrong += _rivals(folder / "bits", given.seed, max(1, given.rounds // 10), result)
        wrong += _full_disk(folder / "small", given.seed, result)
    console.print(result)
    for each in wrong[:20]:
        console.print(each, style="red")
    return 0 if tally.is_clean and not wrong else 1


def _flips(data_dir: Path, seed: int, count: int, show: Callable[[range], Any], result: Table) -> list[str]:
    open_log(data_dir=data_dir).close()
    flips = flip_many(data_dir, seed, count, count, show)
    found, located = sum(each.is_found for each in flips), sum(each.is_located for each in flips)
    result.add_row("flipped bits, in values and on the disk", str(len(flips)))
    result.add_row("of these found / located", f"{found} / {located}")
    return [f"not found or not located: a bit of {each.where}" for each in flips if not each.is_located]


def _rivals(data_dir: Path, seed: int, rounds: int, result: Table) -> list[str]:
    wrong = rounds_of_rivalry(data_dir, seed, rounds)
    result.add_row("two writers on one stream: clear winners", f"{rounds - len(wrong)} of {rounds}")
    return wrong


def _full_disk(folder: Path, seed: int, result: Table) -> list[str]:
    with small_disk(folder) as disk:
        wrong = fill_and_free(disk, seed) if disk is not None else []
        said = "not tried: needs root" if disk is None else "BROKEN" if wrong else "nothing lost"
    result.add_row("disk full and back", said)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
