"""Running a rule: in batch, which is the definition, and online, which must equal it.

A `RuleRun` takes rows in any order within the lateness, holds them until they
are final, and hands them on in the total order (time, stream, sequence). A row
is final when its time is strictly below the watermark. Matches leave in the
order of the times that decided them, which no way of splitting the rows
changes; each leaves once.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from events import CameraCalibrated, EventType, SceneChanged, ZoneDefined, ZoneRemoved
from patterns.binding.bound import BoundRule
from patterns.binding.inputs import SITUATION, rows_of
from patterns.binding.rows import (
    SEQUENCE,
    STREAM,
    TIME,
    StreamNumbers,
    check_envelope,
    in_total_order,
    newest_by_source,
)
from patterns.binding.titles import Scalar
from patterns.durations import microseconds
from patterns.engine.clock import Clock
from patterns.engine.emitter import Emitter
from patterns.engine.engine import Engine, Key
from patterns.engine.finds import Finds
from patterns.engine.matcher import Found, Loss
from patterns.engine.saved import Saved, decode, encode, partitions_from_json, partitions_to_json
from patterns.engine.situations import EventRef, Match, Narrator, as_microseconds, as_python, event_ref, nearest_time
from patterns.engine.timers import TIMER_STREAM
from patterns.errors import StateError
from patterns.scene.site import Site

SITUATIONS_SOURCE = "rules"
"""Source of the situations of rules that are not partitioned by source. No process ends it."""

Rows: TypeAlias = pa.Table | pa.RecordBatch


@dataclass(frozen=True, slots=True)
class GivenUp:
    """What a limit cost: partial matches of a partition, or of several for one reason, that were forgotten.

    Attributes:
        partition: The partition columns and their values; of several, those of the oldest.
        partial_matches: How many partial matches were forgotten; 0: only rows that are looked back at, or that one
            could have begun at.
        why: The limit that was reached, in words.
        since: The time of the first row of what was forgotten.
        partitions: How many partitions they were of.
    """

    partition: dict[str, Scalar]
    partial_matches: int
    why: str
    since: datetime
    partitions: int = 1


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a step of a run led to.

    Attributes:
        matches: The matches that became final, in order.
        late: Rows that came after the watermark had passed them; they take part in no match.
        given_up: What was forgotten because a limit was reached.
    """

    matches: tuple[Match, ...] = ()
    late: tuple[EventRef, ...] = ()
    given_up: tuple[GivenUp, ...] = ()

    def __add__(self, later: "Outcome") -> "Outcome":
        """What this step and a later one led to."""
        return Outcome(self.matches + later.matches, self.late + later.late, self.given_up + later.given_up)


@dataclass(slots=True)
class Counts:
    """What a run has seen: rows in time, rows too late, matches emitted."""

    rows: int = 0
    late: int = 0
    matches: int = 0


def match(bound: BoundRule, rows: Rows) -> list[Match]:
    """The rule's situations in these rows, which are all there are, in any order.

    This is the definition: a `RuleRun` gives the same, however the rows come, as long as none is late.

    Raises:
        MatchError: The rule cannot go on with these rows.
        LimitError: It remembers more than it may.
    """
    run = RuleRun(bound, is_strict=True)
    run.hold(rows)
    return list(run.finish().matches)


