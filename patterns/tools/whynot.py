"""Why a rule did not fire for a subject at a time: how far the best attempt came, and what it fell short by.

Contract: judges what it is given and reads nothing. The rows are those of the rule's input around the
time; the matches are those of a backtest, before `once_per` and `cooldown`, each with the one that held
it back. The answer names rows by stream and sequence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from enum import StrEnum

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from patterns.binding.bound import BoundRule
from patterns.binding.columns import ColumnEvaluator, Rows
from patterns.binding.inputs import rows_of
from patterns.binding.rows import SEQUENCE, STREAM, TIME, StreamNumbers, in_total_order, normalised
from patterns.durations import MICROSECOND
from patterns.engine.situations import EventRef, Match, as_microseconds, as_python, nearest_time
from patterns.scene.geometry import Line, Zone
from patterns.scene.places import Places
from patterns.scene.site import Site
from patterns.tools.attempts import Attempts, Best, Refused, Taken
from patterns.tools.shortfalls import Judge
from patterns.tools.telling import told_time

ROWS_MOST = 5_000
"""Most rows of a partition that attempts are made over: those nearest to the time."""


class Verdict(StrEnum):
    """What the answer comes to."""

    MATCHED = "matched"
    HELD_BACK = "held back"
    COVERED = "covered by another match"
    NOT_FINAL = "not final yet"
    FELL_SHORT = "fell short"
    STILL_OPEN = "still open"
    FILTERED_OUT = "filtered out"
    LATE = "late"
    NO_ROWS = "no rows"


@dataclass(frozen=True, slots=True)
class Decided:
    """A match of the rule; `held_by`: the one before it that held it back."""

    match: Match
    held_by: Match | None


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked.

    Attributes:
        at: The time at which the rule should have fired, or was expected to have begun to.
        subject: Track, plate, ...: the subject of rows, or the value of a partition column, as text; the source
            where a rule is partitioned by nothing else.
        source: Only rows of this source; None: of any.
        window: How far before and after the time is looked.
    """

    at: datetime
    subject: str
    source: str | None
    window: timedelta


@dataclass(frozen=True, slots=True)
class Past:
    """What is known of the time around the question.

    Attributes:
        rows: Rows of the rule's input in the window, in any order, with the envelope.
        late: Stream and sequence of those that came too late to take part.
        decided: The rule's matches in the window, in the order in which they were decided.
        site: What the log said of the cameras.
        watermark: No row before this time is still expected; None: the input has ended, all is final.
        newest: Time of the newest event of the input; None: that of the rows.
        is_cut_before: Whether there are earlier rows than those of the window.
        is_cut_after: Whether there are later ones.
    """

    rows: pa.Table
    late: frozenset[tuple[str, int]] = frozenset()
    decided: Sequence[Decided] = ()
    site: Site = field(default_factory=Site)
    watermark: datetime | None = None
    newest: datetime | None = None
    is_cut_before: bool = False
    is_cut_after: bool = False


@dataclass(frozen=True, slots=True)
class TriedRow:
    """A row, the variable that it was tried as, and what kept it from being that; nothing: it was taken."""

    event: EventRef
    variable: str
    shortfalls: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Answer:
    """Why, in words and rows.

    Attributes:
        verdict: What it comes to.
        headline: The same in one sentence.
        notes: What else there is to know, a sentence each.
        taken: The rows of the best attempt, in order.
        nearest: The row that came nearest to taking it further.
        ended: What the row at which it ended was refused as.
        missing: How many more rows it needed at least.
        match: The match that the verdict speaks of.
        partition: The partition columns.
    """

    verdict: Verdict
    headline: str
    notes: tuple[str, ...] = ()
    taken: tuple[TriedRow, ...] = ()
    nearest: TriedRow | None = None
    ended: tuple[TriedRow, ...] = ()
    missing: int = 0
    match: Match | None = None
    partition: Mapping[str, object] = field(default_factory=dict)


class SubjectUnclear(Exception):
    """The subject is in no row of the window, or in several partitions; the message lists what there is."""


