"""A log whose every segment is sealed as soon as it was appended: what holds for a log must hold for this one."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from store import Appended, Log, Transaction
from store.sealing import Sealer

_SEAL_EVERY_S = 0.05
_FILE_BYTES = 200_000


def seal_all(log: Log, folder: Path, file_bytes: int = 2_000) -> None:
    """Seal everything that the log holds, in files of about so many bytes."""
    sealer = Sealer(log, str(folder), file_bytes=file_bytes)
    sealer.resume()
    list(sealer.seal(datetime.now(UTC) + timedelta(days=2)))


class TieredLog(Log):
    """Seals what each transaction appended, when it has committed."""

    folder: Path
    lock: threading.Lock

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        with super().transaction() as transaction:
            yield transaction
        with self.lock:
            seal_all(self, self.folder)

    def append(self, *given: Any, **more: Any) -> list[Appended]:
        appended = super().append(*given, **more)
        with self.lock:
            seal_all(self, self.folder)
        return appended


@contextmanager
def sealing_meanwhile(log: Log) -> Iterator[None]:
    """Seal a tiered log again and again beside what is done inside; with another kind of log, do nothing."""
    if not isinstance(log, TieredLog):
        yield
        return
    stop = threading.Event()

    def seal() -> int:
        sealer = Sealer(log, str(log.folder), file_bytes=_FILE_BYTES)
        files = 0
        while not stop.wait(_SEAL_EVERY_S):
            for _ in sealer.seal(datetime.now(UTC) + timedelta(days=2)):
                files += 1
                if stop.is_set():
                    break
        return files

    with ThreadPoolExecutor(1) as pool:
        sealing = pool.submit(seal)
        try:
            yield
        finally:
            stop.set()
        assert sealing.result() > 1, "no files were sealed meanwhile"


def tiered(log: Log, folder: Path) -> Log:
    """The same handle on the log, which seals from now on."""
    log.__class__ = TieredLog
    assert isinstance(log, TieredLog)
    log.folder, log.lock = folder, threading.Lock()
    return log
