"""The online processor: follows the log, runs rules over it, appends the situations they find.

Contract: one pass of the log feeds all rules. Each rule has a checkpoint of its own (position and
open state), and a rule's situations and its checkpoint commit in one transaction, so a situation is
appended exactly once whatever is killed when. Each segment is given to a rule as one whole, in
order of position; what a rule finds therefore depends on the log alone, not on how it was read.

A source is live from its first event until its process has finished or failed; then it no longer
holds the watermark back, and when no source is live the rule's input has ended. A rule that raises
is set aside and named; the others go on.
"""

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import pyarrow as pa

from events import (
    Catalogue,
    Draft,
    EventType,
    MatchedRange,
    ProcessFailed,
    ProcessFinished,
    Producer,
    RuleDeployed,
    Segment,
    SituationDetected,
    StreamName,
    UnknownType,
    batch_of,
    decode,
    encode,
    events_of,
    schema_of,
    with_envelope,
)
from patterns.binder import bind
from patterns.errors import PatternError
from patterns.rule import Rule
from patterns.running import Outcome, RuleRun
from patterns.site import SITE_TYPES
from patterns.situations import Match
from store import Log, Subscription, Transaction

logger = logging.getLogger(__name__)

SOURCE = "rules"
"""Source of deployments, and of situations of a rule that is not partitioned by source."""
_CONTROL: tuple[type[EventType], ...] = (*SITE_TYPES, ProcessFinished, ProcessFailed)


@dataclass(frozen=True, slots=True)
class Step:
    """What one step of the processor did."""

    position: int
    """every rule has seen the log up to here"""
    is_caught_up: bool
    situations: int
    """situations appended"""


@dataclass(slots=True)
class _Running:
    """One rule in service."""

    rule: Rule
    run: RuleRun
    saved: int
    """position of its checkpoint in the log"""
    failure: PatternError | None = None


class _Overtaken(Exception):
    """Another processor moved a rule's checkpoint: this one's state is stale."""


def checkpoint_name(station: str, rule: Rule) -> str:
    """Name of the checkpoint of a station's rule in the log."""
    return f"rule/{station}/{rule.rule}/{rule.version}"


def schemas(catalogue: Catalogue) -> dict[str, pa.Schema]:
    """What a rule may be written over: each event type's columns, the envelope's first."""
    names = ("station", "source", "type", "subject")
    envelope = [*(pa.field(name, pa.string()) for name in names), pa.field("sequence", pa.int64())]
    return {str(each.type_name): pa.schema([*envelope, *schema_of(each)]) for each in catalogue}


def deploy(log: Log, station: str, rules: Sequence[Rule], texts: Mapping[str, str], at: datetime) -> list[Rule]:
    """Record the rules as deployed where they are new; those that were new.

    Args:
        log: The log.
        station: This station.
        rules: The rules.
        texts: The rule files' texts by rule name.
        at: The time of the deployment.

    Raises:
        PatternError: A version that was deployed before now has another content.
    """
    stream = StreamName.of(station, SOURCE, RuleDeployed.type_name)
    deployed = _deployed(log, stream)
    for rule in rules:
        known = deployed.get((rule.rule, rule.version), rule.hash)
        if known != rule.hash:
            raise PatternError(
                f"rule {rule.rule} version {rule.version} is deployed with another content: deployed hash "
                f"{known[:12]}, this file's {rule.hash[:12]}. Next: give the changed rule a new version"
            )
    new = [rule for rule in rules if (rule.rule, rule.version) not in deployed]
    expected = log.stream_head(stream).sequence
    for number, rule in enumerate(new):
        event = RuleDeployed(
            time=at, rule=rule.rule, rule_version=rule.version, rule_hash=rule.hash, text=texts[rule.rule]
        )
        log.append([encode(stream, batch_of([event]), _producer(rule))], [expected + number])
    return new


