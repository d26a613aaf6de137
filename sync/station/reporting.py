"""Saves a daemon's status in its log, where other processes read it.

Contract: at each change of state, and every few seconds while it is at work. A daemon that finds another's status in
the place of its own, which it had saved, knows that two run for one station. A log that is away is no error here.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import datetime

from store import Log, LogUnavailable
from sync.errors import WireError
from sync.protocol.reports import CHECKPOINT, State, Status

SAVE_EVERY_S = 5.0
_OTHERS_S = 120.0
"""How long another daemon counts as running after it was seen."""


class Reporter:
    """Saves the status of the daemon of that name."""

    def __init__(self, log: Log, name: str, now: Callable[[], datetime], monotonic: Callable[[], float]) -> None:
        self._log = log
        self._name = name
        self._now = now
        self._monotonic = monotonic
        self._saved: tuple[float, State, str | None] | None = None
        self._others: dict[str, float] = {}
        self.others = 0
        """Other daemons that were seen to run for this station of late."""

    def report(self, state: State, error: str | None, status: Callable[[], Status], *, is_at_work: bool) -> None:
        """Save the status if it is time.

        Args:
            state: The daemon's state.
            error: What went wrong last.
            status: Makes the status.
            is_at_work: Something was done that changes the status.
        """
        at = self._monotonic()
        if self._saved is not None:
            is_same = self._saved[1:] == (state, error)
            if is_same and not (is_at_work and at - self._saved[0] >= SAVE_EVERY_S):
                return
        with suppress(LogUnavailable):  # The next step meets the same, and says it.
            self._save(status(), at)
            self._saved = at, state, error

    def _save(self, status: Status, at: float) -> None:
        position = self._log.head()  # before: whoever holds a connection in a transaction must not wait for another
        with self._log.transaction() as transaction:
            before = _read(transaction.checkpoint(CHECKPOINT).state)
            if before is not None and before.daemon != self._name and self._saved is not None:
                self._others[before.daemon] = at
            self.others = sum(at - seen < _OTHERS_S for seen in self._others.values())
            saved = replace(status, saved_at=self._now(), daemon=self._name, other_daemons=self.others)
            transaction.save_checkpoint(CHECKPOINT, position, saved.to_json())


def _read(state: bytes) -> Status | None:
    try:
        return Status.from_json(state) if state else None
    except WireError:
        return None  # of another release
