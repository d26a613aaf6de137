"""The shared appender as an installation's settings want it: what extractors that run for long append with.

Contract: one a process, and one process a journal; `store.shared` says what it promises.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from store import Journal, Log, SharedAppender
from store.shared import Limits
from vian.settings import Settings

JOURNAL = "journal.sqlite"


@contextmanager
def shared_appender(log: Log, settings: Settings) -> Iterator[SharedAppender]:
    """An appender with the settings' window and size, and a journal for outages, for the length of the block.

    Raises:
        LogUnavailable: The journal cannot be used, or another process uses it.
    """
    limits = Limits(window_s=settings.append_window_ms / 1000, events_max=settings.append_events_max)
    path = settings.journal if settings.journal is not None else settings.data_dir / JOURNAL
    with Journal(path) as journal, SharedAppender(log, limits=limits, journal=journal) as appender:
        yield appender