class Processor:
    """Runs rules over one log. Not for several threads at once."""

    def __init__(
        self, log: Log, station: str, rules: Sequence[Rule], now: Callable[[], datetime] | None = None
    ) -> None:
        """Build a processor that goes on where the rules' checkpoints stand.

        Args:
            log: The log.
            station: This station, in whose streams the situations go.
            rules: The rules.
            now: The clock on the wall, by which a rule's `time.idle` is judged; without one, a silent
                source holds the watermark until its process ends, as a replay needs it.

        Raises:
            PatternError: A rule does not fit the catalogue, or its saved state is not its own.
        """
        self._log = log
        self._station = station
        self._now = now
        self._schemas = schemas(log.catalogue)
        self._rules = list(rules)
        self._running: list[_Running] = []
        self._is_stale = False
        self.segments_skipped = 0
        """Segments of a type or version unknown here, which took no part."""
        self._unknown = 0
        self._restore()
        types = {each.type_name for each in _CONTROL} | {
            name for running in self._running for name in running.run.input_types
        }
        self._subscription = Subscription(log, "rules", types=sorted(types))
        self._subscription.position = self._first_position()

    @property
    def position(self) -> int:
        """Every rule has seen the log up to here."""
        return self._subscription.position

    @property
    def failures(self) -> dict[str, PatternError]:
        """The rules that were set aside, and why."""
        return {each.rule.rule: each.failure for each in self._running if each.failure is not None}

    @property
    def late(self) -> dict[str, int]:
        """For each rule the rows that came too late to take part."""
        return {each.rule.rule: each.run.counts.late for each in self._running}

    def step(self, timeout_s: float = 0.0) -> Step:
        """Run the rules over the next segments, waiting up to `timeout_s` seconds for some.

        Raises:
            LogUnavailable: The database is away; nothing is lost, step again later.
        """
        if self._is_stale:
            self._reset()
        before = self._subscription.position
        delivery = self._subscription.poll(timeout_s)
        if not delivery.segments and self._now is None:
            return Step(delivery.position, delivery.is_caught_up, 0)
        # Until the commit the rules' state is ahead of the log; if that fails, both begin again from there.
        self._is_stale = True
        self._subscription.position = before
        self._unknown = 0
        try:
            drafts = [draft for segment in delivery.segments for draft in self._found(segment)]
            drafts += self._found_idle() if delivery.is_caught_up else []
            if delivery.segments or drafts:
                self._commit(delivery.position, drafts)
        except _Overtaken as error:
            logger.warning("%s; going on from the log", error)
            return Step(before, False, 0)
        self._is_stale = False
        self._subscription.position = delivery.position
        self.segments_skipped += self._unknown
        return Step(delivery.position, delivery.is_caught_up, sum(draft.event_count for draft in drafts))

    def catch_up(self) -> int:
        """Run the rules over all that is there now; the number of situations appended."""
        situations = 0
        while True:
            step = self.step()
            situations += step.situations
            if step.is_caught_up:
                return situations

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()

    # One segment, all rules.

    def _found(self, segment: Segment) -> list[Draft]:
        """The situations that a segment makes final, as one draft for each rule and source."""
        try:
            batch = decode(segment, self._log.catalogue)
        except UnknownType as error:
            self._unknown += 1
            logger.warning("no rule sees the segment at position %d: %s", segment.position, error)
            return []
        rows = with_envelope(segment.stream, segment.header.first_sequence, batch)
        events = events_of(batch) if batch.type in _CONTROL else []
        drafts = []
        for running in self._running:
            if segment.position > running.saved:
                drafts += self._guarded(running, partial(self._outcome, running, rows, events, segment))
        return drafts

    def _found_idle(self) -> list[Draft]:
        """The situations that become final because a source has been silent for the rule's idle time."""
        if self._now is None:
            return []
        now = self._now()
        drafts = []
        for running in self._running:
            if running.rule.time.idle is not None:
                drafts += self._guarded(running, partial(running.run.advance_idle, now))
        return drafts

    def _guarded(self, running: _Running, find: Callable[[], Outcome]) -> list[Draft]:
        """The drafts of what a rule found; none if it raises, which sets it aside."""
        if running.failure is not None:
            return []
        try:
            matches = find().matches
        except PatternError as error:
            running.failure = error
            logger.error("rule %s is set aside: %s", running.rule.rule, error)
            return []
        return drafts_of(running.rule, self._station, matches)

    def _outcome(
        self, running: _Running, rows: pa.RecordBatch, events: Sequence[EventType], segment: Segment
    ) -> Outcome:
        source = segment.stream.source
        outcomes: list[Outcome] = []
        if segment.stream.type in running.run.input_types:
            outcomes.append(running.run.push(rows))
        for number, event in enumerate(events):
            if isinstance(event, SITE_TYPES):
                running.run.learn(event, str(segment.stream), segment.header.first_sequence + number)
            else:
                outcomes.append(running.run.source_ended(source))
        whole = Outcome(
            tuple(match for outcome in outcomes for match in outcome.matches),
            tuple(late for outcome in outcomes for late in outcome.late),
        )
        for late in whole.late:
            logger.warning("rule %s: %s/%d came too late", running.rule.rule, late.stream, late.sequence)
        return whole

    # Checkpoints.

    def _commit(self, position: int, drafts: Sequence[Draft]) -> None:
        """Save the rules' states and append their situations, all or nothing."""
        with self._log.transaction() as transaction:
            for running in self._running:
                if running.failure is None:
                    self._save(transaction, running, position)
            transaction.append(drafts)
        for running in self._running:
            if running.failure is None:
                running.saved = max(running.saved, position)

    def _save(self, transaction: Transaction, running: _Running, position: int) -> None:
        name = checkpoint_name(self._station, running.rule)
        stored = transaction.checkpoint(name).position
        if stored != running.saved:
            raise _Overtaken(f"rule {running.rule.rule} was moved from position {running.saved} to {stored}")
        if position >= running.saved:
            transaction.save_checkpoint(name, position, running.run.state())

    def _restore(self) -> None:
        self._running = [self._restored(rule) for rule in self._rules]

    def _restored(self, rule: Rule) -> _Running:
        run = RuleRun(bind(rule, self._schemas))
        checkpoint = self._log.checkpoint(checkpoint_name(self._station, rule))
        if checkpoint.position:
            run.restore(checkpoint.state)
        return _Running(rule, run, checkpoint.position)

    def _reset(self) -> None:
        """Begin again from the log's checkpoints; rules that were set aside stay so."""
        failures = {each.rule.rule: each.failure for each in self._running}
        self._restore()
        for running in self._running:
            running.failure = failures.get(running.rule.rule)
        self._subscription.position = self._first_position()
        self._is_stale = False

    def _first_position(self) -> int:
        return min((each.saved for each in self._running if each.failure is None), default=self._log.head())


