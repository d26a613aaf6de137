"""One pass over the log: rules that stand at the same position and are fed together.

Contract: each segment is one unit of arrival, given whole and in order of position, so what a rule
finds depends on the log alone, never on how it was read. Segments that were read together are run together, because
that is many times cheaper; what they lead to is still told segment by segment. A rule is fed with segments of the types
that it reads, whichever other rules there are. Events of a stream whose time is far ahead of both
the log's clock and the stream's own past are kept out, so that one wrong clock does not make all
that follows late.
"""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import accumulate, groupby

import numpy as np
import pyarrow as pa

from events import (
    Catalogue,
    EventBatch,
    EventType,
    ProcessFailed,
    ProcessFinished,
    Segment,
    UnknownType,
    ZoneDefined,
    decode,
    events_of,
)
from patterns.binding.inputs import SITUATION
from patterns.binding.rows import Units
from patterns.durations import microseconds
from patterns.engine.ruleset import Outcomes, RuleSetRun, RuleStatus
from patterns.engine.running import Outcome
from patterns.engine.situations import EventRef, as_microseconds
from patterns.errors import MatchError, RuleTooSlow
from patterns.processor.cameras import Known, SiteEvent, site_events
from patterns.processor.limits import ProcessorLimits
from patterns.processor.members import Finding, Member
from patterns.processor.saving import SavedState
from patterns.scene.site import SITE_TYPES, Site

logger = logging.getLogger(__name__)
UNCALIBRATED = "uncalibrated"
"""The `kind` of a log record that says of a source that a rule wants its metres, and there are none yet."""

ENDS: tuple[type[EventType], ...] = (ProcessFinished, ProcessFailed)
"""What says that a source will send no more."""
CONTROL = (*SITE_TYPES, *ENDS)

