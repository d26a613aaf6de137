"""What a match says: its measures, its title, where each of its rows came from, and its identity."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import chain
from typing import Any

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Column, Crosses, Expr, InZone, Kind, OnGround, Reference, walk
from patterns.binding.guards import compile_guard
from patterns.binding.registers import UNSET
from patterns.binding.titles import Scalar, filled_titles
from patterns.durations import MICROSECOND
from patterns.engine.finds import Events, Finds
from patterns.engine.json_texts import json_texts
from patterns.engine.matcher import Event
from patterns.errors import MatchError
from patterns.files.rule import Rule
from patterns.scene.geometry import Line, Zone
from patterns.scene.places import Places
from patterns.scene.site import CALIBRATION

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EARLIEST = datetime(1, 1, 1, tzinfo=UTC)
_LATEST = datetime(9999, 12, 31, 23, 59, 59, 999_999, tzinfo=UTC)
_EARLIEST_US, _LATEST_US = ((each - _EPOCH) // MICROSECOND for each in (_EARLIEST, _LATEST))
_ENCODER = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class EventRef:
    """One event: its stream (`station/source/type`), its sequence there, and when it happened."""

    stream: str
    sequence: int
    time: datetime


@dataclass(frozen=True, slots=True)
class EventRange:
    """Rows that follow each other in the match's partition and are of one stream.

    They are the events of the partition between the two sequences; `rows` says how many.
    """

    stream: str
    first_sequence: int
    last_sequence: int
    rows: int


class Match:
    """One final match of a rule. What it says was decided with it, and never changes."""

    __slots__ = ("at", "said")

    _SAID = (
        "rule", "version", "rule_hash", "severity", "title", "partition", "measures", "first", "last", "decided_at",
        "lineage", "judged_by", "situation_id",
    )  # fmt: skip

    def __init__(self, said: "Said", at: int) -> None:
        """One of those that were found together, and its place among them."""
        self.said = said
        self.at = at

    def __eq__(self, other: object) -> bool:
        """Whether both say the same."""
        if not isinstance(other, Match):
            return NotImplemented
        return all(getattr(self, name) == getattr(other, name) for name in self._SAID)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """All that it says."""
        return f"Match({', '.join(f'{name}={getattr(self, name)!r}' for name in self._SAID)})"

    @property
    def rule(self) -> str:
        """The rule's name."""
        return self.said.rule.rule

    @property
    def version(self) -> int:
        """The rule's version."""
        return self.said.rule.version

    @property
    def rule_hash(self) -> str:
        """The rule's hash."""
        return self.said.rule_hash

    @property
    def severity(self) -> str:
        """The rule's severity."""
        return self.said.rule.severity

    @property
    def title(self) -> str:
        """The rule's title, filled in."""
        (title,) = self.said.titles([self.at])
        return title

    @property
    def partition(self) -> dict[str, Scalar]:
        """The partition columns and their values."""
        return _one(self.said.partitions([self.at]))

    @property
    def measures(self) -> dict[str, Scalar]:
        """The measures in their order."""
        return _one(self.said.measures([self.at]))

    @property
    def first(self) -> EventRef:
        """The event of its first row."""
        return event_ref(self.said.finds.first.event(self.at), self.said.stream_names)

    @property
    def last(self) -> EventRef:
        """The event of its last row."""
        return event_ref(self.said.finds.last.event(self.at), self.said.stream_names)

    @property
    def decided_at(self) -> datetime | None:
        """The event time from which it was final: of the row that decided it, or of the end of its WITHIN.

        None: only the end of the input decided it.
        """
        decided_us = self.said.finds.decided_us[self.at]
        return None if decided_us is None else nearest_time(decided_us)

    @property
    def lineage(self) -> dict[str, tuple[EventRange, ...]]:
        """For each pattern variable that took rows, which."""
        ranges: dict[str, list[EventRange]] = {}
        for variable, stream, first, last, _, rows in self.said.finds.runs_of(self.at):
            each = EventRange(self.said.stream_names[stream], first, last, rows)
            ranges.setdefault(self.said.variables[variable], []).append(each)
        return {variable: tuple(each) for variable, each in ranges.items()}

    @property
    def judged_by(self) -> dict[str, tuple[EventRange, ...]]:
        """The events that drew what its rows were judged by.

        For each shared zone or line, and for the calibration, under `zone:NAME`, `line:NAME` and `calibration`.
        """
        return self.said.judged_by[self.at] if self.said.judged_by else {}

    @property
    def situation_id(self) -> str:
        """Its identity, see `situation_id`."""
        (identity,) = self.said.identities([self.at])
        return identity