def drafts_of(rule: Rule, station: str, matches: Sequence[Match]) -> list[Draft]:
    """The matches as situations to append: one draft for each source, in order."""
    by_source: dict[str, list[SituationDetected]] = {}
    for match in matches:
        by_source.setdefault(str(match.partition.get("source") or SOURCE), []).append(situation_of(match))
    return [
        encode(StreamName.of(station, source, SituationDetected.type_name), batch_of(events), _producer(rule))
        for source, events in by_source.items()
    ]


def situation_of(match: Match) -> SituationDetected:
    """The event that says the match."""
    return SituationDetected(
        time=match.decided_at or match.last.time,
        situation=match.situation_id,
        rule=match.rule,
        rule_version=match.version,
        rule_hash=match.rule_hash,
        severity=match.severity,
        title=match.title,
        partition=_json(match.partition),
        measures=_json(match.measures),
        began_at=match.first.time,
        ended_at=match.last.time,
        lineage=tuple(
            MatchedRange(
                variable=variable,
                stream=each.stream,
                first_sequence=each.first_sequence,
                last_sequence=each.last_sequence,
                events=each.rows,
            )
            for variable, ranges in (*match.lineage.items(), *match.judged_by.items())
            for each in ranges
        ),
    )


def _json(values: Mapping[str, Any]) -> str:
    """JSON of partition columns or measures: times in ISO 8601, durations in seconds, NaN as null."""
    finite = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()
    }
    return json.dumps(finite, default=_plain, ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    assert isinstance(value, timedelta), f"rules have no values of {type(value)}"
    return value.total_seconds()


def _deployed(log: Log, stream: StreamName) -> dict[tuple[str, int], str]:
    """Hashes of the rules that were deployed, by name and version."""
    found = {}
    for segment in log.read_lives(stream):
        for event in events_of(decode(segment, log.catalogue)):
            assert isinstance(event, RuleDeployed)
            found[event.rule, event.rule_version] = event.rule_hash
    return found


def _producer(rule: Rule) -> Producer:
    return Producer(f"rule/{rule.rule}", str(rule.version), bytes.fromhex(rule.hash))
