"""One pass over the log: rules that stand at the same position and are fed together.

Contract: each segment is one unit of arrival, given whole and in order of position, so what a rule
finds depends on the log alone, never on how it was read. A rule is fed with segments of the types
that it reads, whichever other rules there are. Events of a source whose time is far ahead of both
the log's clock and the source's own past are kept out, so that one wrong clock does not make all
that follows late.
"""

import logging
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta

import numpy as np
import pyarrow as pa

from events import (
    Catalogue,
    EventType,
    ProcessFailed,
    ProcessFinished,
    Segment,
    UnknownType,
    ZoneDefined,
    ZoneRemoved,
    decode,
    events_of,
    with_envelope,
)
from patterns.durations import microseconds
from patterns.errors import RuleTooSlow
from patterns.inputs import SITUATION
from patterns.processor.limits import ProcessorLimits
from patterns.processor.members import Finding, Member
from patterns.processor.saving import SavedState
from patterns.ruleset import Outcomes, RuleSetRun, RuleStatus
from patterns.running import Outcome
from patterns.site import SITE_TYPES
from patterns.situations import EventRef, as_microseconds
from store import Log

logger = logging.getLogger(__name__)

ENDS: tuple[type[EventType], ...] = (ProcessFinished, ProcessFailed)
"""What says that a source will send no more."""
CONTROL = (*SITE_TYPES, *ENDS)
SiteEvent = tuple[EventType, str, int]
"""An event, its stream, and its sequence there."""

