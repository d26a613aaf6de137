"""The processes of a station and of central that sync until they are killed, and what they say of it.

Contract: each says something on its pipe as soon as it does its work, and goes on through whatever
happens to its database or its link. Their clocks are files that say how far they are off.
"""

import contextlib
import logging
import os
import random
import socket
import threading
import time
from datetime import UTC, datetime, timedelta
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import httpx
import uvicorn
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fastapi import FastAPI

from events import StreamName, station_name
from store import Appender, Log, LogUnavailable, Signer, StationKey, StoreError
from sync import Daemon, Limits, Pace, Plan, Step, router
from sync.central.access import Access
from sync.keeping.countersigning import is_countersigned
from sync.keeping.pruning import Pruner
from sync.plans.deriving import Deriver, DerivingChore
from sync.plans.planning import planned_in
from sync.protocol.enrolment import new_secret
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import PATH
from sync.station.client import Central
from tests.faults.load import WAIT_S, frames, opened, persistently
from tests.store.samples import NOON, PRODUCER
from vian.tls import station_context

STATION = station_name("brno")
SOURCES = ("gate", "yard", "roof")
STREAMS = tuple(StreamName.of(STATION, source, "track_point") for source in SOURCES)
FILTERED = StreamName.of(STATION, "door", "track_point")
"""Only what a filter leaves of it is sent."""
CENTRAL = station_name("central")
CENTRAL_KEY = StationKey(Ed25519PrivateKey.from_private_bytes(bytes(32)))
DIVISORS = (2, 3)
PLANS = tuple(
    Plan.of({"entries": [{"stream": "*/door/*", "where": f"frame % {n} = 0"}, {"stream": "*/*/*"}]}) for n in DIVISORS
)
"""Each sends every second, or third, event of one stream, and all of the others."""
PRUNE_AFTER = timedelta(seconds=20)
"""Longer than between a backup of central and its restore, as the docs ask for."""
SIGN_EVERY_S = 0.5
BATCH_MAX = 5
APPEND_EVERY_S = 0.05
"""Pause between two appends: the load must leave room for what is tried."""
ANSWER_S_MAX = 0.7
"""Longest wait of the daemon for an answer."""
PACE = Pace(20_000, 3000, in_flight=2, backoff_s=0.005, backoff_s_max=0.04, idle_s=1.0)
"""Small requests and short pauses, so that there are many requests to hit."""

_LOOK_EVERY_S = 0.05


def clock(offset_file: Path) -> datetime:
    """What the clock shows that is as far off as the file says, in seconds."""
    try:
        offset = float(offset_file.read_text() or 0)
    except FileNotFoundError:
        offset = 0.0
    return datetime.now(UTC) + timedelta(seconds=offset)


def append_slowly(data_dir: Path, seed: int, say: Connection) -> None:
    """Append to all streams, a little at a time, and say where each stands once it is acknowledged."""
    choose = random.Random(seed)
    with _open(data_dir) as log:
        appender = Appender(log, PRODUCER, wait_s=WAIT_S)
        streams = (*STREAMS, FILTERED)
        heads = {stream: persistently(log, lambda s=stream: log.stream_head(s)).sequence for stream in streams}
        say.send(dict(heads))
        while True:
            batches = []
            for stream in choose.sample(streams, choose.randint(1, len(streams))):
                first, last = heads[stream] + 1, heads[stream] + choose.randint(1, BATCH_MAX)
                batches.append((stream, frames(first, last, NOON + timedelta(milliseconds=first))))
                heads[stream] = last
            try:
                appender.append(batches)
            except StoreError as error:
                say.send(f"the appender gave up: {error}")
                return
            say.send(dict(heads))
            time.sleep(APPEND_EVERY_S)


