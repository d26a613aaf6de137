"""Repair at the command line: the link to central, and what is asked of whom."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import httpx

from events import StreamName, station_name
from store import Log, verify
from store.keys import load_key
from sync.keeping.gone import Gone, accept, gone_in
from sync.keeping.repair import (
    Damage,
    Repaired,
    Repairer,
    Wanted,
    damaged_headers,
    damaged_payloads,
    hollow_payloads,
)
from sync.station.client import Central, Greeting
from vian.clock import utc_now
from vian.errors import WorldFailed
from vian.membership import load_membership
from vian.replication import REQUEST_SECONDS_MAX
from vian.settings import Settings
from vian.signatures import key_path
from vian.tls import AGAIN, station_context

SEQUENCE_MAX = 2**63 - 1


@contextmanager
def central_link(log: Log, settings: Settings) -> Iterator[Central]:
    """Central, as this enrolled station speaks with it in a session of its own.

    Raises:
        WorldFailed: The station is not enrolled.
        SyncError: Central cannot be reached, or refuses.
    """
    membership = load_membership(settings)
    if membership is None:
        raise WorldFailed("this station is enrolled at no central. Next: vian station enrol CODE --central URL")
    context = station_context(membership.certificate)
    with httpx.Client(base_url=membership.address, timeout=REQUEST_SECONDS_MAX, verify=context) as client:
        link = Central(client, membership.signer(load_key(key_path(settings))), afterwards=AGAIN)
        link.hello(Greeting(station_name(settings.station), log.epoch, utc_now(), (), None, None, wants_cursors=False))
        yield link


def repair_damages(log: Log, settings: Settings) -> Iterator[Repaired]:
    """Repair this log's own streams from central; what is damaged of others is asked of the stations.

    Raises:
        WorldFailed: Something of the station's own is damaged, and it is not enrolled.
        SyncError: Central cannot be reached, or refuses.
    """
    own = station_name(settings.station)
    damaged = [*damaged_payloads(log), *damaged_headers(log, verify(log).broken)]
    foreign = _first_each(each for each in damaged if each.stream.station != own)
    if any(each.stream.station == own for each in damaged):
        with central_link(log, settings) as link:
            repairer = Repairer(log, own, link.read, "central", utc_now)
            yield from repairer.repair_all(only=own)
    yield from _asked(log, foreign)


def bring_back(
    log: Log, settings: Settings, stream: StreamName, epoch: int | None, first: int, last: int
) -> Iterator[Repaired]:
    """Bring back from central the payloads of a stream that left the disk; of another station's stream, ask that.

    Raises:
        WorldFailed: The station is not enrolled.
        SyncError: Central cannot be reached, or refuses.
    """
    gone = list(hollow_payloads(log, stream, first, last, epoch))
    if not gone:
        return
    if stream.station != station_name(settings.station):
        yield from _asked(log, gone)
        return
    with central_link(log, settings) as link:
        repairer = Repairer(log, station_name(settings.station), link.read, "central", utc_now)
        for damage in gone:
            yield repairer.repair(damage)


def note_lost(
    log: Log, settings: Settings, stream: StreamName | None, epoch: int | None, first: int, last: int
) -> list[Gone]:
    """Note in central's own log that what is gone here and at its station is in no backup; which it is.

    The stations are asked for it no more.

    Args:
        log: Central's log.
        settings: Whose log it is.
        stream: Only of this stream.
        epoch: Only of this life of it.
        first: Only what lies from this sequence on.
        last: Only what lies up to this sequence.

    Raises:
        LogUnavailable: The database is away.
    """
    own = station_name(settings.station)
    found = [
        Gone(each.stream, each.epoch, max(first, each.first_sequence), min(last, each.last_sequence))
        for each in gone_in(log, own)
        if stream in (None, each.stream) and epoch in (None, each.epoch) and each.stream.station != own
        if each.first_sequence <= last and each.last_sequence >= first
    ]
    accept(log, own, found, utc_now())
    if found:
        Wanted(log).forget(lambda wanted: any(_holds(each, wanted) for each in found))
    return found


def _asked(log: Log, damages: Sequence[Damage]) -> Iterator[Repaired]:
    """Ask the stations for what is theirs, as far as there is room for it."""
    left_out = {each.position for each in Wanted(log).ask(damages)} if damages else set()
    for each in damages:
        if each.position in left_out:
            why = (
                f"station {each.stream.station} is not asked for it yet: as many segments as may be are asked for "
                "already. Next: the same again once stations sent some; vian sync status names who is silent"
            )
        else:
            why = f"station {each.stream.station} is asked for it at its next hello"
        yield Repaired(each, 0, why)


def _holds(gone: Gone, wanted: Damage) -> bool:
    """Whether a segment that is wanted lies in what is gone."""
    is_there = gone.first_sequence <= wanted.first_sequence <= gone.last_sequence
    return is_there and (gone.stream, gone.epoch) == (wanted.stream, wanted.epoch)


def _first_each(damages: Iterator[Damage]) -> Sequence[Damage]:
    """The damages, one a position."""
    return list({each.position: each for each in reversed(list(damages))}.values())[::-1]
