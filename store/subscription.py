"""Subscriptions: a named reader that catches up, then follows live.

Contract: `poll` gives every segment that the filter lets through exactly in order of position,
each once per life of the subscription object; after a restart it begins behind the saved
checkpoint, so delivery is at least once, and exactly once in effect when output and
`save_checkpoint` share a transaction. Notifications only wake; polling is the floor.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import psycopg

from events import Segment
from store.errors import LogUnavailable
from store.log import Log
from store.reading import Filter

CHANNEL = "vian_log"
POLL_SECONDS = 1.0
"""Longest wait between two looks at the log, were a notification lost."""
DELIVERY_SEGMENTS = 200
_CONNECT_SECONDS = 15


@dataclass(frozen=True, slots=True)
class Delivery:
    """What a poll brought."""

    segments: list[Segment]
    position: int
    """The subscriber has seen all that it wants up to here; save this as its checkpoint."""
    is_caught_up: bool
    """Nothing was waiting behind this delivery when it was read."""


class Subscription:
    """A named reader of the log."""

    def __init__(
        self,
        log: Log,
        name: str,
        *,
        types: Sequence[str] | None = None,
        sources: Sequence[str] | None = None,
        stations: Sequence[str] | None = None,
        limit: int = DELIVERY_SEGMENTS,
    ) -> None:
        self._log = log
        self.name = name
        self._filter = Filter(types, sources, stations)
        self._limit = limit
        self._listening: psycopg.Connection[Any] | None = None
        checkpoint = log.checkpoint(name)
        self.position = checkpoint.position
        self.state = checkpoint.state

    def poll(self, timeout_s: float = 0.0) -> Delivery:
        """The next segments; waits up to `timeout_s` seconds for some when there are none.

        Raises:
            LogUnavailable: The database is away; the position is unchanged, poll again later.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            delivery = self._look()
            remaining = deadline - time.monotonic()
            if delivery.segments or remaining <= 0:
                self.position = delivery.position
                return delivery
            self._wait(min(remaining, POLL_SECONDS))

    def want(self, types: Sequence[str]) -> None:
        """Give only segments of these types from the next poll on."""
        self._filter = replace(self._filter, types=types)

    def close(self) -> None:
        """Stop listening."""
        if self._listening is not None:
            self._listening.close()
            self._listening = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _look(self) -> Delivery:
        head = self._log.head()
        segments = self._log.page(self.position + 1, head, self._filter, self._limit) if head > self.position else []
        if len(segments) == self._limit:
            return Delivery(segments, segments[-1].position, is_caught_up=False)
        return Delivery(segments, head, is_caught_up=True)

    def _wait(self, seconds: float) -> None:
        """Sleep until the log notifies or the time is up."""
        try:
            if self._listening is None or self._listening.closed:
                # A look follows before the next wait, so nothing between look and LISTEN is missed for long.
                self._listening = psycopg.connect(self._log.dsn, autocommit=True, connect_timeout=_CONNECT_SECONDS)
                self._listening.execute(f"listen {CHANNEL}")
                return
            for _ in self._listening.notifies(timeout=seconds, stop_after=1):
                pass
        except psycopg.OperationalError as error:
            self.close()
            raise LogUnavailable(f"the subscription {self.name} lost the database: {error}".strip()) from error
