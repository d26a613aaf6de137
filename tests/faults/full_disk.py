"""A disk that fills under load, and has room again: appends wait, and nothing acknowledged is lost."""

import time
from pathlib import Path

from store import open_log, verify
from tests.faults.load import WAIT_S, Process, append_until_killed, opened
from tests.store.disks import fill

QUIET_S = 2.0
"""An appender that acknowledges nothing for so long waits for room."""


def fill_and_free(disk: Path, seed: int) -> list[str]:
    """What was wrong when the disk filled under load and had room again; nothing if all was well."""
    data_dir = disk / "log"
    open_log(data_dir=data_dir).close()
    with opened(data_dir) as log:
        appender = Process(append_until_killed, data_dir, seed)
        try:
            acknowledged = appender.said()
            ballast = fill(disk, leave_mib=1)
            begun = time.monotonic()
            while appender.pipe.poll(QUIET_S):
                acknowledged = appender.said()
                if isinstance(acknowledged, str):
                    return [acknowledged]
                if time.monotonic() - begun > WAIT_S:
                    return ["the disk never filled"]
            ballast.unlink()
            for _ in range(3):
                acknowledged = appender.said()
                if isinstance(acknowledged, str):
                    return [acknowledged]
        finally:
            appender.close()
        found = log.with_retry(lambda: verify(log))
        wrong = [str(each) for each in found.broken]
        for stream, sequence in acknowledged.items():
            if (stored := log.stream_head(stream).sequence) < sequence:
                wrong.append(f"{stream}: acknowledged up to {sequence}, stored to {stored}")
    return wrong
