"""How late an alert is at central while a backlog of days drains over a mobile link.

Contract: the station's log holds the whole backlog before its daemon starts. Alerts are appended at random times
while it drains; each one's latency runs from its being durable at the station until a subscriber of central's log has
it, which is a little after it is durable there. Both by one clock, of this machine.
"""

import random
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from benchmarks.link import Link, slow_link
from benchmarks.measuring import Figure, Row
from benchmarks.points import PRODUCER
from benchmarks.sync_drain import SEGMENT_EVENTS, backlog, tuned_log, wait_until
from benchmarks.sync_servers import STATION, central_server, enrol, station_daemon
from events import SituationDetected, StreamName, batch_of, encode
from store import Log, Subscription

BITS_PER_S = 1e6
DELAY_S = 0.025
_MEAN_INTERVAL_S = 2.0
_SEED = 20260101
_SETTLE_SECONDS = 20.0
"""The daemon learns how fast the link is, as it would in the first seconds of days."""
_FILLED_AT_ONCE = 100
_PLAN = """entries:
  - {stream: "*/*/situation_detected", priority: alerts}
  - {stream: "*/*/*", priority: points}
"""


class _Follower:
    """Notes when each alert is in central's log."""

    def __init__(self, log: Log) -> None:
        self.seen: dict[int, float] = {}
        self._stop = threading.Event()
        self._subscription = Subscription(log, "follower", types=["situation_detected"])
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            segments = self._subscription.poll(0.2).segments
            now = time.monotonic()
            self.seen.update({int(segment.header.first_sequence): now for segment in segments})

    def close(self) -> None:
        """Stop looking."""
        self._stop.set()
        self._thread.join()
        self._subscription.close()


@dataclass(frozen=True, slots=True)
class _Drain:
    """What happened while the backlog drained."""

    latencies_s: list[float]
    seconds: float
    crossed_bytes: int
    """up the link"""
    stored_bytes: int
    """of payload that central came to hold"""


def alerts(folder: Path, backlog_segments: int, seconds: float | None) -> Iterator[Row | Figure]:
    """Latencies of alerts, and how much of the link was used.

    Args:
        folder: Where the logs live.
        backlog_segments: How much waits at the station.
        seconds: How long to watch; until the backlog is gone if None.
    """
    plan = folder / "plan.yaml"
    plan.write_text(_PLAN)
    with ExitStack() as stack:
        link = stack.enter_context(slow_link(BITS_PER_S, DELAY_S))
        station, central = (stack.enter_context(tuned_log(folder / name)) for name in ("station", "central"))
        for _ in range(backlog_segments // _FILLED_AT_ONCE):
            station.append(backlog(0, _FILLED_AT_ONCE))
        enrol(folder)
        stack.enter_context(central_server(link, folder))
        stack.enter_context(station_daemon(link, folder, plan))
        follower = _Follower(central)
        stack.callback(follower.close)
        wait_until(lambda: central.head() > 0)
        time.sleep(_SETTLE_SECONDS)
        watched = _watched(link, station, central, follower, seconds)
    yield from _figures(watched, backlog_segments)


def _watched(link: Link, station: Log, central: Log, follower: _Follower, seconds: float | None) -> _Drain:
    numbers = random.Random(_SEED)
    stream = StreamName.of(STATION, "rules", SituationDetected.type_name)
    durable: dict[int, float] = {}
    crossed, held, began = link.traffic().up, central.head(), time.monotonic()
    while (time.monotonic() < began + seconds) if seconds is not None else _is_waiting(station, central):
        time.sleep(numbers.expovariate(1 / _MEAN_INTERVAL_S))
        sequence = len(durable)
        station.append([encode(stream, batch_of([_alert()]), PRODUCER)], [sequence])
        durable[sequence + 1] = time.monotonic()
    ended, crossed_bytes, held_then = time.monotonic(), link.traffic().up - crossed, central.head()
    wait_until(lambda: len(follower.seen) == len(durable))
    stored = sum(len(each.payload) for each in central.read_all(held + 1, to_position=held_then))
    latencies_s = [follower.seen[sequence] - at for sequence, at in durable.items()]
    return _Drain(latencies_s, ended - began, crossed_bytes, stored)


def _is_waiting(station: Log, central: Log) -> bool:
    return central.head() < station.head() - 10


def _alert() -> SituationDetected:
    now = datetime.now(UTC)
    return SituationDetected(
        time=now,
        situation="0" * 64,
        rule="yard-dwell",
        rule_version=1,
        rule_hash="0" * 64,
        severity="alarm",
        title="track 7 has been in the yard since 10:00",
        partition='{"track_id": 7}',
        measures="{}",
        began_at=now,
        ended_at=now,
        lineage=(),
    )


def _figures(drain: _Drain, backlog_segments: int) -> Iterator[Row | Figure]:
    p50, p99 = np.percentile(drain.latencies_s, [50, 99])
    events = backlog_segments * SEGMENT_EVENTS
    what = f"an alert at central, backlog of {events:,} events, 1 Mbit/s, 25 ms each way"
    yield Figure(f"{what}, p50", "s", float(p50))
    yield Figure(f"{what}, p99", "s", float(p99))
    yield Figure(f"{what}, max of {len(drain.latencies_s):,}", "s", max(drain.latencies_s), 1.0, at_least=False)
    used, stored = (100 * 8 * each / drain.seconds / BITS_PER_S for each in (drain.crossed_bytes, drain.stored_bytes))
    yield Figure(f"the link meanwhile, over {drain.seconds:,.0f} s", "% used", used, 80.0)
    yield Figure("of it payload that central stored", "%", stored)
