"""What takes payloads off this station's disk: pruner and disk watch from the settings, as a supervised part."""

import threading
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta

import structlog

from events import CheckpointCountersigned, EventError, station_name
from store import Log, LogUnavailable, StoreError
from sync.errors import PlanError
from sync.keeping.countersigned import is_countersigned
from sync.keeping.losses import DiskWatch
from sync.keeping.pruning import IsSigned, Proof, Pruner
from sync.plans.plan import GiveUp
from sync.plans.planning import planned_in
from vian.clock import utc_now
from vian.membership import load_membership
from vian.parts import Part, stepping
from vian.replication import load_plan
from vian.settings import Settings

logger = structlog.get_logger()

_PAUSE_SECONDS = 1.0
_REST_SECONDS = 60.0


def signed_by_central(settings: Settings) -> IsSigned:
    """Whether a countersigned checkpoint is signed by the central that took this station in; none is before it did."""
    membership = load_membership(settings)
    if membership is None:
        return lambda event: False
    key = membership.central_key

    def is_signed(event: CheckpointCountersigned) -> bool:
        return is_countersigned(event, key)

    return is_signed


def pruner_for(log: Log, settings: Settings, days: float) -> Pruner:
    """A pruner of what central holds and what is older than so many days."""
    return Pruner(log, station_name(settings.station), timedelta(days=days), signed_by_central(settings))


def disk_watch_for(log: Log, settings: Settings) -> DiskWatch:
    """A watch over the log's disk, with the policy of the plan that counts at each moment."""
    station = station_name(settings.station)

    def policy() -> Sequence[GiveUp]:
        planned = planned_in(log, station)
        return (load_plan(settings.plan) if planned is None else planned.plan).give_up

    return DiskWatch(log, station, policy, Proof(log, station, signed_by_central(settings)))


def disk_part(log: Log, settings: Settings) -> Part:
    """Makes room when the disk is nearly full, and takes off what is old and held by central."""
    days = settings.prune_after_days
    pruner = None if days is None else pruner_for(log, settings, days)
    return stepping("disk", DiskKeeper(disk_watch_for(log, settings), pruner, utc_now, _pause), log)


def _pause(seconds: float) -> None:
    threading.Event().wait(min(seconds, _PAUSE_SECONDS))


class DiskKeeper:
    """One bounded thing a call: room first, then what is old."""

    def __init__(
        self,
        watch: DiskWatch,
        pruner: Pruner | None,
        now: Callable[[], datetime],
        pause: Callable[[float], object],
    ) -> None:
        self._watch = watch
        self._pruner = pruner
        self._now = now
        self._pause = pause
        self._rests_until: datetime | None = None

    def __call__(self) -> None:
        """Do one thing, or wait a moment where there is nothing to do.

        Raises:
            LogUnavailable: The database is away.
        """
        now = self._now()
        try:
            if self._watch.step(now) or self._prune(now):
                return
        except LogUnavailable:
            raise
        except (StoreError, EventError, PlanError) as error:
            # Recording goes on; what cannot be taken off stays. Verification and the log say what is wrong.
            logger.error("nothing is taken off the disk", part="disk", error=str(error))
            self._rests_until = now + timedelta(seconds=_REST_SECONDS)
        self._pause(_PAUSE_SECONDS)

    def _prune(self, now: datetime) -> bool:
        if self._pruner is None or (self._rests_until is not None and now < self._rests_until):
            return False
        return self._pruner.step(now)
