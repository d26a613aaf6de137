"""Where a station stands with central, as an operator wants to see it: from its log and what its daemon said last.

Contract: reads the log and asks nobody, so it answers offline and whether the daemon runs or not. What waits is
counted by what central held when the daemon last heard of it; where central lacks some behind the newest that it
holds, these are taken to be the oldest. Only what waits is looked at, not what central has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from events import CheckpointSigned, Station, StreamName
from store import Log, StreamHead, health
from store.sizes import Part, Size, sizes
from sync.keeping.countersigning import newest_countersigned
from sync.keeping.gone import gone_in, told_at_station
from sync.plans.deriving import CHECKPOINT as DERIVED
from sync.plans.entries import base_of, derived_name
from sync.plans.plan import Plan
from sync.plans.planning import planned_in
from sync.plans.preview import record_bytes
from sync.protocol.reports import Status, StreamStatus, saved_status
from vian.log_checks import GROWTH_LEAST, GROWTH_WINDOW
from vian.output import counted

SILENT_S = 1200.0
"""A daemon says something at least every 15 minutes, when it says hello; one that did not for so long is not there."""


@dataclass(frozen=True, slots=True)
class StreamView:
    """Where one stream stands that the plan sends."""

    stream: StreamName
    epoch: int
    priority: int
    sequence: int
    """newest event here"""
    at_central: int | None
    """newest event at central; None where that is not known"""
    events: int
    """how many wait to be sent"""
    bytes: int
    """of their records"""
    is_exact: bool
    """counted, not estimated of sealed files"""
    lag_s: float
    """how long ago the oldest of them was recorded, s; 0 where none waits"""
    eta_s: float | None
    """when central has them at the measured rate, with all that goes before them, s; None where it is not known"""
    why_stopped: str | None
    is_apart: bool = False
    """it is of an earlier epoch of which central holds another history: it stays here, and nothing of it waits"""


@dataclass(frozen=True, slots=True)
class StationView:
    """Where the station stands."""

    station: Station
    central: str | None
    state: str
    """the daemon's, when it last said; `no daemon yet`, or `silent` where it said nothing for long"""
    said_age_s: float | None
    """how long ago the daemon said so, s"""
    is_paused: bool
    last_contact_at: datetime | None
    last_contact_age_s: float | None
    clock_offset_s: float | None
    """how far central's clock was ahead at the last hello, s"""
    protocol: int | None
    rate_bps: float | None
    failures: int
    last_error: str | None
    other_daemons: int
    countersigned: int | None
    """newest checkpoint that central countersigned"""
    signed: int
    """newest checkpoint that this station signed"""
    days_left: float | None
    """until the disk is full at the present rate; None where that cannot be told"""
    notes: tuple[str, ...]
    streams: tuple[StreamView, ...]
    """by priority"""

    @property
    def events(self) -> int:
        """How many wait in all."""
        return sum(each.events for each in self.streams)

    @property
    def bytes(self) -> int:
        """Bytes of all that waits."""
        return sum(each.bytes for each in self.streams)

    @property
    def lag_s(self) -> float:
        """How long the oldest that waits has waited, s."""
        return max((each.lag_s for each in self.streams), default=0.0)

    @property
    def eta_s(self) -> float | None:
        """When central has everything, s; None where that is not known."""
        etas = [each.eta_s for each in self.streams if each.why_stopped is None]
        known = [eta for eta in etas if eta is not None]
        return max(known, default=0.0) if len(known) == len(etas) else None


def station_view(log: Log, station: Station, now: datetime, default: Plan) -> StationView:
    """Where the station stands.

    Args:
        log: The station's log.
        station: Its name.
        now: Its clock.
        default: The plan that counts where the log names none.

    Raises:
        LogUnavailable: The database is away.
        PlanError: The plan in the log does not read here.
    """
    planned = planned_in(log, station)
    plan = default if planned is None else planned.plan
    status = saved_status(log)
    _, heads = log.heads(station)
    own = [head for head in heads if head.sequence]
    said_age = None if status is None or status.saved_at is None else _age(status.saved_at, now)
    return StationView(
        station=station,
        central=status.central if status else (planned.central or None if planned else None),
        state=_state(status, said_age),
        said_age_s=said_age,
        is_paused=plan.paused,
        last_contact_at=status.last_contact if status else None,
        last_contact_age_s=_age(status.last_contact, now) if status and status.last_contact else None,
        clock_offset_s=status.clock_offset_s if status else None,
        protocol=status.protocol if status else None,
        rate_bps=status.rate_bps if status else None,
        failures=status.failures if status else 0,
        last_error=status.last_error if status else None,
        other_daemons=status.other_daemons if status else 0,
        countersigned=newest_countersigned(log, station),
        signed=_newest_sequence(own, CheckpointSigned.type_name) or 0,
        days_left=days_left(log),
        notes=(
            *map(told_at_station, gone_in(log, station, station)),
            *(status.notes if status else ()),
            *_unmade(log, own, plan),
        ),
        streams=tuple(_streams(log, own, plan, status, now)),
    )


