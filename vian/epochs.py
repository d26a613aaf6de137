"""Epochs of a station: when its log must begin a new one, so that it is not taken for the log that it replaces.

Contract: a log that holds events is moved to a new epoch only by who asks for it, an empty one at enrolment. Whether a
log must is found by comparing what central holds with what is here; nothing here or there is changed or lost.
"""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from datetime import datetime

import httpx

from events import Station
from store import Log
from store.embedded import EmbeddedServer
from store.epochs import begin_epoch, life_of
from sync.errors import HeadsDisagree
from sync.protocol.wire import STREAMS_MAX, Cursor, HelloAnswer
from sync.runs import StreamKey, end_of
from sync.station.client import Greeting, Link
from sync.station.comparing import check_beyond, is_open
from sync.station.outbox import check_history
from vian.peers import Peer
from vian.tls import AGAIN, station_context

CONNECT_SECONDS = 10.0

Database = AbstractContextManager[tuple[str, EmbeddedServer | None]]
"""Of `vian.options.bare_database`."""


def compare(log: Log, station: Station, peer: Peer, now: datetime) -> tuple[HelloAnswer, list[HeadsDisagree]]:
    """What central says that it holds of the station, and where that cannot be of this log's history.

    In protocol 1 it says so of the streams here alone.

    Raises:
        CentralError: It does not answer, or refuses.
        LogUnavailable: The database is away.
    """
    context = station_context(peer.certificate)
    with httpx.Client(base_url=peer.address, timeout=CONNECT_SECONDS, verify=context) as client:
        link = peer.link(client, AGAIN)
        own = [] if link.knows_all else [head for head in log.streams() if head.stream.station == station]
        answer = link.hello(Greeting(station, log.epoch, now, own[:STREAMS_MAX], None, None))
        return answer, _disagreements(log, station, answer.cursors, link)


def _disagreements(log: Log, station: Station, cursors: Iterable[Cursor], link: Link) -> list[HeadsDisagree]:
    here = {StreamKey(head.stream, head.epoch): head for head in log.streams() if head.stream.station == station}
    found = []
    for cursor in cursors:
        there = end_of([run.run() for run in cursor.runs])
        try:
            if cursor.key in here:
                check_history(log, here[cursor.key], there)
                if is_open(here[cursor.key], there, log.epoch):
                    check_beyond(link, here[cursor.key])
            elif cursor.epoch >= log.epoch:
                raise HeadsDisagree(*cursor.key, there.sequence, None, there.chain_hash)
        except HeadsDisagree as error:
            found.append(error)
    return found


def settle_epoch(open_database: Callable[[], Database], station: Station, epoch: int) -> tuple[int | None, str]:
    """The epoch in which the log of a station that was just enrolled goes on, and what to tell of it.

    A log that holds nothing yet begins the epoch that central names. Where central holds nothing of the station, any
    log will do, and none is opened.

    Args:
        open_database: Opens the station's database, with nobody connected.
        station: Its name.
        epoch: Behind all of which central holds events of the station; 0: it holds none.

    Raises:
        BadRequest: The log is in use.
        LogUnavailable: The database is away, or the role is not the log's owner.
    """
    if not epoch:
        return None, ""
    with open_database() as (dsn, _):
        life = life_of(dsn)
        if life.has_events:
            return life.epoch, (
                f"central holds events of {station}, and this log holds events too: it stays in epoch {life.epoch}. "
                "vian sync doctor says whether they are of one history; if they are not: vian station new-epoch. "
            )
        if life.epoch < epoch:
            begin_epoch(dsn, epoch)
    own = max(life.epoch, epoch)
    return own, f"central holds earlier events of {station}, and this log is empty: it is in epoch {own} from now on. "
