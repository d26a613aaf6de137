"""Derived streams: what the filters of the plan leave of this station's streams, as streams of their own.

Contract: a derived stream `STATION/SOURCE~HASH/TYPE` has its own sequence and chain, and holds each event that its
filter lets through once, in the order of the stream that it comes from, from `from` on: whatever is killed when, in
whatever steps it was made, and also when its entry went out of the plan and came back. Another filter is another
stream, complete from its own `from`. What was derived and how far that goes commit together: the checkpoint
`derive:STREAM` is the log's position up to which the base stream was read. Its state says up to where the derived
stream was made of what the log held when the deriver took up the plan: that is backlog, what follows is live.

Who reads this log by position, as rules and queries do, gets no derived streams unless their source is named: the
events are there already (`store.reading.Filter`).

A deriver is stepped; a step reads one bounded page of the log. A base stream that cannot be filtered (a type unknown
here, a damaged segment, a condition that fails) stops its derived stream until the plan changes or the program is
started again, and the others go on. A segment whose payload was pruned stops it until the payload is back, and it
goes on by itself. One that the log records as lost is passed over: given up here, or pruned here and lost at central
since. Should a backup bring the latter back, this derived stream has passed it for good, for it keeps the order of its
base; another filter is another stream, and has it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from duckdb import DuckDBPyConnection

from events import Draft, EventBatch, EventError, EventType, Position, Producer, Segment, Station, StreamName, decode
from events.segment import draft_of, encode_payload
from store import ChainBroken, Checkpoint, Log, StreamHead
from store.absence import Absence, recorded
from store.reading import DERIVE, Filter
from sync.errors import FilterFailed, PlanError
from sync.plans.awaiting import Missing, Waiting, missing
from sync.plans.entries import Entry, base_of, derived_name
from sync.plans.filtering import Sieve, database, joined
from sync.plans.marks import mark_state
from sync.plans.plan import Plan
from sync.plans.planning import Planned, plan_stream, planned_in

CHECKPOINT = DERIVE
"""Begins the name of a derived stream's checkpoint."""
PRODUCER, PRODUCER_VERSION = "derive", "1"
PAGE_SEGMENTS = 200
PAGE_EVENTS = 50_000
PAGE_POSITIONS = 20_000
"""Most positions of the log that a step passes over."""
SEGMENT_EVENTS, SEGMENT_BYTES = 1_000, 2**20
"""What a derived segment holds at most; a single larger event stands alone."""
UNSAVED_POSITIONS = 20_000
"""Positions that may be passed over without output before the checkpoint is saved; a restart reads them again."""

_UNKNOWN = -1
_BEGIN = Checkpoint(0, b"")


@dataclass(frozen=True, slots=True)
class Derivation:
    """Which stream is derived from which, by which entry."""

    stream: StreamName
    base: StreamName
    entry: Entry


@dataclass(frozen=True, slots=True)
class Standing:
    """How far a derived stream is made."""

    stream: StreamName
    base: StreamName
    position: int
    """position of the log up to which its base was read"""
    error: str | None
    """why it is stopped"""


@dataclass(slots=True)
class _Share:
    """What a step found for one derived stream."""

    reached: int
    batches: list[EventBatch] = field(default_factory=list)
    error: str | None = None
    gone_at: Position | None = None
    """position of a pruned segment, where that is why"""