_NOTHING = Outcome()
_STREAM_COLUMNS = ("station", "source", "type")
_ROW_COLUMNS = frozenset(("time", "sequence"))
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Pass:
    """Rules at one position of the log. Not for several threads at once."""

    def __init__(
        self,
        position: int,
        catalogue: Catalogue,
        limits: ProcessorLimits,
        cameras: Known | None = None,
    ) -> None:
        """A pass without rules.

        Args:
            position: The rules have seen the log up to here.
            catalogue: The event types there are.
            limits: See `ProcessorLimits`.
            cameras: What is known of the cameras there: see `known_at`; None: nothing.
        """
        self.position = position
        self.members: dict[str, Member] = {}
        self.newest_us: dict[str, int] = {}
        """For each stream the newest time that was let in: of its own stream alone, so that what is believed of it does
        not depend on which other types are read."""
        self.segments_skipped = 0
        """Segments of a type or version unknown here, which took no part."""
        self.events_unsaved = 0
        self.save_at = 0.0
        """When what its rules remember is to be saved, by the processor's clock."""
        self._live: dict[str, str] = {}
        """For rules that read situations a source that may still lead to some."""
        self._catalogue = catalogue
        self._limits = limits
        self.site = Site()
        """What is known of the cameras where it stands."""
        self._known = cameras or Known()
        self._site: dict[tuple[object, ...], SiteEvent] = {}
        self._sets: dict[frozenset[str], RuleSetRun] = {}
        self._events_of: dict[frozenset[str], int] = {}
        self._columns: dict[frozenset[str], frozenset[str]] = {}
        for said in self._known.said:
            self._learn(said)

    @property
    def foreknown_to(self) -> int:
        """Up to where the log says something of cameras that is known before its turn; 0: that is all behind."""
        return self._known.to_position if self._known.to_position > self.position else 0

    def is_at(self, position: int, foreknown_to: int) -> bool:
        """Whether it stands there and knows what one does that was made there, and knows the log as far."""
        return self.position == position and foreknown_to in (self.foreknown_to, self._known.read_to)

    @property
    def types(self) -> set[str]:
        """The event types whose segments it is to be given."""
        return {str(each.type_name) for each in CONTROL}.union(*self._sets)

    def add(self, member: Member, saved: SavedState | None = None, spent_s: float = 0.0) -> None:
        """The rule takes part from here on; with a saved state it goes on from that, `spent_s` from what it has taken.

        Raises:
            StateError: The state is not one of this rule.
        """
        self._set_of(member).add(member.bound, None if saved is None else saved.run, member.name, spent_s)
        self.members[member.name] = member
        self._columns.pop(member.types, None)
        for stream, newest_us in (saved.newest_us if saved is not None else {}).items():
            self.newest_us[stream] = max(newest_us, self.newest_us.get(stream, newest_us))

    def remove(self, member: Member) -> None:
        """The rule takes no more part."""
        self._live.clear()  # those above it may wait for less
        del self.members[member.name]
        self._columns.pop(member.types, None)
        self._sets[member.types].remove(member.name)
        if not any(each.types == member.types for each in self.members.values()):
            del self._sets[member.types]

    def absorb(self, other: "Pass") -> list[tuple[Member, Exception]]:
        """Takes over the rules of a pass that stands at the same position; those that could not be, and why."""
        assert other.position == self.position, f"passes at {other.position} and {self.position} cannot be one"
        refused: list[tuple[Member, Exception]] = []
        for member in other.members.values():
            try:
                saved = SavedState(other.position, 0, other.state(member), other.newest_us)
                self.add(member, saved, other._sets[member.types].spent_s(member.name))
            except Exception as error:  # Whatever it is, the other rules go on; the caller names the rule.
                refused.append((member, error))
        return refused

    def state(self, member: Member) -> bytes:
        """All that the rule's run remembers."""
        return self._sets[member.types].state(member.name)

    def use_kernel(self) -> None:
        """Rules that came before the kernel was compiled go on on it, if it is by now."""
        for rules in self._sets.values():
            rules.use_kernel()

    def status(self, member: Member) -> RuleStatus:
        """How the rule stands."""
        return self._sets[member.types].status(member.name)

    def take(self, segments: Sequence[Segment], *, is_one_by_one: bool = False) -> list[Finding]:
        """What the segments, the next in order of position, lead to.

        Args:
            segments: The segments.
            is_one_by_one: Whether each is run by itself, which costs more and leads to the same.

        Raises:
            RunOneByOne: A rule failed among segments that were run together, so that what it found before is lost.
        """
        findings: list[Finding] = []
        together: list[_Part] = []
        events = 0
        for segment in segments:
            try:
                batch = decode(segment, self._catalogue)
            except UnknownType as error:
                self.segments_skipped += 1
                logger.warning("no rule sees the segment at position %d: %s", segment.position, error)
                continue
            self.events_unsaved += segment.header.event_count
            is_control = batch.type in CONTROL
            is_full = events + len(batch) > self._limits.events_together
            if together and (is_control or is_full or is_one_by_one):
                findings += self._pushed(together)
                together, events = [], 0
            if any(segment.stream.type in types for types in self._sets):
                together.append(_Part(segment, batch.type, self._believed(segment, batch)))
                events += len(together[-1])
            if is_control:
                findings += self._pushed(together)
                together, events = [], 0
                self.position = segment.position
                findings += self._controlled(segment, batch)
        findings += self._pushed(together)
        if segments:
            self.position = segments[-1].position
        return findings

    def _controlled(self, segment: Segment, batch: EventBatch) -> list[Finding]:
        """What events lead to that say something of cameras or processes."""
        findings = []
        for said in site_events(segment, events_of(batch)):
            findings += self._ended(segment) if isinstance(said.event, ENDS) else self._told(said)
        return sorted(findings, key=lambda each: each.member.service.key)

    def _pushed(self, parts: Sequence["_Part"]) -> list[Finding]:
        """What segments, of which each is a unit of arrival, lead to."""
        findings = []
        for types, rules in list(self._sets.items()):
            own = [part for part in parts if part.segment.stream.type in types]
            if not own:
                continue
            self._events_of[types] = self._events_of.get(types, 0) + sum(len(part.rows) for part in own)
            known = len(rules.failures)
            outcomes = rules.push_units(_units(own, self._columns_of(types)))
            if len(own) > 1 and len(rules.failures) > known:
                raise RunOneByOne(parts[-1].segment.position)
            for part, outcome in zip(own, outcomes, strict=True):
                self.position = part.segment.position
                self._note_uncalibrated(types, part)
                findings += self._findings(outcome, rules)
        return sorted(findings, key=lambda each: (each.position, each.member.service.key))

    def _note_uncalibrated(self, types: frozenset[str], part: "_Part") -> None:
        """Counts for the rules that ask metres of a segment's events what they could not be told."""
        asking = [each for each in self.members.values() if each.types == types and each.metres.is_asked]
        source = str(part.segment.stream.source)
        zones = [each.event for each in self._site.values() if each.source == source] if asking else []
        is_calibrated = self.site.calibration(source) is not None
        in_metres = [each.zone for each in zones if isinstance(each, ZoneDefined) and each.units == "metres"]
        for member in asking:
            if is_calibrated:
                member.uncalibrated.pop(source, None)
            elif len(part) and member.failure is None and member.metres.asks(source, in_metres):
                if source not in member.uncalibrated:
                    logger.warning(
                        "rule %s version %d asks for metres of source %s, which has no calibration from %s on: there "
                        "it finds none. Next: vian zones calibrate %s POINTS.yaml --station %s, let people pass while "
                        "its extraction runs, or leave the source out in the rule's FROM",
                        member.rule.rule, member.rule.version, source, part.segment.header.time_min, source,
                        part.segment.stream.station,
                        extra={"kind": UNCALIBRATED},
                    )  # fmt: skip
                member.uncalibrated[source] = member.uncalibrated.get(source, 0) + len(part)

    def _columns_of(self, types: frozenset[str]) -> frozenset[str] | None:
        """The columns that the rules of a set read; None: they may read any."""
        if SITUATION in types:
            return None
        if types not in self._columns:
            inputs = (each for member in self.members.values() if member.types == types for each in member.bound.inputs)
            self._columns[types] = frozenset().union(*(each.reads for each in inputs))
        return self._columns[types]

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
                before = {each.name: rules.watermark(each.name) for each in waiting}
                outcomes = rules.advance_idle(now)
                moved = [n for n, at in before.items() if n in rules.rules and rules.watermark(n) != at]
                outcomes = {name: outcomes.get(name, _NOTHING) for name in (*moved, *outcomes)}
                findings += self._findings(outcomes, rules, is_by_silence=True)
        return findings

    @property
    def reads_situations(self) -> bool:
        """Whether what rules find leads to more."""
        return any(SITUATION in types for types in self._sets)

    def settle(self, live: Callable[[Member, int], str | None]) -> list[Finding]:
        """What follows for rules that read situations from there being nothing more to come: sources have ended.

        Args:
            live: A source that may still lead to situations that the rule reads, as the log says it up to a position;
                None: there is none. It is asked again only when the one that it named has ended.
        """
        findings = []
        for member in list(self.members.values()):
            rules = self._sets[member.types]
            if member.failure is not None or member.name in self._live or not rules.may_settle(member.name):
                continue
            source = live(member, self.position)
            if source is not None:
                self._live[member.name] = source
                continue
            # The log does not say when this was, so it is recorded even where it leads to nothing.
            outcomes = rules.settle(member.name)
            kept = {member.name: _NOTHING} if member.name in rules.rules else {}
            findings += self._findings(kept | outcomes, rules, is_by_silence=True)
        return findings

    def pace(self) -> None:
        """Sets aside the rules that take too long, measured since this was last asked."""
        limits = self._limits
        for member in self.members.values():
            events = self._events_of.get(member.types, 0)
            if member.failure is not None or not events:
                continue
            spent_s = self._sets[member.types].spent_s(member.name)
            member.pace.note(spent_s, events, limits.event_us, limits.window_events)
            if member.pace.slow_windows >= limits.slow_windows:
                member.failed_at = self.position + 1
                member.failure = RuleTooSlow(
                    f"it took {member.pace.event_us:,.0f} us an event; the limit rules_event_us is {limits.event_us:g} "
                    f"us over {limits.slow_windows} windows of {limits.window_events} events in a row"
                )
        self._events_of.clear()

    # One segment.

    def _ended(self, segment: Segment) -> list[Finding]:
        """What follows from the source's sending no more."""
        ended = str(segment.stream.source)
        self._live = {name: source for name, source in self._live.items() if source != ended}
        findings = []
        for rules in list(self._sets.values()):
            findings += self._findings(rules.source_ended(segment.stream.source), rules)
        return findings

    def _told(self, said: SiteEvent) -> list[Finding]:
        """Takes in what an event says of a camera, and what is known to hold from there on."""
        findings, word = self._learn(said), self._known.words.get(said.id)
        return findings if word is None else findings + self._learn(word)

    def _learn(self, said: SiteEvent) -> list[Finding]:
        """Takes in what an event says of a camera; only the newest word is kept for rules to come."""
        is_news = True
        with suppress(MatchError):  # rules that need it say so themselves, those to come, too
            is_news = self.site.learn(said.event, said.stream, said.sequence, epoch=said.epoch)
        if is_news:
            self._site.pop(said.about, None)
            self._site[said.about] = said
        findings = []
        for rules in list(self._sets.values()):
            rules.learn(said.event, said.stream, said.sequence, epoch=said.epoch)
            findings += self._findings({}, rules)
        return findings

    def _set_of(self, member: Member) -> RuleSetRun:
        """The set of the rules that read the same types; a new one knows the cameras."""
        if member.types not in self._sets:
            rules = self._sets[member.types] = RuleSetRun()
            for said in self._site.values():
                rules.learn(said.event, said.stream, said.sequence, epoch=said.epoch)
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

    def _believed(self, segment: Segment, batch: EventBatch) -> pa.RecordBatch:
        """The events but for those far in the future, with their sequences."""
        first = segment.header.first_sequence
        rows = batch.data.append_column("sequence", pa.array(np.arange(first, first + len(batch), dtype=np.int64)))
        stream, ahead = str(segment.stream), self._limits.ahead
        newest_us = self.newest_us.get(stream)
        latest_us = _us(segment.header.time_max)
        if ahead is None or newest_us is None or segment.header.time_max - segment.recorded_at <= ahead:
            self.newest_us[stream] = latest_us if newest_us is None else max(latest_us, newest_us)
            return rows
        most_us = max(newest_us, _us(segment.recorded_at)) + microseconds(ahead)
        times = rows.column("time").cast(pa.int64()).to_numpy()
        is_believed = times <= most_us
        if is_believed.any():
            self.newest_us[stream] = max(newest_us, int(times[is_believed].max()))
        refused = np.flatnonzero(~is_believed)
        if len(refused):
            refs = [
                EventRef(stream, first + int(at), _EPOCH + timedelta(microseconds=int(times[at]))) for at in refused
            ]
            for member in self.members.values():
                if segment.stream.type in member.types:
                    member.missed.future(refs, ahead.total_seconds())
        return rows.filter(pa.array(is_believed))


