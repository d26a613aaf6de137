"""The fault campaign of sync: a station and central as processes, a bad link between, and everything dies in turn.

Contract: `python -m tests.faults.sync_campaign --rounds 1500 --seed 1` (`make faults-sync`) prints one
table and ends with 0 if no acknowledged event is lost, none doubled, both logs verify and hold the
same, byte by byte, what was pruned here is whole at central, filtered streams are exact and central
countersigned; else with 1, the seed, what was wrong and the folder, which it keeps. The link cuts
all the while, half of the daemons go over TLS. Time to recover is from the fault until central holds what the
station's log took after it, over the same bad link. PostgreSQL runs with fsync on, in a folder of a real disk.
The same seed gives the same faults in the same order, as far as the machine lets it.
"""

import argparse
import contextlib
import os
import random
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import httpx
import psycopg
from rich.console import Console
from rich.progress import track
from rich.table import Table

from events import Segment, StreamName, decode
from store import Log, LogUnavailable, back_up, open_log, restore, verify
from store.embedded import EmbeddedServer
from sync import Plan
from sync.plans.entries import derived_name
from sync.plans.planning import Planned, planned_in, set_plan
from tests.faults.load import WAIT_S, Process, opened, persistently
from tests.faults.sync_load import (
    ANSWER_S_MAX,
    CENTRAL,
    DIVISORS,
    FILTERED,
    PLANS,
    STATION,
    STREAMS,
    append_slowly,
    invite,
    serve_until_killed,
    station_key,
    sync_until_killed,
)
from tests.store.disks import fill, small_disk
from tests.store.samples import owner
from tests.store.servers import end_servers, postmaster
from tests.sync.proxy import CALM, CUTS, OF_BYTES, OF_EXCHANGES, SILENT, Proxy, Weather
from vian.enrolling import enrol_at
from vian.epochs import settle_epoch
from vian.errors import WorldFailed
from vian.tls import own_certificate

StreamKey = tuple[StreamName, int]

BAD = Weather(share=0.25, kinds=(*OF_EXCHANGES, *CUTS, *CUTS), delay_s=0.01, silent_s=0.2)
"""The link, all the while: every fourth exchange meets something, a cut most often."""
LOAD_S_MAX = 0.15
"""Longest load before a fault."""
OUTAGE_S = 0.3
"""How long an outage lasts that ends by itself."""
CATCH_UP_S_MAX = 120.0
"""Longest wait for central to catch up."""
QUIET_S = 2.0
"""An appender that acknowledges nothing for so long waits for room."""

_POLL_S = 0.01


@dataclass(slots=True)
class Tally:
    """What came of the rounds."""

    seed: int
    recovery_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    link: Counter[str] = field(default_factory=Counter)
    steps: Counter[str] = field(default_factory=Counter)
    acknowledged: int = 0
    held: int = 0
    pruned: int = 0
    countersigned: int = 0
    lost: int = 0
    doubled: int = 0
    wrong: list[str] = field(default_factory=list)

    def add(self, other: "Tally") -> None:
        """Take what came of another campaign as part of this one."""
        for kind, seconds in other.recovery_s.items():
            self.recovery_s[kind] += seconds
        self.link += other.link
        self.steps += other.steps
        self.acknowledged += other.acknowledged
        self.held += other.held
        self.pruned += other.pruned
        self.countersigned += other.countersigned
        self.lost += other.lost
        self.doubled += other.doubled
        self.wrong += other.wrong

    @property
    def cuts(self) -> int:
        """Connections that ended in the middle of what they carried."""
        return sum(self.link[kind] for kind in CUTS)

    @property
    def is_clean(self) -> bool:
        """Whether nothing went wrong."""
        return not self.wrong and not self.lost and not self.doubled


class GaveUp(Exception):
    """The rounds cannot go on: something ended by itself, or central does not catch up."""


