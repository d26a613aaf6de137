"""Central as this station may ask it, from what enrolment left here."""

from collections.abc import Iterator
from contextlib import contextmanager

import httpx

from events import station_name
from store import Log
from sync.station.asking import Desk
from sync.station.client import Central, Greeting
from sync.station.deadlines import bounded
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.membership import Membership, load_membership, station_key
from vian.settings import Settings
from vian.tls import AGAIN, station_context

_CONNECT_SECONDS = 10.0
_ANSWER_SECONDS = 60.0
"""Longer than central spends on a question by default."""


def enrolment(settings: Settings) -> Membership:
    """What enrolment left here; who asks does so as the station that was taken in, whatever the host's name.

    Raises:
        WrongUsage: No central server took this station in.
    """
    membership = load_membership(settings, is_any=True)
    if membership is None:
        raise WrongUsage(
            "this station belongs to no central server that it could ask. "
            "Next: vian station enrol CODE --central URL, with the code that vian station invite makes there; "
            "on central itself, the same command without --central"
        )
    return membership


@contextmanager
def central_desk(
    log: Log, settings: Settings, membership: Membership, transport: httpx.BaseTransport | None = None
) -> Iterator[Desk]:
    """The central server that took this station in, for the length of the block.

    Raises:
        WrongUsage: There is no key to sign questions with.
    """
    station = station_name(membership.station)

    def greeting() -> Greeting:
        return Greeting(station, log.epoch, utc_now(), heads=(), believed=None, checkpoint=None, wants_cursors=False)

    signer = membership.signer(station_key(settings))
    timeout = httpx.Timeout(_ANSWER_SECONDS, connect=_CONNECT_SECONDS)
    context = station_context(membership.certificate)
    with httpx.Client(base_url=membership.address, timeout=timeout, verify=context, transport=transport) as client:
        bounds = bounded(client)
        try:
            yield Desk(Central(client, signer, afterwards=AGAIN), greeting)
        finally:
            bounds.abort()
