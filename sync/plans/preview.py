"""What a plan would mean, before it is set: how much would travel, how long that takes, and what changes.

Contract: it reads the station's log and asks nobody, so it works offline. What central holds is what the daemon
last heard; without that, everything counts as to be sent. Segments that travel as they are stored are counted to
the byte of the protocol's records; what a filter will leave is estimated from a sample, and marked so, and so is what
lies in sealed files.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from events import EventError, Header, Producer, Segment, Station, StreamName, decode, header_bytes
from events import Sequence as SequenceNumber
from events.segment import encode_payload
from store import Log, StreamHead
from store.reading import Filter
from store.sizes import Part, Size, sizes
from sync.errors import FilterFailed, PlanError
from sync.plans.awaiting import Awaited, awaited_by, missing
from sync.plans.changes import Change, changes_of
from sync.plans.checking import warnings_of
from sync.plans.deriving import CHECKPOINT, SEGMENT_EVENTS
from sync.plans.entries import Entry, base_of, derived_name
from sync.plans.filtering import Sieve, database, joined
from sync.plans.plan import Plan
from sync.protocol.reports import Status

SAMPLE_SEGMENTS = 16
RECORD_BYTES = 121
"""What a record of protocol 2 has besides header and payload."""


@dataclass(frozen=True, slots=True)
class Held:
    """What central holds of one stream."""

    ranges: tuple[tuple[int, int], ...]
    """of sequences: behind the first number, up to the second"""
    since: datetime | None = None
    """only segments with an event at or after this time"""


AllHeld = Mapping[tuple[StreamName, int], Held]
"""What central holds of each stream and epoch."""
_NOTHING = Held(())


@dataclass(frozen=True, slots=True)
class EntryPreview:
    """What one entry means."""

    number: int
    entry: Entry
    streams: int
    segments: int
    events: int
    bytes: int
    """of records, as they would travel"""
    is_exact: bool
    """counted, not estimated"""
    seconds: float | None
    """at the rate that is known and the limits of plan and entry; None without a rate"""
    problems: tuple[str, ...]
    """why something of it cannot be told or sent"""


@dataclass(frozen=True, slots=True)
class Preview:
    """What a plan means."""

    entries: tuple[EntryPreview, ...]
    rate_bps: float | None
    seconds: float | None
    """for all of it, the entries sharing the link; None without a rate"""
    staying: int
    """streams that stay at the station"""
    changes: tuple[Change, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Sample:
    """What a filter leaves of a sample of a stream."""

    share: float
    """of the events"""
    bytes_per_event: float


def preview(
    log: Log, station: Station, plan: Plan, present: Plan | None, held: AllHeld, rate_bps: float | None
) -> Preview:
    """What a plan would mean for a station's log as it is now.

    Args:
        log: The station's log.
        station: Whose streams they are.
        plan: The plan, resolved.
        present: The plan that counts now, if any.
        held: What central holds, as far as is known.
        rate_bps: Bits a second that the link carries; None if unknown.

    Raises:
        LogUnavailable: The database is away.
    """
    head, heads = log.heads(station)
    own = [each for each in heads if each.sequence]
    bases = [each for each in own if base_of(each.stream) is None]
    by_entry: dict[int, list[StreamHead]] = {number: [] for number in range(len(plan.entries))}
    staying = 0
    for each in bases:
        entry = plan.chosen(each.stream)
        if entry is not None and entry.sends:
            by_entry[plan.entries.index(entry)].append(each)
        else:
            staying += 1
    awaited = awaited_by(log, station, plan)
    looked = _Look(log, head, {(each.stream, each.epoch): each for each in own}, held, awaited)
    limit = _least(rate_bps, plan.rate_bps) if rate_bps is not None else None
    entries = tuple(looked.entry(n, plan.entries[n], chosen, limit) for n, chosen in by_entry.items())
    looked.close()
    total = None if limit is None else max([sum(e.bytes for e in entries) * 8 / limit, *_times(entries)])
    changes = tuple(changes_of(present, plan, sorted({each.stream for each in bases})))
    return Preview(entries, rate_bps, total, staying, changes, tuple(warnings_of(plan)))


def held_by(status: Status | None, present: Plan | None) -> dict[tuple[StreamName, int], Held]:
    """What central holds, by what the daemon said last of the streams of the present plan.

    Where central lacks some behind its newest event, these are taken to be the oldest.
    """
    held = {}
    for each in status.streams if status is not None else ():
        if each.cursor:
            lacking = max(0, (each.backlog or 0) - (each.sequence - each.cursor))
            entry = None if present is None else present.entry_for(each.stream)
            since = None if entry is None or entry.is_derived else entry.since
            held[each.stream, each.epoch] = Held(((lacking, each.cursor),), since)
    return held


class _Look:
    """Looks at a log for one preview."""

    def __init__(
        self,
        log: Log,
        head: int,
        heads: Mapping[tuple[StreamName, int], StreamHead],
        held: AllHeld,
        awaited: Awaited,
    ) -> None:
        self._log = log
        self._head = head
        self._heads = heads
        self._held = held
        self._awaited = awaited
        self._runs = database()
        self._checkpoints = log.checkpoints()

    def close(self) -> None:
        self._runs.close()

    def entry(self, number: int, entry: Entry, chosen: Sequence[StreamHead], limit: float | None) -> EntryPreview:
        """What an entry means for the streams that come to it."""
        problems: list[str] = []
        streams = {head.stream for head in chosen}
        if not entry.is_derived:
            found = self._sized([(head.stream, head.epoch) for head in chosen], entry.since)
        else:
            found = sum((self._derived(base, chosen, entry, problems) for base in sorted(streams)), _Sized())
        seconds = None if limit is None else found.bytes * 8 / _least(limit, entry.rate_bps)
        size = found.size
        return EntryPreview(
            number,
            entry,
            len(streams),
            size.segments,
            size.events,
            found.bytes,
            size.is_exact,
            seconds,
            tuple(problems),
        )

    def _sized(self, places: Sequence[tuple[StreamName, int]], since: datetime | None) -> "_Sized":
        known = [self._held.get(place, _NOTHING) for place in places]
        parts = [Part(*place, since, held.ranges, held.since) for place, held in zip(places, known, strict=True)]
        found = sizes(self._log, parts)
        return sum(
            (_Sized(each, record_bytes(place[0], each)) for place, each in zip(places, found, strict=True)), _Sized()
        )

    def _derived(self, base: StreamName, chosen: Sequence[StreamHead], entry: Entry, problems: list[str]) -> "_Sized":
        """What a filter leaves of a stream: counted where it has been made already, else estimated."""
        try:
            name = derived_name(base, entry)
            problems += [str(each) for each in missing(self._log, self._awaited, [base])]
            if self._is_made(base, name):
                return self._sized([place for place in self._heads if place[0] == name], None)
            sample = self._sampled(base, entry)
        except (PlanError, EventError, FilterFailed) as error:
            problems.append(f"{base}: {error}")
            return _Sized(Size(is_exact=False))
        whole = [Part(head.stream, head.epoch, entry.since) for head in chosen if head.stream == base]
        before = sum(sizes(self._log, whole), Size()).events
        held = sum(
            last - after for (stream, _), each in self._held.items() if stream == name for after, last in each.ranges
        )
        events = max(0, round(before * sample.share) - held)
        size = Size(-(-events // SEGMENT_EVENTS), events, round(events * sample.bytes_per_event), 0, is_exact=False)
        return _Sized(size, record_bytes(name, size))

    def _is_made(self, base: StreamName, name: StreamName) -> bool:
        """Whether all that the base stream holds has been filtered already."""
        made = self._checkpoints.get(f"{CHECKPOINT}{name}")
        if made is None:
            return False
        wanted = Filter([base.type], [base.source], [base.station])
        return made.position >= self._head or not self._log.page(made.position + 1, self._head, wanted, 1)

    def _sampled(self, base: StreamName, entry: Entry) -> _Sample:
        """What the filter leaves of segments from all over the stream."""
        sieve = Sieve(entry, self._log.catalogue.newest(base.type), self._runs)
        batches = [decode(segment, self._log.catalogue) for segment in self._sample(base, entry.since)]
        if not batches:
            return _Sample(0.0, 0.0)
        passed = [kept for batch in batches if (kept := sieve.passed(batch)) is not None]
        events = sum(map(len, passed))
        if not events:
            return _Sample(0.0, 0.0)
        return _Sample(events / max(1, sum(map(len, batches))), len(encode_payload(joined(passed))) / events)

    def _sample(self, base: StreamName, since: datetime | None) -> Iterator[Segment]:
        wanted = Filter([base.type], [base.source], [base.station], since=since)
        last = 0
        for number in range(SAMPLE_SEGMENTS):
            first = max(last + 1, 1 + self._head * number // SAMPLE_SEGMENTS)
            for segment in self._log.page(first, self._head, wanted, 1):
                last = segment.position
                yield segment


@dataclass(frozen=True, slots=True)
class _Sized:
    """A size, and the bytes of its records."""

    size: Size = field(default_factory=Size)
    bytes: int = 0

    def __add__(self, other: "_Sized") -> "_Sized":
        return _Sized(self.size + other.size, self.bytes + other.bytes)


def record_bytes(stream: StreamName, size: Size) -> int:
    """Bytes of the records of segments of a stream."""
    header = len(header_bytes(Header(stream, 0, SequenceNumber(1), 1, 1, _TIME, _TIME, Producer("", "", bytes(32)))))
    return size.segments * (RECORD_BYTES + header) + size.payload_bytes + size.producer_bytes


_TIME = datetime.fromisoformat("2026-01-01T00:00:00+00:00")


def _least(rate: float, limit: int | None) -> float:
    return rate if limit is None else min(rate, limit)


def _times(entries: Sequence[EntryPreview]) -> list[float]:
    return [entry.seconds for entry in entries if entry.seconds is not None]