class RuleRun:
    """One rule, online. Not for several threads at once.

    One pushed batch is one unit of arrival: its rows are judged against the watermark as it was
    before, then move it. So what is late depends on the batches and their order alone.
    """

    def __init__(self, bound: BoundRule, *, is_strict: bool = False) -> None:
        """A run that has seen nothing.

        Args:
            bound: The rule.
            is_strict: Whether a limit that is reached is an error, as in batch; else what it costs is
                forgotten, and said in the outcome.
        """
        rule = bound.rule
        self.bound = bound
        self.is_strict = is_strict
        self._given_up: list[GivenUp] = []
        self.counts = Counts()
        self._site = bound.site.copy()
        idle = rule.time.idle
        self._clock = Clock(microseconds(rule.time.lateness), None if idle is None else microseconds(idle))
        self._streams = StreamNumbers()
        self._waiting: list[pa.Table] = []
        self._waiting_min_us: int | None = None
        self._emitter = Emitter(rule.emit)
        self._reads_situations = SITUATION in bound.types
        self._rules_read = {each.situation_of for each in bound.inputs if each.type == SITUATION}
        self._attach()

    @property
    def input_types(self) -> frozenset[str]:
        """The event types that the rule reads."""
        return self.bound.types

    @property
    def watermark(self) -> datetime | None:
        """No row before this time is still expected; None: nothing is known yet."""
        watermark_us = self._clock.watermark_us
        return None if watermark_us is None else nearest_time(watermark_us)

    @property
    def held_back(self) -> int:
        """How many matches `once_per` and `cooldown` held back."""
        return self._emitter.held_back

    @property
    def partitions_open(self) -> int:
        """How many partitions anything is remembered of."""
        return len(self._engine.open)

    @property
    def rows_waiting(self) -> int:
        """How many rows are not final yet."""
        return sum(table.num_rows for table in self._waiting)

    @property
    def partial_matches(self) -> int:
        """How many partial matches are open, of all partitions."""
        attempts = (attempt for state in self._engine.open.values() for attempt in state.partition.attempts)
        return sum(len(attempt.threads) for attempt in attempts)

    def set_frame_size(self, source: str, width: int, height: int) -> None:
        """The source's frames have this size in pixels, from the next step on."""
        self._site.frame_sizes[source] = (width, height)

    def know(self, site: Site) -> None:
        """Takes in all that another site knows, beside what was known when the rule was bound."""
        self._site.take(site)

    def learn(self, event: EventType, stream: str, sequence: int, *, epoch: int = 1) -> None:
        """Takes in what an event says of a camera; it holds for rows that are not final yet, and those to come.

        Args:
            event: An event of one of `patterns.scene.site.SITE_TYPES`; others say nothing.
            stream: Its stream, as station/source/type.
            sequence: Its sequence there.
            epoch: The epoch of the stream's station.

        Raises:
            MatchError: It says no zone, line or calibration, and the rule needs it.
        """
        if needs(self.bound, event, needs_calibration=self._narrator.needs_calibration):
            self._site.learn(event, stream, sequence, self._clock.watermark_us, epoch=epoch)

    def push(self, rows: Rows) -> Outcome:
        """Takes rows as they arrive, of any streams. Rows of other event types only move the watermark.

        Raises:
            MatchError: The rule cannot go on with these rows.
        """
        table = as_table(rows)
        check_envelope(table)
        if table.num_rows == 0:
            return Outcome()
        late = self._take(table)
        self._observe(table)
        return self._outcome(self._advance(), late)

    def source_ended(self, source: str) -> Outcome:
        """The source will send no more, so it holds nothing up; when all have ended, the input has.

        The input of a rule that reads situations has not: what other rules found until then is still to come.
        It ends with `settle`.
        """
        if self._reads_situations:
            self._clock.end_unheard(source)
        elif self._clock.end(source):
            return self.finish()
        return self._outcome(self._advance())

    @property
    def may_settle(self) -> bool:
        """Whether the rule reads situations, and all sources that it has heard of have ended."""
        return self._reads_situations and self._clock.have_ended(apart=SITUATIONS_SOURCE)

    def settle(self) -> Outcome:
        """All that was said so far has come. A rule that reads situations is finished where all sources have ended.

        It hears of a source by situations, and by other events that it reads: whether another source lives, that rules
        below it read, who calls this knows.
        """
        return self.finish() if self.may_settle else Outcome()

    def advance_idle(self, now: datetime) -> Outcome:
        """Looks, by the clock on the wall, for sources that have been silent for the idle time."""
        self._clock.look_for_idle(wall_us(now))
        return self._outcome(self._advance())

    def finish(self) -> Outcome:
        """The input has ended: everything is decided. What is pushed after this begins anew."""
        found = self._engine.take(self._released(None))
        found += self._engine.finish(self._clock.newest_us())
        matches = self._emitted(found)
        self._clock.reset()
        self._emitter.reset()
        self._note_threads()
        return self._outcome(matches)

    def hold(self, rows: Rows) -> None:
        """Takes rows that are neither late nor released before `finish`.

        Raises:
            MatchError: The rows are not of the shape that the rule was bound to.
        """
        table = as_table(rows)
        check_envelope(table)
        self._take(table)
        self._observe(table)

    def state(self) -> bytes:
        """All that the run remembers; `restore` in a new run of the same rule goes on from it."""
        header = {
            "rule": self.bound.rule.hash,
            "columns": {name: kind.name for name, kind in self.bound.columns.items()},
            "streams": self._streams.names,
            "site": self._site.to_json(),
            "clock": self._clock.to_json(),
            "emitter": self._emitter.to_json(),
            "counts": [self.counts.rows, self.counts.late, self.counts.matches],
            "partitions": partitions_to_json(self._engine),
        }
        waiting = pa.concat_tables(self._waiting) if self._waiting else None
        return encode(Saved(header, waiting))

    def restore(self, state: bytes) -> None:
        """Goes on from what `state` gave; what this run remembered is forgotten.

        Raises:
            StateError: Not a saved state, or that of another rule, version or set of columns.
        """
        saved = decode(state)
        header = saved.header
        if header["rule"] != self.bound.rule.hash:
            raise StateError(f"the saved state is of rule hash {header['rule']}, this rule's is {self.bound.rule.hash}")
        if header["columns"] != {name: kind.name for name, kind in self.bound.columns.items()}:
            raise StateError("the saved state is of the same rule over other columns")
        self._streams = StreamNumbers.of(header["streams"])
        self._site = Site.from_json(header["site"])
        self._clock.restore(header["clock"])
        self._emitter.restore(header["emitter"])
        self.counts = Counts(*header["counts"])
        self._waiting = [] if saved.waiting is None else [saved.waiting]
        self._waiting_min_us = None if saved.waiting is None else pc.min(saved.waiting.column(TIME)).as_py()
        self._attach()
        for key, remembered in partitions_from_json(header["partitions"]):
            self._engine.put(key, remembered)

    # From arrival to release.

    def _attach(self) -> None:
        self._engine = Engine(self.bound, self._site, is_strict=self.is_strict)
        self._narrator = Narrator(self.bound, self._engine.places, self._streams.names)

    def _observe(self, table: pa.Table) -> None:
        if not self._reads_situations:
            for source, newest in newest_by_source(table):
                self._clock.observe(source, newest)
            return
        is_situation = pc.equal(table.column("type"), SITUATION)
        for rows, revives in (
            (table.filter(pc.invert(is_situation)), True),
            (self._read_of(table.filter(is_situation)), False),
        ):
            for source, newest in newest_by_source(rows):
                self._clock.observe(source, newest, revives=revives)

    def _read_of(self, situations: pa.Table) -> pa.Table:
        """Those of the rules that are read: what a rule means does not depend on which others run beside it."""
        if None in self._rules_read or not situations.num_rows:
            return situations
        return situations.filter(pc.is_in(situations.column("rule"), pa.array(list(self._rules_read))))

    def _take(self, table: pa.Table) -> tuple[EventRef, ...]:
        """Holds the rows that are in time; the others."""
        rows = rows_of(self.bound.inputs, table, self._streams, self._engine.places)
        if rows is None:
            return ()
        late: tuple[EventRef, ...] = ()
        if self._clock.watermark_us is not None:
            is_late = np.asarray(rows.column(TIME)) < self._clock.watermark_us
            if is_late.any():
                late = tuple(dict.fromkeys(self._refs(rows.filter(pa.array(is_late)))))  # of several arms, once
                rows = rows.filter(pa.array(~is_late))
        self.counts.late += len(late)
        self.counts.rows += rows.num_rows
        if rows.num_rows:
            self._wait(rows)
        return late

    def _wait(self, rows: pa.Table) -> None:
        self._waiting.append(rows)
        oldest = pc.min(rows.column(TIME)).as_py()
        self._waiting_min_us = oldest if self._waiting_min_us is None else min(self._waiting_min_us, oldest)

    def _advance(self) -> tuple[Match, ...]:
        """The matches that the watermark, where it stands now, makes final."""
        before_us, watermark_us = self._clock.watermark_us, self._clock.advance()
        if watermark_us is None:
            return ()
        found = self._engine.take(self._released(watermark_us))
        found += self._engine.expire(watermark_us)
        matches = self._emitted(found)
        self._emitter.forget(watermark_us)
        self._limit(before_us, watermark_us)
        return matches

    # What limits cost.

    def _outcome(self, matches: tuple[Match, ...], late: tuple[EventRef, ...] = ()) -> Outcome:
        given_up, self._given_up = tuple(self._given_up), []
        return Outcome(matches, late, given_up)

    def _limit(self, before_us: int | None, watermark_us: int) -> None:
        """Forgets what is too much or too old, now that the watermark has moved."""
        self._note_threads()
        if self.is_strict:
            return
        limits = self.bound.limits
        silent_us = limits.expired_before_us(before_us, watermark_us)
        if silent_us is not None:
            losses = self._engine.give_up_silent(silent_us)
            self._note(f"a partition had no row for {limits.expiry}, which is the limit `expiry`", losses)
        self._note(*self._engine.limit_partitions())

    def _note_threads(self) -> None:
        for loss in self._engine.losses():
            most = self.bound.limits.threads
            self._note(f"a partition has {loss.threads} partial matches; the limit `threads` is {most}", [loss])

    def _note(self, why: str, losses: Sequence[Loss]) -> None:
        if losses:
            oldest = min(losses, key=lambda loss: loss.since_us)
            kinds = (self.bound.columns[name] for name in self.bound.keys)
            partition = {
                name: as_python(value, kind)
                for name, value, kind in zip(self.bound.keys, oldest.key, kinds, strict=True)
            }
            total = sum(loss.threads for loss in losses)
            self._given_up.append(GivenUp(partition, total, why, nearest_time(oldest.since_us), len(losses)))

    def _released(self, before_us: int | None) -> pa.Table:
        """The rows that are final, in the total order; they wait no longer."""
        nothing = self._waiting_min_us is None or (before_us is not None and self._waiting_min_us >= before_us)
        if nothing:
            return pa.table({TIME: pa.array([], pa.int64())})
        waiting = pa.concat_tables(self._waiting).combine_chunks()
        self._waiting, self._waiting_min_us = [], None
        if before_us is not None:
            is_final = np.asarray(waiting.column(TIME)) < before_us
            if not is_final.all():
                self._wait(waiting.filter(pa.array(~is_final)))
                waiting = waiting.filter(pa.array(is_final))
        return in_total_order(waiting, self._streams)

    def _emitted(self, found: list[tuple[Key, Found]]) -> tuple[Match, ...]:
        """The matches that become situations, in the order in which they were decided."""
        newest_us, names = self._clock.newest_us(), self._streams.names
        found = sorted(found, key=lambda pair: decided_order(pair[1], names))
        made = self._narrator.matches(Finds.of(found)) if found else ()
        matches = []
        for (_, each), match in zip(found, made, strict=True):
            now_us = newest_us if each.decided_us is None else each.decided_us
            if self._emitter.lets_through(match, now_us):
                matches.append(match)
        self.counts.matches += len(matches)
        return tuple(matches)

    def _refs(self, rows: pa.Table) -> Iterable[EventRef]:
        columns = [rows.column(name).to_pylist() for name in (STREAM, SEQUENCE, TIME)]
        return (event_ref(each, self._streams.names) for each in zip(*columns, strict=True))


