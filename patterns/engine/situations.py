"""What a match says: its measures, its title, where each of its rows came from, and its identity."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import chain
from typing import Any

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Column, Crosses, Expr, InZone, Kind, OnGround, Reference, walk
from patterns.binding.guards import compile_guard
from patterns.binding.titles import Scalar, filled_title
from patterns.durations import MICROSECOND
from patterns.engine.matcher import Event, Found, runs
from patterns.errors import MatchError
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
    """One final match of a rule. What it says is made when it is first asked for, and never changes.

    Attributes:
        judged_by: The events that drew what its rows were judged by: for each shared zone or line, and
            for the calibration, under `zone:NAME`, `line:NAME` and `calibration`.
    """

    _SAID = (
        "rule", "version", "rule_hash", "severity", "title", "partition", "measures", "first", "last", "decided_at",
        "lineage", "judged_by", "situation_id",
    )  # fmt: skip

    def __init__(
        self,
        narrator: "Narrator",
        key: Sequence[Any],
        found: Found,
        judged_by: dict[str, tuple[EventRange, ...]],
    ) -> None:
        """What the matcher found, and what it was judged by."""
        self._narrator = narrator
        self._key = key
        self._found = found
        self.judged_by = judged_by

    def __eq__(self, other: object) -> bool:
        """Whether both say the same."""
        if not isinstance(other, Match):
            return NotImplemented
        return all(getattr(self, name) == getattr(other, name) for name in self._SAID)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """All that it says."""
        return f"Match({', '.join(f'{name}={getattr(self, name)!r}' for name in self._SAID)})"

    @cached_property
    def _values(self) -> Sequence[Any]:
        return self._narrator.values(self._found)

    @property
    def rule(self) -> str:
        """The rule's name."""
        return self._narrator.rule.rule

    @property
    def version(self) -> int:
        """The rule's version."""
        return self._narrator.rule.version

    @property
    def rule_hash(self) -> str:
        """The rule's hash."""
        return self._narrator.rule_hash

    @property
    def severity(self) -> str:
        """The rule's severity."""
        return self._narrator.rule.severity

    @cached_property
    def title(self) -> str:
        """The rule's title, filled in."""
        return self._narrator.title(self._values, self.partition, self.measures)

    @cached_property
    def partition(self) -> dict[str, Scalar]:
        """The partition columns and their values."""
        return self._narrator.partition(self._key)

    @cached_property
    def measures(self) -> dict[str, Scalar]:
        """The measures in their order."""
        return self._narrator.measures(self._values)

    @cached_property
    def first(self) -> EventRef:
        """The event of its first row."""
        return event_ref(self._found.first, self._narrator.stream_names)

    @cached_property
    def last(self) -> EventRef:
        """The event of its last row."""
        return event_ref(self._found.ending.event, self._narrator.stream_names)

    @property
    def decided_at(self) -> datetime | None:
        """The event time from which it was final: of the row that decided it, or of the end of its WITHIN.

        None: only the end of the input decided it.
        """
        return None if self._found.decided_us is None else nearest_time(self._found.decided_us)

    @cached_property
    def lineage(self) -> dict[str, tuple[EventRange, ...]]:
        """For each pattern variable that took rows, which."""
        return self._narrator.lineage(self._found)

    @cached_property
    def situation_id(self) -> str:
        """Its identity, see `situation_id`."""
        return self._narrator.situation_id(self._key, self._found)


def situation_id(rule: str, version: int, partition: Sequence[Any], first: EventRef, last: EventRef) -> str:
    """The identity of a situation: equal for the same match of the same rule version, wherever it is found.

    SHA-256, in hex, of the UTF-8 JSON array, without spaces,
    `["situation/1", rule, version, [partition values], [stream, sequence, time], [stream, sequence, time]]`
    with the first and the last event; times and durations are whole microseconds, since 1970 UTC.
    """
    events = [(event.stream, event.sequence, as_microseconds(event.time)) for event in (first, last)]
    return _identity(rule, version, [as_microseconds(value) for value in partition], *events)


def _identity(
    rule: str, version: int, partition: Sequence[Any], first: tuple[str, int, Any], last: tuple[str, int, Any]
) -> str:
    content = ("situation/1", rule, version, partition, first, last)
    return hashlib.sha256(_ENCODER.encode(content).encode()).hexdigest()