class Deriver:
    """Makes the derived streams that a station's plan asks for.

    Args:
        log: The station's log; its newest `sync_planned` is the plan.
        station: Whose streams they are.
    """

    def __init__(self, log: Log, station: Station) -> None:
        self._log = log
        self._station = station
        self._runs: DuckDBPyConnection | None = None
        self._head = _UNKNOWN
        self._planned: Planned | None = None
        self._plan_place: tuple[int, int] | None = None
        """Epoch and sequence of the event that names the plan."""
        self._looked_at: set[StreamName] = set()
        """Streams of which it is known what the plan derives from them."""
        self._derivations: dict[StreamName, Derivation] = {}
        self._sieves: dict[tuple[bytes, str], Sieve] = {}
        self._saved: dict[StreamName, int] = {}
        """Where the checkpoints stand, as this deriver knows it."""
        self._positions: dict[StreamName, int] = {}
        """How far the base streams were read; a little ahead of what is saved where nothing was let through."""
        self._errors: dict[StreamName, str] = {}
        self._gone: dict[StreamName, Position] = {}
        """Where streams are stopped because a payload of their base was pruned; it may come back."""
        self._absence: Absence | None = None
        """What the log records of payloads that left the disk, once that was asked for."""
        self._is_turn_of_live = False
        self._begun = 0
        """Where the log stood when the plan was taken up: what is derived up to there is old."""
        self._marks: dict[StreamName, bytes] = {}
        """The states of the checkpoints, as this deriver knows them."""

    def step(self) -> bool:
        """Derive from one page of the log; whether more is waiting.

        Raises:
            PlanError: The log's plan does not read here.
            LogUnavailable: The database is away; nothing is lost, step again later.
        """
        try:
            if self._log.head() != self._head:
                self._look()
            if group := self._next_group():
                self._derive(*group)
        except BaseException:
            self._doubt()  # whether the last commit took place
            raise
        return self._head == _UNKNOWN or self._next_group() is not None

    def standing(self) -> list[Standing]:
        """How far each derived stream of the plan is made, by name."""
        return [
            Standing(name, each.base, self._positions.get(name, 0), self._errors.get(name))
            for name, each in sorted(self._derivations.items())
        ]

    def check(self) -> None:
        """Nothing, if no derived stream is stopped.

        Raises:
            FilterFailed: Some are; it says which and why.
        """
        if stopped := [error for name, error in sorted(self._errors.items()) if name in self._derivations]:
            more = f" (and {len(stopped) - 1} more)" if len(stopped) > 1 else ""
            raise FilterFailed(stopped[0] + more)

    def close(self) -> None:
        """Let go of what runs the conditions."""
        if self._runs is not None:
            self._runs.close()

    def _look(self) -> None:
        """Take up the plan, the streams, and the checkpoints as they are now."""
        head, heads = self._log.heads(self._station)
        self._heed_plan(heads, head)
        self._absence = None
        self._heed_repairs()
        if self._planned is not None:
            for base in _bases(heads) - self._looked_at:
                self._note(base, self._planned.plan)
                self._looked_at.add(base)
        if self._derivations.keys() - self._positions.keys():
            saved = self._log.checkpoints()
            self._saved = {name: saved.get(_checkpoint(name), _BEGIN).position for name in self._derivations}
            self._marks = {name: saved.get(_checkpoint(name), _BEGIN).state for name in self._derivations}
            self._positions = {name: max(at, self._positions.get(name, 0)) for name, at in self._saved.items()}
        self._head = head

    def _heed_plan(self, heads: Sequence[StreamHead], head: int) -> None:
        """Begin anew with the plan that the log names, if it is another."""
        stream = plan_stream(self._station)
        place = max(((each.epoch, each.sequence) for each in heads if each.stream == stream), default=None)
        if place == self._plan_place:
            return
        self._planned = planned_in(self._log, self._station)
        self._plan_place = place
        self._begun = head
        for kept in (self._derivations, self._looked_at, self._errors, self._gone, self._sieves, self._positions):
            kept.clear()

    def _heed_repairs(self) -> None:
        """Go on with the streams for which a payload that was gone is back, or is recorded as lost."""
        for name, position in list(self._gone.items()):
            try:
                (segment,) = self._log.page(position, position, Filter(with_hollow=True), 1)
                goes_on = segment.has_payload or self._is_given_up(segment)
            except (EventError, ChainBroken) as error:
                self._errors[name] = _why(self._derivations[name], position, error)
                continue
            if goes_on:
                del self._gone[name], self._errors[name]

    def _is_given_up(self, segment: Segment) -> bool:
        if self._absence is None:
            bases = {each.base for each in self._derivations.values()}
            self._absence = recorded(self._log, bases, self._station)
        return self._absence.is_lost(segment)

    def _doubt(self) -> None:
        """Read the checkpoints again before the next step."""
        self._head = _UNKNOWN
        self._positions.clear()

    def _note(self, base: StreamName, plan: Plan) -> None:
        """Note what the plan derives from a stream, if anything, and why that cannot be where it cannot."""
        entry = plan.chosen(base)
        if entry is None or not entry.is_derived:
            return
        try:
            name = derived_name(base, entry)
        except PlanError as error:
            self._derivations[base] = Derivation(base, base, entry)
            self._errors[base] = str(error)
            return
        self._derivations[name] = Derivation(name, base, entry)
        if name not in self._errors:
            try:
                self._sieve(entry, self._log.catalogue.newest(base.type))
            except (PlanError, EventError) as error:
                self._errors[name] = f"{base} cannot be filtered: {error}"

    def _sieve(self, entry: Entry, event_type: type[EventType]) -> Sieve:
        key = (entry.filter_digest, event_type.type_name)
        if key not in self._sieves:
            self._runs = self._runs or database()  # most stations filter nothing, and need none
            self._sieves[key] = Sieve(entry, event_type, self._runs)
        return self._sieves[key]

    def _next_group(self) -> tuple[list[Derivation], int, int] | None:
        """The derived streams to go on with, which all stand at one position, and the positions to read.

        Those that are foremost, and so get what is new, take turns with those that are last.
        """
        at = {name: self._positions[name] for name in self._derivations if name not in self._errors}
        waiting = sorted({position for position in at.values() if position < self._head})
        if not waiting:
            return None
        foremost = max(at.values())
        is_live = waiting[-1] == foremost and (len(waiting) == 1 or not self._is_turn_of_live)
        begun = waiting[-1] if is_live else waiting[0]
        ahead = min((position for position in at.values() if position > begun), default=self._head)
        old = self._begun if begun < self._begun else self._head
        end = min(self._head, ahead, begun + PAGE_POSITIONS, old)
        group = [self._derivations[name] for name, position in at.items() if position == begun]
        return group, begun + 1, end

    def _derive(self, group: Sequence[Derivation], first: int, last: int) -> None:
        """Derive what a page of the log holds for streams that stand at one position."""
        self._is_turn_of_live = not self._is_turn_of_live
        wanted = Filter(
            types=sorted({str(each.base.type) for each in group}),
            sources=sorted({str(each.base.source) for each in group}),
            stations=[self._station],
            with_hollow=True,
        )
        segments = self._log.page(first, last, wanted, PAGE_SEGMENTS)
        reached = last if len(segments) < PAGE_SEGMENTS else segments[-1].position
        segments, reached = _bounded(segments, reached)
        by_base: dict[StreamName, list[Segment]] = {each.base: [] for each in group}
        for segment in segments:
            if segment.stream in by_base:
                by_base[segment.stream].append(segment)
        shares = {each.stream: self._share(each, by_base[each.base], reached) for each in group}
        if self._store(shares):
            for name, share in shares.items():
                self._positions[name] = share.reached
                if share.error is not None:
                    self._errors[name] = share.error
                    if share.gone_at is not None:
                        self._gone[name] = share.gone_at

    def _share(self, derivation: Derivation, segments: Sequence[Segment], reached: int) -> _Share:
        """What one derived stream gets of its base's segments, as far as they can be filtered."""
        batches: list[EventBatch] = []
        since = derivation.entry.since
        for number, segment in enumerate(segments):
            if since is not None and segment.header.time_max < since:
                continue
            try:
                if segment.has_payload:
                    batches.append(decode(segment, self._log.catalogue))
                    continue
                if self._is_given_up(segment):
                    continue  # as the log says, and central is told
            except (EventError, ChainBroken) as error:
                share = self._share(derivation, segments[:number], segment.position - 1)
                return _stopped(share, derivation, segment.position, error)
            share = self._share(derivation, segments[:number], Position(segment.position - 1))
            return self._stopped_at_gap(share, derivation, segment)
        if not batches:
            return _Share(reached)
        sieve = self._sieve(derivation.entry, batches[0].type)
        try:
            passed = sieve.passed(joined(batches))
        except FilterFailed as error:
            if len(segments) == 1:
                return _stopped(_Share(segments[0].position - 1), derivation, segments[0].position, error)
            return self._halved(derivation, segments, reached)
        return _Share(reached, [] if passed is None else list(_cut(passed)))

    def _stopped_at_gap(self, share: _Share, derivation: Derivation, segment: Segment) -> _Share:
        """The share, stopped before a segment whose payload was pruned, unless it stopped earlier."""
        if share.error is None:
            waiting = Waiting(derivation.stream, segment.position - 1, derivation.entry.since)
            here = Missing(
                derivation.base,
                derivation.stream,
                segment.header.epoch,
                segment.header.first_sequence,
                segment.header.last_sequence,
            )
            try:
                found = next(missing(self._log, {derivation.base: waiting}), here)
            except (EventError, ChainBroken):
                found = here  # how far it goes cannot be read, but this one is gone
            share.error = str(found)
            share.gone_at = segment.position
        return share

    def _halved(self, derivation: Derivation, segments: Sequence[Segment], reached: int) -> _Share:
        """The same in two halves, to find the segment at which the condition fails."""
        middle = len(segments) // 2
        first = self._share(derivation, segments[:middle], segments[middle].position - 1)
        if first.error is not None:
            return first
        second = self._share(derivation, segments[middle:], reached)
        return _Share(second.reached, first.batches + second.batches, second.error)

    def _store(self, shares: Mapping[StreamName, _Share]) -> bool:
        """Append what was derived and move the checkpoints; False if another deriver was faster."""
        has_output = any(share.batches or share.error for share in shares.values())
        has_caught_up = any(self._saved[name] < self._begun <= share.reached for name, share in shares.items())
        is_far = any(share.reached - self._saved[name] >= UNSAVED_POSITIONS for name, share in shares.items())
        if not (has_output or has_caught_up or is_far):
            return True
        names = {_checkpoint(name): name for name in shares}
        marks = {name: self._mark(name, share) for name, share in shares.items()}
        with self._log.transaction() as transaction:
            stand = transaction.checkpoints(list(names))
            if any(stand[checkpoint].position != self._saved[name] for checkpoint, name in names.items()):
                self._doubt()
                return False
            drafts = list(self._drafts(shares))
            for draft, appended in zip(drafts, transaction.append(drafts), strict=True):
                if shares[draft.stream].reached == self._begun:
                    marks[draft.stream] = mark_state(
                        appended.first_sequence + draft.event_count - 1, appended.chain_hash
                    )
            transaction.save_checkpoints(
                {checkpoint: Checkpoint(shares[name].reached, marks[name]) for checkpoint, name in names.items()}
            )
        self._saved.update({name: share.reached for name, share in shares.items()})
        self._marks.update(marks)
        return True

    def _mark(self, name: StreamName, share: _Share) -> bytes:
        """The state to be saved: how far the stream is old, once that is known."""
        if share.reached < self._begun:
            return b""
        if share.reached > self._begun and self._marks.get(name):
            return self._marks[name]
        head = self._log.stream_head(name)  # void where another deriver moves the checkpoint
        return mark_state(head.sequence, head.chain_hash)

    def _drafts(self, shares: Mapping[StreamName, _Share]) -> Iterator[Draft]:
        for name, share in shares.items():
            producer = Producer(PRODUCER, PRODUCER_VERSION, self._derivations[name].entry.filter_digest)
            for batch in share.batches:
                # Without the door: what it did not ask for yet when the event came in is no reason to lose it here.
                yield draft_of(name, batch, producer, encode_payload(batch))


