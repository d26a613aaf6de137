"""Room on the log's disk: how much is left, and whether more may be recorded.

Contract: PostgreSQL must never meet a full disk, so recording stops while some room is left, says so, and goes on by
itself when there is room again. Between half of what must stay free and all of it, what was taken off the log is
counted as room too (`credit`): PostgreSQL uses it again before its files grow. It looks only where the disk can be
seen, that is at an embedded log's.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from store.errors import DiskNearlyFull

CREDIT = "disk"
"""Name of the checkpoint that says how much was taken off, and up to which position it was used again."""
_MIB = 2**20

Rows = Callable[[str, Mapping[str, Any]], list[tuple[Any, ...]]]


class Room:
    """The room on one log's disk.

    Args:
        rows: Asks the log's database.
        folder: Where the embedded log is; None where its disk cannot be seen.
        free: Tells the free bytes of a folder's disk.
    """

    def __init__(self, rows: Rows, folder: Path | None, free: Callable[[Path], int] | None = None) -> None:
        self._rows = rows
        self._folder = folder
        self._free = free or (lambda path: shutil.disk_usage(path).free)
        self.bytes_min = 0
        """What must stay free, in bytes; 0: nothing is asked of the disk."""

    def free(self) -> int | None:
        """Free bytes of the log's disk; None where it cannot be seen."""
        return None if self._folder is None else self._free(self._folder)

    def gains_by(self, folder: Path) -> bool:
        """Whether what goes from a folder gives room to the log's disk.

        Raises:
            OSError: The folder cannot be seen.
        """
        return self._folder is not None and folder.stat().st_dev == self._folder.stat().st_dev

    def is_low(self) -> bool:
        """Whether less is free than must stay."""
        free = self.free() if self.bytes_min else None
        return free is not None and free < self.bytes_min

    def credit(self) -> int:
        """Bytes that were taken off the log and not used again since; 0 where nothing was.

        Raises:
            LogUnavailable: The database is away.
        """
        rows = self._rows(
            "select c.state, (select coalesce(sum(octet_length(g.payload)), 0)::bigint from segments g "
            "where g.position > c.position) from checkpoints c where c.name = %(name)s",
            {"name": CREDIT},
        )
        return max(0, credit_of(rows[0][0]) - rows[0][1]) if rows else 0

    def require(self) -> None:
        """Nothing, if more may be recorded.

        Raises:
            DiskNearlyFull: It may not.
            LogUnavailable: The database is away.
        """
        free = self.free() if self.bytes_min else None
        if free is None or free >= self.bytes_min:
            return
        if free >= self.bytes_min // 2 and self.credit() > 0:
            return
        raise DiskNearlyFull(
            f"the disk of the log has {free // _MIB} MiB free, and {self.bytes_min // _MIB} MiB must stay free "
            "(setting disk_free_mb_min): nothing more is recorded. Next: make room on it, or say under give_up in the "
            "plan what may go first, and keep vian serve or vian sync running; what waits goes on by itself"
        )


def credit_state(credit: int) -> bytes:
    """What the checkpoint holds."""
    return json.dumps({"credit_bytes": credit}).encode()


def credit_of(state: bytes) -> int:
    """The credit that a checkpoint's state says."""
    return int(json.loads(state)["credit_bytes"]) if state else 0
