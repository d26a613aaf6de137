"""The station's side of replication: plan and daemon from the settings."""

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import httpx
import structlog

from events import station_name
from store import Log
from sync.plans.checking import check_filters
from sync.plans.deriving import Deriver, DerivingChore
from sync.plans.plan import Plan
from sync.plans.planning import planned_in
from sync.protocol.reports import Pace, Step
from sync.station.daemon import Daemon
from sync.station.deadlines import bounded
from sync.station.rotation import take_turns
from sync.station.unreachable import GOES_ON
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part
from vian.peers import Peer
from vian.settings import Settings
from vian.tls import station_context

logger = structlog.get_logger()

REQUEST_SECONDS_MAX = 30.0
PACE = Pace(in_flight=2)
"""One request is answered while the next one travels; what the settings say by default."""
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


def pace_of(settings: Settings) -> Pace:
    """How much a daemon sends at a time, as the settings say."""
    return replace(
        PACE,
        request_bytes=settings.sync_request_kb_max * 1024,
        latency_s=settings.sync_latency_s,
        in_flight=settings.sync_in_flight,
        hello_s=settings.sync_hello_s,
    )


@contextmanager
def station_daemon(
    log: Log,
    station: str,
    peer: Peer,
    plan: Plan,
    now: Callable[[], datetime] = utc_now,
    transport: httpx.BaseTransport | None = None,
    pace: Pace = PACE,
    afterwards: str = GOES_ON,
) -> Iterator[Daemon]:
    """A daemon that sends the station's streams to central, for the length of the block.

    Args:
        log: The station's log.
        station: Name of the station.
        peer: The central server.
        plan: Which streams, in which order.
        now: The station's clock.
        transport: Carries the requests; over the network by default.
        pace: How much at a time.
        afterwards: What becomes of it when central is back, for messages.

    Raises:
        WrongUsage: The log is another station's.
    """
    stations = sorted({head.stream.station for head in log.streams()})
    if stations and station not in stations:
        raise WrongUsage(
            f"this log has no streams of station {station}, but of {', '.join(stations[:5])}. "
            f"Next: give --station {stations[0]} if central knows that name, else vian station invite {stations[0]} "
            f"there; or extract with --station {station}"
        )
    context = station_context(peer.certificate)
    with httpx.Client(
        base_url=peer.address, timeout=REQUEST_SECONDS_MAX, verify=context, transport=transport
    ) as client:
        if transport is None:
            take_turns(client, context, pace.in_flight + 1)  # one for what is live
        bounds = bounded(client)
        deriver = Deriver(log, station_name(station))
        try:
            yield Daemon(
                log,
                station_name(station),
                plan,
                peer.link(client, afterwards),
                now=now,
                random=random.random,
                pace=pace,
                central_key=peer.public_key,
                chores=(DerivingChore(deriver),),
            )
        finally:
            deriver.close()
            bounds.abort()


def sync_part(daemon: Daemon) -> Part:
    """The daemon as a supervised part, which tells the program's log what an operator should know."""
    telling = Telling(daemon)
    return Part("sync", lambda stop: daemon.run(stop, telling))


class Telling:
    """Tells the program's log of a failure that lasts, and of another daemon beside this one: once each."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._error: str | None = None
        self._others = 0

    def __call__(self, step: Step) -> None:
        """Take in what a step was."""
        for each in step.gone:
            logger.error("payload gone here and at central", range=each, next="vian sync status")
        if step.error is not None and self._error != str(step.error):
            self._error = str(step.error)
            logger.warning("sync waits", error=self._error)
        elif step.did == "sent" and self._error is not None:
            self._error = None
            logger.info("sync goes on")
        if (others := self._daemon.other_daemons) != self._others:
            self._others = others
            self._tell_others()

    def _tell_others(self) -> None:
        if self._others:
            advice = "stop all vian sync and vian serve of this station but one"
            logger.warning("another daemon runs for this station too", count=self._others, next=advice)
        else:
            logger.info("no other daemon runs for this station any more")
