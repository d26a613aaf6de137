"""Further work of a daemon, done a piece at a time when nothing live waits.

Contract: a chore that has nothing to do is asked again when the log has grown or after a while. One that fails is
told in the daemon's status and asked again as late; the others, and sync, go on.
"""

from collections.abc import Sequence
from datetime import datetime

from events import EventError
from store import LogUnavailable, StoreError
from sync.errors import SyncError
from sync.protocol.reports import Chore


class Chores:
    """The chores of one daemon, in turn."""

    def __init__(self, chores: Sequence[Chore]) -> None:
        self._chores = list(chores)
        self._busy = list(chores)
        self._notes: dict[int, str] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Why some could not be done."""
        return tuple(self._notes.values())

    def wake(self) -> None:
        """Ask all of them again."""
        self._busy = list(self._chores)

    def step(self, now: datetime) -> bool:
        """Let the next one that may have something to do do a piece; whether there was one.

        Raises:
            LogUnavailable: The database is away.
        """
        if not self._busy:
            return False
        chore = self._busy.pop(0)
        try:
            has_more = chore.step(now)
        except LogUnavailable:
            raise
        except (SyncError, EventError, StoreError) as error:
            self._notes[id(chore)] = str(error)
            return True
        self._notes.pop(id(chore), None)
        if has_more:
            self._busy.append(chore)
        return True