_NOTHING = Outcome()
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Pass:
    """Rules at one position of the log. Not for several threads at once."""

    def __init__(
        self, position: int, catalogue: Catalogue, limits: ProcessorLimits, site: Iterable[SiteEvent] = ()
    ) -> None:
        """A pass without rules.

        Args:
            position: The rules have seen the log up to here.
            catalogue: The event types there are.
            limits: See `ProcessorLimits`.
            site: What the log up to there says of the cameras, in order.
        """
        self.position = position
        self.members: dict[str, Member] = {}
        self.newest_us: dict[str, int] = {}
        """For each source the newest time that was let in."""
        self.segments_skipped = 0
        """Segments of a type or version unknown here, which took no part."""
        self.events_unsaved = 0
        self.save_at = 0.0
        """When what its rules remember is to be saved, by the processor's clock."""
        self._catalogue = catalogue
        self._limits = limits
        self._site: dict[tuple[object, ...], SiteEvent] = {}
        self._sets: dict[frozenset[str], RuleSetRun] = {}
        self._events_of: dict[frozenset[str], int] = {}
        for event, stream, sequence in site:
            self._learn(event, stream, sequence)

    @property
    def types(self) -> set[str]:
        """The event types whose segments it is to be given."""
        return {str(each.type_name) for each in CONTROL}.union(*self._sets)

    def add(self, member: Member, saved: SavedState | None = None) -> None:
        """The rule takes part from here on; with a saved state it goes on from that.

        Raises:
            StateError: The state is not one of this rule.
        """
        self._set_of(member).add(member.bound, None if saved is None else saved.run, member.name)
        self.members[member.name] = member
        for source, newest_us in (saved.newest_us if saved is not None else {}).items():
            self.newest_us[source] = max(newest_us, self.newest_us.get(source, newest_us))

    def remove(self, member: Member) -> None:
        """The rule takes no more part."""
        del self.members[member.name]
        self._sets[member.types].remove(member.name)
        if not any(each.types == member.types for each in self.members.values()):
            del self._sets[member.types]

    def absorb(self, other: "Pass") -> None:
        """Takes over the rules of a pass that stands at the same position.

        Raises:
            StateError: A rule does not understand its own state.
        """
        assert other.position == self.position, f"passes at {other.position} and {self.position} cannot be one"
        for member in other.members.values():
            self.add(member, SavedState(other.position, 0, other.state(member), other.newest_us))

    def state(self, member: Member) -> bytes:
        """All that the rule's run remembers."""
        return self._sets[member.types].state(member.name)

    def status(self, member: Member) -> RuleStatus:
        """How the rule stands."""
        return self._sets[member.types].status(member.name)

    def take(self, segment: Segment) -> list[Finding]:
        """What the segment, the next in order of position, leads to."""
        self.position = segment.position
        try:
            batch = decode(segment, self._catalogue)
        except UnknownType as error:
            self.segments_skipped += 1
            logger.warning("no rule sees the segment at position %d: %s", segment.position, error)
            return []
        self.events_unsaved += segment.header.event_count
        findings: list[Finding] = []
        if any(segment.stream.type in types for types in self._sets):
            rows = with_envelope(segment.stream, segment.header.first_sequence, batch)
            rows = self._believed(segment, rows)
            for types, rules in list(self._sets.items()):
                if segment.stream.type in types:
                    self._events_of[types] = self._events_of.get(types, 0) + rows.num_rows
                    findings += self._findings(rules.push(rows), rules)
        if batch.type in CONTROL:
            for number, event in enumerate(events_of(batch)):
                findings += self._told(event, segment, segment.header.first_sequence + number)
        return sorted(findings, key=lambda each: each.member.service.key)

    def fall_idle(self, now: datetime) -> list[Finding]:
        """What follows from sources that have been silent for a rule's idle time, by the clock on the wall."""
        findings = []
        for types, rules in list(self._sets.items()):
            waiting = [
                each
                for each in self.members.values()
                if each.types == types and each.rule.time.idle and each.failure is None
            ]
            if waiting:
                before = {each.name: rules.status(each.name).watermark for each in waiting}
                outcomes = rules.advance_idle(now)
                moved = [n for n, at in before.items() if n in rules.rules and rules.status(n).watermark != at]
                outcomes = {name: outcomes.get(name, _NOTHING) for name in (*moved, *outcomes)}
                findings += self._findings(outcomes, rules, is_by_silence=True)
        return findings

    @property
    def reads_situations(self) -> bool:
        """Whether what rules find leads to more."""
        return any(SITUATION in types for types in self._sets)

    def settle(self) -> list[Finding]:
        """What follows for rules that read situations from there being nothing more to come: sources have ended."""
        findings = []
        for types, rules in list(self._sets.items()):
            if SITUATION in types:
                findings += self._findings(rules.settle(), rules, is_by_silence=True)
        return findings

    def pace(self) -> None:
        """Sets aside the rules that take too long, measured since this was last asked."""
        limits = self._limits
        for member in self.members.values():
            events = self._events_of.get(member.types, 0)
            if member.failure is not None or not events:
                continue
            member.pace.note(self.status(member).spent_s, events, limits.event_us, limits.window_events)
            if member.pace.slow_windows >= limits.slow_windows:
                member.failed_at = self.position + 1
                member.failure = RuleTooSlow(
                    f"it took {member.pace.event_us:,.0f} us an event; the limit rules_event_us is {limits.event_us:g} "
                    f"us over {limits.slow_windows} windows of {limits.window_events} events in a row"
                )
        self._events_of.clear()

    # One segment.

    def _told(self, event: EventType, segment: Segment, sequence: int) -> list[Finding]:
        if not isinstance(event, ENDS):
            return self._learn(event, str(segment.stream), sequence)
        findings = []
        for rules in list(self._sets.values()):
            findings += self._findings(rules.source_ended(segment.stream.source), rules)
        return findings

    def _learn(self, event: EventType, stream: str, sequence: int) -> list[Finding]:
        """Takes in what an event says of a camera; only the newest word is kept for rules to come."""
        key = _what(event, stream)
        self._site.pop(key, None)
        self._site[key] = (event, stream, sequence)
        findings = []
        for rules in list(self._sets.values()):
            rules.learn(event, stream, sequence)
            findings += self._findings({}, rules)
        return findings

    def _set_of(self, member: Member) -> RuleSetRun:
        """The set of the rules that read the same types; a new one knows the cameras."""
        if member.types not in self._sets:
            rules = self._sets[member.types] = RuleSetRun()
            for event, stream, sequence in self._site.values():
                rules.learn(event, stream, sequence)
        return self._sets[member.types]

    def _findings(self, outcomes: Outcomes, rules: RuleSetRun, *, is_by_silence: bool = False) -> list[Finding]:
        """The outcomes with whose they are; a rule that raised is marked."""
        findings = []
        for name, outcome in outcomes.items():
            member = self.members[name]
            member.missed.late(outcome.late)
            member.missed.given_up(outcome.given_up)
            findings.append(Finding(member, self.position, outcome, is_by_silence))
        for name in list(rules.failures):
            member = self.members[name]
            if member.failure is None:
                member.failure, member.failed_at = rules.failures[name], self.position
        return findings

    def _believed(self, segment: Segment, rows: pa.RecordBatch) -> pa.RecordBatch:
        """The rows but for those far in the future."""
        source, ahead = str(segment.stream.source), self._limits.ahead
        newest_us = self.newest_us.get(source)
        latest_us = _us(segment.header.time_max)
        if ahead is None or newest_us is None or segment.header.time_max - segment.recorded_at <= ahead:
            self.newest_us[source] = latest_us if newest_us is None else max(latest_us, newest_us)
            return rows
        most_us = max(newest_us, _us(segment.recorded_at)) + microseconds(ahead)
        times = rows.column("time").cast(pa.int64()).to_numpy()
        is_believed = times <= most_us
        if is_believed.any():
            self.newest_us[source] = max(newest_us, int(times[is_believed].max()))
        refused = np.flatnonzero(~is_believed)
        if len(refused):
            first = segment.header.first_sequence
            refs = [
                EventRef(str(segment.stream), first + int(at), _EPOCH + timedelta(microseconds=int(times[at])))
                for at in refused
            ]
            for member in self.members.values():
                if segment.stream.type in member.types:
                    member.missed.future(refs, ahead.total_seconds())
        return rows.filter(pa.array(is_believed))