def why_not(bound: BoundRule, question: Question, past: Past) -> Answer:
    """Why the rule did not fire for the subject at the time.

    Raises:
        SubjectUnclear: No row of the subject, or several partitions with rows of it.
        FrameSizeUnknown: A normalised zone or line, and no frame size of its source.
        MatchError: The rows do not fit the rule.
    """
    return _Case(bound, question, past).answer()


@dataclass(frozen=True, slots=True)
class _Partition:
    """The rows of one partition in their order, those of the window only."""

    table: pa.Table
    streams: StreamNumbers
    key: Mapping[str, object]

    def event(self, row: int) -> EventRef:
        stream, sequence, time_us = (self.table.column(name)[row].as_py() for name in (STREAM, SEQUENCE, TIME))
        return EventRef(self.streams.names[stream], sequence, nearest_time(time_us))


def _times_us(rows: pa.Table) -> np.ndarray:
    times: np.ndarray = rows.column("time").cast(pa.timestamp("us", "UTC")).cast(pa.int64()).to_numpy()
    return times


class _Case:
    """One question."""

    def __init__(self, bound: BoundRule, question: Question, past: Past) -> None:
        self.bound = bound
        self.question = question
        self.past = past
        self.places = Places(bound.rule.zones, bound.rule.lines, past.site)
        self.notes: list[str] = []

    def answer(self) -> Answer:
        own = self._own_rows()
        in_time = self._in_time(own)
        if in_time.num_rows == 0:
            return self._all_late(own)
        passed = rows_of(self.bound.inputs, in_time, StreamNumbers(), self.places)
        if passed is None:
            return self._all_filtered(in_time)
        if passed.num_rows < in_time.num_rows:
            self.notes.append(
                f"{in_time.num_rows - passed.num_rows} of {in_time.num_rows} rows do not pass the filter of FROM"
            )
        partition = self._partition_of(passed)
        return self._of_partition(partition)

    # From the subject to its partition.

    def _own_rows(self) -> pa.Table:
        rows = self.past.rows
        if self.question.source is not None:
            rows = rows.filter(pc.equal(rows.column("source"), self.question.source))
        own = rows.filter(pa.array(self._is_of_subject(rows)))
        if own.num_rows == 0:
            raise SubjectUnclear(self._nobody(rows))
        return own

    def _is_of_subject(self, rows: pa.Table) -> np.ndarray:
        is_own = np.zeros(rows.num_rows, dtype=bool)
        for name in self._subject_columns(rows):
            texts = rows.column(name).cast(pa.string())
            is_own |= np.asarray(pc.fill_null(pc.equal(texts, self.question.subject), False))
        return is_own

    def _subject_columns(self, rows: pa.Table) -> list[str]:
        names = dict.fromkeys(["subject", *self.bound.keys])
        others = {"source", "station", "type"} - ({"source"} if self._is_of_sources else set())
        return [name for name in names if name in rows.column_names and name not in others]

    @property
    def _is_of_sources(self) -> bool:
        """Whether a source is what the rule is about, as one that waits for what does not come."""
        return "source" in self.bound.keys and set(self.bound.keys) <= {"source", "station"}

    def _nobody(self, rows: pa.Table) -> str:
        question = self.question
        begin, end = (told_time(question.at + sign * question.window) for sign in (-1, 1))
        where = f" of source {question.source}" if question.source else ""
        said = f"no {' or '.join(sorted(self.bound.types))} of {question.subject!r}{where} between {begin} and {end}"
        others = self._subjects_by_distance(rows)
        if not others:
            return f"{said}, nor of anything else"
        return f"{said}; there are, nearest in time first: {', '.join(others[:8])}"

    def _subjects_by_distance(self, rows: pa.Table) -> list[str]:
        name = "source" if self._is_of_sources else "subject"
        if name not in rows.column_names:
            return []
        apart = [abs(time - self.question.at) for time in rows.column("time").to_pylist()]
        nearest: dict[str, timedelta] = {}
        for subject, each in zip(rows.column(name).to_pylist(), apart, strict=True):
            if subject is not None:
                nearest[subject] = min(each, nearest.get(subject, each))
        return sorted(nearest, key=lambda subject: (nearest[subject], subject))

    def _in_time(self, rows: pa.Table) -> pa.Table:
        names = _event_names(rows)
        is_late = np.array([name in self.past.late for name in names], dtype=bool)
        if is_late.any():
            self.notes.append(f"{int(is_late.sum())} of its {rows.num_rows} rows came too late to take part")
        return rows.filter(pa.array(~is_late))

    def _all_late(self, own: pa.Table) -> Answer:
        lateness = self.bound.rule.time.lateness.total_seconds()
        return Answer(
            Verdict.LATE,
            f"all {own.num_rows} rows came after the watermark had passed them, so none took part: they were more than "
            f"{lateness:g} s (time.lateness) older than the newest event of their input. Next: raise time.lateness",
        )

    def _all_filtered(self, rows: pa.Table) -> Answer:
        nearest_type = rows.column("type")[int(np.argmin(np.abs(_times_us(rows) - self._at_us)))].as_py()
        arm = next(each for each in self.bound.inputs if each.type == nearest_type)
        assert arm.where is not None, "without a filter all rows pass"
        streams = StreamNumbers()
        rows = rows.filter(pc.equal(rows.column("type"), nearest_type))
        table = in_total_order(normalised(rows, arm.reads, streams), streams)
        row = int(np.argmin(np.abs(table.column(TIME).to_numpy() - self._at_us)))
        shortfalls = Judge(self.bound, self._evaluator(table)).of(arm.where, "", row)
        nearest = TriedRow(_Partition(table, streams, {}).event(row), "WHERE", tuple(map(str, shortfalls)))
        return Answer(
            Verdict.FILTERED_OUT,
            f"none of its {rows.num_rows} rows passes the filter of FROM, so the pattern never saw it",
            tuple(self.notes),
            nearest=nearest,
        )

    def _partition_of(self, own: pa.Table) -> _Partition:
        keys = list(self.bound.keys)
        wanted = own.select(keys).group_by(keys).aggregate([]).to_pylist()
        if len(wanted) > 1:
            shown = "; ".join(", ".join(f"{name} {value}" for name, value in each.items()) for each in wanted)
            raise SubjectUnclear(f"{self.question.subject!r} is in {len(wanted)} partitions: {shown}")
        key = wanted[0] if wanted else {}
        streams = StreamNumbers()
        table = in_total_order(self._in_partition(key, streams), streams).combine_chunks()
        return _Partition(_nearest_rows(table, self._at_us), streams, key)

    def _in_partition(self, key: Mapping[str, object], streams: StreamNumbers) -> pa.Table:
        rows = self.past.rows
        in_time = np.array([name not in self.past.late for name in _event_names(rows)], dtype=bool)
        table = rows_of(self.bound.inputs, rows.filter(pa.array(in_time)), streams, self.places)
        assert table is not None, "there is the row that gave the key"
        for name, value in key.items():
            column = table.column(name)
            same = pc.is_null(column) if value is None else pc.equal(column, pa.scalar(value, column.type))
            table = table.filter(pc.fill_null(same, False))
        return table

    # From the partition to the answer.

    def _of_partition(self, partition: _Partition) -> Answer:
        self._note_elsewhere(partition)
        decided = [each for each in self.past.decided if dict(each.match.partition) == self._as_python(partition)]
        at_hand = next((each for each in decided if self._covers(each.match)), None)
        if at_hand is not None:
            return self._decided(at_hand, partition)
        self.notes += [
            f"it did match from {told_time(each.match.first.time)} to {told_time(each.match.last.time)}"
            for each in decided
        ]
        return self._attempted(partition, decided)

    def _note_elsewhere(self, partition: _Partition) -> None:
        """Notes zones and lines that no row of the partition can ever meet."""
        sources = set(partition.table.column("source").to_pylist())
        rule = self.bound.rule
        shapes: dict[str, Sequence[Zone | Line]] = {
            **{f"zone {name!r}": self.places.zones_named(name) for name in rule.zones},
            **{f"line {name!r}": self.places.lines_named(name) for name in rule.lines},
            **{
                f"shared {name!r}": [*self.places.zones_named(name), *self.places.lines_named(name)]
                for name in rule.shared
            },
        }
        for what, known in shapes.items():
            there = sorted({each.source for each in known})
            if not sources & set(there):
                self.notes.append(
                    f"{what} is of source {', '.join(there) or '(none)'}, and all rows here are of "
                    f"{', '.join(sorted(sources))}: no condition on it is ever true"
                )

    def _as_python(self, partition: _Partition) -> dict[str, object]:
        return {name: as_python(value, self.bound.columns[name]) for name, value in partition.key.items()}

    def _covers(self, match: Match) -> bool:
        """Whether the time lies between the match's first event and the moment that decided it."""
        return match.first.time <= self.question.at <= max(match.last.time, match.decided_at or match.last.time)

    def _decided(self, decided: Decided, partition: _Partition) -> Answer:
        match = decided.match
        span = f"from {told_time(match.first.time)} to {told_time(match.last.time)}"
        when = "at the end of the input" if match.decided_at is None else f"at {told_time(match.decided_at)}"
        if decided.held_by is None:
            verdict, headline = Verdict.MATCHED, f"it did match, {span}, and was a situation {when}"
        else:
            other = decided.held_by
            emit = self.bound.rule.emit
            cooldown = "for good" if emit.cooldown is None else f"for {emit.cooldown.total_seconds():g} s"
            before = told_time(other.decided_at or other.last.time)
            verdict = Verdict.HELD_BACK
            headline = (
                f"it did match, {span}, and was held back {when}: the situation of {before} holds others of its "
                f"{', '.join(emit.once_per or self.bound.keys)} back {cooldown} (emit)"
            )
        taken = _rows_of_match(match, partition)
        return Answer(verdict, headline, tuple(self.notes), taken, match=match, partition=self._as_python(partition))

    def _attempted(self, partition: _Partition, decided: Sequence[Decided]) -> Answer:
        times_us = partition.table.column(TIME).to_pylist()
        is_whole = not self.past.is_cut_before
        has_ended = self.past.watermark is None and not self.past.is_cut_after
        tries = Attempts(
            bound=self.bound,
            evaluator=self._evaluator(partition.table),
            times_us=times_us,
            near_us=self._at_us,
            is_whole=is_whole,
            has_ended=has_ended,
            until_us=self._until_us(times_us),
            key=tuple(partition.key.values()),
        )
        known = {as_microseconds(each.match.first.time) for each in decided}
        # The first rows of a window only serve PREV of those behind them: what is before them is not here.
        begin = 0 if is_whole else min(self.bound.reach, len(times_us) - 1)
        starts = [row for row, time in enumerate(times_us) if row >= begin and time not in known]
        best = tries.run(starts)
        for last in tries.complete:
            answer = self._complete(last, partition, decided)
            if answer is not None:
                return answer
        if best is None:
            return self._none(partition)
        due_us = tries.due_us(best.thread) if best.refused is None else None
        if due_us is not None:
            until = nearest_time(self._until_us(times_us))
            self.notes.append(f"TIMER is due at {told_time(nearest_time(due_us))}; time has come to {told_time(until)}")
        return self._fell_short(best, partition)

    def _until_us(self, times_us: Sequence[int]) -> int:
        """How far time has come: up to the watermark, or up to and with the newest event."""
        newest = self.past.watermark or self.past.newest
        value = as_microseconds(newest) if newest is not None else times_us[-1]
        assert isinstance(value, int)
        return value if self.past.watermark is not None else value + 1

    def _complete(self, last: Taken, partition: _Partition, decided: Sequence[Decided]) -> Answer | None:
        """An attempt that came to a match which the rule did not find: why."""
        rows = [self._event(each, partition) for each in last.rows()]
        begin, end = rows[0].time, rows[-1].time
        if not begin <= self.question.at <= end + self.question.window / 2:
            return None
        taken = self._taken_rows(last, partition)
        watermark = self.past.watermark
        cover = next((e.match for e in decided if e.match.first.time <= end and begin <= e.match.last.time), None)
        if cover is not None:
            other = f"{told_time(cover.first.time)} to {told_time(cover.last.time)}"
            headline = (
                f"rows from {told_time(begin)} to {told_time(end)} would match, but the match from {other} took "
                f"some of them: AFTER MATCH SKIP {self.bound.skip.value}"
            )
            verdict = Verdict.COVERED
        elif watermark is not None:
            headline = (
                f"rows from {told_time(begin)} to {told_time(end)} match, but that is not final: the watermark "
                f"stands at {told_time(watermark)}, because a source may still send earlier events"
            )
            verdict = Verdict.NOT_FINAL
        else:
            return None
        return Answer(verdict, headline, tuple(self.notes), taken, match=cover, partition=self._as_python(partition))

    def _none(self, partition: _Partition) -> Answer:
        return Answer(
            Verdict.NO_ROWS,
            f"no attempt begins in the {partition.table.num_rows} rows of the window",
            tuple(self.notes),
            partition=self._as_python(partition),
        )

    def _fell_short(self, best: Best, partition: _Partition) -> Answer:
        taken = () if best.thread.taken is None else self._taken_rows(best.thread.taken, partition)
        nearest = None if best.refused is None else _tried(best.refused, partition)
        is_open = best.ended_at is None and self.past.watermark is not None
        if best.ended_at is None:
            last = partition.event(partition.table.num_rows - 1)
            self.notes.append(f"no further row came after {told_time(last.time)}")
        came = f"{len(taken)} row{'s' if len(taken) > 1 else ''}" if taken else "not one row"
        headline = f"the best attempt took {came} and needed {best.missing} more"
        if nearest is not None:
            where = f"the row of {told_time(nearest.event.time)}"
            headline += f"; what came nearest to {nearest.variable} is {where}"
        return Answer(
            Verdict.STILL_OPEN if is_open else Verdict.FELL_SHORT,
            headline,
            tuple(self.notes),
            taken,
            nearest,
            tuple(_tried(each, partition) for each in best.ended),
            best.missing,
            partition=self._as_python(partition),
        )

    def _taken_rows(self, last: Taken, partition: _Partition) -> tuple[TriedRow, ...]:
        return tuple(TriedRow(self._event(each, partition), each.variable) for each in last.rows())

    def _event(self, taken: Taken, partition: _Partition) -> EventRef:
        """The row's event; a virtual row is that which set it, at the time when it was due."""
        event = partition.event(taken.row)
        return event if taken.due_us is None else replace(event, time=nearest_time(taken.due_us))

    def _evaluator(self, table: pa.Table) -> ColumnEvaluator:
        return ColumnEvaluator(Rows(table, np.arange(table.num_rows, dtype=np.int64)), self.places)

    @property
    def _at_us(self) -> int:
        value = as_microseconds(self.question.at)
        assert isinstance(value, int)
        return value


