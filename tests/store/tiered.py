"""A log whose every segment is sealed as soon as it was appended: what holds for a log must hold for this one."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from store import Appended, Log, Transaction
from store.sealing import Sealer


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


def tiered(log: Log, folder: Path) -> Log:
    """The same handle on the log, which seals from now on."""
    log.__class__ = TieredLog
    assert isinstance(log, TieredLog)
    log.folder, log.lock = folder, threading.Lock()
    return log
