"""`/metrics`: what an operator watches of a station or of central, for Prometheus.

Contract: the figures of `vian sync status`, looked at no more often than every `LOOK_EVERY_S`; a log that is away is
a figure, not an error. Few series: of more than `STREAMS_MAX` streams the rest is one, and so are stations. Names of
streams and stations are in it, and nothing secret. Every metric is in `METRICS`, and in the page on operations.
"""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from ipaddress import ip_address

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from events import Station
from store import Log, LogUnavailable
from sync.central.registry import Registry
from sync.errors import PlanError
from vian.central_view import central_view
from vian.replication import load_plan
from vian.sync_view import days_left, station_view
from vian.version import VERSION

LOOK_EVERY_S = 10.0
STREAMS_MAX = 200
STATIONS_MAX = 1000
OTHERS = "(others)"

METRICS: Mapping[str, str] = {
    "vian_info": "Version and role of the program, as labels; always 1.",
    "vian_log_available": "1 while the log's database answers, 0 while it does not, and nothing else is told.",
    "vian_log_position": "Segments in the log.",
    "vian_disk_free_bytes": "Room on the disk of an embedded log.",
    "vian_disk_days_left": "Days until that disk is full at the rate of the last days.",
    "vian_sync_backlog_events": "Station: events of a stream that wait to be sent.",
    "vian_sync_backlog_bytes": "Station: bytes of them, as they travel.",
    "vian_sync_lag_seconds": "Station: how long the oldest event of a stream that waits has waited.",
    "vian_sync_stopped": "Station: 1 if the stream is stopped and needs a person.",
    "vian_sync_last_contact_seconds": "Station: how long ago central answered.",
    "vian_sync_clock_offset_seconds": "Station: how far central's clock was ahead at the last hello.",
    "vian_sync_rate_bits_per_second": "Station: what the link carried while sending.",
    "vian_sync_failures": "Station: failures in a row since something went well.",
    "vian_sync_paused": "Station: 1 if the plan is paused.",
    "vian_sync_checkpoint_signed": "Station: number of the newest checkpoint that it signed.",
    "vian_sync_checkpoint_countersigned": "Station: number of the newest that central countersigned.",
    "vian_station_last_contact_seconds": "Central: how long ago the station was heard of.",
    "vian_station_behind_events": "Central: events that the station has beyond what is here, by its newest hello.",
    "vian_station_missing_events": "Central: events in gaps before the newest that is here.",
    "vian_station_lag_seconds": "Central: how long ago the newest was stored, where the station has more.",
    "vian_station_revoked": "Central: 1 if the station is shut out.",
    "vian_sync_refusals_total": "Central: requests refused since the program started, by endpoint and code.",
}
"""Each metric and what it says."""

Refused = Callable[[], Mapping[tuple[str, str], int]]
"""How many requests were refused since the start, by endpoint and code."""


@dataclass(frozen=True, slots=True)
class Watched:
    """What is told of."""

    log: Log
    station: Station
    """of this program: the station's name, or central's"""
    registry: Registry | None = None
    """central's; None at a station"""
    refused: Refused = dict


class Metrics:
    """The metrics of one program, as text; may be used by several threads.

    Args:
        watched: What is told of.
        now: This machine's clock.
        monotonic: Seconds that never go back.
        is_public: Whether other machines may read them.
    """

    def __init__(
        self,
        watched: Watched,
        now: Callable[[], datetime],
        monotonic: Callable[[], float],
        *,
        is_public: bool = False,
    ) -> None:
        self._watched = watched
        self._now = now
        self._monotonic = monotonic
        self._is_public = is_public
        self._lock = threading.Lock()
        self._looked: tuple[float, bytes] | None = None

    def may_read(self, address: str | None) -> bool:
        """Whether who asks from that address may read them."""
        if self._is_public:
            return True
        try:
            return address is not None and ip_address(address).is_loopback
        except ValueError:
            return False

    def text(self) -> bytes:
        """The metrics in Prometheus' text format, version 0.0.4."""
        with self._lock:
            at = self._monotonic()
            if self._looked is None or at - self._looked[0] >= LOOK_EVERY_S:
                registry = CollectorRegistry()
                registry.register(_Collector(list(_collected(self._watched, self._now()))))
                self._looked = at, generate_latest(registry)
            return self._looked[1]


class _Collector:
    """Hands out what was collected."""

    def __init__(self, found: Sequence[Metric]) -> None:
        self._found = found

    def collect(self) -> Iterator[Metric]:
        yield from self._found


