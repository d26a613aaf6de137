"""The bell: wakes a daemon when its station's log grows.

Contract: what is appended behind the position that was looked at ends the `wait`, so nothing is missed between
looking and sleeping. It rings by the log's notifications, with the subscription's polling as the floor.
"""

import threading

from events import Station
from store import Log, LogUnavailable, Subscription

_WAIT_SECONDS = 0.5
"""Longest time until a `stop` that is set ends a wait."""


class Bell:
    """Wakes the daemon when the station's log grows; its subscription is made when first needed."""

    def __init__(self, log: Log, station: Station) -> None:
        self._log = log
        self._station = station
        self._subscription: Subscription | None = None

    def wait(self, position: int, seconds: float, stop: threading.Event) -> bool:
        """Sleep until the log has grown beyond a position, the time is up, or `stop` is set; whether it has grown."""
        try:
            if self._subscription is None:
                self._subscription = Subscription(self._log, "sync", stations=[self._station], limit=1)
            self._subscription.position = position
            while seconds > 0 and not stop.is_set():
                if self._subscription.poll(min(seconds, _WAIT_SECONDS)).segments:
                    return True
                seconds -= _WAIT_SECONDS
        except LogUnavailable:
            stop.wait(_WAIT_SECONDS)  # The step that follows meets the same, and reports it.
        return False

    def close(self) -> None:
        """Stop listening."""
        if self._subscription is not None:
            self._subscription.close()