def decided_order(found: Found, names: Sequence[str]) -> tuple[Any, ...]:
    """By deciding time, time itself before its rows and timers after; then by the deciding and the first event."""
    stream, sequence, time_us = found.first
    first = (time_us, names[stream], sequence)
    if found.decided_us is None:
        return (1, 0, 0, "", 0, *first)
    if found.decided_by is None:
        return (0, found.decided_us, 0, "", 0, *first)
    if found.decided_by[0] == TIMER_STREAM:
        return (0, found.decided_us, 2, "", 0, *first)
    return (0, found.decided_us, 1, names[found.decided_by[0]], found.decided_by[1], *first)


def needs(bound: BoundRule, event: EventType, *, needs_calibration: bool) -> bool:
    """Whether the rule can have use for what the event says of a camera."""
    shared = bound.rule.shared
    if isinstance(event, ZoneDefined | ZoneRemoved):
        return event.zone in shared
    return not isinstance(event, CameraCalibrated | SceneChanged) or bool(shared) or needs_calibration


def as_table(rows: Rows) -> pa.Table:
    """The rows as a table."""
    return pa.Table.from_batches([rows]) if isinstance(rows, pa.RecordBatch) else rows


def wall_us(now: datetime) -> int:
    """The time as whole microseconds since 1970."""
    value = as_microseconds(now)
    assert isinstance(value, int)
    return value
