"""Into the log: what a step found, with the marks of who found it, in one transaction.

Contract: a situation is appended exactly once, however often a commit is tried and however many
processors try. The marks are locked first and compared: what another processor appended is not
appended again, and where it decided something that the log does not hold (that a source is silent), this
one is told to begin again from the log.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache, partial
from typing import Any, Literal

from events import Draft, Segment, StreamName
from patterns.engine.situations import EventRef
from patterns.errors import PatternError, RuleTooSlow
from patterns.processor.deploying import Service, retirement_draft
from patterns.processor.members import Finding, Member
from patterns.processor.passes import Pass
from patterns.processor.saving import Mark, SavedState, mark_bytes, mark_name, mark_of, state_bytes, state_name
from patterns.processor.writing import drafts_of_each
from store import Checkpoint, Log


class Overtaken(Exception):
    """Another processor has decided something that this one does not know: it must begin again from the log."""


@dataclass(slots=True)
class Work:
    """What a pass has found and not committed yet.

    Attributes:
        rules: The pass.
        position: It has seen the log up to here.
        findings: What it found, in order.
        rule_events: Segments that say which rules run from here on.
    """

    rules: Pass
    position: int
    findings: list[Finding]
    rule_events: list[Segment]


@dataclass(frozen=True, slots=True)
class Written:
    """A finding, how many situations it tells, and these as segments to append."""

    finding: Finding
    situations: int
    drafts: list[Draft]


class Committer:
    """Writes what is found. Not for several threads at once."""

    def __init__(self, log: Log, station: str, at: Callable[[], datetime], *, is_recording_ends: bool) -> None:
        """Make one.

        Args:
            log: The log.
            station: This station.
            at: When it is now.
            is_recording_ends: Whether a rule that leaves service is to stay out of it.
        """
        self._log = log
        self._station = station
        self._at = at
        self._is_recording_ends = is_recording_ends

    def written(self, work: Work) -> list[Written]:
        """What was found as segments to append.

        A rule whose situations cannot be written is marked as failed where the first of these was found, as one that
        raises, and what it found from there on is taken out of the work: the others go on.
        """
        of_member: dict[str, list[int]] = {}
        for place, each in enumerate(work.findings):
            of_member.setdefault(each.member.name, []).append(place)
        written: dict[int, Written] = {}
        for places in of_member.values():
            written |= zip(places, self._written_of([work.findings[place] for place in places]), strict=False)
        ordered = [written[place] for place in sorted(written)]
        work.findings[:] = [each.finding for each in ordered]
        return ordered

    def states(self, work: Work, leaving: Sequence[Member], *, is_saving: bool) -> dict[str, bytes]:
        """By rule that stays what it remembers, to be saved.

        A rule of which that cannot be had is marked as failed behind this work, as one that raises: the others go on.

        Args:
            work: What was found.
            leaving: The rules that leave service with it.
            is_saving: Whether all are saved; else those only that silence has moved, which the log does not hold.
        """
        silenced = {each.member.name for each in work.findings if each.is_by_silence}
        states = {}
        for member in work.rules.members.values():
            if member in leaving or not (is_saving or member.name in silenced):
                continue
            try:
                states[member.name] = state_bytes(_state(work, member))
            except Exception as error:  # The rule is named with it when it leaves.
                member.failure, member.failed_at = error, work.position + 1
        return states

    def commit(
        self, work: Work, written: Sequence[Written], leaving: Sequence[Member], states: Mapping[str, bytes]
    ) -> int:
        """Append what was found, and set the marks; the number of situations appended.

        Args:
            work: What was found.
            written: The same as segments.
            leaving: The rules that leave service with it.
            states: By rule what it remembers, of those of which that is saved, too.

        Raises:
            Overtaken: Another processor has decided something that this one does not know. Nothing is appended.
            LogUnavailable: It may have been committed or not: try again with the same work.
        """
        members = list(work.rules.members.values())
        silenced = {each.member.name for each in work.findings if each.is_by_silence}
        said = {each.member.name for each in work.findings if each.outcome.matches}
        saving = [each for each in members if each.name in states]
        moving = [each for each in members if each in leaving or each in saving or each.name in said]
        if not moving:
            return 0
        places = {each.name: mark_name(self._station, *each.service.key) for each in moving}
        with self._log.transaction() as transaction:
            locked = transaction.checkpoints(list(places.values()))
            stored = {each.name: self._agreed(work, each, mark_of(locked[places[each.name]])) for each in moving}
            fresh = [
                each for each in written if each.drafts and _is_new(each.finding, stored[each.finding.member.name])
            ]
            drafts = [draft for each in fresh for draft in each.drafts]
            marks, checkpoints = {}, {}
            for member in moving:
                before = stored[member.name]
                is_saved = member in saving and (member.name in silenced or before.saved < work.position)
                if is_saved:
                    checkpoints[state_name(self._station, *member.service.key)] = Checkpoint(
                        work.position, states[member.name]
                    )
                if is_saved or member in leaving:
                    drafts += member.missed.drafts(self._station, self._at())
                if member in leaving:
                    drafts += self._end(member)
                mark = _moved(work, member, before, is_silenced=member.name in silenced, is_saved=is_saved)
                marks[member.name] = replace(mark, is_done=self._is_recording_ends and member in leaving)
                checkpoints[places[member.name]] = Checkpoint(mark.position, mark_bytes(marks[member.name]))
            transaction.save_checkpoints(checkpoints)
            transaction.append(drafts)
        for member in moving:
            if member in leaving or member.name in silenced or marks[member.name].saved > member.mark.saved:
                member.missed.clear()
            member.mark = marks[member.name]
        for member in leaving:
            work.rules.remove(member)
        return sum(each.situations for each in fresh)

    def end_of(self, service: Service, error: Exception, position: int) -> list[Draft]:
        """The event that says that a version cannot go on."""
        why: Literal["too_slow", "failed"] = "too_slow" if isinstance(error, RuleTooSlow) else "failed"
        text = str(error) if isinstance(error, PatternError) else f"{type(error).__name__}: {error}"
        reason = f"at position {position}: {text}"
        return [retirement_draft(self._station, service, self._at(), why, "dropped", reason)]

    def _end(self, member: Member) -> list[Draft]:
        is_told = member.service.retirement is not None
        if member.failure is None or is_told or not self._is_recording_ends:
            return []
        return self.end_of(member.service, member.failure, member.failed_at)

    def _written_of(self, findings: Sequence[Finding]) -> list[Written]:
        """What findings of one rule are as segments; those before the first that cannot be written."""
        member = findings[0].member
        is_before_end = self._is_before_end_of(member)
        told = [member.told(each, is_before_end) for each in findings]
        write = partial(drafts_of_each, member.rule, self._station, is_shadow=member.service.is_shadow)
        try:
            drafts = write(told)
        except Exception:  # Whatever it is, the other rules go on; which finding it is shows one by one.
            drafts = []
            for finding, matches in zip(findings, told, strict=True):
                try:
                    drafts += write([matches])
                except Exception as error:  # The rule is named with it when it leaves.
                    member.failure, member.failed_at = error, finding.position
                    break
        return [Written(each, len(matches), few) for each, matches, few in zip(findings, told, drafts, strict=False)]

    def _agreed(self, work: Work, member: Member, stored: Mark | None) -> Mark:
        """The rule's mark in the log, which may be further on than what this processor knows.

        Raises:
            Overtaken: Another processor knows of silence, of another life or of an end, that this one does not.
        """
        known = member.mark
        if stored is None or stored.life < known.life:
            return replace(known, saved=0)
        is_done = stored.is_done and self._is_recording_ends
        is_saved_between = known.saved < stored.saved < work.position
        if stored.life > known.life or stored.idles != known.idles or is_done or is_saved_between:
            raise Overtaken(f"rule {member.name} was moved on by another processor, to position {stored.position}")
        return replace(stored, position=max(stored.position, known.position))

    def _is_before_end_of(self, member: Member) -> Callable[[EventRef], bool]:
        """Whether an event lies before the rule's retirement."""
        gone = member.service.retirement

        @cache
        def last(stream: str) -> int:
            assert gone is not None, "asked of retired rules only"
            return self._log.stream_head(StreamName.of(*stream.split("/")), at_position=gone.position).sequence

        return lambda event: event.sequence <= last(event.stream)