class DerivingChore:
    """A deriver as further work of a daemon, in whose status it tells what is stopped."""

    def __init__(self, deriver: Deriver) -> None:
        self._deriver = deriver

    def step(self, now: datetime) -> bool:
        """Derive from one page of the log; whether more is waiting.

        Raises:
            FilterFailed: Nothing is waiting, but for streams that are stopped.
            PlanError: The log's plan does not read here.
            LogUnavailable: The database is away; nothing is lost, step again later.
        """
        del now  # what is derived depends on the log alone
        if self._deriver.step():
            return True
        self._deriver.check()
        return False


def _checkpoint(stream: StreamName) -> str:
    return f"{CHECKPOINT}{stream}"


def _bases(heads: Sequence[StreamHead]) -> set[StreamName]:
    """The streams that are not derived, each once whatever its epochs."""
    found = {head.stream for head in heads if head.sequence}
    return {stream for stream in found if base_of(stream) is None}


def _bounded(segments: list[Segment], reached: int) -> tuple[list[Segment], int]:
    """As many of the segments as a step takes, and the position up to which they go."""
    events = 0
    for number, segment in enumerate(segments, 1):
        events += segment.header.event_count
        if events >= PAGE_EVENTS and number < len(segments):
            return segments[:number], segment.position
    return segments, reached


def _cut(batch: EventBatch) -> Iterator[EventBatch]:
    """The batch in pieces of a segment each, in order."""
    if len(batch) > 1 and (len(batch) > SEGMENT_EVENTS or batch.data.nbytes > SEGMENT_BYTES):
        middle = SEGMENT_EVENTS if len(batch) > SEGMENT_EVENTS else len(batch) // 2
        yield from _cut(batch.slice(0, middle))
        yield from _cut(batch.slice(middle))
    else:
        yield batch


def _stopped(share: _Share, derivation: Derivation, position: Position, error: Exception) -> _Share:
    """The share, stopped before a segment unless it stopped earlier."""
    if share.error is None:
        share.error = _why(derivation, position, error)
    return share


def _why(derivation: Derivation, position: Position, error: Exception) -> str:
    """Why a derived stream is stopped."""
    return (
        f"{derivation.stream} is stopped before position {position} of {derivation.base}: {error}. "
        "Next: correct the plan, upgrade ViAn, or vian verify; then restart vian sync"
    )
