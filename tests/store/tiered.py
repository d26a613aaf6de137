"""A log whose every segment is sealed as soon as it was appended: what holds for a log must hold for this one."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from store import Log, Transaction
from store.sealing import Sealer


def seal_all(log: Log, folder: Path, file_bytes: int = 2_000) -> None:
    """Seal everything that the log holds, in files of about so many bytes."""
    sealer = Sealer(log, str(folder), file_bytes=file_bytes)
    sealer.resume()
    list(sealer.seal(datetime.now(UTC) + timedelta(days=2)))


class TieredLog(Log):
    """Seals what each transaction appended, when it has committed."""

    folder: Path

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        with super().transaction() as transaction:
            yield transaction
        seal_all(self, self.folder)


def tiered(log: Log, folder: Path) -> TieredLog:
    """Another handle on the log, that seals."""
    handle = TieredLog(log.dsn, log.catalogue)
    handle.folder = folder
    return handle