def _is_new(finding: Finding, stored: Mark) -> bool:
    """Whether what was found is not in the log yet; what silence led to is, only if the marks differ."""
    return finding.is_by_silence or finding.position > stored.position


def _moved(work: Work, member: Member, stored: Mark, *, is_silenced: bool, is_saved: bool) -> Mark:
    """The mark behind this work. That of a rule that failed stays where it was still well."""
    position = work.position if member.failure is None else member.failed_at - 1
    return Mark(
        position=max(position, stored.position),
        life=member.mark.life,
        idles=stored.idles + is_silenced,
        saved=work.position if is_saved else stored.saved,
        report=_report(work, member) if is_saved else stored.report,
    )


def _state(work: Work, member: Member) -> SavedState:
    return SavedState(
        position=work.position,
        life=member.mark.life,
        run=work.rules.state(member),
        newest_us=work.rules.newest_us,
        finish_after_us=member.finish_after_us,
        foreknown_to=work.rules.foreknown_to,
    )


def _report(work: Work, member: Member) -> dict[str, Any]:
    """How the rule stands, for those who ask."""
    status = work.rules.status(member)
    return {
        "rows": status.counts.rows,
        "late": status.counts.late,
        "matches": status.counts.matches,
        "held_back": status.held_back,
        "partitions_open": status.partitions_open,
        "rows_waiting": status.rows_waiting,
        "watermark": None if status.watermark is None else status.watermark.isoformat(),
        "uncalibrated": dict(member.uncalibrated),
        "spent_s": round(status.spent_s, 6),
        "event_us": round(member.pace.event_us, 3) or member.mark.report.get("event_us", 0.0),
    }
