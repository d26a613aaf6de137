"""A day's work in minutes: how late a subscriber is, and what it costs, at a steady rate and in a burst.

    python -m benchmarks.sustained [--quick] [--folder DIR] [--results FILE]

One process as a station runs it: the shared appender, the row projector and a subscriber, each in a thread
of its own, over the embedded PostgreSQL with durable commits. A hundred cameras submit in turn.

- latency: from the commit (`recorded_at`, taken in it) to the subscriber, by the same machine's clock;
- CPU: of this process and of all of PostgreSQL's, as a share of one core;
- memory: this process's own, at the middle and at the end; lag of the projector in segments.
"""

import argparse
import json
import tempfile
import threading
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import psutil

from benchmarks.measuring import cpu_of, keep
from benchmarks.points import CAMERAS, PRODUCER, points, stream
from store import Log, Projector, SharedAppender, Subscription, open_log

_STEP_SECONDS = 0.2


@dataclass(frozen=True, slots=True)
class Load:
    """How much comes, and for how long."""

    name: str
    events_per_s: int
    seconds: float
    per_submission: int
    """events that a camera submits at a time"""
    is_projected_meanwhile: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a load came to."""

    load: str
    events_per_s: int
    seconds: float
    events: int
    events_per_s_reached: float
    latency_p50_ms: float
    latency_p99_ms: float
    latency_max_ms: float
    cores: float
    """CPU seconds of this process and PostgreSQL, a second"""
    memory_mb_middle: float
    memory_mb_end: float
    projector_lag_segments_max: int
    subscriber_lag_events_end: int
    """events that the subscriber had not seen when the last was acknowledged"""
    seconds_to_catch_up: float
    """from the last acknowledgement until subscriber and projector had all"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, and keep the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="30 seconds and 10 instead of 10 minutes and one")
    parser.add_argument("--folder", type=Path, help="where the databases live, on a real disk")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/sustained.json"))
    options = parser.parse_args(arguments)
    steady, burst = (30.0, 10.0) if options.quick else (600.0, 60.0)
    loads = (Load("steady", 25_000, steady, 25, True), Load("burst", 200_000, burst, 200, False))
    outcomes = []
    for load in loads:
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            Path(folder).chmod(0o755)
            with open_log(data_dir=Path(folder) / "log") as log:
                outcomes.append(_measured(log, load))
        print(json.dumps(asdict(outcomes[-1]), indent=1), flush=True)
    keep(options.results, is_quick=options.quick, outcomes=[asdict(each) for each in outcomes])


class _Follower:
    """A subscriber that notes how late each segment came."""

    def __init__(self, log: Log) -> None:
        self._subscription = Subscription(log, "follower", types=["track_point"])
        self.late_ms = array("d")  # compact, lest the measurement look like growth
        self.events = 0

    def step(self) -> None:
        """See what is new."""
        segments = self._subscription.poll(_STEP_SECONDS).segments
        now = datetime.now(UTC)
        for segment in segments:
            self.late_ms.append((now - segment.recorded_at).total_seconds() * 1e3)
            self.events += segment.header.event_count

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()


class _Running:
    """Steps again and again in a thread of its own until told to stop; an error ends it and is raised at the end."""

    def __init__(self, step: Callable[[], object]) -> None:
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(step,), daemon=True)
        self._thread.start()

    def _run(self, step: Callable[[], object]) -> None:
        try:
            while not self._stop.is_set():
                step()
        except BaseException as error:
            self._error = error

    def end(self) -> None:
        """Stop, and raise what went wrong."""
        self._stop.set()
        self._thread.join()
        if self._error is not None:
            raise self._error


def _measured(log: Log, load: Load) -> Outcome:
    follower, projector = _Follower(log), Projector(log)
    me = psutil.Process()
    lags = [0]
    running = [_Running(follower.step)]
    if load.is_projected_meanwhile:
        running.append(_Running(lambda: projector.step(_STEP_SECONDS)))
    with cpu_of(lambda: _processes(log)) as cpu_s:
        began = time.monotonic()
        with SharedAppender(log) as appender:
            sent, middle_mb = _submit_all(appender, load, lambda: lags.append(log.head() - projector.position))
            appender.flush()
            taken_s = time.monotonic() - began
            behind = sent - follower.events
            end_mb = me.memory_info().rss / 2**20
            used_s = cpu_s()
    acknowledged = time.monotonic()
    while follower.events < sent:
        time.sleep(0.005)
    for each in running:
        each.end()
    projector.catch_up()
    caught_up_s = time.monotonic() - acknowledged
    follower.close()
    projector.close()
    p50, p99 = np.percentile(follower.late_ms, [50, 99])
    lag = max(lags) if load.is_projected_meanwhile else 0
    return Outcome(
        load.name,
        load.events_per_s,
        load.seconds,
        sent,
        sent / taken_s,
        float(p50),
        float(p99),
        max(follower.late_ms),
        used_s / taken_s,
        middle_mb,
        end_mb,
        lag,
        behind,
        caught_up_s,
    )


def _submit_all(appender: SharedAppender, load: Load, look: Callable[[], object]) -> tuple[int, float]:
    """Submit at the load's rate; events sent, and this process's memory in the middle."""
    batches = [points(load.per_submission, seed) for seed in range(CAMERAS)]
    interval_s = load.per_submission / load.events_per_s
    total = int(load.seconds / interval_s)
    me, middle_mb = psutil.Process(), 0.0
    began = time.monotonic()
    looked = began
    for number in range(total):
        due = began + number * interval_s
        if (wait := due - time.monotonic()) > 0.002:
            time.sleep(wait)
        appender.submit(stream(number), batches[number % CAMERAS], PRODUCER)
        if number == total // 2:
            middle_mb = me.memory_info().rss / 2**20
        if time.monotonic() > looked + 1:
            looked = time.monotonic()
            look()
    return total * load.per_submission, middle_mb


def _processes(log: Log) -> list[psutil.Process]:
    """This process and PostgreSQL's."""
    assert log.server is not None, "the embedded server is measured"
    first = (log.server.data_dir / "pg" / "postmaster.pid").read_text().split("\n")[0]
    postmaster = psutil.Process(int(first))
    return [psutil.Process(), postmaster, *postmaster.children(recursive=True)]


if __name__ == "__main__":
    main()
