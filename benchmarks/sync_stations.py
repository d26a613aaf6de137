"""Many stations' daemons as tasks of one process: python -m benchmarks.sync_stations FOLDER LOG NAME ...

Contract: it sends what waits, says a line when central has that of each, and sends what waits then when it is told a
line. When central has everything of each it waits for another line, so that its own end is not timed.
"""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.sync_servers import membership
from store import load_key, open_log
from vian.peers import peer_by_membership
from vian.replication import load_plan, station_daemon
from vian.signatures import KEY_NAME


def main(folder: Path, log_name: str, names: list[str]) -> None:
    """Run the stations' daemons until they are done."""
    with ExitStack() as stack:
        log = stack.enter_context(open_log(data_dir=folder / log_name))
        key = load_key(folder / "station" / KEY_NAME)
        daemons = [
            stack.enter_context(
                station_daemon(log, name, peer_by_membership(membership(folder, name), key), load_plan(None))
            )
            for name in names
        ]
        pool = stack.enter_context(ThreadPoolExecutor(len(daemons)))
        list(pool.map(_drain, daemons))
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.readline()
        list(pool.map(_drain, daemons))
        sys.stdin.readline()


def _drain(daemon: Any) -> None:
    """Go on as an operator's daemon does, which says hello again after a lost connection."""
    while (step := daemon.step()).did != "nothing":
        if step.error is not None:
            print(step.error, file=sys.stderr)
            time.sleep(step.sleep_s)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
