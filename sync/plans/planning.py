"""The plan in the station's log: the newest event `sync_planned` is the one that counts.

Contract: a plan is set by appending an event to the stream `STATION/sync/sync_planned` of the station's own log,
unless it says what the newest says already; nothing else remembers it. A daemon that runs takes it up at its next
step. A plan that this program cannot read is an error, never another plan.
"""

from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime

from events import EventError, Producer, Station, StreamName, SyncPlanned, batch_of, decode, encode, events_of
from store import Log, SequenceConflict, StreamHead
from sync.errors import PlanError
from sync.plans.plan import Plan

PRODUCER = "sync"
PRODUCER_VERSION = "1"
_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class Planned:
    """A plan as the log has it."""

    plan: Plan
    central: str
    """address of the central server that it was set for; empty where none was known"""
    plan_hash: str
    """SHA-256 of the plan's canonical form, in hexadecimal"""
    time: datetime
    """when it was set, by the station's clock"""
    epoch: int
    sequence: int
    """place of the event in its stream"""


def plan_stream(station: Station) -> StreamName:
    """The stream that holds the station's plans."""
    return StreamName.of(station, "sync", SyncPlanned.type_name)


def planned_in(log: Log, station: Station) -> Planned | None:
    """The plan that the log names last; None where none was set yet.

    Raises:
        PlanError: It does not read here: a newer ViAn wrote it, or it is damaged.
        LogUnavailable: The database is away.
    """
    head = log.stream_head(plan_stream(station))
    lives = [head] if head.sequence else log.lives(head.stream)  # of before a restore
    return _planned_at(log, lives[-1]) if lives else None


def _planned_at(log: Log, head: StreamHead) -> Planned:
    place = f"the plan at {head.stream}/{head.sequence}"
    segment = next(log.read(head.stream, head.sequence, epoch=head.epoch), None)
    if segment is None:
        raise PlanError(f"{place} has left this station's disk. Next: vian sync plan set FILE")
    try:
        event = events_of(decode(segment, log.catalogue))[-1]
        assert isinstance(event, SyncPlanned)
        plan = Plan.parse(event.plan, place)
    except (EventError, PlanError) as error:
        raise PlanError(
            f"{place} does not read here: {error}. Next: upgrade ViAn if a newer one set it, else set it again with "
            "vian sync plan set FILE"
        ) from error
    return Planned(plan, event.central, event.plan_hash, event.time, head.epoch, head.sequence)


def set_plan(log: Log, station: Station, plan: Plan, central: str, now: datetime) -> Planned:
    """Set the plan, and say how the log has it; nothing is appended where the log says so already.

    Args:
        log: The station's log.
        station: Whose plan it is.
        plan: The plan; `from: now` in it becomes the time `now`.
        central: Address of the central server; empty where none is known.
        now: The station's clock.

    Raises:
        PlanError: It names no stream of this station, or a `from` lies ahead of the clock.
        SequenceConflict: Others set plans again and again at the same moment.
        LogUnavailable: The database is away.
    """
    if not any(entry.fits_station(station) for entry in plan.entries):
        raise PlanError(f"the plan names no stream of station {station}; write */... or {station}/... in an entry")
    for _ in range(_ATTEMPTS - 1):
        with suppress(SequenceConflict):
            return _set(log, station, plan, central, now)
    return _set(log, station, plan, central, now)


def _set(log: Log, station: Station, plan: Plan, central: str, now: datetime) -> Planned:
    stream = plan_stream(station)
    head = log.stream_head(stream)
    present = planned_in(log, station)
    plan = plan.resolved(now, present.plan if present else None)
    plan_hash = plan.plan_hash
    if present and (present.central, present.plan_hash) == (central, plan_hash.hex()):
        return present
    event = SyncPlanned(time=now, central=central, plan=plan.canonical(), plan_hash=plan_hash.hex())
    draft = encode(stream, batch_of([event]), Producer(PRODUCER, PRODUCER_VERSION, plan_hash))
    log.append([draft], [head.sequence], from_reserve=True)  # it may say what is given up on a full disk
    return Planned(plan, central, plan_hash.hex(), event.time, log.epoch, head.sequence + 1)