def sync_until_killed(data_dir: Path, address: str, pinned: str | None, seed: int, say: Connection) -> None:
    """Run the station's daemon against central's address, and say of each step what it did, and its error."""
    context = station_context(pinned)
    with _open(data_dir) as log, httpx.Client(base_url=address, timeout=ANSWER_S_MAX, verify=context) as client:
        key = station_key(log.epoch)

        def made() -> Daemon:
            planned = planned_in(log, STATION)
            return Daemon(
                log,
                STATION,
                PLANS[0] if planned is None else planned.plan,
                Central(client, RequestSigner(key, STATION, CENTRAL_KEY.id, PATH)),
                now=lambda: clock(data_dir / "clock"),
                random=random.Random(seed).random,
                pace=PACE,
                chores=(Signing(log, key), DerivingChore(Deriver(log, STATION)), Pruning(log)),
                central_key=CENTRAL_KEY.public,
            )

        def tell(step: Step) -> None:
            say.send((step.did, f"{type(step.error).__name__}: {step.error}" if step.error else None))

        persistently(log, made).run(threading.Event(), tell)


class Signing:
    """Signs the station's log now and then, so that there is something to countersign."""

    def __init__(self, log: Log, key: StationKey) -> None:
        self._signer = Signer(log, STATION, lambda: key, lambda: NOON)
        self._next_at = 0.0

    def step(self, now: datetime) -> bool:
        """Sign what is new, if it is time."""
        if time.monotonic() > self._next_at:
            self._signer.sign()
            self._next_at = time.monotonic() + SIGN_EVERY_S
        return False


class Pruning:
    """Takes payloads off the station's log that central countersigned, by a clock that does not jump."""

    def __init__(self, log: Log) -> None:
        self._pruner = Pruner(log, STATION, PRUNE_AFTER, lambda event: is_countersigned(event, CENTRAL_KEY.public))

    def step(self, now: datetime) -> bool:
        """Take off what may go."""
        return self._pruner.step(datetime.now(UTC))


def station_key(epoch: int) -> StationKey:
    """The key of the machine that is the station in that epoch."""
    return StationKey(Ed25519PrivateKey.from_private_bytes(bytes([epoch] * 32)))


def serve_until_killed(data_dir: Path, port: int, tls_port: int, pem: Path, say: Connection) -> None:
    """Serve central over the log, in the clear and over TLS, and say when it listens."""
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)  # what it finds strange is what we send
    with _open(data_dir) as log:
        access = Access(log, CENTRAL, CENTRAL_KEY, now=lambda: clock(data_dir / "clock"))
        persistently(log, access.registry.recover)

        def serve(at: int, **more: Any) -> None:
            listening = socket.create_server(("127.0.0.1", at))
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            app = FastAPI()
            limits = Limits(idle_s_max=2.0)
            app.include_router(router(log, None, limits, now=lambda: clock(data_dir / "clock"), access=access))
            config = uvicorn.Config(app, log_config=None, lifespan="off", ws="none", **more)
            threading.Thread(target=uvicorn.Server(config).run, args=([listening],), daemon=True).start()

        serve(port)
        serve(tls_port, ssl_certfile=pem, ssl_keyfile=pem)
        threading.Thread(target=_keep, args=(log,), daemon=True).start()
        say.send("ready")
        _end_with(say)


def invite(log: Log) -> bytes:
    """The secret of a code by which the station enrols at central."""
    now = datetime.now(UTC)
    registry, secret = Access(log, CENTRAL, CENTRAL_KEY, now=lambda: now).registry, new_secret()
    registry.invite(STATION, secret, ("replicate",), (), now + timedelta(days=10_000))
    return secret


def _open(data_dir: Path) -> Log:
    """The log, once its database is there: it may be recovering, or its disk full."""
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return opened(data_dir)
        except LogUnavailable:
            if time.monotonic() > deadline:
                raise
        time.sleep(_LOOK_EVERY_S)


def _end_with(say: Connection) -> None:
    """End when whoever began this is gone: it says nothing any more, and would not notice."""
    with contextlib.suppress(EOFError, OSError):
        say.recv()
    os._exit(0)


def _keep(log: Log) -> None:
    """Start central's database again whenever it died, as the parts of `vian serve` do."""
    while True:
        with contextlib.suppress(LogUnavailable):
            persistently(log, log.head)
        time.sleep(_LOOK_EVERY_S)
