"""The station's side of replication: plan and daemon from the settings."""

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import httpx
import structlog

from events import station_name
from store import Log
from sync.checking import check_filters
from sync.client_v1 import CentralV1
from sync.daemon import Daemon
from sync.deadlines import bounded
from sync.deriving import Deriver, DerivingChore
from sync.plan import Plan
from sync.planning import planned_in
from sync.reports import Pace, Step
from sync.rotation import take_turns
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part

logger = structlog.get_logger()

REQUEST_SECONDS_MAX = 30.0
PACE = Pace(in_flight=2)
"""One request is answered while the next one travels."""
DEFAULT_PLAN = (
    {"stream": "*/*/situation_detected", "priority": "situations"},
    {"stream": "*/*/rule_deployed", "priority": "situations"},
    {"stream": "*/*/rule_retired", "priority": "situations"},
    # What the points that follow rest on goes before them, and what says that there are no more, behind.
    {"stream": "*/*/video_added", "priority": "situations"},
    {"stream": "*/*/process_started", "priority": "situations"},
    {"stream": "*/*/process_finished", "priority": "media"},
    {"stream": "*/*/process_failed", "priority": "media"},
    {"stream": "*/*/track_ended", "priority": "tracks"},
    {"stream": "*/*/*", "priority": "points"},
)
"""What a station sends that was given no plan: everything, situations first."""


def load_plan(path: Path | None) -> Plan:
    """The plan of the file, or the default one."""
    return Plan.load(path) if path is not None else Plan.of({"entries": list(DEFAULT_PLAN)}, "default plan")


def plan_at_start(log: Log, station: str, path: Path | None, now: Callable[[], datetime] = utc_now) -> Plan:
    """The plan with which a station begins: the file's, else the one that its log names last, else the default one.

    Raises:
        PlanError: The file says none, or one with a filter that does not fit its types, or the log's plan does not
            read here.
    """
    planned = planned_in(log, station_name(station))
    if path is None and planned is not None:
        return planned.plan
    plan = load_plan(path).resolved(now(), planned.plan if planned else None)
    check_filters(plan, log.catalogue)
    return plan


@contextmanager
def station_daemon(
    log: Log,
    station: str,
    central: str,
    token: str,
    plan: Plan,
    now: Callable[[], datetime] = utc_now,
    transport: httpx.BaseTransport | None = None,
) -> Iterator[Daemon]:
    """A daemon that sends the station's streams to central, for the length of the block.

    Args:
        log: The station's log.
        station: Name of the station.
        central: Address of the central server.
        token: The station's token.
        plan: Which streams, in which order.
        now: The station's clock.
        transport: Carries the requests; over the network by default.

    Raises:
        WrongUsage: The address is not one of HTTP, or the log is another station's.
    """
    if not _is_address(central):
        raise WrongUsage(f"central must be an address such as http://central.example:8470, got {central!r}")
    stations = sorted({head.stream.station for head in log.streams()})
    if stations and station not in stations:
        raise WrongUsage(
            f"this log has no streams of station {station}, but of {', '.join(stations[:5])}. "
            f"Next: give --station {stations[0]} if central knows that name, else vian station add {stations[0]} "
            f"there; or extract with --station {station}"
        )
    with httpx.Client(base_url=central, timeout=REQUEST_SECONDS_MAX, transport=transport) as client:
        if transport is None:
            take_turns(client)
        bounds = bounded(client)
        deriver = Deriver(log, station_name(station))
        try:
            link = CentralV1(client, token)
            chores = (DerivingChore(deriver),)
            yield Daemon(
                log, station_name(station), plan, link, now=now, random=random.random, pace=PACE, chores=chores
            )
        finally:
            deriver.close()
            bounds.abort()


def _is_address(text: str) -> bool:
    try:
        url = httpx.URL(text)
    except httpx.InvalidURL:
        return False
    return url.scheme in ("http", "https") and bool(url.host)


def sync_part(daemon: Daemon) -> Part:
    """The daemon as a supervised part; a failure that lasts is logged once."""
    told: list[str] = []

    def tell(step: Step) -> None:
        if step.error is not None and told != [str(step.error)]:
            told[:] = [str(step.error)]
            logger.warning("sync waits", error=str(step.error))
        elif step.did == "sent" and told:
            told.clear()
            logger.info("sync goes on")

    return Part("sync", lambda stop: daemon.run(stop, tell))
