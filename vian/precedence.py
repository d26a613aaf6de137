"""What goes first where both want the same processor: storing what stations send, before writing rows of it.

Contract: while something urgent runs, and shortly after, what can wait is held back; but not longer than its patience,
and from then on not at all until it has caught up. So rows are late by the patience at most, plus what they take.

Python's threads share one lock, and one PostgreSQL serves both: side by side each takes three times as long.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from store.subscription import Delivery

QUIET_SECONDS = 0.1
"""How long nothing urgent must have run: between two requests of a station that sends on and on is less."""


class Precedence:
    """Counts what is urgent, and holds back what can wait.

    Args:
        patience_s: How long what can wait is held back at most, in seconds.
        quiet_s: How long after the last urgent work.
    """

    def __init__(self, patience_s: float, quiet_s: float = QUIET_SECONDS) -> None:
        self._patience_s = patience_s
        self._quiet_s = quiet_s
        self._changed = threading.Condition()
        self._urgent = 0
        self._quiet_since = -float("inf")

    @contextmanager
    def urgent(self) -> Iterator[None]:
        """What runs in the block goes first."""
        with self._changed:
            self._urgent += 1
        try:
            yield
        finally:
            with self._changed:
                self._urgent -= 1
                self._quiet_since = time.monotonic()
                self._changed.notify_all()

    def yielding(self, step: Callable[[], Delivery]) -> Callable[[], Delivery]:
        """The step, held back while something urgent runs."""
        held_since: float | None = None

        def held() -> Delivery:
            nonlocal held_since
            now = time.monotonic()
            held_since = now if held_since is None else held_since
            self._wait_until_quiet(held_since + self._patience_s)
            delivery = step()
            if delivery.is_caught_up:
                held_since = None
            return delivery

        return held

    def _wait_until_quiet(self, deadline: float) -> None:
        with self._changed:
            while (now := time.monotonic()) < deadline:
                quiet_at = deadline if self._urgent else self._quiet_since + self._quiet_s
                if quiet_at <= now:
                    return
                self._changed.wait(min(quiet_at, deadline) - now)
