"""What derived streams still wait for of their bases: what may not be taken off the disk, and what has been already.

Contract: reads only. A derived stream waits for the segments of its base behind its checkpoint, but for those that
lie wholly before its `from`. What was pruned of them can come back from central; what the log records as lost is
waited for no more, though a backup may bring it back.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime

from events import Segment, Station, StreamName
from store import Log
from store.absence import pruned_segments
from store.reading import DERIVE
from sync.errors import PlanError
from sync.plans.entries import Entry, base_of, derived_name
from sync.plans.plan import Plan
from sync.plans.planning import planned_in


@dataclass(frozen=True, slots=True)
class Waiting:
    """From where on a derived stream waits for its base."""

    stream: StreamName
    position: int
    """of the log, up to which its base was read"""
    since: datetime | None
    """what happened before is not wanted"""

    def wants(self, position: int, time_max: datetime) -> bool:
        """Whether it waits for a segment of its base at a position."""
        return position > self.position and (self.since is None or time_max >= self.since)


Awaited = Mapping[StreamName, Waiting]
"""By base."""


@dataclass(frozen=True, slots=True)
class Missing:
    """Events of a base that a derived stream waits for and that were pruned; without a gap."""

    base: StreamName
    stream: StreamName
    epoch: int
    first_sequence: int
    last_sequence: int

    def __str__(self) -> str:
        where = f"from sequence {self.first_sequence} to {self.last_sequence} of epoch {self.epoch}"
        return f"{self.base} was pruned {where}: {self.stream} is stopped there until they are back. {next_of(self)}"


def next_of(missing: Missing) -> str:
    """What to do about it."""
    return (
        f"Next: vian sync repair --stream {missing.base} --epoch {missing.epoch} --from {missing.first_sequence} "
        f"--to {missing.last_sequence} brings them back from central, and it goes on by itself; or give the entry a "
        "from behind them, for central has them in the stream itself"
    )


def awaited(log: Log, station: Station) -> Awaited:
    """What the streams wait for that the plan in the log derives.

    Raises:
        PlanError: The log's plan does not read here.
        LogUnavailable: The database is away.
    """
    planned = planned_in(log, station)
    if planned is None or not any(entry.is_derived for entry in planned.plan.entries):
        return {}
    return awaited_by(log, station, planned.plan)


def awaited_by(log: Log, station: Station, plan: Plan) -> Awaited:
    """What the streams would wait for that a plan derives.

    Raises:
        LogUnavailable: The database is away.
    """
    made = log.checkpoints()
    found = {}
    for base in sorted({head.stream for head in log.streams() if head.stream.station == station and head.sequence}):
        entry = plan.chosen(base) if base_of(base) is None else None
        name = _derived(base, entry) if entry is not None and entry.is_derived else None
        if entry is not None and name is not None:
            checkpoint = made.get(f"{DERIVE}{name}")
            found[base] = Waiting(name, 0 if checkpoint is None else checkpoint.position, entry.since)
    return found


def _derived(base: StreamName, entry: Entry) -> StreamName | None:
    try:
        return derived_name(base, entry)
    except PlanError:
        return None  # it cannot be filtered, and nothing waits


def missing(log: Log, wanted: Awaited, bases: Collection[StreamName] | None = None) -> Iterator[Missing]:
    """What was pruned of what derived streams wait for, as ranges, by base.

    Args:
        log: The log.
        wanted: What is waited for.
        bases: Only of these.

    Raises:
        ChainBroken, EventError: A record, or a segment, cannot be read.
        LogUnavailable: The database is away.
    """
    for base, waiting in wanted.items():
        if bases is None or base in bases:
            yield from ranges(waiting, base, pruned_segments(log, base))


def ranges(waiting: Waiting, base: StreamName, segments: Iterator[Segment]) -> Iterator[Missing]:
    """The segments that are waited for, as ranges."""
    at: Missing | None = None
    for segment in segments:
        header = segment.header
        if not waiting.wants(segment.position, header.time_max):
            continue
        first, last, epoch = int(header.first_sequence), int(header.last_sequence), int(header.epoch)
        if at is not None and (at.epoch, at.last_sequence + 1) == (epoch, first):
            first = at.first_sequence
        elif at is not None:
            yield at
        at = Missing(base, waiting.stream, epoch, first, last)
    if at is not None:
        yield at