class RunOneByOne(Exception):
    """A rule failed among segments that were run together: they are to be run again, one by one.

    Attributes:
        position: The last of them.
    """

    def __init__(self, position: int) -> None:
        super().__init__(f"a rule failed among segments up to position {position}")
        self.position = position


@dataclass(frozen=True, slots=True)
class _Part:
    """A segment and its events, with their sequences."""

    segment: Segment
    type: type[EventType]
    rows: pa.RecordBatch

    def __len__(self) -> int:
        return int(self.rows.num_rows)


def _units(parts: Sequence[_Part], columns: frozenset[str] | None) -> list[Units]:
    """The segments as units of arrival, those of one type that follow each other in one table.

    Args:
        parts: The segments.
        columns: The columns that are read; None: all.
    """
    return [_united(list(few), columns) for _, few in groupby(parts, key=lambda part: part.type)]


def _united(parts: Sequence[_Part], columns: frozenset[str] | None) -> Units:
    whole = pa.Table.from_batches([part.rows for part in parts])
    bounds = list(accumulate((len(part) for part in parts), initial=0))
    streams = [part.segment.stream for part in parts]
    table = {name: _spread([str(getattr(each, name)) for each in streams], bounds) for name in _STREAM_COLUMNS}
    if columns is None or "subject" in columns:
        subject = parts[0].type.subject_field
        nothing = pa.nulls(len(whole), pa.string())
        table["subject"] = nothing if subject is None else whole.column(subject).cast(pa.string())
    kept = [name for name in whole.column_names if columns is None or name in columns or name in _ROW_COLUMNS]
    return Units(pa.table(table | {name: whole.column(name) for name in kept}), bounds)


def _spread(texts: Sequence[str], bounds: Sequence[int]) -> pa.DictionaryArray:
    """A column with one text for each unit's rows."""
    numbers = {text: number for number, text in enumerate(dict.fromkeys(texts))}
    of_units = np.array([numbers[text] for text in texts], dtype=np.int32)
    return pa.DictionaryArray.from_arrays(
        pa.array(np.repeat(of_units, np.diff(bounds))), pa.array(list(numbers), pa.string())
    )


def newest_of(newest_us: Mapping[str, int], types: Collection[str]) -> int:
    """The newest time of any stream of these types, in microseconds; 0 where there is none."""
    return max((each for stream, each in newest_us.items() if stream.rsplit("/", 1)[-1] in types), default=0)


def _us(time: datetime) -> int:
    value = as_microseconds(time)
    assert isinstance(value, int), "a time is whole microseconds"
    return value
