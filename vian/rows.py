"""The row tables' upkeep as the settings want it, for a command and for a server.

Contract: what upkeep does is logged; that queries were in the way is no error, it tries again.
"""

import threading
from collections import Counter
from datetime import UTC, datetime

import structlog

from store import Log, RowPolicy, maintain
from vian.errors import WrongUsage
from vian.parts import Part, stepping
from vian.settings import Settings

logger = structlog.get_logger()


def row_policy(log: Log, settings: Settings) -> RowPolicy:
    """What the settings want upkeep to see to.

    Raises:
        WrongUsage: They name an event type that is not known.
    """
    unknown = sorted(name for name in settings.rows_keep_days_by_type if name not in log.catalogue)
    if unknown:
        known = ", ".join(sorted(event_type.type_name for event_type in log.catalogue))
        raise WrongUsage(f"setting rows_keep_days_by_type: no event type {unknown[0]!r}; known: {known}")
    return RowPolicy(
        keep_days=settings.rows_keep_days,
        keep_days_by_type=settings.rows_keep_days_by_type,
        ahead_days=settings.rows_ahead_days,
        close_after_h=settings.rows_close_after_h,
    )


def upkeep_part(log: Log, settings: Settings) -> Part:
    """A part that sees to the row tables now and then; in a thread of its own, for an index may take minutes."""
    policy = row_policy(log, settings)

    def run(stop: threading.Event) -> None:
        stepping("row upkeep", lambda: _once(log, policy, stop, settings.rows_upkeep_s), log).run(stop)

    return Part("row upkeep", run)


def _once(log: Log, policy: RowPolicy, stop: threading.Event, pause_s: float) -> None:
    ahead = Counter[str]()
    for done in maintain(log, policy, datetime.now(UTC)):
        if done.action == "made":
            ahead[done.type] += done.partitions
        else:
            logger.info("row upkeep", action=done.action, type=done.type, day=str(done.day), partitions=done.partitions)
        if stop.is_set():
            break
    if ahead:  # a line for each of thirty tables says no more
        logger.info("row upkeep", action="made", types=len(ahead), partitions=ahead.total())
    stop.wait(pause_s)
