"""The online processor: follows the log, runs rules over it, appends the situations they find.

Contract: one pass of the log feeds all rules. What a rule finds is appended exactly once, whatever is
killed when: its situations and its mark commit together, what it remembers is saved now and then, and
after a restart the log is read again from there, up to the mark without saying anything twice. Two
processors may run at once: one commits, the other takes note and goes on.

Which rules run is said by the log (`patterns.processor.deploying`), and followed while it changes: a
rule that begins in the past catches up in a pass of its own, a page at a time, and then joins the
others. A rule that raises, or is too slow, is set aside and named; the others go on.

A source is live from its first event until its process has finished or failed; then it no longer
holds the watermark back, and when no source is live the rule's input has ended.
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import islice

import pyarrow as pa

from events import Segment, SituationDetected, SituationShadowed, decode
from patterns.binding.binder import bind
from patterns.binding.strata import rules_read, with_situations
from patterns.durations import microseconds
from patterns.engine.situations import as_microseconds
from patterns.errors import PatternError, StateError
from patterns.files.rule import Rule
from patterns.processor.cameras import known_at
from patterns.processor.committing import Committer, Overtaken, Work
from patterns.processor.deploying import (
    RULE_EVENTS,
    OpenMatches,
    Retirement,
    Service,
    note,
    readable_by,
    rule_of,
    rules_in_service,
    schemas,
    standing,
)
from patterns.processor.limits import ProcessorLimits
from patterns.processor.live import Below, live_source, types_below
from patterns.processor.members import Finding, Member
from patterns.processor.passes import Pass, RunOneByOne, newest_of
from patterns.processor.saving import (
    Mark,
    mark_name,
    mark_of,
    stored_state,
)
from patterns.processor.writing import SOURCE, producer_of
from store import Log, LogUnavailable, Subscription

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Step:
    """What one step of the processor did."""

    position: int
    """every rule has seen the log up to here"""
    is_caught_up: bool
    situations: int
    """situations appended"""


class Processor:
    """Runs rules over one log. Not for several threads at once."""

    def __init__(
        self,
        log: Log,
        station: str,
        rules: Sequence[Rule] | None = None,
        now: Callable[[], datetime] | None = None,
        limits: ProcessorLimits | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Build a processor that goes on where the log says the rules stand.

        Args:
            log: The log.
            station: This station, in whose streams the situations go.
            rules: These rules and no others, whether they are deployed or not; None: those that are
                deployed, as that changes.
            now: The clock on the wall, by which a rule's `time.idle` is judged; without one, a silent
                source holds the watermark until its process ends, as a replay needs it.
            limits: See `ProcessorLimits`.
            clock: Seconds that never go back, by which it is judged when to save.

        Raises:
            PatternError: A given rule does not fit the catalogue.
        """
        self._log = log
        self._station = station
        self._now = now
        self._limits = limits or ProcessorLimits()
        self._clock = clock
        self._schemas = schemas(log.catalogue)
        self._given = None if rules is None else {(each.rule, each.version): each for each in rules}
        self._failures: dict[str, Exception] = {}
        self._work: Work | None = None
        self._is_stale = False
        self._segments_skipped = 0
        self._one_by_one_to = 0
        self._recorded_at = datetime(1970, 1, 1, tzinfo=UTC)
        self._made_at = log.head()
        for rule in rules or ():
            bind(rule, self._readable_by(rule), limits=self._limits.rules)  # what does not fit is told at once
        self._committer = Committer(log, station, self._at, is_recording_ends=rules is None)
        self._subscription = Subscription(log, "rules", limit=self._limits.segments)
        self._begin()

    @property
    def position(self) -> int:
        """Every rule has seen the log up to here, and what it found is in the log."""
        return self._position

    @property
    def rules(self) -> list[tuple[Service, Rule]]:
        """The versions in service, and the rules that they are."""
        return [(each.service, each.rule) for each in self._members()]

    @property
    def failures(self) -> dict[str, Exception]:
        """The rules that were set aside, and why."""
        return dict(self._failures)

    @property
    def late(self) -> dict[str, int]:
        """For each rule the rows that came too late to take part."""
        return {
            each.service.rule: rules.status(each).counts.late
            for rules in (self._main, *self._joining)
            for each in rules.members.values()
        }

    @property
    def segments_skipped(self) -> int:
        """Segments of a type or version unknown here, which took no part."""
        return self._segments_skipped + self._main.segments_skipped

    def step(self, timeout_s: float = 0.0) -> Step:
        """Run the rules over the next segments, waiting up to `timeout_s` seconds for some.

        Raises:
            LogUnavailable: The database is away; nothing is lost, step again later.
        """
        if self._is_stale:
            self._begin()
        situations = 0
        try:
            situations += self._finish_work()
            is_caught_up = self._follow(0.0 if self._joining else timeout_s)
            situations += self._finish_work()
            joining = list(self._joining)
            for rules in joining:
                self._catch_up(rules)
                situations += self._finish_work()
        except RunOneByOne as error:
            self._one_by_one_to = max(error.position, self._one_by_one_to)
            self._is_stale, self._work = True, None
            return Step(self._position, False, situations)
        except Overtaken as error:
            logger.warning("%s; going on from the log", error)
            self._is_stale, self._work = True, None
            return Step(self._position, False, 0)
        # What those behind have found may be read by those that lead.
        return Step(self.position, is_caught_up and not joining, situations)

    def catch_up(self) -> int:
        """Run the rules over all that is there now, and save what they remember; the situations appended."""
        situations = 0
        while True:
            step = self.step()
            situations += step.situations
            if step.is_caught_up:
                self.save()
                return situations

    def save(self) -> None:
        """Save what the rules remember, so that a restart need not read again what they have seen.

        Raises:
            LogUnavailable: The database is away.
        """
        if self._is_stale:
            return
        try:
            self._finish_work()
            for rules in (self._main, *self._joining):
                if any(each.mark.saved < rules.position for each in rules.members.values()):
                    self._commit(Work(rules, rules.position, [], []), is_saving=True)
                    rules.use_kernel()
        except Overtaken as error:
            logger.warning("%s; going on from the log", error)
            self._is_stale, self._work = True, None

    def reload(self, rules: Sequence[Rule], *, open_matches: OpenMatches = "finished") -> None:
        """Run these rules from here on, in place of those that were given.

        A version that is new begins here; one that is no longer there is dropped, or finishes what it has begun.
        Where the log says which rules run, `deploy` and `retire` do this.

        Raises:
            PatternError: A rule does not fit the catalogue; nothing has changed.
        """
        assert self._given is not None, "what is deployed runs, not what is given"
        wanted = {(each.rule, each.version): each for each in rules}
        for rule in rules:
            bind(rule, with_situations(self._schemas, rules), limits=self._limits.rules)
        at = self._main.position
        gone = Retirement(at, "told", open_matches, "it was taken from the rules")
        for member in self._members():
            if member.service.key not in wanted and member.service.retirement is None:
                member.service = replace(member.service, retirement=gone)
        running = {each.service.key for each in self._members() if each.service.retirement is None}
        self._given = wanted
        for key, rule in wanted.items():
            if key not in running:
                self._admit(_given_service(rule, self._services.get(key), after=at))
        self._want()
        self._note_position()
        self._main.save_at = self._clock()  # where they began must be in the log soon

    def close(self) -> None:
        """Save, and stop listening."""
        try:
            self.save()
        except LogUnavailable as error:
            logger.warning("what the rules remember is not saved; the log is read again at the next start: %s", error)
        finally:
            self._subscription.close()

    # Where to begin.

    def _begin(self) -> None:
        """Bring the rules to where the log says that they stand."""
        self._work = None
        head = self._log.head()
        self._services = standing(self._log, self._station, head)
        self._joining: list[Pass] = []
        self._main = Pass(-1, self._log.catalogue, self._limits)
        for service in self._wanted():
            if service.rule not in self._failures or self._given is None:
                self._admit(service)
        # Those that are furthest lead; the others catch up with them.
        self._joining.sort(key=lambda each: each.position)
        self._main = self._joining.pop() if self._joining else self._pass_at(head, head)
        self._known_to = head
        self._subscription.position = self._main.position
        self._want()
        self._note_position()
        self._is_stale = False

    def _wanted(self) -> list[Service]:
        if self._given is None:
            return list(self._services.values())
        return [_given_service(rule, self._services.get(key)) for key, rule in self._given.items()]

    def _admit(self, service: Service, start: int | None = None) -> None:
        """Take a version into service where it stands; one that cannot be is set aside.

        Args:
            service: The version.
            start: A position behind that from which it sees the log, with nothing between for it to see.
        """
        name, version = service.key
        row = self._log.checkpoint(mark_name(self._station, name, version))
        mark = mark_of(row)
        if mark is not None and mark.is_done and mark.life == service.life and self._given is None:
            return
        gone = service.retirement
        if gone is not None and gone.position <= service.after:
            return
        try:
            member = self._member(service)
        except PatternError as error:
            self._refuse(service, error, service.position)
            return
        self._failures.pop(name, None)
        if mark is not None and (mark.life == service.life or self._given is not None):
            member.mark = replace(mark, is_done=False)
        if not self._is_restored(member):
            if row.position > service.after:
                member.known = self._identities(service)
            rules = self._pass_for(service.after if start is None else start, self._foreknown_to(service))
            try:
                rules.add(member)
            except Exception as error:  # Whatever it is, the processor begins with the others.
                self._refuse(service, error, service.position)

    def _foreknown_to(self, service: Service) -> int:
        """Up to where the log is read for what holds of cameras before its turn, however often the version begins."""
        known = self._services.get(service.key)
        is_deployed = known is not None and known.rule_hash == service.rule_hash
        return service.position if is_deployed else self._made_at

    def _member(self, service: Service) -> Member:
        rule = self._rule(service)
        bound = bind(rule, self._readable_by(rule), limits=self._limits.rules)
        return Member(service, bound, Mark(service.after, service.life))

    def _readable_by(self, rule: Rule) -> Mapping[str, pa.Schema]:
        """What the rule may be written over.

        Raises:
            RuleError: The rule's situations lead back to it.
        """
        if not rules_read(rule):
            return self._schemas
        return readable_by(self._log, rule, None if self._given is None else list(self._given.values()))

    def _rule(self, service: Service) -> Rule:
        given = (self._given or {}).get(service.key)
        return given if given is not None else rule_of(service)

    def _is_restored(self, member: Member) -> bool:
        """Whether the rule goes on from its saved state; otherwise the log is read again from where it began."""
        name, version = member.service.key
        try:
            state = stored_state(self._log, self._station, name, version)
        except StateError as error:
            self._warn_of_state(member, error)
            return False
        if state is None or (state.life != member.mark.life):
            return False
        rules = self._pass_for(state.position, state.foreknown_to)
        try:
            rules.add(member, state)
        except Exception as error:  # What else a state leads to that fits nothing any more: it is of no use.
            self._warn_of_state(member, error)
            return False
        member.mark = replace(member.mark, saved=state.position)
        member.finish_after_us = state.finish_after_us
        return True

    def _warn_of_state(self, member: Member, error: Exception) -> None:
        logger.warning(
            "rule %s version %d is run again from position %d, and nothing is appended twice: %s",
            *member.service.key, member.service.after, error if isinstance(error, StateError) else repr(error),
        )  # fmt: skip

    def _identities(self, service: Service) -> set[str]:
        """Of the situations of a version that are in the log behind where it begins."""
        types = [SituationDetected.type_name, SituationShadowed.type_name]
        producer = f"rule/{service.rule}", str(service.version)
        found = set()
        for segment in self._log.read_all(service.after + 1, types=types, stations=[self._station]):
            if (segment.header.producer.name, segment.header.producer.version) == producer:
                said = decode(segment, self._log.catalogue)
                found |= set(said.data.column("situation").to_pylist())
        return found

    def _pass_for(self, position: int, foreknown_to: int) -> Pass:
        """The pass at this position, and with what is known up to the other, to which a rule may be added."""
        foreknown_to = foreknown_to if foreknown_to > position else 0
        passes = (self._main, *self._joining)
        found = next((each for each in passes if each.is_at(position, foreknown_to)), None)
        if found is None:
            made = self._pass_at(position, foreknown_to)
            found = next((each for each in passes if each.is_at(position, made.foreknown_to)), made)
            if found is made:
                self._joining.append(made)
        return found

    def _pass_at(self, position: int, foreknown_to: int) -> Pass:
        known = known_at(self._log, position, foreknown_to)
        rules = Pass(position, self._log.catalogue, self._limits, known)
        self._plan_save(rules)
        return rules

    # Forward.

    def _follow(self, timeout_s: float) -> bool:
        """Give the leading pass what comes next, up to where the set of rules changes; whether that is all there is."""
        delivery = self._subscription.poll(timeout_s)
        segments, rule_events = self._cut(delivery.segments)
        position = rule_events[-1].position if rule_events else delivery.position
        is_caught_up = delivery.is_caught_up and not rule_events
        self._is_stale = True  # until what follows from the segments is known, the rules are ahead of it
        findings = self._taken(self._main, segments)
        self._main.position = position
        if self._main.reads_situations:
            is_caught_up = is_caught_up and not segments  # what these led to is still to be read
            is_settled = is_caught_up and not self._joining  # what those behind find is still to be read, too
            findings += self._main.settle(self._live_source) if is_settled else []
        if is_caught_up and self._now is not None:
            findings += self._main.fall_idle(self._now())
        self._subscription.position = position
        self._work = Work(self._main, position, findings, rule_events)
        self._is_stale = False
        return is_caught_up

    def _live_source(self, member: Member, position: int) -> str | None:
        """A source that may still lead to situations that the rule reads."""
        others = rules_in_service(self._log) if self._given is None else list(self._given.values())
        return live_source(self._log, Below(types_below(member.rule, others), member.service.after), position)

    def _catch_up(self, rules: Pass) -> None:
        """Give a pass that is behind a page of what lies between it and the leading one."""
        until = self._main.position
        found = self._log.read_all(rules.position + 1, types=sorted(rules.types), to_position=until)
        page = list(islice(found, self._limits.segments))
        self._is_stale = True
        findings = self._taken(rules, page)
        if len(page) < self._limits.segments:
            rules.position = until
        self._work = Work(rules, rules.position, findings, [])
        self._is_stale = False

    def _taken(self, rules: Pass, segments: Sequence[Segment]) -> list[Finding]:
        """What segments, the next of the pass, lead to.

        Raises:
            RunOneByOne: A rule failed; this begins again from the log.
        """
        self._recorded_at = max([self._recorded_at, *(each.recorded_at for each in segments)])
        return rules.take(segments, is_one_by_one=rules.position < self._one_by_one_to)

    def _cut(self, segments: list[Segment]) -> tuple[list[Segment], list[Segment]]:
        """The segments before the first that says which rules run, and that with those right behind it."""
        if self._given is not None:
            return segments, []
        first = next((at for at, each in enumerate(segments) if self._is_rule_event(each)), len(segments))
        last = first
        while last < len(segments) and self._is_rule_event(segments[last]):
            if last > first and segments[last].position != segments[last - 1].position + 1:
                break
            last += 1
        return segments[:first], segments[first:last]

    def _is_rule_event(self, segment: Segment) -> bool:
        stream = segment.stream
        names = [each.type_name for each in RULE_EVENTS]
        is_ours = (stream.station, stream.source) == (self._station, SOURCE) and stream.type in names
        return is_ours and segment.position > self._known_to

    def _finish_work(self) -> int:
        """Commit what was found, and then change the set of rules where the log said so; the situations appended."""
        work = self._work
        if work is None:
            return 0
        is_saving = self._is_save_due(work.rules)
        situations = self._commit(work, is_saving=is_saving)
        if work.rule_events:
            self._is_stale = True  # a change is taken in whole, or again from the log
            self._change(work.rule_events)
            self._is_stale = False
        self._work = None  # what is committed is not committed again, whatever follows
        if is_saving:
            work.rules.use_kernel()
        self._joined()
        self._note_position()
        return situations

    def _note_position(self) -> None:
        """Once nothing is left to commit: who asks from another thread shall not hear of what is still under way."""
        if self._work is None:
            self._position = min(each.position for each in (self._main, *self._joining))

    def _change(self, segments: Sequence[Segment]) -> None:
        """Take in what segments, one right behind the other, say about which rules run from here on."""
        first, last = segments[0].position, segments[-1].position
        for service in [each for segment in segments for each in note(self._services, segment, self._log.catalogue)]:
            running = {each.service.key: each for each in self._members()}
            member = running.get(service.key)
            if member is not None and member.mark.life != service.life:
                next(each for each in (self._main, *self._joining) if member.name in each.members).remove(member)
                member = None
            if member is not None:
                member.service = service
            elif service.retirement is None:
                self._admit(service, last if service.after >= first else None)
        self._want()

    def _joined(self) -> None:
        """Let the passes that caught up become part of the leading one."""

        def is_as_far(rules: Pass) -> bool:
            return not rules.members or self._main.is_at(rules.position, rules.foreknown_to)

        for rules in [each for each in self._joining if is_as_far(each)]:
            self._joining.remove(rules)
            self._segments_skipped += rules.segments_skipped
            for member, error in self._main.absorb(rules):
                self._refuse(member.service, error, rules.position)
            self._want()

    def _want(self) -> None:
        """Ask the log for the types that the leading pass reads."""
        types = self._main.types
        if self._given is None:
            types |= {str(each.type_name) for each in RULE_EVENTS}
        self._subscription.want(sorted(types))

    def _members(self) -> list[Member]:
        return [member for rules in (self._main, *self._joining) for member in rules.members.values()]

    # Out of service.

    def _leaving(self, rules: Pass) -> list[Member]:
        """The rules that leave service now: set aside, dropped, or done with what they had begun."""
        rules.pace()
        return [each for each in rules.members.values() if each.failure is not None or self._is_over(rules, each)]

    def _is_over(self, rules: Pass, member: Member) -> bool:
        gone = member.service.retirement
        if gone is None or rules.position < gone.position:
            return False
        if gone.open_matches == "dropped":
            return True
        status = rules.status(member)
        if status.partitions_open == 0 and status.rows_waiting == 0:
            return True
        if member.finish_after_us is None:
            within_us = member.bound.within_us
            longest_us = microseconds(self._limits.finish) if within_us is None else within_us
            member.finish_after_us = newest_of(rules.newest_us, member.types) + longest_us
        watermark_us = None if status.watermark is None else as_microseconds(status.watermark)
        return isinstance(watermark_us, int) and watermark_us > member.finish_after_us

    def _set_aside(self, service: Service, error: Exception) -> None:
        """Name the rule that cannot go on."""
        self._failures[service.rule] = error
        logger.error("rule %s is set aside: %s", service.rule, error)

    def _refuse(self, service: Service, error: Exception, position: int) -> None:
        """Set a rule aside that is in no pass, and say so in the log, where that says which rules run."""
        self._set_aside(service, error)
        if self._given is None and service.retirement is None:
            self._log.append(self._committer.end_of(service, error, position))

    def _at(self) -> datetime:
        """When it is now, by the clock on the wall or, in a replay, by that of the log."""
        return self._recorded_at if self._now is None else self._now()

    # Into the log.

    def _is_save_due(self, rules: Pass) -> bool:
        if all(each.mark.saved >= rules.position for each in rules.members.values()):
            return False
        return self._clock() >= rules.save_at or rules.events_unsaved >= self._limits.save_every_events

    def _plan_save(self, rules: Pass) -> None:
        rules.save_at, rules.events_unsaved = self._clock() + self._limits.save_every_s, 0

    def _commit(self, work: Work, *, is_saving: bool) -> int:
        written = self._committer.written(work)
        leaving = self._leaving(work.rules)
        states = self._committer.states(work, leaving, is_saving=is_saving)
        leaving += [each for each in work.rules.members.values() if each.failure is not None and each not in leaving]
        situations = self._committer.commit(work, written, leaving, states)
        for member in leaving:
            if member.failure is not None:
                self._set_aside(member.service, member.failure)
        if is_saving:
            self._plan_save(work.rules)
        return situations


def _given_service(rule: Rule, known: Service | None, after: int = 0) -> Service:
    """How a rule stands that was given: as the log says, but in service whatever that says."""
    if known is not None and known.rule_hash == rule.hash:
        return replace(known, retirement=None)
    producer = producer_of(rule)
    return Service(
        rule=rule.rule,
        version=rule.version,
        rule_hash=producer.configuration_hash.hex(),
        text="",
        deployed_at=datetime(1970, 1, 1, tzinfo=UTC),
        position=after,
        after=after,
        is_shadow=rule.shadow,
    )
