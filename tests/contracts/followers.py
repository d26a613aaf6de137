"""Subscriptions that the tests watch, and what they bring."""

import threading

from events import Segment
from store import Log, Subscription

WAIT_S = 60.0
"""Longest wait for something that a correct log does at once."""


class Watched(Subscription):
    """A subscription that tells when it listens and waits."""

    def __init__(self, log: Log, name: str) -> None:
        super().__init__(log, name)
        self.waiting = threading.Event()

    def _wait(self, seconds: float) -> None:
        if self._listening is not None:
            self.waiting.set()
        super()._wait(seconds)


def drained(subscription: Subscription) -> list[Segment]:
    """All that is there now."""
    segments: list[Segment] = []
    while True:
        delivery = subscription.poll()
        segments += delivery.segments
        assert subscription.position == delivery.position
        if delivery.is_caught_up:
            return segments
