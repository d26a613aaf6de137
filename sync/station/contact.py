"""Contact with central: when it was last, what went wrong since, how long to pause.

Contract: pauses double with each failure up to a bound, and are shortened by up to half at random, so that many
stations do not come back at once. What only a person can change is asked for at the longest pause; a refusal counts as
such from the second in a row on, because the link may have garbled the first.
"""

from collections.abc import Callable
from datetime import datetime

from store import LogUnavailable
from sync.errors import NotAuthorised, PlanError, ProtocolMismatch, SessionOver, SyncError
from sync.protocol.reports import Pace


class Contact:
    """How it stands with central."""

    def __init__(self, pace: Pace, now: Callable[[], datetime], random: Callable[[], float]) -> None:
        self._pace = pace
        self._now = now
        self._random = random
        self._was_refused = False
        self.failures = 0
        """Failed steps since something last went well."""
        self.last_error: str | None = None
        self.last: datetime | None = None
        """When central answered last."""
        self.clock_offset_s: float | None = None
        """How far central's clock was ahead at the last hello."""

    def answered(self) -> None:
        """Central has answered."""
        self.last = self._now()
        self._was_refused = False

    def greeted(self, asked: datetime, central_time: datetime) -> None:
        """Central has answered a hello."""
        self.answered()
        self.clock_offset_s = (central_time - asked).total_seconds()

    def went_well(self) -> None:
        """Something was acknowledged, or nothing is left to do."""
        self.failures = 0
        self.last_error = None

    def pause_after(self, error: SyncError | LogUnavailable) -> float:
        """Seconds to wait after the failure."""
        self.failures += 1
        self.last_error = str(error)
        if isinstance(error, SessionOver) and self.failures == 1:
            return 0.0
        if self._is_lasting(error):
            pause = self._pace.backoff_s_max
        else:
            pause = min(self._pace.backoff_s_max, self._pace.backoff_s * 2 ** min(self.failures - 1, 30))
        return pause * (0.5 + self._random() / 2)

    def _is_lasting(self, error: SyncError | LogUnavailable) -> bool:
        """Whether only a person can change what is wrong."""
        was_refused, self._was_refused = self._was_refused, isinstance(error, NotAuthorised | ProtocolMismatch)
        return isinstance(error, PlanError) or (was_refused and self._was_refused)