def _one(columns: Mapping[str, Sequence[Scalar]]) -> dict[str, Scalar]:
    return {name: column[0] for name, column in columns.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What matches of one rule say that were found together, by column.

    Attributes:
        rule: The rule.
        rule_hash: Its hash.
        variables: The pattern's variables, by number.
        stream_names: The streams' names, by number.
        finds: What was found.
        keys: The partition columns' names and types.
        outputs: Names and types of the measures, and then of what the title shows beside.
        measured: How many of these are measures.
        values: By output its values, as the engine has them.
        judged_by: For each match what its rows were judged by; empty where events draw nothing for the rule.
    """

    rule: Rule
    rule_hash: str
    variables: Sequence[str]
    stream_names: Sequence[str]
    finds: Finds
    keys: Sequence[tuple[str, Kind]]
    outputs: Sequence[tuple[str, Kind]]
    measured: int
    values: Sequence[Sequence[Any]]
    judged_by: Sequence[dict[str, tuple[EventRange, ...]]]

    def partitions(self, places: Sequence[int]) -> dict[str, list[Scalar]]:
        """The partition columns of the matches at these places."""
        return _columns(self.keys, self.finds.keys, places)

    def measures(self, places: Sequence[int]) -> dict[str, list[Scalar]]:
        """The measures of the matches at these places, in their order."""
        return _columns(self.outputs[: self.measured], self.values, places)

    def titles(self, places: Sequence[int]) -> list[str]:
        """The titles of the matches at these places.

        A measure goes before a partition column, and this before any other column.
        """
        others = _columns(self.outputs[self.measured :], self.values[self.measured :], places)
        shown = {**others, **self.partitions(places), **self.measures(places)}
        return filled_titles(self.rule.title, shown, len(places))

    def identities(self, places: Sequence[int]) -> list[str]:
        """The identities of the matches at these places, see `situation_id`."""
        # The engine's times are microseconds already.
        keys = [json_texts([column[at] for at in places]) for column in self.finds.keys]
        partitions = map(",".join, zip(*keys, strict=True)) if keys else [""] * len(places)
        events = [_event_texts(each, self.stream_names, places) for each in (self.finds.first, self.finds.last)]
        begin = ",".join(json_texts(["situation/1", self.rule.rule, self.rule.version]))
        return [
            hashlib.sha256(f"[{begin},[{partition}],{first},{last}]".encode()).hexdigest()
            for partition, first, last in zip(partitions, *events, strict=True)
        ]


def _event_texts(events: Events, stream_names: Sequence[str], places: Sequence[int]) -> list[str]:
    """The events as identities write them."""
    names = json_texts(stream_names)
    streams, sequences, times_us = events
    return [f"[{names[streams[at]]},{sequences[at]},{times_us[at]}]" for at in places]


def _columns(
    named: Sequence[tuple[str, Kind]], columns: Sequence[Sequence[Any]], places: Sequence[int]
) -> dict[str, list[Scalar]]:
    """The values at these places as Python has them, by name."""
    return {
        name: as_pythons([column[at] for at in places], kind)
        for (name, kind), column in zip(named, columns, strict=False)
    }


def situation_id(rule: str, version: int, partition: Sequence[Any], first: EventRef, last: EventRef) -> str:
    """The identity of a situation: equal for the same match of the same rule version, wherever it is found.

    SHA-256, in hex, of the UTF-8 JSON array, without spaces,
    `["situation/1", rule, version, [partition values], [stream, sequence, time], [stream, sequence, time]]`
    with the first and the last event; times and durations are whole microseconds, since 1970 UTC.
    """
    events = [[event.stream, event.sequence, as_microseconds(event.time)] for event in (first, last)]
    content = ["situation/1", rule, version, [as_microseconds(value) for value in partition], *events]
    return hashlib.sha256(_ENCODER.encode(content).encode()).hexdigest()


class Narrator:
    """Makes matches of what the matcher found."""

    def __init__(self, bound: BoundRule, places: Places, stream_names: Sequence[str]) -> None:
        self.rule = bound.rule
        self.variables = bound.variables
        self.site = places.site
        self.stream_names = stream_names
        self.drawn = _drawn_by_events(bound)
        self.rule_hash = bound.rule.hash
        self.keys = [(name, bound.columns[name]) for name in bound.keys]
        slots = {slot: index for index, slot in enumerate(bound.slots)}
        registers = dict(bound.register_of)
        outputs = (*bound.measures, *bound.title_columns)
        self.outputs = [(output.name, output.value.kind) for output in outputs]
        self.measured = len(bound.measures)
        self.is_numbered = bound.is_numbered
        self.guards = [compile_guard(output.value, slots, registers, places) for output in outputs]
        self.plain = [_plain_register(output.value, registers) for output in outputs]
        self.are_times = [_is_other_time(output.value) for output in outputs]
        self.key_times = [at for at, (_, kind) in enumerate(self.keys) if kind is Kind.TIME]

    @property
    def needs_calibration(self) -> bool:
        """Whether the rule itself asks for metres."""
        return "calibration" in self.drawn

    def matches(self, finds: Finds) -> list[Match]:
        """What was found as matches, as they leave the engine; what they say is decided here.

        Raises:
            MatchError: A match has a time that no calendar has, or says what cannot be known, such as whether a
                point lies in a zone in metres while nothing is known of the camera.
        """
        values = self._values(finds)
        times = [column for column, is_time in zip(values, self.are_times, strict=True) if is_time]
        for column in (finds.first.times_us, finds.last.times_us, *times, *(finds.keys[at] for at in self.key_times)):
            _check_times(column)
        judged_by = [self._judged_by(finds, at) for at in range(len(finds))] if self.drawn else []
        said = Said(
            self.rule, self.rule_hash, self.variables, self.stream_names, finds, self.keys, self.outputs,
            self.measured, values, judged_by,
        )  # fmt: skip
        return [Match(said, at) for at in range(len(finds))]

    def _values(self, finds: Finds) -> list[Sequence[Any]]:
        """The measures' and then the title's values, as the engine has them."""
        remembered = [*finds.registers, finds.numbers] if self.is_numbered else finds.registers
        rows = list(zip(*remembered, strict=True)) if remembered else [()] * len(finds)
        return [
            [guard((), registers) for registers in rows] if at is None else _set(remembered[at])
            for guard, at in zip(self.guards, self.plain, strict=True)
        ]

    def _judged_by(self, finds: Finds, at: int) -> dict[str, tuple[EventRange, ...]]:
        streams = {self.stream_names[stream] for _, stream, *_ in finds.runs_of(at)}
        sources = {stream.split("/")[1] for stream in streams}
        first_us, last_us = finds.first.times_us[at], finds.last.times_us[at]
        versions = {label: self.site.judged_by(name, sources, first_us, last_us) for label, name in self.drawn.items()}
        if any(
            isinstance(each.said, Zone | Line) and each.said.units == "metres" for each in chain(*versions.values())
        ):
            versions["calibration"] = self.site.judged_by(CALIBRATION, sources, first_us, last_us)
        return {
            label: tuple(EventRange(each.stream, each.sequence, each.sequence, 1) for each in found)
            for label, found in versions.items()
            if found
        }


def _drawn_by_events(bound: BoundRule) -> dict[str, str]:
    """What the rule uses that events draw, by the label that a situation gives it."""
    rule = bound.rule
    drawn: dict[str, str] = {}
    if any(each.units == "metres" for each in (*rule.zones.values(), *rule.lines.values())):
        drawn["calibration"] = CALIBRATION
    guards = tuple(each.guard for each in bound.conditions if each.guard is not None)
    read = (part for each in bound.inputs for part in (*each.projected.values(), each.where) if part is not None)
    values = tuple(each.value for each in (*bound.measures, *bound.title_columns))
    for part in (part for expr in (*bound.predicates, *guards, *read, *values) for part in walk(expr)):
        if isinstance(part, InZone) and part.zone in rule.shared:
            drawn[f"zone:{part.zone}"] = part.zone
        elif isinstance(part, Crosses) and part.line in rule.shared:
            drawn[f"line:{part.line}"] = part.line
        elif isinstance(part, OnGround):
            drawn["calibration"] = CALIBRATION
    return drawn


def _is_other_time(value: Expr) -> bool:
    """Whether the value is a time, and not that of one of the match's rows, which lies between its first and last."""
    is_of_row = isinstance(value, Reference) and isinstance(value.operand, Column) and value.operand.name == "time"
    return value.kind is Kind.TIME and not is_of_row


def _plain_register(value: Expr, registers: Mapping[Expr, int]) -> int | None:
    """The register that holds the value as it is; None: it has to be computed."""
    is_one_of_several = isinstance(value, Reference) and value.offset != 0
    return None if is_one_of_several else registers.get(value)


def _set(column: Sequence[Any]) -> Sequence[Any]:
    """What a register held, NULL where nothing was written to it."""
    return [None if value is UNSET else value for value in column] if UNSET in column else column


def event_ref(event: Event, stream_names: Sequence[str]) -> EventRef:
    """The event with its stream's name and its time."""
    stream, sequence, time_us = event
    return EventRef(stream_names[stream], sequence, _time(time_us))


def as_python(value: Any, kind: Kind) -> Scalar:
    """A value of the engine as Python has it: times and durations are no longer microseconds."""
    (plain,) = as_pythons([value], kind)
    return plain


def as_pythons(values: list[Any], kind: Kind) -> list[Scalar]:
    """Values of the engine as Python has them: times and durations are no longer microseconds."""
    if kind is Kind.TIME:
        return [None if value is None else _time(value) for value in values]
    if kind is Kind.DURATION:
        return [None if value is None else timedelta(microseconds=value) for value in values]
    return values


def nearest_time(microseconds: int) -> datetime:
    """The time, or the first or last that there is: for bounds, such as the end of a WITHIN."""
    return _EPOCH + timedelta(microseconds=nearest_us(microseconds))


def nearest_us(microseconds: int) -> int:
    """The same, in microseconds since 1970."""
    return min(max(microseconds, _EARLIEST_US), _LATEST_US)


def _time(microseconds: int) -> datetime:
    if not _EARLIEST_US <= microseconds <= _LATEST_US:
        _check_times([microseconds])
    return _EPOCH + timedelta(0, 0, microseconds)


def _check_times(microseconds: Sequence[int | None]) -> None:
    for each in microseconds:
        if each is not None and not _EARLIEST_US <= each <= _LATEST_US:
            raise MatchError(f"a time must lie in the years 1 to 9999, got {each} us since 1970")


def as_microseconds(value: Scalar) -> bool | int | float | str | None:
    """The value with times and durations as whole microseconds again: what identities are made of."""
    if isinstance(value, datetime):
        since = value - _EPOCH
        return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds
    return value // MICROSECOND if isinstance(value, timedelta) else value
