"""A station's daemon as a process of its own, to be killed: python -m tests.sync.station_process DSN URL."""

import random
import sys
import threading

import httpx

from events import load_catalogue
from store import Log
from sync import Daemon, Pace
from tests.sync.conftest import BRNO, EVERYTHING, NOON, signed_link


def main(dsn: str, url: str) -> None:
    pace = Pace(request_bytes=2000, backoff_s=0.01, backoff_s_max=0.1)
    with Log(dsn, load_catalogue()) as log, httpx.Client(base_url=url) as client:
        daemon = Daemon(
            log, BRNO, EVERYTHING, signed_link(client), now=lambda: NOON, random=random.Random(2).random, pace=pace
        )

        def tell(step: object) -> None:
            sys.stdout.write(f"{getattr(step, 'did', '')}\n")
            sys.stdout.flush()

        daemon.run(threading.Event(), tell)


if __name__ == "__main__":
    main(*sys.argv[1:])
