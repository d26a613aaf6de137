"""Supervised parts: the long-running pieces of a server or of the demo, each in a thread.

Contract: a part runs until it is told to stop. `stepping` makes one of a function that does one
bounded thing: a database that is away is waited for, with back-off. Any other error stops the
whole, and is raised where `Parts.check` or the end of the block is reached. Nothing is swallowed.
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import structlog

from store import Log, LogUnavailable

logger = structlog.get_logger()

_BACKOFF_SECONDS_MIN = 0.1
_BACKOFF_SECONDS_MAX = 5.0
_JOIN_SECONDS = 30.0


@dataclass(frozen=True, slots=True)
class Part:
    """One long-running piece of work."""

    name: str
    run: Callable[[threading.Event], None]
    """works until the event is set, and then returns within about a second"""
    close: Callable[[], None] = lambda: None


def stepping(name: str, step: Callable[[], object], log: Log, close: Callable[[], None] = lambda: None) -> Part:
    """A part that steps again and again, and waits for the log's database when it is away.

    Args:
        name: Name of the part.
        step: Does one bounded thing; waits at most about a second for something to do.
        log: The log that it rests on.
        close: Called once at the end.
    """

    def run(stop: threading.Event) -> None:
        pause = _BACKOFF_SECONDS_MIN
        while not stop.is_set():
            try:
                step()
                pause = _BACKOFF_SECONDS_MIN
            except LogUnavailable as error:
                logger.warning("waits for the database", part=name, error=str(error))
                stop.wait(pause)
                pause = min(2 * pause, _BACKOFF_SECONDS_MAX)
                _revive(name, log)

    return Part(name, run, close)


def _revive(name: str, log: Log) -> None:
    try:
        log.revive()
    except LogUnavailable as error:
        logger.warning("the database does not come back yet", part=name, error=str(error))


class Parts:
    """Parts that run together until the block ends or one of them fails."""

    def __init__(self, parts: Iterable[Part]) -> None:
        self._parts = list(parts)
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._threads = [
            threading.Thread(target=self._run, args=(part,), name=f"vian-{part.name}", daemon=True)
            for part in self._parts
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(_JOIN_SECONDS)
        for part in self._parts:
            part.close()
        if error is None:
            self.check()

    def check(self) -> None:
        """Raise the error that stopped a part, if one did."""
        if self._failure is not None:
            raise self._failure

    def wait(self, seconds: float) -> bool:
        """Wait until a part fails or the time is up; whether all still run."""
        return not self._stop.wait(seconds)

    def stop(self) -> None:
        """Ask all parts to end."""
        self._stop.set()

    def _run(self, part: Part) -> None:
        try:
            part.run(self._stop)
        except BaseException as error:
            logger.error("stopped", part=part.name, error=str(error))
            self._failure = self._failure or error
            self._stop.set()