def site_at(log: Log, position: int) -> list[SiteEvent]:
    """What the log says of the cameras when it is read from a position on, in order.

    That is what stands up to there; and of what is first said later, the first word: a zone that was drawn when the
    footage was already in the log holds for all of it.
    """
    names = {str(each.type_name) for each in SITE_TYPES}
    streams = {head.stream for head in log.streams() if head.stream.type in names}
    segments = [each for stream in streams for each in log.read_lives(stream)]
    found: list[SiteEvent] = []
    known: set[tuple[object, ...]] = set()
    for segment in sorted(segments, key=lambda each: each.position):
        for at, event in enumerate(_events(segment, log.catalogue)):
            key = _what(event, str(segment.stream))
            if segment.position <= position or key not in known:
                found.append((event, str(segment.stream), segment.header.first_sequence + at))
            known.add(key)
    return found


def _what(event: EventType, stream: str) -> tuple[object, ...]:
    """What the event is about: a camera's frames or calibration, or one of its zones or lines."""
    is_shape = isinstance(event, ZoneDefined | ZoneRemoved)
    return stream.rsplit("/", 1)[0], "zone" if is_shape else event.type_name, getattr(event, "zone", None)


def _events(segment: Segment, catalogue: Catalogue) -> list[EventType]:
    try:
        return list(events_of(decode(segment, catalogue)))
    except UnknownType:
        return []  # counted and logged where the segment is read in its turn


def newest_of(newest_us: Mapping[str, int]) -> int:
    """The newest time of any source, in microseconds; 0 where there is none."""
    return max(newest_us.values(), default=0)


def _us(time: datetime) -> int:
    value = as_microseconds(time)
    assert isinstance(value, int), "a time is whole microseconds"
    return value
