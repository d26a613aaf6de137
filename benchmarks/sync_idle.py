"""What a station costs that has nothing to send: bytes on the wire, and CPU of the two programs and their logs."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from benchmarks.link import fast_link
from benchmarks.measuring import Figure, Row
from benchmarks.sync_drain import backlog, tuned_log, wait_until
from benchmarks.sync_servers import central_server, enrol, station_daemon

_STREAMS = 100
_SETTLE_SECONDS = 15.0
"""Connections that are kept for the next segment are closed by then."""


def idle(folder: Path, seconds: float) -> Iterator[Row | Figure]:
    """A station with a hundred streams, all of them at central, watched for so long."""
    with ExitStack() as stack:
        link = stack.enter_context(fast_link())
        station, central = (stack.enter_context(tuned_log(folder / name)) for name in ("station", "central"))
        station.append(backlog(0, _STREAMS))
        enrol(folder)
        server = stack.enter_context(central_server(link, folder))
        daemon = stack.enter_context(station_daemon(link, folder))
        wait_until(lambda: _STREAMS < station.head() <= central.head())
        time.sleep(_SETTLE_SECONDS)
        crossed, before = link.traffic(), (daemon.cost(), server.cost())
        began = time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - began
        after, traffic = (daemon.cost(), server.cost()), link.traffic().since(crossed)
    costs = [later.since(earlier) for later, earlier in zip(after, before, strict=True)]
    yield Figure("idle station, on the wire", "bytes/min", traffic.both / took * 60, 1000.0, at_least=False)
    yield Figure("idle station, its daemon", "% of a core", 100 * costs[0].program_s / took, 1.0, at_least=False)
    yield Figure("idle station, the daemon's PostgreSQL", "% of a core", 100 * costs[0].postgres_s / took)
    yield Figure("idle station, central", "% of a core", 100 * costs[1].program_s / took, 1.0, at_least=False)
    yield Figure("idle station, central's PostgreSQL", "% of a core", 100 * costs[1].postgres_s / took)