def _collected(watched: Watched, now: datetime) -> Iterator[Metric]:
    role = "station" if watched.registry is None else "central"
    yield _gauge("vian_info", {(VERSION, role): 1.0}, ("version", "role"))
    if watched.registry is not None:
        refusals = CounterMetricFamily(
            "vian_sync_refusals", METRICS["vian_sync_refusals_total"], None, ["endpoint", "code"]
        )
        for key, count in sorted(watched.refused().items()):
            refusals.add_metric(key, count)
        yield refusals
    try:
        found = list(_of_log(watched, now))
    except LogUnavailable:
        yield _gauge("vian_log_available", {(): 0.0})
        return
    yield _gauge("vian_log_available", {(): 1.0})
    yield from found


def _of_log(watched: Watched, now: datetime) -> Iterator[Metric]:
    log = watched.log
    yield _gauge("vian_log_position", {(): log.head()})
    yield from _known("vian_disk_free_bytes", log.room.free())
    if watched.registry is not None:
        yield from _known("vian_disk_days_left", days_left(log))
        yield from _of_central(log, watched.registry, now)
        return
    try:
        yield from _of_station(log, watched.station, now)
    except PlanError:
        yield from _known("vian_disk_days_left", days_left(log))  # of a newer ViAn's; sync itself says it


def _of_station(log: Log, station: Station, now: datetime) -> Iterator[Metric]:
    view = station_view(log, station, now, load_plan(None))
    yield from _known("vian_disk_days_left", view.days_left)
    yield from _known("vian_sync_last_contact_seconds", view.last_contact_age_s)
    yield from _known("vian_sync_clock_offset_seconds", view.clock_offset_s)
    yield from _known("vian_sync_rate_bits_per_second", view.rate_bps)
    yield _gauge("vian_sync_failures", {(): view.failures})
    yield _gauge("vian_sync_paused", {(): view.is_paused})
    yield _gauge("vian_sync_checkpoint_signed", {(): view.signed})
    yield _gauge("vian_sync_checkpoint_countersigned", {(): view.countersigned or 0})
    rows = [
        (f"{each.stream}{f'@{each.epoch}' if each.epoch > 1 else ''}", each.events, each.bytes, each.lag_s, each)
        for each in view.streams
    ]
    yield _series("vian_sync_backlog_events", "stream", [(row[0], row[1]) for row in rows], STREAMS_MAX, sum)
    yield _series("vian_sync_backlog_bytes", "stream", [(row[0], row[2]) for row in rows], STREAMS_MAX, sum)
    yield _series("vian_sync_lag_seconds", "stream", [(row[0], row[3]) for row in rows], STREAMS_MAX, max)
    stopped = [(row[0], float(row[4].why_stopped is not None)) for row in rows]
    yield _series("vian_sync_stopped", "stream", stopped, STREAMS_MAX, max)


def _of_central(log: Log, registry: Registry, now: datetime) -> Iterator[Metric]:
    rows = [each for each in central_view(log, registry, now).stations if each.state != "unknown"]
    ages = [(each.station, each.last_contact_age_s) for each in rows if each.last_contact_age_s is not None]
    yield _series("vian_station_last_contact_seconds", "station", ages, STATIONS_MAX, max)
    behind = [(each.station, each.behind) for each in rows]
    yield _series("vian_station_behind_events", "station", behind, STATIONS_MAX, sum)
    missing = [(each.station, each.missing) for each in rows]
    yield _series("vian_station_missing_events", "station", missing, STATIONS_MAX, sum)
    yield _series("vian_station_lag_seconds", "station", [(e.station, e.lag_s) for e in rows], STATIONS_MAX, max)
    revoked = [(each.station, float(each.state == "revoked")) for each in rows]
    yield _series("vian_station_revoked", "station", revoked, STATIONS_MAX, max)


def _series(
    name: str,
    label: str,
    values: Sequence[tuple[str, float]],
    most: int,
    joined: Callable[[Sequence[float]], float],
) -> Metric:
    """A gauge with one label; of more values than `most`, the rest is one."""
    shown: dict[tuple[str, ...], float] = {(each,): value for each, value in values[:most]}
    if rest := [value for _, value in values[most:]]:
        shown[OTHERS,] = joined(rest)
    return _gauge(name, shown, (label,))


def _known(name: str, value: float | None) -> Iterator[Metric]:
    """A gauge, where its value is known."""
    if value is not None:
        yield _gauge(name, {(): value})


def _gauge(name: str, values: Mapping[tuple[str, ...], float], labels: Sequence[str] = ()) -> Metric:
    family = GaugeMetricFamily(name, METRICS[name], labels=list(labels))
    for key, value in values.items():
        family.add_metric(key, float(value))
    return family