class Narrator:
    """Makes matches of what the matcher found, and says for them what they say."""

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
        self.times = [
            guard for output, guard in zip(outputs, self.guards, strict=True) if _is_other_time(output.value)
        ]  # fmt: skip
        self.key_times = [at for at, (_, kind) in enumerate(self.keys) if kind is Kind.TIME]

    @property
    def needs_calibration(self) -> bool:
        """Whether the rule itself asks for metres."""
        return "calibration" in self.drawn

    def match(self, key: Sequence[Any], found: Found) -> Match:
        """The match as it leaves the engine.

        Raises:
            MatchError: It has a time that no calendar has.
        """
        _check_time(found.first[2])
        _check_time(found.ending.event[2])
        remembered = self._remembered(found)
        for guard in self.times:
            _check_time(guard((), remembered))
        for at in self.key_times:
            _check_time(key[at])
        return Match(self, key, found, self._judged_by(found) if self.drawn else {})

    def values(self, found: Found) -> list[Any]:
        """The measures' and then the title's values, as the engine has them."""
        remembered = self._remembered(found)
        return [guard((), remembered) for guard in self.guards]

    def _remembered(self, found: Found) -> Sequence[Any]:
        registers = found.ending.registers
        return (*registers, found.number) if self.is_numbered else registers

    def partition(self, key: Sequence[Any]) -> dict[str, Scalar]:
        """The partition columns and their values."""
        return {name: as_python(value, kind) for (name, kind), value in zip(self.keys, key, strict=True)}

    def measures(self, values: Sequence[Any]) -> dict[str, Scalar]:
        """The measures in their order."""
        measured = zip(self.outputs[: self.measured], values, strict=False)
        return {name: as_python(value, kind) for (name, kind), value in measured}

    def title(self, values: Sequence[Any], partition: dict[str, Scalar], measures: dict[str, Scalar]) -> str:
        """The rule's title, filled in; a measure goes before a partition column, and this before any other column."""
        columns = zip(self.outputs[self.measured :], values[self.measured :], strict=True)
        others = {name: as_python(value, kind) for (name, kind), value in columns}
        return filled_title(self.rule.title, {**others, **partition, **measures})

    def lineage(self, found: Found) -> dict[str, tuple[EventRange, ...]]:
        """For each pattern variable that took rows, which."""
        ranges: dict[str, list[EventRange]] = {}
        for _, variable, stream, first, last, _, rows in runs(found.ending.trace):
            each = EventRange(self.stream_names[stream], first, last, rows)
            ranges.setdefault(self.variables[variable], []).append(each)
        return {variable: tuple(each) for variable, each in ranges.items()}

    def situation_id(self, key: Sequence[Any], found: Found) -> str:
        """The identity, see `situation_id`: the engine's times are microseconds already."""
        first, last = (
            (self.stream_names[stream], sequence, time_us)
            for stream, sequence, time_us in (found.first, found.ending.event)
        )
        return _identity(self.rule.rule, self.rule.version, key, first, last)

    def _judged_by(self, found: Found) -> dict[str, tuple[EventRange, ...]]:
        streams = {self.stream_names[stream] for _, _, stream, *_ in runs(found.ending.trace)}
        sources = {stream.split("/")[1] for stream in streams}
        first_us, last_us = found.first[2], found.ending.event[2]
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


def event_ref(event: Event, stream_names: Sequence[str]) -> EventRef:
    """The event with its stream's name and its time."""
    stream, sequence, time_us = event
    return EventRef(stream_names[stream], sequence, _time(time_us))


def as_python(value: Any, kind: Kind) -> Scalar:
    """A value of the engine as Python has it: times and durations are no longer microseconds."""
    if value is None:
        return None
    if kind is Kind.TIME:
        return _time(value)
    plain: Scalar = timedelta(microseconds=value) if kind is Kind.DURATION else value
    return plain


def nearest_time(microseconds: int) -> datetime:
    """The time, or the first or last that there is: for bounds, such as the end of a WITHIN."""
    return _EPOCH + timedelta(microseconds=min(max(microseconds, _EARLIEST_US), _LATEST_US))


def _time(microseconds: int) -> datetime:
    _check_time(microseconds)
    return _EPOCH + timedelta(microseconds=microseconds)


def _check_time(microseconds: int | None) -> None:
    if microseconds is not None and not _EARLIEST_US <= microseconds <= _LATEST_US:
        raise MatchError(f"a time must lie in the years 1 to 9999, got {microseconds} us since 1970")


def as_microseconds(value: Scalar) -> bool | int | float | str | None:
    """The value with times and durations as whole microseconds again: what identities are made of."""
    if isinstance(value, datetime):
        since = value - _EPOCH
        return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds
    return value // MICROSECOND if isinstance(value, timedelta) else value