def default_window(bound: BoundRule) -> timedelta:
    """How far around a time attempts are looked for: the rule's WITHIN, else a minute."""
    return timedelta(minutes=1) if bound.within_us is None else bound.within_us * MICROSECOND


def _tried(refused: Refused, partition: _Partition) -> TriedRow:
    return TriedRow(partition.event(refused.row), refused.variable, tuple(map(str, refused.shortfalls)))


def _rows_of_match(match: Match, partition: _Partition) -> tuple[TriedRow, ...]:
    """The rows of the match that lie in the window, in order."""
    events = [partition.event(row) for row in range(partition.table.num_rows)]
    return tuple(
        TriedRow(event, variable)
        for event in events
        for variable, ranges in match.lineage.items()
        if any(
            each.stream == event.stream and each.first_sequence <= event.sequence <= each.last_sequence
            for each in ranges
        )
    )


def _event_names(rows: pa.Table) -> list[tuple[str, int]]:
    columns = [rows.column(name).to_pylist() for name in ("station", "source", "type", "sequence")]
    return [
        (f"{station}/{source}/{type_}", sequence) for station, source, type_, sequence in zip(*columns, strict=True)
    ]


def _nearest_rows(table: pa.Table, at_us: int) -> pa.Table:
    """At most `ROWS_MOST` rows, those around the time."""
    if table.num_rows <= ROWS_MOST:
        return table
    middle = int(np.searchsorted(table.column(TIME).to_numpy(), at_us))
    begin = min(max(middle - ROWS_MOST // 2, 0), table.num_rows - ROWS_MOST)
    return table.slice(begin, ROWS_MOST).combine_chunks()