class Campaign:
    """A station, central and the link between them, to which faults happen.

    Args:
        folder: Where all their data go.
        seed: Of the faults.
        station_dir: The station's data directory; within the folder by default.
        central_dir: Central's, likewise.
    """

    def __init__(
        self, folder: Path, seed: int, station_dir: Path | None = None, central_dir: Path | None = None
    ) -> None:
        self.tally = Tally(seed)
        self._choose = random.Random(seed)
        self._folder = folder
        self._station_dir = station_dir or folder / "station-1"
        self._central_dir = central_dir or folder / "central-1"
        for each in (self._station_dir, self._central_dir):
            self._make_log(each)
        self._central = opened(self._central_dir)
        self._port, self._tls_port = _free_port(), _free_port()
        self._certificate = own_certificate(folder)
        self._links = (Proxy(self._port, seed), Proxy(self._tls_port, seed, is_opaque=True))
        self._ledger: dict[StreamKey, int] = {}
        """What the station's log acknowledged, of each of its lives."""
        self._past: dict[StreamKey, list[Segment]] = {}
        """What central held of lives of the station that are over."""
        self._seen: dict[StreamKey, set[int]] = defaultdict(set)
        """Events at central."""
        self._checked = 0
        self._backups = 0
        self._start_central()
        self._enrol()
        self._station = opened(self._station_dir)
        self._weather(BAD)
        self._appender = self._started(append_slowly, self._station_dir, self._seed())
        self._note(self._appender.said())
        self._daemons = [self._daemon()]

    def close(self) -> None:
        """End all of it."""
        for process in (*self._daemons, self._appender, self._server):
            process.close()
        for link in self._links:
            link.close()
        self._station.close()
        self._central.close()
        for data_dir in (self._station_dir, self._central_dir, self._folder):
            end_servers(data_dir)

    def round(self, *kinds: str) -> None:
        """Let the load run for a random while, let these things happen at once, and see central catch up."""
        self._listen(self._choose.uniform(0.0, LOAD_S_MAX))
        begun = time.monotonic()
        for kind in kinds:
            FAULTS[kind](self)
        self._go_on()
        for kind in kinds:
            self.tally.recovery_s[kind].append(time.monotonic() - begun)
        self._only_one_daemon()
        self._check_new()

    def cut_until(self, cuts: int) -> None:
        """Go on until the link has ended so many connections."""
        self._weather(replace(BAD, kinds=CUTS, share=0.9))
        while self._link_cuts() < cuts:
            self._listen(0.1)
        self._weather(BAD)

    def finish(self) -> None:
        """End the load, let central catch up over a good link, and compare the two logs as wholes."""
        self._appender.kill()
        self._hear()
        self._weather(CALM)
        heads: dict[StreamKey, int] = {}
        self._countersigned()
        while heads != (heads := self._heads_here()):  # what the killed one had begun may still be committed
            self._caught_up(heads)
            self._listen(LOAD_S_MAX)
        self._filtered_is_whole()
        self.tally.link = sum((link.counts for link in self._links), Counter())
        self._check_new()
        self._check_whole()
        self._check_kept()
        self.tally.acknowledged = sum(self._ledger.values())
        self.tally.held = sum(map(len, self._seen.values()))

    def _countersigned(self) -> None:
        """Wait until central has countersigned something of the station's present life; a busy machine takes long."""
        self._wait_until(lambda: bool(self._signatures()))

    def _wait_until(self, is_so: Callable[[], bool]) -> None:
        """Return when it is so, or has not become so for long: who needs it looks."""
        deadline = time.monotonic() + WAIT_S
        while not is_so() and time.monotonic() < deadline:
            self._listen(0.1)

    def _planned(self) -> Planned | None:
        return persistently(self._station, lambda: planned_in(self._station, STATION))

    def _signatures(self) -> int:
        stream = StreamName.of(STATION, "sync", "checkpoint_countersigned")
        return int(persistently(self._station, lambda: self._station.stream_head(stream)).sequence)

    # Faults.

    def kill_daemon(self) -> None:
        """SIGKILL of the station's daemon, and another one."""
        self._end_daemon(self._daemons.pop(0))
        self._daemons.append(self._daemon())

    def kill_central(self) -> None:
        """SIGKILL of central's server, and another one."""
        self._server.close()
        self._start_central()

    def stop_database_here(self) -> None:
        """An immediate stop of the station's PostgreSQL."""
        self._stop_database(self._station, self._station_dir)

    def stop_database_at_central(self) -> None:
        """An immediate stop of central's PostgreSQL."""
        self._stop_database(self._central, self._central_dir)

    def jump(self) -> None:
        """The clock of either side jumps by up to ten years."""
        side = self._choose.choice((self._station_dir, self._central_dir))
        offset = self._choose.choice((-1, 1)) * 10 ** self._choose.uniform(0, 8.5)
        partial = side / "clock.new"
        partial.write_text(f"{offset:.3f}")
        partial.rename(side / "clock")

    def freeze_central(self) -> None:
        """Central takes connections and says nothing, until it goes on as if nothing had been."""
        self._frozen(self._server)

    def freeze_daemon(self) -> None:
        """The daemon stands still in the middle of whatever it does."""
        self._frozen(self._daemons[0])

    def silence(self) -> None:
        """Every connection falls silent and stays open."""
        self._weather(Weather(share=1.0, kinds=(SILENT,), silent_s=ANSWER_S_MAX * 2))
        self._listen(OUTAGE_S)
        self._weather(BAD)

    def cut_off(self) -> None:
        """The link goes down with all that is under way."""
        for link in self._links:
            link.set(is_down=True)
            link.cut_all()
        self._listen(OUTAGE_S)
        self._weather(BAD)

    def change_plan(self) -> None:
        """Another filter, while whatever is under way is under way."""
        self._wait_until(lambda: self._planned() is not None)  # the first daemon may only just have begun
        planned = self._planned()
        assert planned is not None, "a daemon has set one"
        plan = next(each for each in PLANS if each.entries != planned.plan.entries)
        persistently(self._station, lambda: set_plan(self._station, STATION, plan, planned.central, _real_now()))

    def begin_second_daemon(self) -> None:
        """A second daemon for the same station, beside the first until the round is over."""
        self._daemons.append(self._daemon())

    def restore_central(self) -> None:
        """Central is lost and restored from the backup of an earlier moment, on a new disk."""
        folder = self._folder / f"backup-{self._backups}"
        persistently(self._central, lambda: back_up(self._central, folder))
        self._listen(self._choose.uniform(0.1, 0.5))
        self._check_new()  # what was there before is counted
        self._server.close()
        self._central.close()
        end_servers(self._central_dir)
        self._backups += 1
        self._central_dir = self._folder / f"central-{self._backups + 1}"
        self._make_log(self._central_dir)
        server = EmbeddedServer(self._central_dir)
        restore(server.dsn, folder)
        server.close()
        self._central = opened(self._central_dir)
        self._checked = 0
        self._seen.clear()
        self._start_central()

    def reimage_station(self) -> None:
        """The station's disk is lost, and a new machine with a key of its own enrols under its name: a new epoch."""
        self._appender.kill()
        self._hear()
        self._end_daemon(self._daemons.pop(0))
        epoch = self._station.epoch
        self._station.close()
        end_servers(self._station_dir)
        self._remember(epoch)
        self._station_dir = self._folder / f"station-{epoch + 1}"
        self._make_log(self._station_dir)
        self._enrol(epoch + 1)
        self._station = opened(self._station_dir)
        self._expect(self._station.epoch == epoch + 1, f"epoch {self._station.epoch} follows {epoch}")
        self._appender.close()
        self._appender = self._started(append_slowly, self._station_dir, self._seed())
        self._note(self._appender.said())
        self._daemons.append(self._daemon())

    def fill_disk(self, disk: Path, side: str) -> None:
        """Fill the disk on which one side's log lies, until nothing moves; then make room, and see it go on.

        Raises:
            GaveUp: It never filled, or does not go on.
        """
        ballast = fill(disk, leave_mib=1)
        begun = time.monotonic()
        filled = self._station if side == "station" else self._central
        last: dict[StreamKey, int] = {}
        while last != (last := self._moved(side)):
            with contextlib.suppress(psycopg.Error), owner(filled) as connection:
                connection.execute("select pg_switch_wal()")  # so that the log wants room soon
            self._listen(QUIET_S)
            if time.monotonic() - begun > CATCH_UP_S_MAX:
                raise GaveUp(f"the disk of {side} never filled")
        begun = time.monotonic()
        ballast.unlink()
        self._go_on()
        self.tally.recovery_s[f"{side}'s disk full"].append(time.monotonic() - begun)
        self._check_new()

    def _moved(self, side: str) -> dict[StreamKey, int]:
        """What grows while there is room."""
        if side == "station":
            return dict(self._ledger)
        try:
            return {(head.stream, head.epoch): int(head.sequence) for head in self._central.streams()}
        except LogUnavailable:
            return {}

    def _enrol(self, epoch: int = 1) -> None:
        """Take the station's machine in, as `vian station enrol` does, over TLS, by a code that serves once."""
        url, pinned = httpx.URL(f"https://127.0.0.1:{self._tls_port}"), self._certificate.certificate.read_text()
        deadline = time.monotonic() + CATCH_UP_S_MAX
        while True:
            secret = persistently(self._central, lambda: invite(self._central))
            try:
                joined = enrol_at(url, pinned, secret, STATION, station_key(epoch))
                break
            except WorldFailed:  # central may be coming back from what was done to it before
                if time.monotonic() > deadline:
                    raise
        settle_epoch(lambda: _database(self._station_dir), STATION, joined.epoch)

    def _remember(self, epoch: int) -> None:
        """Keep what central holds of a life that is over: it is all that is left, and must stay."""
        self._check_new()
        for stream in STREAMS:
            self._past[stream, epoch] = persistently(
                self._central, lambda s=stream: list(self._central.read(s, epoch=epoch))
            )  # type: ignore[misc]
            del self._ledger[stream, epoch]

    def _stop_database(self, log: Log, data_dir: Path) -> None:
        persistently(log, log.head)  # it may be recovering from what was done to it before
        postmaster(data_dir).send_signal(signal.SIGQUIT)

    def _frozen(self, process: Process) -> None:
        process.signal(signal.SIGSTOP)
        self._listen(OUTAGE_S)
        process.signal(signal.SIGCONT)

    def _only_one_daemon(self) -> None:
        while len(self._daemons) > 1:
            self._end_daemon(self._daemons.pop(self._choose.randrange(len(self._daemons))))

    # Checks.

    def _go_on(self) -> None:
        """Wait until central holds what the station's log took after now, and so all that it took before.

        Raises:
            GaveUp: It does not.
        """
        self._hear()
        for _ in range(3):  # the append under way, its successor, and one that was whole begun after
            self._note(self._appender.said())
        self._caught_up(dict(self._ledger))

    def _caught_up(self, wanted: dict[StreamKey, int]) -> None:
        """Wait until central holds so much.

        Raises:
            GaveUp: It does not.
        """
        deadline = time.monotonic() + CATCH_UP_S_MAX
        while missing := self._missing(wanted):
            if time.monotonic() > deadline:
                raise GaveUp(f"central does not catch up: it lacks {missing}; daemons said {self.tally.steps}")
            self._listen(_POLL_S)

    def _missing(self, wanted: dict[StreamKey, int]) -> dict[StreamKey, int]:
        """What of it central does not hold yet, by how far each stream has come without a gap."""
        runs = persistently(self._central, self._central.all_runs)
        held = {key: first.sequence for key, (first, *_) in runs.items() if not first.after}
        return {key: last for key, last in wanted.items() if held.get(key, 0) < last}

    def _heads_here(self) -> dict[StreamKey, int]:
        """Where the streams stand here that the plan sends."""
        heads = persistently(self._station, self._station.streams)
        plan = self._plan()
        return {(h.stream, h.epoch): int(h.sequence) for h in heads if plan.entry_for(h.stream) is not None}

    def _plan(self) -> Plan:
        planned = persistently(self._station, lambda: planned_in(self._station, STATION))
        return PLANS[0] if planned is None else planned.plan

    def _filtered_is_whole(self) -> None:
        """Wait until central holds all that the plan's filter leaves.

        Raises:
            GaveUp: It does not.
        """
        deadline = time.monotonic() + CATCH_UP_S_MAX
        index = next(n for n, each in enumerate(PLANS) if each.entries == self._plan().entries)
        wanted = [frame for frame in self._frames(self._station, FILTERED) if frame % DIVISORS[index] == 0]
        while (held := self._frames(self._central, _derived(index))) != wanted:
            if time.monotonic() > deadline:
                raise GaveUp(f"of {len(wanted)} events that the filter leaves central holds {len(held)}, or others")
            self._listen(_POLL_S)

    def _frames(self, log: Log, stream: StreamName) -> list[int]:
        """Frames of the stream in the station's present epoch."""
        epoch = self._station.epoch
        segments = persistently(log, lambda: list(log.read(stream, epoch=epoch)))
        return [n for each in segments for n in decode(each, log.catalogue).data.column("frame").to_pylist()]

    def _check_new(self) -> None:
        """What came to central since the last check: nothing is double, and each event is itself."""
        segments = persistently(self._central, lambda: list(self._central.read_all(self._checked + 1)))
        for segment in segments:
            self._expect(segment.position == self._checked + 1, f"position {segment.position} follows {self._checked}")
            self._checked = segment.position
            if segment.stream.station != STATION:
                continue
            header = segment.header
            numbers = range(header.first_sequence, header.last_sequence + 1)
            seen = self._seen[segment.stream, header.epoch]
            self.tally.doubled += len(seen.intersection(numbers))
            seen.update(numbers)
            if segment.stream in STREAMS:
                frames = decode(segment, self._central.catalogue).data.column("frame").to_pylist()
                self._expect(frames == list(numbers), f"{segment.stream}: frames {frames[:3]}... at {numbers}")

    def _check_whole(self) -> None:
        """Both logs verify, and hold the same of this station, byte by byte; earlier lives are as they were."""
        for name, log, own in (("station", self._station, STATION), ("central", self._central, CENTRAL)):
            found = persistently(log, lambda log=log, own=own: verify(log, station=own))  # type: ignore[misc]
            self._expect(found.is_sound, f"the log of {name} does not verify: {list(map(str, found.broken[:3]))}")
        for key in self._heads_here():
            here, there = (_segments(log, key) for log in (self._station, self._central))
            is_same = [_proof(each) for each in here] == [_proof(each) for each in there]
            self._expect(is_same, f"{key}: {len(here)} segments here, {len(there)} at central, or other bytes")
            self._expect(all(each.has_payload for each in there), f"{key}: central lacks payloads")
            self.tally.pruned += sum(not each.has_payload for each in here)
        for key, acknowledged in self._ledger.items():
            self._count_lost(key, acknowledged)
        for key, segments in self._past.items():
            self._expect(
                [_bytes(each) for each in _segments(self._central, key)][: len(segments)]
                == [_bytes(each) for each in segments],
                f"{key}: what central held of an earlier life is not there any more",
            )

    def _check_kept(self) -> None:
        """Central has countersigned, and of each filter holds events that it leaves, in order, from the first on."""
        signed = self._signatures()
        self.tally.countersigned += signed
        self._expect(bool(signed), "central countersigned nothing of the station's present life")
        frames = self._frames(self._station, FILTERED)
        for index, divisor in enumerate(DIVISORS):
            held = self._frames(self._central, _derived(index))
            wanted = [frame for frame in frames if frame % divisor == 0]
            self._expect(held == wanted[: len(held)], f"of every {divisor}. event central holds others, or doubles")

    def _count_lost(self, key: StreamKey, acknowledged: int) -> None:
        missing = len(set(range(1, acknowledged + 1)) - self._seen[key])
        self.tally.lost += missing
        self._expect(not missing, f"{key}: acknowledged up to {acknowledged}, central lacks {missing} of them")

    def _expect(self, is_so: bool, otherwise: str) -> None:
        if not is_so:
            self.tally.wrong.append(f"round {sum(map(len, self.tally.recovery_s.values()))}: {otherwise}")

    # Processes.

    def _make_log(self, data_dir: Path) -> None:
        """An empty log: a copy of one that is made once, owners included."""
        empty = self._folder / "empty"
        if not empty.exists():
            open_log(data_dir=empty).close()
        subprocess.run(["cp", "-a", empty, data_dir], check=True)

    def _seed(self) -> int:
        return self._choose.randrange(2**32)

    def _started(self, target: Callable[..., None], *arguments: Any) -> Process:
        return Process(target, *arguments)

    def _daemon(self) -> Process:
        plain, opaque = (link.port for link in self._links)
        pinned = self._certificate.certificate.read_text()
        way = self._choose.choice(((f"http://127.0.0.1:{plain}", None), (f"https://127.0.0.1:{opaque}", pinned)))
        return self._started(sync_until_killed, self._station_dir, *way, self._seed())

    def _weather(self, weather: Weather) -> None:
        """Let it be so on both links; what cannot be seen into has more pieces than exchanges."""
        plain, opaque = self._links
        plain.weather = weather
        kinds = tuple(kind for kind in weather.kinds if kind in OF_BYTES)
        opaque.weather = replace(
            weather, kinds=kinds, share=weather.share if weather.share > 0.5 else weather.share / 5
        )

    def _start_central(self) -> None:
        ways = (self._port, self._tls_port, self._certificate.certificate)
        self._server = self._started(serve_until_killed, self._central_dir, *ways)
        self._server.said()

    def _end_daemon(self, daemon: Process) -> None:
        daemon.kill()
        self._note_steps(daemon)
        daemon.close()

    def _listen(self, seconds: float) -> None:
        """Note what all of them say, for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            wait([self._appender.pipe, *(daemon.pipe for daemon in self._daemons)], left)
            self._hear()

    def _hear(self) -> None:
        for words in self._appender.last_words():
            self._note(words)
        for daemon in self._daemons:
            self._note_steps(daemon)
            if not daemon.is_running:
                raise GaveUp("the daemon ended by itself")

    def _note(self, words: Any) -> None:
        if isinstance(words, str):
            raise GaveUp(words)
        for stream in STREAMS:
            self._ledger[stream, self._station.epoch] = words[stream]

    def _note_steps(self, daemon: Process) -> None:
        for did, error in daemon.last_words():
            self.tally.steps[did if error is None else f"{did}: {error.split(':')[0]}"] += 1
            if did == "stopped":
                self._expect(False, f"a stream stopped: {error}")

    def _link_cuts(self) -> int:
        return sum(link.counts[kind] for link in self._links for kind in CUTS)


FAULTS: dict[str, Callable[[Campaign], None]] = {
    "daemon killed": Campaign.kill_daemon,
    "central killed": Campaign.kill_central,
    "station's PostgreSQL stopped": Campaign.stop_database_here,
    "central's PostgreSQL stopped": Campaign.stop_database_at_central,
    "clock jumped": Campaign.jump,
    "central frozen": Campaign.freeze_central,
    "daemon frozen": Campaign.freeze_daemon,
    "link silent": Campaign.silence,
    "link down": Campaign.cut_off,
    "two daemons": Campaign.begin_second_daemon,
    "plan changed": Campaign.change_plan,
    "central restored": Campaign.restore_central,
    "station re-imaged": Campaign.reimage_station,
}
TIMES = {
    "daemon killed": 500,
    "central killed": 500,
    "station's PostgreSQL stopped": 100,
    "central's PostgreSQL stopped": 100,
    "clock jumped": 100,
    "central frozen": 40,
    "daemon frozen": 40,
    "link silent": 40,
    "link down": 40,
    "two daemons": 60,
    "plan changed": 60,
    "central restored": 5,
    "station re-imaged": 5,
}
"""How often each happens in a full campaign; a shorter one has the same shares, and each at least once."""
FAULTS_IN_FULL = sum(TIMES.values())
CUTS_IN_FULL = 10_000
ALONE = ("central restored", "station re-imaged")
"""What takes one side away altogether: nothing else can happen to it meanwhile."""


def schedule(faults: int, choose: random.Random) -> list[tuple[str, ...]]:
    """So many faults, in rounds of one to three at once."""
    wanted = [kind for kind, times in TIMES.items() for _ in range(max(1, round(times * faults / FAULTS_IN_FULL)))]
    choose.shuffle(wanted)
    rounds: list[tuple[str, ...]] = []
    while wanted:
        count = choose.choice((1, 1, 1, 2, 3))
        together = wanted[:count]
        if set(together) & set(ALONE) or len(set(together)) < len(together):
            together = wanted[:1]
        del wanted[: len(together)]
        rounds.append(tuple(together))
    return rounds


def run(faults: int, seed: int, folder: Path, show: Callable[[list[Any]], Any] = iter) -> Tally:
    """Let so many faults happen, and their share of cuts, and compare the two sides at the end."""
    campaign = Campaign(folder, seed)
    try:
        for kinds in show(schedule(faults, random.Random(seed))):
            campaign.round(*kinds)
        campaign.cut_until(faults * CUTS_IN_FULL // FAULTS_IN_FULL)
        campaign.finish()
    except (GaveUp, AssertionError, EOFError) as error:
        campaign.tally.wrong.append(f"{type(error).__name__}: {error}")
    finally:
        campaign.close()
    return campaign.tally


def run_on_full_disk(side: str, seed: int, folder: Path) -> Tally | None:
    """Fill the disk of one side under load, and make room again; None where no small disk can be mounted."""
    with small_disk(folder.with_name(f"{folder.name}-small")) as disk:
        if disk is None:
            return None
        campaign = Campaign(folder, seed, **{f"{side}_dir": disk / "log"})
        try:
            campaign.fill_disk(disk, side)
            campaign.finish()
        except (GaveUp, AssertionError, EOFError) as error:
            campaign.tally.wrong.append(f"{type(error).__name__}: {error}")
        finally:
            campaign.close()
        return campaign.tally


def table(tally: Tally) -> Table:
    """The figures."""
    shown = Table(title=f"faults of sync, seed {tally.seed}", title_justify="left")
    for name in ("fault", "times", "recovery, median s", "max s"):
        shown.add_column(name, justify="left" if name == "fault" else "right")
    for kind, seconds in sorted(tally.recovery_s.items()):
        shown.add_row(kind, str(len(seconds)), f"{statistics.median(seconds):.2f}", f"{max(seconds):.2f}")
    for kind, count in sorted(tally.link.items()):
        shown.add_row(f"exchange {kind}", str(count))
    shown.add_section()
    for what, count in (
        ("connections cut in the middle", tally.cuts),
        ("events acknowledged at the station", tally.acknowledged),
        ("events at central, of all lives", tally.held),
        ("countersignatures of the last life", tally.countersigned),
        ("segments pruned at the station, whole at central", tally.pruned),
        ("acknowledged events lost", tally.lost),
        ("events doubled", tally.doubled),
    ):
        shown.add_row(what, str(count))
    shown.add_row("heads, bytes, chains of both logs", "equal" if not tally.wrong else "BROKEN")
    return shown


def main() -> int:
    """Run the campaign from the command line."""
    parser = argparse.ArgumentParser(description="Faults on purpose between a station and central.")
    parser.add_argument("--rounds", type=int, default=FAULTS_IN_FULL, help="faults; with each, its share of cuts")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(2**31))
    given = parser.parse_args()
    console = Console()
    folder = Path(tempfile.mkdtemp(prefix="vian-faults-", dir=os.environ.get("VIAN_FAULTS_DIR") or "/var/tmp"))
    folder.chmod(0o755)
    tally = run(given.rounds, given.seed, folder / "load", lambda rounds: track(rounds, "faults", console=console))
    for side in ("station", "central"):
        full = run_on_full_disk(side, given.seed, folder / f"full-{side}")
        if full is not None:
            tally.add(full)
    console.print(table(tally))
    for each in tally.wrong[:20]:
        console.print(each, style="red")
    if tally.is_clean:
        shutil.rmtree(folder, ignore_errors=True)
        return 0
    console.print(f"Next: look into {folder}, and run again with --seed {given.seed}", style="red")
    return 1


def _free_port() -> int:
    """A port below those from which connections go out: while central is down, nobody must come to bear its number."""
    for port in random.sample(range(15_000, 30_000), 100):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    raise AssertionError("no port is free")


@contextlib.contextmanager
def _database(data_dir: Path) -> Iterator[tuple[str, EmbeddedServer | None]]:
    """The database of a log, with nobody connected."""
    server = EmbeddedServer(data_dir)
    try:
        yield server.dsn, server
    finally:
        server.close()


def _derived(index: int) -> StreamName:
    """The stream that the filter of that plan makes."""
    return derived_name(FILTERED, PLANS[index].entries[0])


def _real_now() -> datetime:
    return datetime.now(UTC)


def _segments(log: Log, key: StreamKey) -> list[Segment]:
    stream, epoch = key
    return list(log.read(stream, epoch=epoch, with_hollow=True))


def _proof(segment: Segment) -> tuple[Any, ...]:
    """What stays of a segment whatever becomes of its payload."""
    return segment.header, segment.payload_hash, segment.chain_hash


def _bytes(segment: Segment) -> tuple[Any, ...]:
    return segment.header, segment.payload, segment.payload_hash, segment.chain_hash


if __name__ == "__main__":
    sys.exit(main())