def days_left(log: Log) -> float | None:
    """Days until the log's disk is full at the rate of the last days; None where that cannot be told yet, or seen."""
    free = log.room.free()
    grown = health.growth(log, GROWTH_WINDOW) if free is not None else None
    if free is None or grown is None or grown.over < GROWTH_LEAST:
        return None
    return max(0, free - log.room.bytes_min) / max(1.0, grown.bytes_per_day)


def _state(status: Status | None, said_age_s: float | None) -> str:
    if status is None:
        return "no daemon yet"
    return "silent" if said_age_s is None or said_age_s > SILENT_S else status.state


def _newest_sequence(heads: Sequence[StreamHead], type_name: str) -> int | None:
    return max((head.sequence for head in heads if head.stream.type == type_name), default=None)


def _streams(
    log: Log, heads: Sequence[StreamHead], plan: Plan, status: Status | None, now: datetime
) -> list[StreamView]:
    """The streams that the plan sends, by priority, each with what waits and when that is done."""
    said = {(each.stream, each.epoch): each for each in (status.streams if status else ())}
    entries = [(head, entry) for head in heads if (entry := plan.entry_for(head.stream)) is not None]
    parts = [_waiting(head, said.get((head.stream, head.epoch)), entry.since) for head, entry in entries]
    found = iter(sizes(log, [part for each in parts for part in each]))
    sized = [sum((next(found) for _ in each), Size()) for each in parts]
    views = [
        _stream(head, entry.priority, said.get((head.stream, head.epoch)), size, now)
        for (head, entry), size in zip(entries, sized, strict=True)
    ]
    views.sort(key=lambda view: (view.priority, view.stream, view.epoch))
    rates = [rate for rate in (status.rate_bps if status else None, plan.rate_bps) if rate]
    return _with_times(views, min(rates) if status and status.rate_bps else None)


def _unmade(log: Log, heads: Sequence[StreamHead], plan: Plan) -> list[str]:
    """What cannot be counted yet, because it is filtered first."""
    made = log.checkpoints()
    streams = {head.stream for head in heads if base_of(head.stream) is None}
    entries = [(stream, entry) for stream in streams if (entry := plan.chosen(stream)) and entry.sends]
    count = sum(e.is_derived and f"{DERIVED}{derived_name(stream, e)}" not in made for stream, e in entries)
    if not count:
        return []
    noun = counted(count, "stream")
    return [
        f"of {noun} the plan sends what a filter leaves, which vian sync makes, also without central, and counts then"
    ]


def _waiting(head: StreamHead, said: StreamStatus | None, since: datetime | None) -> list[Part]:
    """Which parts of a stream central lacks."""
    if said is not None and said.is_apart:
        return []
    cursor = (said.cursor or 0) if said else 0
    parts = [Part(head.stream, head.epoch, since, after=cursor)] if head.sequence > cursor else []
    lacking = max(0, (said.backlog or 0) - max(0, said.sequence - cursor)) if said and cursor else 0
    return [Part(head.stream, head.epoch, since, until=lacking), *parts] if lacking else parts


def _stream(head: StreamHead, priority: int, said: StreamStatus | None, size: Size, now: datetime) -> StreamView:
    return StreamView(
        stream=head.stream,
        epoch=head.epoch,
        priority=priority,
        sequence=head.sequence,
        at_central=said.cursor if said else None,
        events=size.events,
        bytes=record_bytes(head.stream, size),
        is_exact=size.is_exact,
        lag_s=_age(size.recorded_from, now) if size.recorded_from else 0.0,
        eta_s=None,
        why_stopped=said.error if said else None,
        is_apart=said is not None and said.is_apart,
    )


def _with_times(views: Sequence[StreamView], rate_bps: float | None) -> list[StreamView]:
    """The streams with the time until each is at central, if more urgent ones go first."""
    timed, before = [], 0
    for view in views:
        if view.why_stopped is None:
            before += view.bytes
        eta = 0.0 if not view.events else None if rate_bps is None else before * 8 / rate_bps
        timed.append(replace(view, eta_s=None if view.why_stopped else eta))
    return timed


def _age(then: datetime, now: datetime) -> float:
    return max(0.0, (now - then).total_seconds())
